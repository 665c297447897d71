"""Contract of a fuzz target, and of a module with targets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, Protocol

INPUT_BYTES_MAX: Final = 4096
"""Default maximum length of an input, bytes: several frames or requests, and short enough to be fast."""


def as_it_is(data: bytes, _random: Random) -> bytes:
    return data


FRAMES_BYTES_MAX: Final = 2048


@dataclass(frozen=True, slots=True)
class Target:
    run: Callable[[bytes], None]
    """Function that raises an exception for an input that violates an invariant. Each exception is a finding."""
    seeds: Callable[[], Sequence[bytes]]
    """Function that returns valid inputs as a start, made by encoders: a few dozen, the same for each call."""
    mend: Callable[[bytes, Random], bytes] = as_it_is
    """Function that corrects check values after a mutation, so that the fuzzer reaches the code behind them."""
    words: Callable[[], Sequence[bytes]] = tuple
    bytes_max: int = INPUT_BYTES_MAX


def check_printable(text: str) -> None:
    """Raise an exception if the text could forge a log line or control a terminal."""
    assert text.isprintable(), ascii(text)


class TargetGroup(Protocol):
    def names(self) -> Sequence[str]: ...

    def make(self, name: str) -> Target:
        """Make the target with this name. Import the tested code only here."""
        ...
