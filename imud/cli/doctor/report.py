"""What `imud doctor` prints: findings in 80 columns with what is wrong last, or JSON; and its exit status."""

import textwrap
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from imud.cli.doctor.finding import DoctorCheck, DoctorFinding, Severity
from imud.cli.doctor.surroundings import Surroundings
from imud.cli.output import COLUMNS
from imud.errors import ImudError
from imud.log import MESSAGE_CHARACTERS_MAX, printable

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
