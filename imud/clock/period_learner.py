"""The step between samples, in ticks of a counter, learned from the steps; the samples that are missing in longer ones.

Nothing here reads a clock.
"""

from collections.abc import Callable
from typing import Final

CONSISTENT: Final = 4
"""Number of equal steps in a row that make a rate."""
CONSISTENT_LONGER: Final = 12
"""The same for a longer step than before: where one of ten messages is lost, every second minute at 1 kHz leaves the
same hole four times in a row, and a period of two ticks for one would shift device time by a tick."""
OFF_MOST: Final = 2.0
"""Ticks by which steps of an uneven rate can differ from as many periods: one, and the error of the period."""
STEADY_STEPS: Final = 64
"""Number of equal steps in a row that were a rate: another one afterwards is a change of it."""
GAP_FACTOR: Final = 1.5
"""While the period is not known, a step that is so much longer than the one before or after has a gap in it."""
LEARNED_STEPS: Final = 4
"""A gap of more periods is not learned from: how many it has rests on the period itself."""
WHOLE_AFTER: Final = 64
"""Number of equal steps after which the period is a whole number of ticks: a different step before was a loss."""
WHOLE_OFF: Final = 0.5
"""A whole number of ticks that is further from the mean is another rate."""
UNJUDGED_MOST: Final = 64
"""Steps from before there is a period that are kept until there is one; a device of an even rate has a few."""
EVERY_TICK: Final = 1.5
"""With a shorter period two samples can be in one tick; with a longer one it is the same sample."""
MEMORY: Final = 4096
"""Steps in the mean of a period that is no whole number of ticks; then both sums are halved."""


