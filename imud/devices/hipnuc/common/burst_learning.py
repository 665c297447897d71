"""What a device sends, learned from the first frames heard: the kinds that every burst has, their order, the period."""

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Final, NamedTuple

PERIODS: Final = 4
"""Periods that must look alike."""
STEPS_MAX: Final = 64
"""Where times of arrival are so bad that four periods are never alike, the mean of so many."""
FRAMES_MAX: Final = 128
"""Frames kept while learning; they have room for four periods of more kinds than any device has."""


class Learned(NamedTuple):
    """A device's bursts."""

    order: tuple[int, ...]
    """Kinds that are in every burst, as they are sent."""
    period_ns: int
    """From burst to burst."""


class BurstLearning:
    """Learns from frames in the order they come. Synchronization: one thread."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, int]] = []
        self._steps: list[int] = []

    def take(self, kind: int, t_ns: int) -> Learned | None:
        """Take one frame's kind and time of arrival; returns what is known once it is."""
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
    """The kinds that stand in every slice once, if their order is the same in all; else None."""
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
