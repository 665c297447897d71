"""The unit tests of codecs, clock, ring and C header on this architecture's Python, with Debian's pytest."""

from pathlib import Path

from tests.lab_debian.guest.checks import Checks, Failed
from tests.lab_debian.guest.system import PYTHON, SHARE, Host, run

LIMIT_S = 2400
FOLDERS = ("tests/formats", "tests/devices", "tests/clock", "tests/publishers/shm", "tests/client", "tests/include")
LOCAL = Path("/var/tmp/tree")
"""A copy in the guest: the share asks the host for every file."""


def check(checks: Checks, _host: Host) -> None:
    """One check per folder, on the package's own libraries."""
    run("cp", "--recursive", str(SHARE / "tree"), str(LOCAL))
    for folder in FOLDERS:
        with checks(f"pytest {folder}"):
            command = [
                "env",
                f"--chdir={LOCAL}",
                "PYTHONPATH=/usr/lib/python3/dist-packages",
                PYTHON,
                "-m",
                "pytest",
                "-q",
            ]
            command += ["-p", "no:cacheprovider", "-x", "--timeout=600", folder]
            result = run(*command, limit_s=LIMIT_S)
            print(f"       {(result.stdout.strip().splitlines() or ['no output'])[-1]}", flush=True)
            if result.returncode:
                raise Failed(result.stdout[-3000:])
