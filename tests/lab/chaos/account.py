"""Check of one device over one life of the daemon: samples and losses compared with the truth.

Rule. A hole is the number of true samples between two received samples. The ledger counts each hole exactly if the
daemon can know its size. The size follows from the counter of a device that kept running, also while the link was
missing, and from the deadlines of a polled device. The daemon cannot know the size

- if the device restarted: its counter contains nothing about the time before;
- before it knows the rate of a device that sends time but no sequence numbers, or the values that it needs to recognise
  a counter after a missing link (`KNOWN`);
- if a polled device was missing: imud does not read it then, and the device has no counter.

Such a hole is uncertain. It counts as one of the ledger's gaps of unknown size, and its part in `lost` is between 0 and
its size, or the ledger counts it with an error of at most one sample. Therefore, with the ledger's number of unknown
gaps U,

    holes - (the U largest uncertain holes) - (one for each other uncertain hole) <= lost
    lost <= holes + (one for each uncertain hole)

and U is at most the number of uncertain holes. Without an uncertain hole, `lost` is exactly the truth. A polled device
with failed first reads has such a gap before its first sample. The time after the newest sample belongs to no gap.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from imud.contracts.status import DeviceStatus
from imud.model.ledger import bytes_open, frames_open
from imud.model.sample import Sample

LEARNED: Final = 4
"""Number of equal steps in a row that define a rate (imud.sampling.device_time.CONSISTENT). No loss is known before."""
KNOWN: Final = 80
"""Number of samples after a restart of the device until imud recognises its counter after a missing link. A fit needs 8
(imud.sampling.clock.ENOUGH_POINTS), the period of numbered samples needs four windows of 16 with one disturbed window
(imud.sampling.gaps.WINDOW_MESSAGES), and SIGSTOP one more window."""
UNKNOWN_MOST: Final = 2
"""A hole before the rate is known counts twice: as a step longer than the previous step and longer than the next
step."""


class Interval(NamedTuple):
    begin_ns: int
    end_ns: int
    restarts: bool = False
    """True if the device restarted in the hole or is polled."""

    def touches(self, before: Sample, after: Sample) -> bool:
        return self.begin_ns <= after.t_rx_ns and self.end_ns >= before.t_ns


class Hole(NamedTuple):
    missing: int
    is_certain: bool
    """Whether the daemon can know the size of the hole."""
    unknown_most: int = 1
    """Maximum number of gaps of unknown size that the daemon counts for the hole."""
    is_open: bool = False
    """True if the hole has a sample on one side only: no sample after it (`unknown_most` is 0), or no sample before
    it."""


class Account(NamedTuple):
    samples: int = 0
    lost: int = 0
    holes: int = 0
    least: int = 0
    most: int = 0
    """Bounds of `lost` according to the rule."""
    unknown: int = 0
    unknown_most: int = 0
    """Maximum number of unknown gaps by the rule."""
    outages: int = 0

    @property
    def balanced(self) -> bool:
        return self.least <= self.lost <= self.most and self.unknown <= self.unknown_most

    def __add__(self, other: tuple[object, ...]) -> "Account":
        assert isinstance(other, Account)
        return Account(*(a + b for a, b in zip(tuple(self), tuple(other), strict=True)))


def sequence_faults(samples: Sequence[Sample], first_seq: int) -> list[str]:
    """Return the faults of numbers and time stamps: numbers are consecutive, time stamps increase and are not after the
    arrival."""
    found = []
    numbers = [sample.seq for sample in samples]
    if numbers != list(range(first_seq, first_seq + len(numbers))):
        broken = next((a, b) for a, b in pairwise([first_seq - 1, *numbers]) if b != a + 1)
        found.append(f"sample {broken[1]} follows {broken[0]}")
    if any(b.t_ns <= a.t_ns for a, b in pairwise(samples)):
        found.append("a time stamp does not increase")
    if any(sample.t_ns > sample.t_rx_ns for sample in samples):
        found.append("a time stamp is later than the arrival")
    return found


def open_ledger(status: DeviceStatus) -> str:
    """Return the difference by which the ledger does not balance; empty if it balances."""
    byte, frame = bytes_open(status.ledger), frames_open(status.ledger)
    return f"the ledger does not balance: {byte} bytes and {frame} frames are not counted" if byte or frame else ""


def find_holes(
    samples: Sequence[Sample], numbers: Sequence[int], outages: Sequence[Interval], *, learns: bool = False
) -> list[Hole]:
    """Return the holes between samples with the given true numbers.

    `learns` means that the device sends time but no sequence numbers.
    """
    found: list[Hole] = []
    heard, even = 1, 0
    for (before, a), (after, b) in pairwise(zip(samples, numbers, strict=True)):
        missing = b - a - 1
        touching = [outage for outage in outages if outage.touches(before, after)]
        restarts = any(outage.restarts for outage in touching)
        unlearned = learns and even < LEARNED
        is_uncertain = restarts or (missing > 0 and (unlearned or (bool(touching) and heard < KNOWN)))
        found.append(Hole(missing, not is_uncertain, UNKNOWN_MOST if unlearned else 1))
        heard = 1 if restarts else heard + 1
        if unlearned:
            even = 0 if restarts else (even + 1) * (not missing)
    return found


def account(samples: int, holes: Sequence[Hole], lost: int, unknown: int, outages: int) -> Account:
    true = sum(hole.missing for hole in holes if not hole.is_open)
    uncertain = sorted((hole for hole in holes if not hole.is_certain and not hole.is_open), reverse=True)
    least = true - sum(hole.missing for hole in uncertain[:unknown]) - sum(h.missing > 0 for h in uncertain[unknown:])
    most = true + len(uncertain) + sum(hole.missing + 1 for hole in holes if hole.is_open)
    unknown_most = sum(hole.unknown_most for hole in holes if not hole.is_certain)
    return Account(samples, lost, true, least, most, unknown, unknown_most, outages)
