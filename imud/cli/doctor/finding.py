"""Contract of a check: a function that looks at the surroundings and yields what it found."""

from collections.abc import Callable, Iterator
from enum import StrEnum
from typing import NamedTuple

import msgspec

from imud.cli.doctor.surroundings import Surroundings


class Severity(StrEnum):
    """What a finding means."""

    OK = "ok"
    """Looked at, and in order."""
    NOTE = "note"
    """Nothing wrong, but good to know."""
    WARNING = "warning"
    """imud works, but not as well as it could."""
    ERROR = "error"
    """A device or an output does not work."""
    NOT_CHECKED = "not checked"
    """It could not be looked at; `seen` says why."""


class DoctorFinding(msgspec.Struct, frozen=True):
    """One thing that a check found."""

    severity: Severity
    seen: str
    """What was seen, for a person; with the device, port or interface that it is about."""
    advice: str = ""
    """What to do next; empty where there is nothing to do."""


Findings = Iterator[DoctorFinding]


class DoctorCheck(NamedTuple):
    """One row of the list of checks."""

    name: str
    """Short, unique, for people and for programs that read `--json`."""
    run: Callable[[Surroundings], Findings]
    """Yields what it found; nothing where the configuration has nothing that it is about.

    Raises OSError, ValueError and ImudError where it cannot look."""


def ok(seen: str) -> DoctorFinding:
    """Looked at, and in order."""
    return DoctorFinding(Severity.OK, seen)


def note(seen: str, advice: str = "") -> DoctorFinding:
    """Good to know."""
    return DoctorFinding(Severity.NOTE, seen, advice)


def warning(seen: str, advice: str) -> DoctorFinding:
    """Not as good as it could be."""
    return DoctorFinding(Severity.WARNING, seen, advice)


def error(seen: str, advice: str) -> DoctorFinding:
    """Something does not work."""
    return DoctorFinding(Severity.ERROR, seen, advice)


def not_checked(why: str, advice: str = "") -> DoctorFinding:
    """It could not be looked at, for this reason."""
    return DoctorFinding(Severity.NOT_CHECKED, why, advice)