class PeriodLearner:
    """Estimate of the step between samples in device ticks; counts the samples missing in a longer one.

    The period is measured, not taken from the nominal rate. `on_unknown_gap` is called for a step whose missing samples
    are not known within one: before there is a period, or where its error over many periods is too large.
    """

    __slots__ = (
        "_before", "_candidate", "_count", "_even", "_odd_at", "_on_unknown_gap", "_run", "_run_sum", "_steady", "_sum",
        "_uneven", "_uneven_sum", "_unjudged", "changes", "is_gap", "is_new", "period_ticks",
    )  # fmt: skip

    def __init__(self, on_unknown_gap: Callable[[], None] = lambda: None) -> None:
        self._on_unknown_gap = on_unknown_gap
        self.is_gap = False
        """Whether the newest step that was no period was noted as a gap of unknown size."""
        self.period_ticks = 0.0
        """Mean step; 0 while unknown."""
        self._sum = 0.0
        self._count = 0.0
        self._even = 0
        self._before = -1
        self._candidate = 0
        self._run = 0
        self._run_sum = 0
        self._uneven = self._uneven_sum = 0
        """Steps in a row that are not the period exactly, and their sum."""
        self._unjudged: list[int] = []
        """Steps from before there was a period that were not noted as gaps."""
        self._odd_at = 0.0
        """Number of the last step that was no period."""
        self._steady = False
        """Whether there were many periods in a row before it; a period learned of steps with losses is no rate."""
        self.is_new = False
        """Whether the period is another since this was set to False: the device's rate was changed."""
        self.changes = 0
        """Times that a period of no whole number of ticks showed where in a tick it is; 0 where it is a whole one."""

    def add_step(self, ticks: int) -> int:
        """Add the step to the newest sample; return how many samples are missing in it."""
        period = self.period_ticks
        if ticks <= 0:
            if 0 < period < EVERY_TICK:
                self._refine(0)
            return 0
        if ticks == period:
            self.add_even_steps()
            return 0
        if period and abs(ticks - period) <= 1 and int(ticks / period + 0.5) == 1:
            self._refine(ticks)
            return 0
        if self._learn(ticks):
            return 0
        if not period:
            return 0
        return self.steps_in(ticks) - 1

    def restart(self, *, was_added: bool = False) -> None:
        """Forget the newest step: the counter began anew, or was not read for a while.

        `was_added`: what was added last was no step of one counter; whoever calls notes the gap.
        """
        if was_added and self._unjudged and not self.is_gap:
            self._unjudged.pop()
        self._run, self.is_gap = 0, False

    def add_even_steps(self, count: int = 1) -> None:
        """Add so many steps that are exactly the period, at least one."""
        self._run = 0
        self._even += count

    def steps_in(self, ticks: int) -> int:
        """Return how many periods are in a longer step; the period must be known."""
        period = self.period_ticks
        steps = max(int(ticks / period + 0.5), 1)
        if not self.changes:
            return steps
        if steps <= LEARNED_STEPS and abs(ticks - steps * period) <= 1:
            self._average(ticks, steps)  # the mean of what is left, where one of ten is lost, is off by a thousandth
        elif steps > (self._count + self._even) * period:  # the mean is off by a tick over all it was made of
            self._on_unknown_gap()
        return steps

    def _average(self, ticks: int, steps: int) -> None:
        """Add `steps` periods of `ticks` in all to the mean."""
        self._sum += ticks + int(self._even * self.period_ticks)
        self._count += steps + self._even
        self._even = 0
        self.period_ticks = self._sum / self._count

    def _refine(self, ticks: int) -> None:
        self._run = 0
        if self._even:
            self._uneven = self._uneven_sum = 0
        self._uneven += 1
        self._uneven_sum += ticks
        if self._uneven == CONSISTENT_LONGER:
            count, total = self._uneven, self._uneven_sum
            self._uneven = self._uneven_sum = 0
            if abs(total - count * self.period_ticks) > OFF_MOST:
                self._note_odd()
                self._adopt(total, count, is_new=self._steady)
                return
        self._average(ticks, 1)
        same, self._before = ticks == self._before, ticks
        self.changes += not same
        if same and self.changes <= 1 and self._count >= WHOLE_AFTER:
            self.is_new = abs(ticks - self.period_ticks) > WHOLE_OFF
            self._odd_at = 0.0
            self.period_ticks, self._sum, self._count, self.changes = float(ticks), float(ticks), 1.0, 0
        while self._count >= MEMORY:
            self._sum /= 2
            self._count /= 2

    def _learn(self, ticks: int) -> bool:
        """Adopt another period when the last steps agree on it; return whether they do."""
        self._uneven, self._uneven_sum, self.is_gap = 0, 0, False
        is_first = not self.period_ticks
        if is_first and len(self._unjudged) < UNJUDGED_MOST:
            self._unjudged.append(ticks)
        if self._run and abs(ticks - self._candidate) <= 1:
            self._run += 1
            self._run_sum += ticks
        else:
            if self._run and is_first:
                shorter, longer = sorted((ticks, self._candidate))
                if longer > GAP_FACTOR * shorter + 1:
                    self.is_gap = True
                    self._on_unknown_gap()
                    if longer in self._unjudged:
                        self._unjudged.remove(longer)
            self._candidate, self._run, self._run_sum = ticks, 1, ticks
            self._note_odd()
        longer = 0 < self.period_ticks < self._candidate
        if self._run < (CONSISTENT_LONGER if longer or self._steady else CONSISTENT):
            return False
        self._adopt(self._run_sum, self._run, is_new=self._steady)
        if is_first:
            self._judge()
        return True

    def _judge(self) -> None:
        """Note the gaps among the steps from before the first period: two beside each other can be of a like length."""
        for ticks in self._unjudged:
            if int(ticks / self.period_ticks + 0.5) > 1 and ticks - self.period_ticks >= 1:
                self._on_unknown_gap()
        self._unjudged.clear()

    def _note_odd(self) -> None:
        """Note a step that is no period, and whether there were many before."""
        even = self._count + self._even - self._odd_at
        if even:
            self._steady = not 0 < even < STEADY_STEPS
            self._odd_at += even

    def _adopt(self, ticks: int, steps: int, *, is_new: bool) -> None:
        """Take `ticks` over so many steps for the period from now on."""
        self.is_new = is_new
        self._odd_at, self._steady = 0.0, False
        self._sum, self._count = float(ticks), float(steps)
        self.period_ticks = self._sum / self._count
        self._run = self._even = self._uneven = self._uneven_sum = self.changes = 0
        self._before = -1
