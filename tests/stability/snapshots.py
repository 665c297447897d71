"""Stored facts of each interface, `tests/stability/NAME.txt`, and their comparison with the present facts.

Each line is the name of a fact, a tab, and its text. The first line is the version of the interface.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from tests.stability.facts import REQUIRED, Facts
from tests.stability.interfaces import INTERFACES, Interface

FOLDER: Final = Path(__file__).parent
VERSION: Final = "version"
SHOWN: Final = 40
"""Maximum number of changes in a message."""


class Change(NamedTuple):
    """Difference of one fact; None if the fact is absent."""

    name: str
    before: str | None
    after: str | None
    is_compatible: bool
    """Whether existing programs continue to work: an addition that they do not have to supply."""

    def __str__(self) -> str:
        if self.before is None:
            return f"added    {self.name}: {self.after}"
        if self.after is None:
            return f"removed  {self.name}: {self.before}"
        return f"changed  {self.name}: {self.before}  ->  {self.after}"


def stored(name: str) -> Facts:
    """Return the stored facts of an interface; empty if no file exists."""
    file = FOLDER / f"{name}.txt"
    lines = file.read_text().splitlines() if file.exists() else []
    return {fact: text for fact, _, text in (line.partition("\t") for line in lines)}


def present(interface: Interface) -> Facts:
    """Return the facts of the code."""
    return {VERSION: interface.version} | {name: " ".join(text.split()) for name, text in interface.facts().items()}


def changes(before: Mapping[str, str], after: Mapping[str, str]) -> list[Change]:
    """Return the differences of the facts, without the version."""
    found = []
    for name in sorted((before.keys() | after.keys()) - {VERSION}):
        old, new = before.get(name), after.get(name)
        if old != new:
            # programs do not use a new command or function, so it can have required arguments
            is_free = not str(new).startswith(REQUIRED) or _owner(name, after) not in (None, *before)
            found.append(Change(name, old, new, old is None and is_free))
    return found


def _owner(name: str, facts: Mapping[str, str]) -> str | None:
    """Return the fact of the command, function or object that the name is a part of; None without such a fact."""
    places = (place for place in reversed(range(len(name))) if name[place] in ".([ :" and name[:place] in facts)
    return next((name[:place] for place in places), None)


def problem(before: Mapping[str, str], after: Mapping[str, str], place: str) -> str:
    """Return why the present facts cannot replace the stored facts; empty if they can.

    `place`: place of the version. An incompatible change needs another version.
    """
    broken = [one for one in changes(before, after) if not one.is_compatible]
    if not broken or before.get(VERSION) != after[VERSION]:
        return ""
    return (
        f"incompatible changes: {len(broken)}, version still {after[VERSION]}: undo the changes, or increment "
        f"{place}, and describe the changes in CHANGELOG.md under Changed or Removed"
    )


def advice(name: str, interface: Interface, before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Return the differences of an interface and the next steps; empty without a difference."""
    found = changes(before, after)
    if before == after:
        return ""
    return "\n".join(_lines(name, found, problem(before, after, interface.place), before, after))


def _lines(
    name: str, found: list[Change], reason: str, before: Mapping[str, str], after: Mapping[str, str]
) -> Iterator[str]:
    yield f"interface {name}: version {before.get(VERSION, 'none')} in tests/stability/{name}.txt, {after[VERSION]} now"
    for kind, of_kind in (("incompatible", False), ("compatible", True)):
        some = [one for one in found if one.is_compatible is of_kind]
        yield from (f"  {kind}: {one}" for one in some[:SHOWN])
        if len(some) > SHOWN:
            yield f"  {kind}: and {len(some) - SHOWN} more"
    if reason:
        yield f"  {reason}"
    else:
        yield "  describe the changes in CHANGELOG.md, and update docs/stability.md if a rule changes"
    yield "  then run: python -m tests.stability --write"


def write(name: str, after: Mapping[str, str]) -> None:
    """Store the facts of an interface."""
    lines = [f"{VERSION}\t{after[VERSION]}", *(f"{one}\t{after[one]}" for one in sorted(after.keys() - {VERSION}))]
    (FOLDER / f"{name}.txt").write_text("\n".join(lines) + "\n")


def all_interfaces() -> Iterator[tuple[str, Interface, Facts, Facts]]:
    """Yield name, interface, stored facts and present facts."""
    for name, interface in INTERFACES.items():
        yield name, interface, stored(name), present(interface)
