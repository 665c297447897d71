"""Copies of the tree in which pytest runs, and the test modules that a module of imud needs."""

import ast
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, Final

from tests.mutants.changes import ROOT

DOCUMENT_TESTS: Final = {"tests/test_docs.py", "tests/test_architecture.py"}
USERS: Final = ("-m", "not live and not thorough")
"""Options of pytest for the tests in other folders."""
LIMIT_S: Final = 900
"""Maximum time of one run of pytest."""


def tests_in(folder: Path) -> list[str]:
    """Return the test modules of a folder, without its subfolders and without tests of documents."""
    tests = [path.relative_to(ROOT).as_posix() for path in sorted(folder.glob("test_*.py"))]
    return [test for test in tests if test not in DOCUMENT_TESTS]


@cache
def rules() -> dict[str, Any]:
    """Return the constants TESTED_IN and ELSEWHERE of tests/test_architecture.py in the tree of ROOT."""
    nodes = ast.parse((ROOT / "tests/test_architecture.py").read_bytes()).body
    found = {ast.unparse(node.targets[0]): node.value for node in nodes if isinstance(node, ast.Assign)}
    return {name: ast.literal_eval(found[name]) for name in ("TESTED_IN", "ELSEWHERE")}


def stages(path: str) -> list[list[str]]:
    """Return the arguments of pytest for a module of imud: its tests, its folder, the subfolders, the folders above.

    The last stage has the tests in other folders that import the module, without slow tests. Tests of the whole daemon
    run for modules at the top only.
    """
    module = Path(path).with_suffix("")
    dotted = ".".join(module.parts)
    folders = [ROOT / "tests" / folder for folder in module.relative_to("imud").parents]
    name = re.compile(rf".*/test_{module.name.strip('_')}(_\w+)?\.py")
    own = [test for test in tests_in(folders[0]) if name.fullmatch(test)]
    tested_in = rules()["TESTED_IN"]
    first = own or ([f"tests/{tested_in[dotted]}"] if dotted in tested_in else [])
    below = sorted(folders[0].glob("*/**/")) if len(folders) > 1 else []
    found = [first, tests_in(folders[0]), [test for folder in below for test in tests_in(folder)]]
    found += map(tests_in, folders[1:-1])
    every = [folder for folder in sorted((ROOT / "tests").glob("**/")) if folder.name not in rules()["ELSEWHERE"]]
    found.append([test for folder in every for test in tests_in(folder) if dotted in (ROOT / test).read_text()])
    stage_of = {test: number for number, stage in reversed(list(enumerate(found))) for test in stage}
    own_stages = [[test for test in stage if stage_of[test] == number] for number, stage in enumerate(found)]
    if users := own_stages.pop():
        own_stages.append([*USERS, *users])
    return [stage for stage in own_stages if stage]


@dataclass
class Run:
    """The result of pytest: its exit status (None after a time-out), and output."""

    status: int | None
    output: str

    @property
    def passed(self) -> bool:
        """Whether no test failed; 5 means that no test was selected."""
        return self.status in (0, 5)

    @property
    def failed(self) -> list[str]:
        return re.findall(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - .*)?$", self.output, re.MULTILINE)


class Tree:
    """A copy of the tree for one job, with a virtual environment whose imud is the copy."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = folder / "tree"
        files = subprocess.run(
            ["git", "ls-files", "-coz", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True
        )
        for name in files.stdout.decode().split("\0"):
            if name and (ROOT / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)
        for path in (ROOT / "imud").glob("*.so"):  # git ignores the kernel; tests compare the Python code with it
            shutil.copy2(path, self.root / "imud")
        self.mtime = count(int(time.time()))
        self._make_environment()

    def _make_environment(self) -> None:
        own, (packages,) = self.root / ".venv", Path(sys.prefix).glob("lib/python*/site-packages")
        target = own / packages.relative_to(sys.prefix)
        for folder in (own / "bin", target):
            folder.mkdir(parents=True)
        shutil.copy(Path(sys.prefix, "pyvenv.cfg"), own)
        for path in Path(sys.prefix, "bin").iterdir():
            if path.name != "imud":
                (own / "bin" / path.name).symlink_to(path.resolve() if path.name.startswith("python") else path)
        for path in packages.iterdir():
            if path.name != "_editable_impl_imud.pth":
                (target / path.name).symlink_to(path)
        (target / "imud.pth").write_text(f"{self.root}\n")
        self.python = str(own / "bin" / "python")
        program = own / "bin" / "imud"
        program.write_text(f"#!{self.python}\nimport sys\nfrom imud.cli import main\nsys.exit(main())\n")
        program.chmod(0o755)
        self.environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {
            "PATH": f"{own / 'bin'}:{os.environ['PATH']}", "VIRTUAL_ENV": str(own), "COLUMNS": "400",
            "PYTHONPATH": str(self.root), "MUTANTS_JOB": str(self.folder),
        }  # fmt: skip
        for environment in (self.environment, {}):  # a test may start a child without environment variables
            command = [self.python, "-c", "import imud; print(imud.__file__)"]
            found = subprocess.run(command, cwd="/", env=environment, capture_output=True, text=True, check=True).stdout
            assert Path(found).is_relative_to(self.root), f"tests would import {found}, expected {self.root}"

    @contextmanager
    def changed(self, name: str, original: bytes, changed: bytes) -> Iterator[None]:
        self._write(name, changed)
        try:
            yield
        finally:
            self._write(name, original)

    def _write(self, name: str, content: bytes) -> None:
        """Write a file. Each version has its own mtime, so that Python never uses the bytecode of another."""
        path = self.root / name
        path.write_bytes(content)
        os.utime(path, (seconds := next(self.mtime), seconds))

    def pytest(self, *arguments: str) -> Run:
        """Run pytest in a process group of its own, then kill all processes that the tests left."""
        options = ["-x", "-q", "-p", "no:cacheprovider", "-rfE", "--tb=short", f"--basetemp={self.folder / 'tmp'}"]
        output = self.folder / "output"
        with output.open("wb") as file:
            process = subprocess.Popen(
                [self.python, "-m", "pytest", *options, *arguments], cwd=self.root, env=self.environment,
                stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
            try:
                status: int | None = process.wait(LIMIT_S)
            except subprocess.TimeoutExpired:
                status = None
            finally:
                self._kill_children(process.pid)
                process.wait()
        return Run(status, output.read_text(errors="replace"))

    def _kill_children(self, group: int) -> None:
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)
        for environ in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):  # the process ended
                if f"MUTANTS_JOB={self.folder}\0".encode() in environ.read_bytes():
                    os.kill(int(environ.parent.name), signal.SIGKILL)
