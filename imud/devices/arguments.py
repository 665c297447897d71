"""Checks of the arguments of commands: each returns its value, or raises BadArgument naming what was expected."""

from collections.abc import Iterable
from enum import Enum
from typing import TypeVar

from imud.errors import BadArgument

E = TypeVar("E", bound=Enum)


def member(name: str, value: E, kind: type[E]) -> E:
    """A member of `kind`, not its bare value."""
    if not isinstance(value, kind):
        raise BadArgument(f"{name}: expected one of {listed(f'{kind.__name__}.{m.name}' for m in kind)}, got {value!r}")
    return value


def one_of(name: str, value: int, allowed: Iterable[int]) -> int:
    """One of some whole numbers; True and False are none."""
    values = sorted(allowed)
    if isinstance(value, bool) or not isinstance(value, int) or value not in values:
        raise BadArgument(f"{name}: expected one of {listed(values)}, got {value!r}")
    return value


def listed(values: Iterable[object]) -> str:
    """Values as text, with commas."""
    return ", ".join(map(str, values))
