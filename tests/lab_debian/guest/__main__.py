"""The program in the guest: `python3 -m tests.lab_debian.guest [--short] ARCHITECTURE [GROUP...]` runs checks.

Exit status: 0 if all checks passed, 1 if a check failed.
"""

import argparse
import sys
from collections.abc import Callable
from typing import TypeAlias

from tests.lab_debian.guest import (
    buses,
    first_contact,
    installation,
    outputs,
    removal,
    replug,
    rights,
    sandbox,
    service,
    views,
)
from tests.lab_debian.guest.checks import Checks
from tests.lab_debian.guest.system import SHARE, Host, uptime_s

Group: TypeAlias = Callable[[Checks, Host], None]

GROUPS: dict[str, Group] = {
    "installation": installation.check, "service": service.check, "rights": rights.check, "sandbox": sandbox.check,
    "outputs": outputs.check, "views": views.check, "buses": buses.check, "replug": replug.check,
    "doctor": first_contact.check_doctor, "complaints": first_contact.check_complaints,
    "setup": first_contact.check_setup, "streaming": service.check_streaming, "removal": removal.check,
}  # fmt: skip
"""Groups in the order of execution. The first installs the package, the second leaves the service running."""
RUNS = {
    "amd64": (
        *("service", "rights", "sandbox", "outputs", "views", "buses", "replug", "doctor", "complaints", "setup"),
        "removal",
    ),
    "arm64": ("streaming", "sandbox", "doctor"),
}


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("architecture", choices=list(RUNS))
    parser.add_argument("groups", nargs="*", metavar="GROUP")
    parser.add_argument("--short", action="store_true")
    options = parser.parse_args(arguments)
    checks = Checks(SHARE / "results.json")
    host = Host()
    if options.short:
        replug.ROUNDS = replug.ROUNDS_SHORT
    for name in ("installation", *(options.groups or RUNS[options.architecture])):
        checks.begin(name)
        try:
            GROUPS[name](checks, host)
        except Exception:
            with checks("the code between the checks runs without an exception"):
                raise
    print(f"{checks.summary()}, {uptime_s():.0f} s after the kernel's start", flush=True)
    return 1 if checks.failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
