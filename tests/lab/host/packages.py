"""The Debian packages that the lab needs: list the missing packages, and install them on request.

As a program (`tests/lab/deps`), it installs the missing packages. With `--check`, it only lists them.
"""

import os
import re
import shutil
import subprocess
import sys

from tests.lab.host.errors import LabError

KERNEL_SOURCE = "linux-source-6.12"

PACKAGES = {
    "qemu-system-x86": "boots the kernel", KERNEL_SOURCE: "the kernel's source", "gcc": "builds the kernel",
    "libc6-dev": "builds the kernel", "make": "builds the kernel", "flex": "builds the kernel",
    "bison": "builds the kernel", "bc": "builds the kernel", "libelf-dev": "builds the kernel",
    "xz-utils": "unpacks the kernel's source", "kmod": "loads the module in the guest",
    "iproute2": "sets up interfaces in the guest", "i2c-tools": "independent peer of the tests",
    "spi-tools": "independent peer of the tests", "can-utils": "independent peer of the tests",
    "gpiod": "independent peer of the tests", "gpsd": "independent peer of the tests, also outside of the lab",
    "chrony": "independent peer of the tests, also outside of the lab",
}  # fmt: skip


def installed_versions(names: list[str]) -> dict[str, str]:
    """Return the versions of the installed packages in `names`. Raises LabError without dpkg."""
    if shutil.which("dpkg-query") is None:
        raise LabError("cannot find dpkg-query: the lab needs Debian 12 or a derived system")
    query = ["dpkg-query", "--show", "--showformat=${Package} ${db:Status-Status} ${Version}\n", *names]
    listing = subprocess.run(query, capture_output=True, text=True, check=False).stdout
    rows = [line.split() for line in listing.splitlines()]
    return {row[0]: row[2] for row in rows if len(row) == 3 and row[1] == "installed"}


def missing() -> list[str]:
    present = installed_versions(list(PACKAGES))
    return [name for name in PACKAGES if name not in present]


def require_all() -> None:
    """Raise LabError with the missing packages and the command that installs them."""
    absent = missing()
    if absent:
        raise LabError(f"missing Debian packages: {' '.join(absent)}; try make lab-deps")


def kernel_source_version() -> str:
    """Return the installed version of the kernel's source package, such as 6.12.117-1~deb12u1."""
    return installed_versions([KERNEL_SOURCE])[KERNEL_SOURCE]


def without_candidate(names: list[str]) -> list[str]:
    policy = subprocess.run(
        ["apt-cache", "policy", *names], capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"}
    ).stdout
    known = re.findall(r"^(\S+):\n  Installed: .*\n  Candidate: (?!\(none\))", policy, re.MULTILINE)
    return [name for name in names if name not in known]


def install(names: list[str]) -> None:
    """Install packages with apt-get, with sudo for other users than root. Raises LabError if apt-get fails."""
    prefix = [] if os.geteuid() == 0 else ["sudo"]
    if prefix and shutil.which("sudo") is None:
        raise LabError(f"cannot install packages without root or sudo; run as root: apt-get install {' '.join(names)}")
    if subprocess.run([*prefix, "apt-get", "update"], check=False).returncode:
        raise LabError("apt-get update failed")
    unknown = without_candidate(names)
    if unknown:
        raise LabError(
            f"apt has no candidate for: {' '.join(unknown)} (Debian 12 has {KERNEL_SOURCE} in bookworm-security)"
        )
    command = [*prefix, "apt-get", "install", "--yes", "--no-install-recommends", *names]
    if subprocess.run(command, check=False).returncode:
        raise LabError(f"apt-get install failed: {' '.join(names)}")


def main(arguments: list[str]) -> int:
    """Run `deps` or `deps --check`. Return 0 if all packages are installed at the end, otherwise 1 with one line."""
    try:
        if arguments not in ([], ["--check"]):
            raise LabError(f"usage: tests/lab/deps [--check], got: {' '.join(arguments)}")
        if arguments:
            require_all()
        elif absent := missing():
            install(absent)
        print("lab: all packages are installed")
    except LabError as error:
        print(f"lab: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
