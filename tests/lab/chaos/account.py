"""The account of one device over one life of the daemon: samples and losses against the truth.

Rule. A hole is the number of true samples between two received ones. The ledger's losses must equal the sum of all
holes that no outage touches. An outage is a time in which the link was away or the device began anew: the daemon
cannot know what was sent then and does not count it. Where an outage begins or ends in the middle of a sample, or in
the kernel's buffer, one sample per outage may be counted or not, hence |lost - holes| <= outages.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from imud.contracts.status import DeviceStatus
from imud.ledger import bytes_open, frames_open
from imud.sample import Sample

LEARNED: Final = 4
"""So many equal steps in a row are a rate (imud.clock.device_time.CONSISTENT); before that no loss can be known."""
LOSSES: Final = ("lost_gap_device", "lost_crc", "lost_overrun", "lost_queue")


class Interval(NamedTuple):
    """A time, CLOCK_MONOTONIC in ns."""

    begin_ns: int
    end_ns: int


class Account(NamedTuple):
    """What one device did in one life, or in several together."""

    samples: int = 0
    holes: int = 0
    """True samples between received ones, outages apart."""
    lost: int = 0
    """Losses of the ledger in the same time."""
    outages: int = 0
    unheard: int = 0
    """True samples in holes that an outage touches."""

    @property
    def balanced(self) -> bool:
        """Whether the ledger's losses are the true ones."""
        return abs(self.lost - self.holes) <= self.outages

    def __add__(self, other: tuple[object, ...]) -> "Account":
        assert isinstance(other, Account)
        return Account(*(a + b for a, b in zip(tuple(self), tuple(other), strict=True)))


def losses(ledger: Mapping[str, int]) -> int:
    """Samples lost by every cause."""
    return sum(ledger[name] for name in LOSSES)


def sequence_faults(samples: Sequence[Sample], first_seq: int) -> list[str]:
    """What is wrong with numbers and stamps: numbers follow each other, stamps rise and are not after the arrival."""
    found = []
    numbers = [sample.seq for sample in samples]
    if numbers != list(range(first_seq, first_seq + len(numbers))):
        broken = next((a, b) for a, b in pairwise([first_seq - 1, *numbers]) if b != a + 1)
        found.append(f"sample {broken[1]} follows {broken[0]}")
    if any(b.t_ns <= a.t_ns for a, b in pairwise(samples)):
        found.append("a stamp does not rise")
    if any(sample.t_ns > sample.t_rx_ns for sample in samples):
        found.append("a stamp is after the arrival")
    return found


def open_ledger(status: DeviceStatus) -> str:
    """By how much the ledger does not close; empty if it does."""
    byte, frame = bytes_open(status.ledger), frames_open(status.ledger)
    return f"{byte} bytes and {frame} frames unaccounted for" if byte or frame else ""


def account(
    samples: Sequence[Sample],
    numbers: Sequence[int],
    lost: int,
    outages: Sequence[Interval],
    *,
    learns: bool = False,
) -> Account:
    """Compare losses with the holes between samples whose true numbers are given.

    `learns`: the device gives time and no numbers, so holes before LEARNED equal steps in a row are not countable.
    """
    holes = unheard = even = 0
    for (before, a), (after, b) in pairwise(zip(samples, numbers, strict=True)):
        missing = b - a - 1
        away = any(outage.begin_ns <= after.t_rx_ns and outage.end_ns >= before.t_rx_ns for outage in outages)
        if away or (learns and even < LEARNED):
            unheard += missing
            even = even if even >= LEARNED else (even + 1) * (not missing)
        else:
            holes += missing
    return Account(len(samples), holes, lost, len(outages) + (learns and even < LEARNED), unheard)
