"""Build of the kernel `imud/_kernel.c` and of the plots of `imud web`: hook of hatchling, and a program for a checkout.

The kernel is optional. Without a C compiler or the headers of Python, or with IMUD_KERNEL=0, the build prints one line,
and imud uses its Python code. The kernel uses the limited API: one file works with Python 3.11 and all later versions.

uPlot, which draws the plots, is optional. npm installs it. Without npm or the network, the build prints one line, and
`imud web` shows no plots. An sdist contains the files of uPlot, so a build of an sdist needs no npm.
"""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zlib import crc32

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # as a program, without hatchling
    BuildHookInterface = object  # type: ignore[assignment,misc]

SOURCE = "imud/_kernel.c"
LIBRARY = "imud/_kernel.abi3.so"
# -ffp-contract=off: a fused product and sum would give other time stamps than Python
OPTIONS = ("-std=c11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-fno-strict-aliasing")


def compile_kernel(root: Path, compiler: str = "", options: tuple[str, ...] = ()) -> str:
    """Compile the kernel below `root`. Return the reason if that is not possible, otherwise an empty text."""
    command = shlex.split(compiler or os.environ.get("CC", "") or "cc")
    # a cross compiler needs the headers of its target: folders separated by `:`
    folders = (os.environ.get("IMUD_PYTHON_INCLUDE") or sysconfig.get_paths()["include"]).split(":")
    includes = [f"-I{folder}" for folder in folders]
    target = root / LIBRARY
    made = target.with_suffix(f".{os.getpid()}")  # a running imud keeps the old file
    source = root / SOURCE
    # imud does not use a library of another source
    version = f"-DSOURCE_CRC={crc32(source.read_bytes())}u"
    try:
        subprocess.run(
            [*command, *OPTIONS, *options, version, *includes, str(source), "-o", str(made), "-lm"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        made.replace(target)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    except subprocess.CalledProcessError as error:
        made.unlink(missing_ok=True)
        return next((line for line in error.stderr.splitlines() if "error" in line), f"status {error.returncode}")
    return ""


# For another version: `npm install --package-lock-only --omit-lockfile-registry-resolved uplot@VERSION` in the folder
# LOCK, then `sha256sum` of the files. npm compares the archive with the lock file. A build compares the files, because
# an sdist contains only them.
LOCK = "packaging/web"
UPLOT = "imud/web/static/uplot"
UPLOT_FILES = {
    "dist/uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "dist/uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    "LICENSE": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
}
"""Files of uPlot that a build contains, and their SHA-256."""
NPM = ("npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error", "--fetch-retries=1")
NPM_S = 120
"""Maximum duration of npm, s."""
WITHOUT_UPLOT = (
    "imud is built without uPlot, imud web shows no plots: {}, then build again (in a checkout: python hatch_build.py)"
)


def different_file(folder: Path) -> str:
    """Return the first file of uPlot in `folder` that has another SHA-256, and both values; empty if all are right."""
    for name, expected in UPLOT_FILES.items():
        path = folder / name
        got = sha256(path.read_bytes()).hexdigest() if path.is_file() else "no file"
        if got != expected:
            return f"{name}: expected the SHA-256 {expected}, got {got}"
    return ""


def run_npm(root: Path, folder: str) -> str:
    """Install the npm package in `folder`. Return the reason if that is not possible, otherwise an empty text."""
    if shutil.which(NPM[0]) is None:
        return "npm is missing; install npm"
    try:
        for name in ("package.json", "package-lock.json"):
            shutil.copy(root / LOCK / name, folder)
        subprocess.run(NPM, cwd=folder, check=True, capture_output=True, text=True, timeout=NPM_S)
    except subprocess.CalledProcessError as error:
        lines = error.stderr.splitlines() or [f"status {error.returncode}"]
        return f"npm ci failed: {lines[0]}; connect this host to the registry of npm"
    except subprocess.TimeoutExpired:
        return f"npm ci did not end in {NPM_S} s; connect this host to the registry of npm"
    except OSError as error:
        return f"{error}; correct the checkout"
    return ""


def install_uplot(root: Path) -> str:
    """Place the files of uPlot below `root`. Return the reason if that is not possible, otherwise an empty text."""
    target = root / UPLOT
    if not different_file(target):
        return ""
    shutil.rmtree(target, ignore_errors=True)  # a build must not contain other files
    with TemporaryDirectory() as folder:
        if problem := run_npm(root, folder):
            return problem
        package = Path(folder, "node_modules/uplot")
        if problem := different_file(package):
            return f"{problem}; correct UPLOT_FILES"
        for name in UPLOT_FILES:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(package / name, target / name)
    return ""


class BuildHook(BuildHookInterface):  # type: ignore[misc,type-arg,unused-ignore]
    """Adds uPlot to an sdist, and both to a wheel. For an editable installation, both are in the checkout."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Install uPlot and compile the kernel before the build."""
        if problem := install_uplot(Path(self.root)):
            print(WITHOUT_UPLOT.format(problem), file=sys.stderr)
        else:
            build_data["artifacts"] += [f"/{UPLOT}/{name}" for name in UPLOT_FILES]
        if self.target_name == "wheel":
            self._add_kernel(build_data)

    def _add_kernel(self, build_data: dict[str, Any]) -> None:
        is_off = os.environ.get("IMUD_KERNEL") == "0"
        problem = "IMUD_KERNEL=0" if is_off else compile_kernel(Path(self.root))
        if problem:
            print(f"imud is built without its C kernel, it uses more CPU time: {problem}", file=sys.stderr)
            return
        build_data["artifacts"].append(f"/{LIBRARY}")
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"cp311-abi3-{platform}"


def main() -> int:
    root = Path(__file__).parent
    problem = compile_kernel(root, options=tuple(sys.argv[1:]))
    print(problem or f"compiled {LIBRARY}")
    uplot_problem = install_uplot(root)
    print(WITHOUT_UPLOT.format(uplot_problem) if uplot_problem else f"{UPLOT} contains uPlot")
    return 1 if problem or uplot_problem else 0


if __name__ == "__main__":
    sys.exit(main())
