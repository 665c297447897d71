"""The Debian packages that the lab needs on the host, and the packages of imud that a run installs."""

import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tests.lab.host.environment import ROOT
from tests.lab.host.errors import LabError
from tests.lab.host.packages import install, installed_versions
from tests.lab_debian.host.release import AMD64, ARM64, Release

NEEDED = ("mmdebstrap", "e2fsprogs", "kmod", "cpio", "debhelper")
EMULATORS = {
    "amd64": ("qemu-system-x86",),
    "arm64": ("qemu-system-arm", "qemu-user-static", "binfmt-support", "arch-test"),
}
"""QEMU's package for the virtual machine and for emulated maintainer scripts, by foreign architecture."""
BUILD = ROOT / "packaging" / "debian" / "build"
BUILD_LIMIT_S = 30 * 60  # limit for make deb
NEXT = "+lab1"


def missing(release: Release) -> list[str]:
    """Return the names of the Debian packages that a run of `release` needs and that are not installed."""
    names = [*NEEDED, *EMULATORS[release.architecture]]
    present = installed_versions(names)
    return [name for name in names if name not in present]


def obstacle(release: Release) -> str:
    """Return why this host cannot run `release`, one line; empty if it can."""
    if platform.machine() != "x86_64":
        return f"expected an x86_64 host, got {platform.machine()}"
    if os.geteuid() != 0:
        return "cannot build root file systems without root; run as root"
    if shutil.which("apt-get") is None:
        return "cannot find apt-get: the lab installs Debian from the archives of the host's apt"
    if absent := missing(release):
        return f"missing Debian packages: {' '.join(absent)}; try make {deps_target(release)}"
    return ""


def deps_target(release: Release) -> str:
    return "lab-debian-deps" if release.architecture == "amd64" else "lab-arm64-deps"


def build(release: Release, python: Path) -> Path:
    """Build the package of imud for `release` like `make deb`, and return it. Raises LabError with its last line."""
    command = [str(BUILD), release.suite, release.architecture]
    environment = {**os.environ, "PYTHON": str(python)}
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False, env=environment, cwd=ROOT
        )
    except subprocess.TimeoutExpired as error:
        raise LabError(f"cannot build the package within {BUILD_LIMIT_S} s") from error
    lines = [line for line in (result.stdout + result.stderr).splitlines() if line.strip()]
    if result.returncode:
        raise LabError(f"cannot build the package: {lines[-1] if lines else 'no output'}")
    return Path(result.stdout.splitlines()[-1])


def next_version(package: Path, folder: Path) -> Path:
    """Build the same package with a later version in `folder`, for an upgrade, and return it."""
    tree = folder / "tree"
    try:
        subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(tree)], check=True, timeout=BUILD_LIMIT_S)
        control = tree / "DEBIAN" / "control"
        control.write_text(later(control.read_text(encoding="utf-8")), encoding="utf-8")
        result = folder / "next.deb"
        pack = ["dpkg-deb", "--root-owner-group", "-Zgzip", "-z1", "--build", str(tree), str(result)]
        subprocess.run(pack, check=True, timeout=BUILD_LIMIT_S, stdout=subprocess.DEVNULL)
    except (subprocess.SubprocessError, OSError) as error:
        raise LabError(f"cannot build the package for the upgrade: {error}") from error
    finally:
        shutil.rmtree(tree, ignore_errors=True)
    return result


def later(control: str) -> str:
    """Return a control file with a later version. Raises LabError if the file has no version."""
    changed, count = re.subn(r"^(Version: .*)$", rf"\1{NEXT}", control, flags=re.MULTILINE)
    if count != 1:
        raise LabError(f"expected one version in the control file, got {count}")
    return changed


def main(arguments: list[str]) -> int:
    """Run `deps amd64` or `deps arm64`: install the missing packages. Return 0 if all packages are installed."""
    try:
        if len(arguments) != 1 or arguments[0] not in EMULATORS:
            raise LabError(f"usage: tests/lab_debian/deps {{amd64|arm64}}, got: {' '.join(arguments)}")
        release = (AMD64 if arguments[0] == "amd64" else ARM64)[0]
        if absent := missing(release):
            install(absent)
        print("lab-debian: all packages are installed")
    except LabError as error:
        print(f"lab-debian: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
