"""Timing of bursts: a device's bursts, learned from the first frames heard, and the number of missing bursts.

A device sends the frames of one instant back to back: a burst. `BurstLearning` finds the kinds that are in every burst,
their order and the period. `Cadence` follows the period from then on and counts missing bursts by time, because these
frames have no counter. A burst that is late may have been held up together with those behind it, which then come
sooner than the rate allows and make up for it; only lateness that stays is loss. So the count comes two bursts after
the gap.
"""

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Final, NamedTuple

from imud.units import NS_PER_MS, NS_PER_S

PERIODS: Final = 4
"""Periods that must look alike."""
STEPS_MAX: Final = 64
"""Number of periods to average where arrival times vary so much that four periods are never alike."""
FRAMES_MAX: Final = 128
"""Frames kept while learning; they have room for four periods of more kinds than any device has."""


class Learned(NamedTuple):
    """Learned properties of a device's bursts."""

    order: tuple[int, ...]
    """Kinds that are in every burst, as they are sent."""
    period_ns: int
    """From burst to burst."""


class BurstLearning:
    """Learning from frames in the order they arrive. Synchronization: one thread."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, int]] = []
        self._steps: list[int] = []

    def add_frame(self, kind: int, t_ns: int) -> Learned | None:
        """Add the kind and time of arrival of one frame; return the bursts once they are known."""
        frames = self._frames
        frames.append((kind, t_ns))
        places = [place for place, (other, _) in enumerate(frames) if other == kind]
        if len(places) <= PERIODS:
            if len(frames) > FRAMES_MAX:
                del frames[: FRAMES_MAX // 2]
            return None
        slices = [frames[begin:end] for begin, end in pairwise(places)]
        order = _in_every(slices)
        if order is None:
            del frames[: places[1]]
            return None
        times = [frames[place][1] for place in places]
        steps = [b - a for a, b in pairwise(times)]
        self._steps += steps[-1:]
        if 2 * max(steps) > 3 * min(steps) and len(self._steps) < STEPS_MAX:
            del frames[: places[1]]
            return None
        period = median(steps) if len(self._steps) < STEPS_MAX else fmean(self._steps)
        return Learned(_from_head(order, frames), int(period))


def _in_every(slices: Sequence[Sequence[tuple[int, int]]]) -> tuple[int, ...] | None:
    """Return the kinds that occur once in every slice, if their order is the same in all; else None."""
    common = set.intersection(*({kind for kind, _ in one} for one in slices))
    orders = {tuple(kind for kind, _ in one if kind in common) for one in slices}
    order = orders.pop()
    return order if not orders and len(order) == len(common) else None


def _from_head(order: tuple[int, ...], frames: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """The same cycle of kinds, begun after the longest pause; the lowest kind where all pauses are alike."""
    heard = [(kind, t_ns) for kind, t_ns in frames if kind in order]
    pauses: dict[int, list[int]] = {kind: [0] for kind in order}
    for (_, before_ns), (kind, t_ns) in pairwise(heard):
        pauses[kind].append(t_ns - before_ns)
    head = max(order, key=lambda kind: (median(pauses[kind][1:] or [0]), -kind))
    begin = order.index(head)
    return order[begin:] + order[:begin]


SILENCE_NS: Final = NS_PER_S
"""A longer gap is silence of the device, not loss."""
PERIOD_LEAST_NS: Final = NS_PER_MS
"""Shortest period: no device sends faster than 1 kHz."""
STEADY_BURSTS: Final = 2
"""Number of bursts at the usual distance after which no delayed burst is expected any more."""
ODD_BURSTS: Final = 8
"""Number of distances in a row, all shorter or all longer and within 1/4 of each other, that are another rate."""
SMOOTHING: Final = 16
"""Weight of what is known of the period against one more distance."""


class Cadence:
    """Period and missing bursts of one device. Synchronization: one thread."""

    __slots__ = ("_late_ns", "_newest_ns", "_odd_ns", "_silent", "_steady", "period_ns")

    def __init__(self, period_ns: int, newest_ns: int) -> None:
        """`newest_ns`: arrival of the newest burst."""
        self.period_ns = max(period_ns, PERIOD_LEAST_NS)
        """Between two bursts."""
        self._newest_ns = newest_ns
        self._late_ns = 0
        """Lateness that may still be made up for."""
        self._silent = False
        self._steady = 0
        self._odd_ns: list[int] = []

    @property
    def is_late(self) -> bool:
        """Whether a gap is not settled yet."""
        return self._late_ns > 0

    def begin(self, t_ns: int) -> tuple[int, int]:
        """A burst begins to arrive: returns how many bursts are now known to be missing in a gap before it (`is_late`
        since), and how many of those are loss."""
        step_ns, period_ns = t_ns - self._newest_ns, self.period_ns
        self._newest_ns = t_ns
        if 4 * step_ns > 5 * period_ns:
            self._long(step_ns)
            return 0, 0
        if 4 * step_ns < 3 * period_ns:
            self._short(step_ns)
            return 0, 0
        self.period_ns += (step_ns - period_ns) // SMOOTHING
        self._odd_ns.clear()
        if not self._late_ns:
            return 0, 0
        self._late_ns += min(0, step_ns - period_ns)
        self._steady += 1
        return self._settle() if self._steady >= STEADY_BURSTS else (0, 0)

    def _long(self, step_ns: int) -> None:
        self._late_ns += step_ns - self.period_ns
        self._silent |= step_ns > SILENCE_NS
        self._steady = 0
        self._add_odd(step_ns, 1)

    def _short(self, step_ns: int) -> None:
        made_up_ns = self.period_ns - step_ns
        self._steady = 0
        if self._late_ns:
            self._late_ns = max(0, self._late_ns - made_up_ns)
            self._odd_ns.clear()
        else:
            self._add_odd(step_ns, -1)

    def _add_odd(self, step_ns: int, side: int) -> None:
        """Adopt another rate; what was late by the old one was not."""
        odd = self._odd_ns
        if odd and ((odd[0] - self.period_ns) * side < 0 or 4 * abs(step_ns - odd[0]) > odd[0]):
            odd.clear()
        odd.append(step_ns)
        if len(odd) >= ODD_BURSTS:
            self.period_ns = max(int(median(odd)), PERIOD_LEAST_NS)
            self._late_ns, self._silent = 0, False
            odd.clear()

    def _settle(self) -> tuple[int, int]:
        missed = (2 * self._late_ns + self.period_ns) // (2 * self.period_ns)
        lost = 0 if self._silent else missed
        self._late_ns, self._silent, self._steady = 0, False, 0
        return missed, lost
