"""`imud doctor`: run all checks, print what was found; the exit status says how bad it is.

Nothing is changed and no port is opened. It runs with the daemon up or down, as any user; what a user may not see is
listed as not checked.
"""

import argparse
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.doctor import (
    buses,
)
from imud.cli.doctor import (
    buses as can,
)
from imud.cli.doctor import (
    daemon as outputs,
)
from imud.cli.doctor import (
    daemon as service,
)
from imud.cli.doctor import (
    daemon as traffic,
)
from imud.cli.doctor import (
    machine as host,
)
from imud.cli.doctor import (
    machine as kernel_log,
)
from imud.cli.doctor import (
    ports as access,
)
from imud.cli.doctor import (
    ports as serial_ports,
)
from imud.cli.doctor.surroundings import DoctorCheck, DoctorFinding, Severity, Surroundings, ask_daemon
from imud.cli.output import COLUMNS
from imud.cli.run import DEFAULT_FILE
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable
from imud.model.errors import ImudError

MARGIN: Final = 13
"""Width of the column of severities."""
STATUS: Final = {Severity.ERROR: 2, Severity.WARNING: 1}
"""Exit status by the worst severity; 0 for the others."""
FINDINGS_MAX: Final = 300
"""Of one check: 256 devices have some each."""


class Examined(NamedTuple):
    """A check that ran, with what it found."""

    name: str
    findings: list[DoctorFinding]


def examine(checks: Sequence[DoctorCheck], at: Surroundings) -> list[Examined]:
    """Run all checks. One that cannot look is a finding and ends no other."""
    return [Examined(check.name, _findings(check, at)) for check in checks]


def _findings(check: DoctorCheck, at: Surroundings) -> list[DoctorFinding]:
    found: list[DoctorFinding] = []
    try:
        for finding in check.run(at):
            found.append(finding)
            if len(found) == FINDINGS_MAX:
                break
    except (OSError, ImudError, ValueError, LookupError, TypeError, AttributeError) as problem:
        found.append(DoctorFinding(Severity.NOT_CHECKED, f"{check.name}: {_reason(problem)}"))
    return found


def _reason(problem: Exception) -> str:
    """Why a check could not look."""
    if isinstance(problem, FileNotFoundError) and problem.filename:
        return f"{problem.filename} is not there, or not installed"
    return str(problem) or type(problem).__name__


def exit_status(examined: Sequence[Examined]) -> int:
    """0 for nothing wrong, 1 for warnings, 2 for errors."""
    return max((STATUS.get(finding.severity, 0) for one in examined for finding in one.findings), default=0)


def verdict(examined: Sequence[Examined]) -> str:
    """The last line: what is wrong, and whether all was looked at."""
    found = [finding.severity for one in examined for finding in one.findings]
    unseen = found.count(Severity.NOT_CHECKED)
    wrong = [
        _counted(found.count(severity), str(severity))
        for severity in (Severity.ERROR, Severity.WARNING)
        if severity in found
    ]
    if wrong:
        return ", ".join(wrong) + (f"; {_counted(unseen, 'thing')} could not be checked" if unseen else "")
    if unseen:
        return f"nothing wrong found in what could be checked; {_counted(unseen, 'thing')} could not"
    return "nothing wrong found"


def page(examined: Sequence[Examined]) -> str:
    """All findings by check, those in order first, and the verdict."""
    findings = [finding for one in examined for finding in one.findings]
    findings.sort(key=lambda finding: _RANK[finding.severity])
    return "\n".join([*(_block(finding) for finding in findings), "", *textwrap.wrap(verdict(examined), COLUMNS)])


_RANK: Final = {
    Severity.OK: 0, Severity.NOTE: 1, Severity.NOT_CHECKED: 2, Severity.WARNING: 3, Severity.ERROR: 4,
}  # fmt: skip


def _block(finding: DoctorFinding) -> str:
    lines = _wrapped(finding.seen)
    if finding.advice:
        lines += _wrapped(f"→ {finding.advice}")
    return "\n".join(
        f"{finding.severity if not number else '':<{MARGIN}}{line}".rstrip() for number, line in enumerate(lines)
    )


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(printable(text, MESSAGE_CHARACTERS_MAX), COLUMNS - MARGIN, break_on_hyphens=False)


def as_json(examined: Sequence[Examined]) -> bytes:
    """All findings by check, for programs."""
    found = [finding for one in examined for finding in one.findings]
    return msgspec.json.encode(
        {
            "status": exit_status(examined),
            "complete": all(finding.severity is not Severity.NOT_CHECKED for finding in found),
            "verdict": verdict(examined),
            "checks": [{"name": one.name, "findings": one.findings} for one in examined],
        }
    )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


CHECKS: Final = (
    DoctorCheck("configuration", service.configuration),
    DoctorCheck("service", service.service),
    DoctorCheck("socket", service.socket),
    DoctorCheck("stale configuration", service.stale_configuration),
    DoctorCheck("devices", service.device_states),
    DoctorCheck("ports", serial_ports.ports_present),
    DoctorCheck("rights", access.rights),
    DoctorCheck("rules of the unit", access.unit_rules),
    DoctorCheck("ports taken", serial_ports.ports_taken),
    DoctorCheck("ModemManager", serial_ports.modem_manager),
    DoctorCheck("latency timer", serial_ports.latency_timer),
    DoctorCheck("serial data", traffic.heard),
    DoctorCheck("RS-485", traffic.half_duplex),
    DoctorCheck("restarts", traffic.restarts),
    DoctorCheck("CAN interfaces", can.can_up),
    DoctorCheck("CAN state", can.can_state),
    DoctorCheck("CAN bit rate", can.can_bitrate),
    DoctorCheck("bus nodes", buses.bus_nodes),
    DoctorCheck("I2C", buses.i2c_transfers),
    DoctorCheck("SPI", buses.spi_transfers),
    DoctorCheck("lines", traffic.lines),
    DoctorCheck("clock", host.host_clock),
    DoctorCheck("storage", host.storage),
    DoctorCheck("power", host.power),
    DoctorCheck("processor", host.processor),
    DoctorCheck("kernel log", kernel_log.kernel_log),
    DoctorCheck("shared memory", outputs.shared_memory),
    DoctorCheck("Prometheus", outputs.prometheus),
)
"""In the order in which they are explained by one another; docs/doctor.md has them all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud doctor`."""
    add_socket(parser)
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE", help="configuration (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="for programs: every check with its findings")


def run(args: argparse.Namespace) -> int:
    """Print the findings; 0 for nothing wrong, 1 for warnings, 2 for errors."""
    at = Surroundings(args.config.absolute(), partial(ask_daemon, args.socket))
    examined = examine(CHECKS, at)
    sys.stdout.write((as_json(examined).decode() if args.json else page(examined)) + "\n")
    return exit_status(examined)


DOCTOR = CliCommand(add_arguments, run)
