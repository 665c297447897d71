"""Time over a jump of the device's counter to UTC: from where the old fit ended, at the rate of UTC.

What the old fit knew of the device's crystal does not hold any more: the counter is UTC now, whatever the crystal does.
"""

from math import hypot
from typing import Final

RATE: Final = 50e-6
"""How far CLOCK_MONOTONIC is from the rate of UTC at most: a crystal's tolerance, where nothing steers it."""
TICK_SHARE: Final = 0.5
"""Where in its ticks the device measures is not known."""


class Holdover:
    """A line for as long as the new fit does not count. Errors grow with time."""

    __slots__ = ("_error_ns", "_t_ns", "_x")

    slope: Final = 1.0
    """Host ns per device ns."""
    slope_error: Final = RATE

    def __init__(self, x: int, t_ns: int, error_ns: float, tick_ns: int) -> None:
        self._x = x
        self._t_ns = t_ns
        self._error_ns = hypot(error_ns, TICK_SHARE * tick_ns)

    def at(self, x: int) -> int:
        """Host time at device time `x`."""
        return self._t_ns + x - self._x

    def error_ns(self, x: int) -> float:
        """One-sigma error of that."""
        return self._error_ns + RATE * (x - self._x)
