"""Programs of a foreign architecture. The kernel of the host runs them with qemu-user (binfmt_misc).

`built` makes their root file system once per change of its inputs: Python and compiler of the release, only unpacked,
so that no maintainer script needs emulation, and pytest. `command` runs a program there. It can change only the folder
of its run.
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from tests.lab.host import cache
from tests.lab.host.errors import LabError
from tests.lab_debian.host.image import CLEAN, bootstrap, enable_emulation
from tests.lab_debian.host.release import PYTHONS, Release

PACKAGES = ("base-files", "base-passwd", "dash", "coreutils", "python3", "gcc", "g++", "libc6-dev")
WHEELS = ("pytest>=8.2", "pytest-timeout>=2.3", "hypothesis>=6.100", "canopen>=2.3", "cantools>=39", "pynmea2>=1.19")
"""Packages of the Python Package Index that the tests import, in addition to imud and its package."""
MACHINES = {"arm64": "aarch64"}
TAGS = ("manylinux_2_17", "manylinux2014", "manylinux_2_28")
ROOT_NAME = "root"
SITE = "/opt/site"
PYCACHE = "pycache"
"""Folder of bytecode for later runs: compiling takes longer than the tests."""
NEEDED_BYTES = 2 << 30  # free space for a root file system
PIP_LIMIT_S = 600

ENTER = """\
set -eu
made=$1 work=$2 tree=$3
shift 3
root=$made/root
mount --bind "$root" "$root"
mount -o remount,bind,ro "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t tmpfs tmpfs "$root/tmp"
mount --bind "$work" "$root/mnt"
mkdir -p "$work/tree" "$work/pycache"
mount --bind "$tree" "$root/mnt/tree"
mount -o remount,bind,ro "$root/mnt/tree"
mount --bind "$made/pycache" "$root/mnt/pycache"
exec chroot "$root" "$@"
"""
"""Script in a mount namespace, so that no mount remains. /mnt is the run's folder, and /mnt/tree is the repository."""


def built(release: Release, python: Path, say: Callable[[str], None]) -> Path:
    """Return the folder of `release`; build it if it is not in the cache. `python` has pip. Raises LabError."""

    def make(folder: Path) -> None:
        say(f"{release.name}: unpacking Python, compiler and pytest (a minute, once)")
        make_root(release, python, folder)

    enable_emulation(release.architecture)
    return cache.get(f"programs-{release.name}-{key(release)}", make, NEEDED_BYTES, say, cache.cache_root("-debian"))


def key(release: Release) -> str:
    return cache.key_of(release.name.encode(), Path(__file__).read_bytes())


def make_root(release: Release, python: Path, folder: Path) -> None:
    root = folder / ROOT_NAME
    bootstrap(release, root, folder / "build.log", "extract", PACKAGES)
    for name in ("passwd", "group"):
        shutil.copy(root / f"usr/share/base-passwd/{name}.master", root / "etc" / name)
    for name, target in (("cc", "gcc"), ("c++", "g++")):  # normally created by maintainer scripts
        (root / "usr/bin" / name).symlink_to(target)
    for name in ("proc", "dev/shm", "tmp", "mnt"):
        (root / name).mkdir(parents=True, exist_ok=True)
    (folder / PYCACHE).mkdir()
    install_wheels(release, python, root / SITE.lstrip("/"))


def install_wheels(release: Release, python: Path, site: Path) -> None:
    """Unpack WHEELS for the release's Python and architecture with the host's pip. Raises LabError if pip fails."""
    machine = MACHINES[release.architecture]
    fits = ["--only-binary=:all:", "--implementation", "cp", "--python-version", PYTHONS[release.suite]]
    fits += [word for tag in TAGS for word in ("--platform", f"{tag}_{machine}")]
    command = [str(python), "-m", "pip", "install", "--quiet", "--no-compile", "--target", str(site), *fits, *WHEELS]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=PIP_LIMIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LabError(f"expected the end of pip within {PIP_LIMIT_S} s") from error
    if result.returncode:
        lines = [line for line in (result.stdout + result.stderr).splitlines() if line.strip()]
        raise LabError(f"wheels for {release.name}: {lines[-1] if lines else 'pip failed'}")


def command(made: Path, work: Path, tree: Path, words: list[str]) -> list[str]:
    """Return the command that runs `words` in `made` at low priority, with `work` as /mnt and `tree` as /mnt/tree."""
    enter = ["unshare", "--mount", "sh", "-c", ENTER, "sh"]
    return ["nice", "-n", "5", *enter, str(made), str(work), str(tree), *words]


def environment(*paths: str) -> dict[str, str]:
    """Return the environment of such a program, without variables of the host, and with `paths` for Python."""
    return {
        **CLEAN, "LC_ALL": "C.UTF-8", "PYTHONPYCACHEPREFIX": "/mnt/pycache",
        "HYPOTHESIS_STORAGE_DIRECTORY": "/mnt/hypothesis", "PYTHONPATH": os.pathsep.join(paths),
    }  # fmt: skip
