"""`imud doctor`: run all checks and print the findings. The exit status is the worst severity.

The command changes nothing and opens no port. It works with and without the daemon, and for every user. A check that
needs more rights has the severity "not checked".
"""

import argparse
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.doctor import buses, daemon, machine, ports
from imud.cli.doctor.surroundings import DoctorCheck, DoctorFinding, Severity, Surroundings, ask_daemon, file_of_daemon
from imud.cli.output import COLUMNS
from imud.cli.run import DEFAULT_FILE
from imud.host.installation import documents
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable, printable_json
from imud.model.errors import ImudError

MARGIN: Final = 13  # width of the column with the severities, characters
STATUS: Final = {Severity.ERROR: 2, Severity.WARNING: 1}  # exit status by the worst severity; 0 for other severities
FINDINGS_MAX: Final = 300  # Maximum number of findings of one check. imud supports 256 devices.


class Examined(NamedTuple):
    """Findings of a check."""

    name: str
    findings: list[DoctorFinding]


def examine(checks: Sequence[DoctorCheck], at: Surroundings) -> list[Examined]:
    """Run all checks. A check that fails returns the finding "not checked"; the other checks continue."""
    return [Examined(check.name, _findings(check, at)) for check in checks]


def _findings(check: DoctorCheck, at: Surroundings) -> list[DoctorFinding]:
    found: list[DoctorFinding] = []
    try:
        for finding in check.run(at):
            found.append(finding)
            # the report stays readable, also for a daemon with a faulty configuration
            if len(found) == FINDINGS_MAX:
                break
    # for example, a command with unexpected JSON
    except (OSError, ImudError, ValueError, LookupError, TypeError, AttributeError) as problem:
        found.append(DoctorFinding(Severity.NOT_CHECKED, f"{check.name}: {_reason(problem)}"))
    return found


def _reason(problem: Exception) -> str:
    """Return the reason why a check failed."""
    if isinstance(problem, FileNotFoundError) and problem.filename:
        return f"{problem.filename} does not exist or is not installed"
    return str(problem) or type(problem).__name__


def exit_status(examined: Sequence[Examined]) -> int:
    """Return 0 without problems, 1 for warnings, 2 for errors."""
    return max((STATUS.get(finding.severity, 0) for one in examined for finding in one.findings), default=0)


def verdict(examined: Sequence[Examined]) -> str:
    """Return the last line: the number of problems and of failed checks."""
    found = [finding.severity for one in examined for finding in one.findings]
    unseen = found.count(Severity.NOT_CHECKED)
    wrong = [
        _counted(found.count(severity), str(severity))
        for severity in (Severity.ERROR, Severity.WARNING)
        if severity in found
    ]
    if wrong:
        return ", ".join(wrong) + (f"; {_counted(unseen, 'item')} not checked" if unseen else "")
    if unseen:
        return f"no problem found; {_counted(unseen, 'item')} not checked"
    return "no problem found"


def page(examined: Sequence[Examined]) -> str:
    """Format all findings, the worst severity last, the place of the documents that they name, and the verdict."""
    findings = [finding for one in examined for finding in one.findings]
    # the worst findings are last, next to the prompt of the shell
    findings.sort(key=lambda finding: _RANK[finding.severity])
    place = [f"Folder docs: {documents()}", ""] if any("docs/" in finding.advice for finding in findings) else []
    blocks = [_block(finding) for finding in findings]
    return "\n".join([*blocks, "", *place, *textwrap.wrap(verdict(examined), COLUMNS)])


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


def as_json(examined: Sequence[Examined]) -> str:
    """Return all findings by check, as JSON."""
    found = [finding for one in examined for finding in one.findings]
    return printable_json(
        {
            "status": exit_status(examined),
            "complete": all(finding.severity is not Severity.NOT_CHECKED for finding in found),
            "verdict": verdict(examined),
            "checks": [{"name": one.name, "findings": one.findings} for one in examined],
        }
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


# All checks, causes before their effects. docs/doctor.md describes each check.
CHECKS: Final = (
    DoctorCheck("configuration", daemon.configuration),
    DoctorCheck("service", daemon.service),
    DoctorCheck("socket", daemon.socket),
    DoctorCheck("stale configuration", daemon.stale_configuration),
    DoctorCheck("devices", daemon.device_states),
    DoctorCheck("ports", ports.ports_present),
    DoctorCheck("rights", ports.rights),
    DoctorCheck("rules of the unit", ports.unit_rules),
    DoctorCheck("ports taken", ports.ports_taken),
    DoctorCheck("ModemManager", ports.modem_manager),
    DoctorCheck("latency timer", ports.latency_timer),
    DoctorCheck("serial data", daemon.heard),
    DoctorCheck("RS-485", daemon.half_duplex),
    DoctorCheck("CAN interfaces", buses.can_up),
    DoctorCheck("CAN state", buses.can_state),
    DoctorCheck("CAN bit rate", buses.can_bitrate),
    DoctorCheck("bus nodes", buses.bus_nodes),
    DoctorCheck("I2C", buses.i2c_transfers),
    DoctorCheck("SPI", buses.spi_transfers),
    DoctorCheck("lines", daemon.lines),
    DoctorCheck("clock", machine.host_clock),
    DoctorCheck("storage", machine.storage),
    DoctorCheck("power", machine.power),
    DoctorCheck("processor", machine.processor),
    DoctorCheck("C kernel", daemon.c_kernel),
    DoctorCheck("kernel log", machine.kernel_log),
    DoctorCheck("shared memory", daemon.shared_memory),
    DoctorCheck("Prometheus", daemon.prometheus),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "-c", "--config", type=Path, metavar="FILE",
        help=f"configuration file (default: the file of the running daemon, otherwise {DEFAULT_FILE})",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print every check with its findings as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the findings. Return 0 without problems, 1 for warnings, 2 for errors."""
    # absolute: messages then contain the complete path
    file = args.config or file_of_daemon(args.socket) or DEFAULT_FILE
    at = Surroundings(file.absolute(), partial(ask_daemon, args.socket))
    examined = examine(CHECKS, at)
    sys.stdout.write((as_json(examined) if args.json else page(examined)) + "\n")
    return exit_status(examined)


DOCTOR = CliCommand(add_arguments, run)
