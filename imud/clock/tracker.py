"""A line through the stamps of even events: where the next one is due, and how far stamps spread about it.

Unlike arrivals, stamps of a line are late by microseconds, so their mean is followed and not their lower envelope: at
first a fit of equal weights, later one that forgets (alpha-beta filter), 32 events long. A crystal that drifts by
0.1 ppm/s is then followed within 0.1 µs at 10 Hz and above.
"""

from typing import Final

from imud.units import NS_PER_US

MEMORY: Final = 32
SMOOTHING: Final = 1 / 32
FIRST_SPREAD_NS: Final = 10 * NS_PER_US
_LEVEL: Final = (1.0, 1.0, *(2 * (2 * n - 1) / (n * (n + 1)) for n in range(2, MEMORY + 1)))
_SLOPE: Final = (0.0, 0.0, *(6 / (n * (n + 1)) for n in range(2, MEMORY + 1)))
"""Gains of the n-th of equally weighted points on a line."""


class Tracker:
    """A line from device time to host time, through the stamps."""

    __slots__ = ("_count", "_offset", "_x", "_y", "slope", "spread_ns")

    def __init__(self, x: int, y: int, slope: float) -> None:
        self._x = x
        self._y = y
        self._offset = 0.0
        """The line at `_x`, above `_y`: floats of ns since boot lose digits after some months."""
        self._count = 1
        self.slope = slope
        """Host ns per device ns."""
        self.spread_ns = float(FIRST_SPREAD_NS)
        """Mean distance of stamps from where they were due."""

    def above(self, x: int, y: int) -> float:
        """How much later than due at `x` an event at `y` is, ns."""
        return y - self._y - self._offset - self.slope * (x - self._x)

    def at(self, x: int) -> int:
        """When the event at `x` is due."""
        return self._y + int(self._offset + self.slope * (x - self._x))

    def take(self, x: int, y: int, above: float) -> None:
        """Follow an event `above` its due time; x rises."""
        self._count = n = self._count + 1 if self._count < MEMORY else MEMORY
        self.slope += _SLOPE[n] * above / (x - self._x)
        self._offset = (_LEVEL[n] - 1.0) * above
        self._x, self._y = x, y
        self.spread_ns += ((above if above > 0 else -above) - self.spread_ns) * SMOOTHING

    def judge(self, above: float) -> None:
        """An event was seen so far from its due time, whether it is followed or not."""
        self.spread_ns += (abs(above) - self.spread_ns) * SMOOTHING
