"""Builds the lab's kernel and its module from Debian's source package, once per change of their inputs.

The cache contains two folders. `kernel-<key>` contains the image and the files for building modules (key:
configuration, package version, this recipe). `lab-<key>` contains image and module (key: also the module's source). A
change of the module therefore takes seconds, not minutes.
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from tests.lab.host import cache
from tests.lab.host.errors import LabError
from tests.lab.host.packages import KERNEL_SOURCE, kernel_source_version

LAB = Path(__file__).resolve().parents[1]
CONFIG = LAB / "kernel.config"
MODULE_SOURCE = LAB / "kmod"
MODULE = "imud_lab.ko"
IMAGE = "bzImage"
ARCHIVE = Path("/usr/src") / f"{KERNEL_SOURCE}.tar.xz"
KERNEL_BUILD_BYTES = 3_000_000_000  # 1.9 GB used (du -s of a built tree, 6.12.117)
MODULE_BUILD_BYTES = 50_000_000  # free space for a build of the module
STEP_LIMIT_S = 4 * 3600  # 5 minutes on two idle cores, 40 minutes on a busy host
FROM_OUTER_MAKE = {"MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "ARCH", "CROSS_COMPILE"}
KEEP_FOR_MODULES = ("Makefile", "Module.symvers", ".config", "arch", "include", "scripts", "tools", IMAGE)


def built(say: Callable[[str], None]) -> Path:
    version = kernel_source_version()
    inputs = (CONFIG.read_bytes(), version.encode(), Path(__file__).read_bytes())
    module = [part for path in module_sources() for part in (path.name.encode(), path.read_bytes())]
    lab_name = f"lab-{cache.key_of(*inputs, *module)}"
    if found := cache.find(lab_name):
        return found

    def make_kernel(folder: Path) -> None:
        say(f"building kernel {version} (some minutes, once)")
        build_kernel(folder)

    def make_module(folder: Path) -> None:
        say("building the kernel module")
        build_module(folder, kernel)

    kernel = cache.get(f"kernel-{cache.key_of(*inputs)}", make_kernel, KERNEL_BUILD_BYTES, say)
    return cache.get(lab_name, make_module, MODULE_BUILD_BYTES, say)


def build_kernel(folder: Path) -> None:
    """Unpack, configure, compile and trim the kernel. `folder` then contains the remaining tree."""
    log = folder / "build.log"
    step(["tar", "--extract", "--file", str(ARCHIVE), "--strip-components=1"], folder, log)
    step(["make", "tinyconfig"], folder, log)
    shutil.copy(CONFIG, folder / CONFIG.name)
    step(["scripts/kconfig/merge_config.sh", "-m", ".config", CONFIG.name], folder, log)
    step(["make", "olddefconfig"], folder, log)
    require_config(CONFIG.read_text(encoding="ascii"), (folder / ".config").read_text(encoding="ascii"))
    step(["make", f"-j{jobs()}", IMAGE, "modules"], folder, log)
    shutil.copy(folder / "arch/x86/boot" / IMAGE, folder / IMAGE)
    trim(folder)


def build_module(folder: Path, kernel: Path) -> None:
    build = folder / "build"
    build.mkdir()
    for path in module_sources():
        shutil.copy(path, build)
    step(["make", "-C", str(kernel), f"M={build}", "modules"], folder, folder / "build.log")
    shutil.copy(build / MODULE, folder / MODULE)
    shutil.copy(kernel / IMAGE, folder / IMAGE)
    shutil.rmtree(build)


def module_sources() -> list[Path]:
    """Return the source files of the module, without files of an earlier build."""
    written = [path for path in MODULE_SOURCE.glob("[!.]*.[ch]") if not path.name.endswith(".mod.c")]
    return [*sorted(written), MODULE_SOURCE / "Makefile"]


def jobs() -> int:
    return len(os.sched_getaffinity(0))


def require_config(wanted: str, got: str) -> None:
    """Raise LabError if an option of the fragment is not in the configuration (missing dependency or new name)."""
    taken = set(got.splitlines())
    options = [line for line in wanted.splitlines() if line.startswith("CONFIG_")]
    unset = [line.split()[1] for line in wanted.splitlines() if line.endswith(" is not set")]
    lost = [line for line in options if line not in taken]
    lost += [f"{name} off" for name in unset if any(line.startswith(f"{name}=") for line in taken)]
    if lost:
        raise LabError(f"{CONFIG.name}: expected {', '.join(lost)} in the configuration of the kernel")


def trim(folder: Path) -> None:
    """Remove all files that a build of modules does not need: 1.9 GB become 135 MB."""
    _remove_all_but(folder, {*KEEP_FOR_MODULES, "build.log"})
    _remove_all_but(folder / "arch", {"x86"})
    _remove_all_but(folder / "tools", {"objtool"})


def _remove_all_but(folder: Path, kept: set[str]) -> None:
    for entry in folder.iterdir():
        if entry.name in kept:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def step(command: list[str], folder: Path, log: Path) -> None:
    """Run one step at low priority with its output in `log`. LabError quotes the first error line of the log."""
    environment = {name: value for name, value in os.environ.items() if name not in FROM_OUTER_MAKE}
    environment |= {"LC_ALL": "C", "KBUILD_BUILD_TIMESTAMP": "@0"}
    with open(log, "ab") as output:
        try:
            result = subprocess.run(
                ["nice", *command], cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT, timeout=STEP_LIMIT_S, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise LabError(f"build: {command[0]} took more than {STEP_LIMIT_S} s") from error
    if result.returncode:
        raise LabError(f"build: {' '.join(command[:2])} failed: {why(log)}")


def why(log: Path) -> str:
    """Return the first line of a build log with an error, or the last line."""
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if "error:" in line.lower() or "No space left" in line or "not found" in line]
    return next(iter(errors), lines[-1] if lines else "no output")
