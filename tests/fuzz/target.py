"""Contract: what a fuzz target is, and what a module with targets has."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, Protocol

INPUT_BYTES_MAX: Final = 4096
"""Longest input where a target names no other length: several frames or requests, and short enough to be fast."""


def as_it_is(data: bytes, _random: Random) -> bytes:
    return data


FRAMES_BYTES_MAX: Final = 2048


@dataclass(frozen=True, slots=True)
class Target:
    run: Callable[[bytes], None]
    """Raises for an input that violates an invariant; whatever it raises is a finding."""
    seeds: Callable[[], Sequence[bytes]]
    """Valid inputs to begin with, made by encoders; a few dozen, the same at each call."""
    mend: Callable[[bytes, Random], bytes] = as_it_is
    """Makes check values right after a mutation, so that what stands behind them is reached too."""
    words: Callable[[], Sequence[bytes]] = tuple
    bytes_max: int = INPUT_BYTES_MAX


def check_printable(text: str) -> None:
    """Fail for text that could forge a line of a log or steer a terminal."""
    assert text.isprintable(), ascii(text)


class TargetGroup(Protocol):
    def names(self) -> Sequence[str]: ...

    def make(self, name: str) -> Target:
        """Make the target of that name. Imports what it tests no earlier than here."""
        ...
