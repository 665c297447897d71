"""Samples missing by the device's own time, and device time finer than its tick: the period is learned, not nominal."""

from typing import Final

CONSISTENT: Final = 4
"""So many equal steps in a row are a rate."""
CONSISTENT_LONGER: Final = 12
"""The same for a longer step than before: where one of ten messages is lost, every second minute at 1 kHz leaves the
same hole four times in a row, and a period of two ticks for one would shift device time by a tick."""
WHOLE_AFTER: Final = 64
"""After so many equal steps the period is whole: what differed in the beginning was a loss."""
EVERY_TICK: Final = 1.5
"""With a shorter period two samples can be in one tick; with a longer one it is the same sample."""
MEMORY: Final = 4096
"""Steps in the mean of a period that is no whole number of ticks; then both sums are halved."""


class PeriodLearner:
    """Learns the step between samples, in device ticks, and counts what is missing in a longer one."""

    __slots__ = ("_before", "_candidate", "_count", "_even", "_run", "_run_sum", "_sum", "changes", "period_ticks")

    def __init__(self) -> None:
        self.period_ticks = 0.0
        """Mean step; 0 while unknown."""
        self._sum = 0.0
        self._count = 0.0
        self._even = 0
        self._before = -1
        self._candidate = 0
        self._run = 0
        self._run_sum = 0
        self.changes = 0
        """Times that a period of no whole number of ticks showed where in a tick it is; 0 where it is a whole one."""

    def step(self, ticks: int) -> int:
        """Take the step to the newest sample; returns how many samples are missing in it."""
        period = self.period_ticks
        if ticks <= 0:
            if 0 < period < EVERY_TICK:
                self._refine(0)
            return 0
        if ticks == period:
            self._run = 0
            self._even += 1
            return 0
        if period and abs(ticks - period) <= 1 and int(ticks / period + 0.5) == 1:
            self._refine(ticks)
            return 0
        if self._learn(ticks):
            return 0
        if not period:
            return 0
        steps = max(int(ticks / period + 0.5), 1)
        if self.changes and abs(ticks - steps * period) <= 1:
            self._add(ticks, steps)  # the mean of what is left, where one of ten is lost, is off by a thousandth
        return steps - 1

    def _add(self, ticks: int, steps: int) -> None:
        """So many steps together are so many ticks."""
        self._sum += ticks + int(self._even * self.period_ticks)
        self._count += steps + self._even
        self._even = 0
        self.period_ticks = self._sum / self._count

    def _refine(self, ticks: int) -> None:
        self._run = 0
        self._add(ticks, 1)
        same, self._before = ticks == self._before, ticks
        self.changes += not same
        if same and self.changes <= 1 and self._count >= WHOLE_AFTER:
            self.period_ticks, self._sum, self._count, self.changes = float(ticks), float(ticks), 1.0, 0
        while self._count >= MEMORY:
            self._sum /= 2
            self._count /= 2

    def _learn(self, ticks: int) -> bool:
        """Whether the last steps agree on another period, which is then adopted."""
        if self._run and abs(ticks - self._candidate) <= 1:
            self._run += 1
            self._run_sum += ticks
        else:
            self._candidate, self._run, self._run_sum = ticks, 1, ticks
        if self._run < (CONSISTENT_LONGER if 0 < self.period_ticks < self._candidate else CONSISTENT):
            return False
        self._sum, self._count = float(self._run_sum), float(self._run)
        self.period_ticks = self._sum / self._count
        self._run = self._even = self.changes = 0
        self._before = -1
        return True
