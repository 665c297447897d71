"""`imud doctor --json` as a process: its findings, and the matching exit status."""

import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec

LIMIT_S: Final = 150.0
STATUS: Final = {"error": 2, "warning": 1}
"""Exit status by severity (docs/doctor.md); 0 for all other severities."""
ORDINARY_USER: Final = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=+dac_read_search",
    "--ambient-caps=+dac_read_search",
)  # fmt: skip
"""Runs a program as `nobody` without groups. It may read all files: the interpreter may be in root's home."""


class Found(msgspec.Struct, frozen=True):
    severity: str
    seen: str
    advice: str


class CheckOutcome(msgspec.Struct, frozen=True):
    name: str
    findings: list[Found]


class Diagnosis(msgspec.Struct, frozen=True):
    status: int
    complete: bool
    verdict: str
    checks: list[CheckOutcome]

    def of(self, severity: str) -> list[tuple[str, str]]:
        return [
            (check.name, found.seen) for check in self.checks for found in check.findings if found.severity == severity
        ]

    def advice(self, check: str, severity: str, seen: str, advice: str = "") -> str:
        found = [one for each in self.checks if each.name == check for one in each.findings]
        fitting = [one for one in found if one.severity == severity and seen in one.seen and advice in one.advice]
        assert fitting, f"{check}: expected {severity} with {seen!r} and the step {advice!r}, got {found}"
        return fitting[0].advice

    def has(self, check: str, severity: str, seen: str, advice: str = "") -> None:
        self.advice(check, severity, seen, advice)


def diagnose(config: Path, socket: Path, *prefix: str) -> Diagnosis:
    """Run `imud doctor` after the words `prefix`. Check that the exit status matches the worst finding."""
    doctor = (sys.executable, "-m", "imud", "doctor", "--json", "--socket", str(socket), "--config", str(config))
    result = subprocess.run([*prefix, *doctor], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert not result.stderr, result.stderr
    found = msgspec.json.decode(result.stdout, type=Diagnosis)
    severities = [one.severity for check in found.checks for one in check.findings]
    assert result.returncode == found.status == max(STATUS.get(severity, 0) for severity in severities)
    return found
