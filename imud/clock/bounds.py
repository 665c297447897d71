"""Where the truth can lie by stamps of whole milliseconds: each says between which two instants, all together say more.

All lines from device time to host time that pass through every interval are a corridor (`corridor`); its middle is the
answer and its width the error. A device whose samples drift through the milliseconds of the other clock narrows it to
some ten µs within seconds; one in lockstep leaves a millisecond for ever, and that is then what is said. The fit of
arrivals has no part in it, so that a link that misleads the fit does not narrow the corridor wrongly.
"""

from collections import deque
from math import hypot, sqrt
from typing import Final

from imud.clock.corridor import Point, corridor
from imud.clock.envelope import lower_hull
from imud.units import NS_PER_S, NS_PER_US

BIN_NS: Final = NS_PER_S
BINS: Final = 32
"""Half a minute: a crystal that drifts by 0.1 ppm/s leaves a straight line by 13 µs."""
NARROWEST_NS: Final = 60 * NS_PER_US
SIGMA_OF_RANGE: Final = 1 / sqrt(12)
APART_SIGMAS: Final = 1.75
"""A constant delay that hides in the fit is anything up to √3 of its sigmas: within that nothing contradicts."""


class _Bin:
    """The narrowest floor and ceiling of a stretch of device time, each with the device time it stands at."""

    __slots__ = ("begin", "high", "high_x", "low", "low_x")

    def __init__(self, x: int, low: int, high: int) -> None:
        self.begin = self.low_x = self.high_x = x
        self.low = low
        self.high = high

    def narrow(self, x: int, low: int, high: int, slope: float) -> None:
        """Take another interval, `slope` host ns per device ns."""
        if low - self.low > slope * (x - self.low_x):
            self.low, self.low_x = low, x
        if high - self.high < slope * (x - self.high_x):
            self.high, self.high_x = high, x


class Bounds:
    """Lowest and highest time that a sample can have, by the intervals of the last half minute."""

    __slots__ = ("_bins", "_fan", "_middle", "_narrowest_ns", "_slope", "_width_ns", "_x", "_y", "fresh_x", "known")

    def __init__(self, narrowest_ns: int = NARROWEST_NS) -> None:
        self._narrowest_ns = narrowest_ns
        self._bins: deque[_Bin] = deque(maxlen=BINS)
        self._x = self._y = 0
        self._middle = 0.0
        self._slope = 1.0
        self._width_ns = self._fan = 0.0
        """Of the corridor at `_x`, and how much it opens per device ns from there on."""
        self.fresh_x = 0
        """Device time of the newest interval."""
        self.known = False
        """Whether there is a corridor."""

    def clear(self) -> None:
        """Nothing is known any more."""
        self._bins.clear()
        self.known = False

    def add(self, x: int, low: int, high: int, arrival_ns: int, slope: float) -> None:
        """The sample at device time `x` is between `low` and `high`, and not after the arrival of its message.

        A device ns is about `slope` host ns.
        """
        if low < arrival_ns < high:
            high = arrival_ns
        bins = self._bins
        self.fresh_x = x
        if bins and x - bins[-1].begin < BIN_NS:
            bins[-1].narrow(x, low, high, slope)
            return
        if bins:
            self._fit(x, slope)
        bins.append(_Bin(x, low, high))

    def width_ns(self, x: int) -> float:
        """Of the corridor at device time `x`, not before its newest end."""
        return self._width_ns + self._fan * (x - self._x)

    def improved(self, x: int, fit_ns: int, error_ns: float, common_ns: float) -> tuple[float, float]:
        """(what to add to the fit for the sample at `x`, one-sigma error after it); `error_ns` is the fit's.

        `common_ns` is the error that all intervals share. Each weighs by its error, and the result lies within the
        corridor. Both can be wrong by the same uneven ticks, so the error is that of the better, and a fit that has to
        be moved into the corridor is worse by that. Where the two contradict each other beyond their errors, one of
        them is wrong, and nothing says which: a device that gets no pulse any more says for a while that it is on UTC.
        """
        width_ns = max(self.width_ns(x), self._narrowest_ns)
        middle = self._y - fit_ns + self._middle + self._slope * (x - self._x)
        own_ns = hypot(SIGMA_OF_RANGE * width_ns, common_ns)
        wanted = middle * error_ns * error_ns / (error_ns * error_ns + own_ns * own_ns)
        most = width_ns / 2 + 2 * common_ns
        held = min(max(wanted, middle - most), middle + most)
        error = min(own_ns, error_ns + abs(held - wanted))
        if abs(middle) > most + APART_SIGMAS * error_ns:
            error = max(error, (abs(held) + error_ns) / 2)
        return held, error

    def _fit(self, x: int, slope: float) -> None:
        """Lay the corridor through all bins again; the oldest go where no line passes through all."""
        bins = self._bins
        while bins:
            x0, y0 = bins[0].begin, bins[0].low
            ceiling = [_point(b.high_x - x0, b.high - y0, slope) for b in bins]
            floor = [_point(b.low_x - x0, y0 - b.low, -slope) for b in bins]
            found = corridor(lower_hull(ceiling), [(xf, -f) for xf, f in lower_hull(floor)], float(x - x0))
            if found is not None and found.highest_ns >= found.lowest_ns:
                break
            for _ in range((len(bins) + 1) // 2):
                bins.popleft()
        else:
            self.known = False
            return
        self.known = True
        self._x, self._y = x, y0
        self._middle = (found.lowest_ns + found.highest_ns) / 2 + slope * (x - x0)
        self._slope = slope + (0.0 if len(bins) == 1 else (found.slope_lowest + found.slope_highest) / 2)
        self._width_ns = found.highest_ns - found.lowest_ns
        self._fan = found.slope_highest - found.slope_lowest


def _point(x: int, y: int, slope: float) -> Point:
    """A point relative to a line through the origin."""
    return float(x), y - slope * x
