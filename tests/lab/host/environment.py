"""Program of the guest: the script that starts pytest or another command in the Python of the project.

Until the first test, the guest imports modules, several times slower than the host. Therefore `precompile` compiles
them, and pytest runs without the plugin of hypothesis, whose import took half of the collection (12 of 25 s on a busy
host, `python -X importtime -m pytest` in the guest). Tests with hypothesis work without the plugin.
"""

import contextlib
import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.lab.host.errors import LabError

ROOT = Path(__file__).resolve().parents[3]
TEST_LIMIT_S = 120  # per test: twice the normal limit, because the guest is several times slower than the host
PROBE_LIMIT_S = 300  # start of Python on a busy host
COMPILED = ("imud", "tests/conftest.py", "tests/lab", "tests/support")


@dataclass(frozen=True)
class Python:
    venv: Path
    base: Path


def find_python(venv: Path) -> Python:
    """Return the Python of `venv`. Raises LabError if it has no pytest or pytest-timeout."""
    interpreter = venv / "bin" / "python"
    if not os.access(interpreter, os.X_OK):
        raise LabError(f"cannot find Python at {interpreter}; create the virtual environment first, or use --venv")
    probe = [str(interpreter), "-c", "import sys, pytest, pytest_timeout; print(sys.base_prefix)"]
    try:
        result = subprocess.run(probe, capture_output=True, text=True, timeout=PROBE_LIMIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LabError(f"cannot start {interpreter} within {PROBE_LIMIT_S} s") from error
    if result.returncode:
        why = (result.stderr.strip().splitlines() or ["no output"])[-1]
        raise LabError(f"{interpreter} cannot run pytest: {why}")
    return Python(venv.absolute(), Path(result.stdout.strip()))


def precompile(python: Python) -> None:
    """Compile COMPILED to bytecode, which the guest can read but not write.

    Ignore failures, such as a read-only tree or a syntax error. The guest then needs more time or reports the error.
    """
    files = [str(ROOT / name) for name in COMPILED]
    command = [str(python.venv / "bin" / "python"), "-m", "compileall", "-q", *files]
    with contextlib.suppress(subprocess.TimeoutExpired):
        subprocess.run(command, capture_output=True, timeout=PROBE_LIMIT_S, check=False)


def pytest_command(python: Python, arguments: list[str]) -> list[str]:
    """Return the pytest command for tests/lab, or for `arguments`. The arguments are last and override the defaults."""
    return [
        *(str(python.venv / "bin" / "python"), "-m", "pytest", "-o", "testpaths=tests/lab"),
        *("-p", "no:cacheprovider", "-p", "no:hypothesispytest"),
        *("--junit-xml=/run/lab/junit.xml", f"--timeout={TEST_LIMIT_S}"),
        f"--color={'yes' if sys.stdout.isatty() else 'no'}",
        *arguments,
    ]


def script(python: Python, command: list[str]) -> str:
    """Return the shell script that runs `command` from the repository's root in a clean environment."""
    variables = {
        "PATH": f"{python.venv}/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/tmp",
        "LANG": "C.UTF-8", "TERM": os.environ.get("TERM", "dumb"), "COLUMNS": str(shutil.get_terminal_size().columns),
        "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": "1", "IMUD_LAB": "/run/lab",
    }  # fmt: skip
    settings = [f"{name}={value}" for name, value in variables.items()]
    return f"cd {shlex.quote(str(ROOT))} &&\nexec {shlex.join(['env', '-i', *settings, *command])}\n"


def shown_folders(python: Python) -> list[Path]:
    return [ROOT, python.venv, python.base]
