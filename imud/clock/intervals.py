"""The time of samples from stamps of whole milliseconds: an interval each, narrowed by those of the last half minute.

All lines from device time to host time that pass through every interval are a feasible set (`feasible_lines`); its
middle is the estimate and its width the error. A device whose samples drift through the milliseconds of the other clock
narrows it to some ten µs within seconds; one in lockstep leaves a millisecond, however long it runs, and the error says
so. The fit of arrivals has no part in it, so that a link that misleads the fit does not narrow the set wrongly.
"""

from collections import deque
from math import hypot
from typing import Final

from imud.clock.arrival_fit import Point, feasible_lines, lower_hull
from imud.clock.link_delay import SIGMA_OF_RANGE
from imud.units import NS_PER_S, NS_PER_US

BIN_NS: Final = NS_PER_S
BINS: Final = 32
"""Half a minute: a crystal that drifts by 0.1 ppm/s leaves a straight line by 13 µs."""
NARROWEST_NS: Final = 60 * NS_PER_US
APART_SIGMAS: Final = 1.75
"""A constant delay that hides in the fit is anything up to √3 of its sigmas: within that nothing contradicts."""


class _Bin:
    """The narrowest bounds in an interval of device time, each with its device time."""

    __slots__ = ("begin_ns", "high", "high_device_ns", "low", "low_device_ns")

    def __init__(self, device_ns: int, low: int, high: int) -> None:
        self.begin_ns = self.low_device_ns = self.high_device_ns = device_ns
        self.low = low
        self.high = high

    def narrow(self, device_ns: int, low: int, high: int, slope: float) -> None:
        """Add another interval, `slope` host ns per device ns."""
        if low - self.low > slope * (device_ns - self.low_device_ns):
            self.low, self.low_device_ns = low, device_ns
        if high - self.high < slope * (device_ns - self.high_device_ns):
            self.high, self.high_device_ns = high, device_ns


class IntervalFit:
    """Lowest and highest possible time of a sample, by the intervals of the last half minute.

    The set is never taken for narrower than `narrowest_ns`.
    """

    __slots__ = (
        "_bins", "_fan", "_middle", "_narrowest_ns", "_ref_device_ns", "_ref_ns", "_slope", "_width_ns", "known",
        "newest_ns",
    )  # fmt: skip

    def __init__(self, narrowest_ns: int = NARROWEST_NS) -> None:
        self._narrowest_ns = narrowest_ns
        self._bins: deque[_Bin] = deque(maxlen=BINS)
        self._ref_device_ns = self._ref_ns = 0
        self._middle = 0.0
        self._slope = 1.0
        self._width_ns = self._fan = 0.0
        """Of the set at `_ref_device_ns`, and how much it opens per device ns from there on."""
        self.newest_ns = 0
        """Device time of the newest interval."""
        self.known = False
        """Whether there is an estimate."""

    def clear(self) -> None:
        """Forget all intervals."""
        self._bins.clear()
        self.known = False

    def add_interval(self, device_ns: int, low: int, high: int, arrival_ns: int, slope: float) -> None:
        """Add that the sample at `device_ns` is between `low` and `high`, and not after the arrival of its message.

        A device ns is about `slope` host ns.
        """
        if low < arrival_ns < high:
            high = arrival_ns
        bins = self._bins
        self.newest_ns = device_ns
        if bins and device_ns - bins[-1].begin_ns < BIN_NS:
            bins[-1].narrow(device_ns, low, high, slope)
            return
        if bins:
            self._fit(device_ns, slope)
        bins.append(_Bin(device_ns, low, high))

    def width_ns(self, device_ns: int) -> float:
        """Width of the set at `device_ns`, not before its newest end."""
        return self._width_ns + self._fan * (device_ns - self._ref_device_ns)

    def combined(self, device_ns: int, fit_ns: int, error_ns: float, common_ns: float) -> tuple[float, float]:
        """Return (what to add to the fit of arrivals for the sample at `device_ns`, one-sigma error after it).

        `error_ns` is the error of the fit, `common_ns` the error that all intervals share. Each weighs by its error,
        and the result lies within the set. Both can be wrong by the same uneven ticks, so the error is that of the
        better, and a fit that has to be moved into the set is worse by that. Where the two contradict each other beyond
        their errors, one of them is wrong, and nothing shows which: a device that gets no pulse any more reports for a
        while that it is on UTC.
        """
        width_ns = max(self.width_ns(device_ns), self._narrowest_ns)
        middle = self._ref_ns - fit_ns + self._middle + self._slope * (device_ns - self._ref_device_ns)
        own_ns = hypot(SIGMA_OF_RANGE * width_ns, common_ns)
        wanted = middle * error_ns * error_ns / (error_ns * error_ns + own_ns * own_ns)
        most = width_ns / 2 + 2 * common_ns
        held = min(max(wanted, middle - most), middle + most)
        error = min(own_ns, error_ns + abs(held - wanted))
        if abs(middle) > most + APART_SIGMAS * error_ns:
            error = max(error, (abs(held) + error_ns) / 2)
        return held, error

    def _fit(self, device_ns: int, slope: float) -> None:
        """Fit all bins again; the oldest go where no line passes through all."""
        bins = self._bins
        while bins:
            x0, y0 = bins[0].begin_ns, bins[0].low
            upper = [_point(b.high_device_ns - x0, b.high - y0, slope) for b in bins]
            lower = [_point(b.low_device_ns - x0, y0 - b.low, -slope) for b in bins]
            found = feasible_lines(lower_hull(upper), [(xl, -f) for xl, f in lower_hull(lower)], float(device_ns - x0))
            if found is not None and found.highest_ns >= found.lowest_ns:
                break
            for _ in range((len(bins) + 1) // 2):
                bins.popleft()
        else:
            self.known = False
            return
        self.known = True
        self._ref_device_ns, self._ref_ns = device_ns, y0
        self._middle = (found.lowest_ns + found.highest_ns) / 2 + slope * (device_ns - x0)
        self._slope = slope + (0.0 if len(bins) == 1 else (found.slope_lowest + found.slope_highest) / 2)
        self._width_ns = found.highest_ns - found.lowest_ns
        self._fan = found.slope_highest - found.slope_lowest


def _point(x: int, y: int, slope: float) -> Point:
    """A point relative to a line through the origin."""
    return float(x), y - slope * x
