"""Devices on UTC or with a pulse per second: each sample lies within a millisecond of known time.

`DeviceUtc`: with PPS and RMC the ms counter of a HiPNUC module turns into "UTC in ms" (manual 1.2.1); of 32 bits, so
either Unix time modulo 2³² or the time of day, no source says which. A counter that agrees with the host's UTC within
milliseconds eight times in a second or more, or right after it jumped, is UTC. GPS time, 18 s ahead, never agrees.

`PpsAge`: the host and the device both see a pulse per second, and `pps_age_ms` is how long before a sample it was. It
is in whole ms, taken as cut off (the HiPNUC manual 3.3.1 says "the time elapsed"; that it is cut and not rounded is
assumed, as in its other stamps), so each sample lies between pulse + age and a millisecond later. Behind a plain UART
the fit of arrivals is better than that; behind a slow adapter the pulse is.
"""

from collections import deque
from collections.abc import Iterable
from math import hypot, sqrt
from typing import Final

from imud.contracts.lines import UtcReference
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import Point, feasible_lines, lower_hull
from imud.sampling.arrival_time import SIGMA_OF_RANGE

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
        # of the set at `_ref_device_ns`, and how much it opens per device ns from there on
        self._width_ns = self._fan = 0.0
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


DAY_NS: Final = 86_400 * NS_PER_S
SIGMAS: Final = 3
SLACK_NS: Final = 2 * NS_PER_MS
TOLERANCE_MOST_NS: Final = NS_PER_S // 4
AGREEMENTS: Final = 8
DISAGREEMENTS: Final = 8
TICK_ERROR: Final = 1 / sqrt(6)
"""Half a tick with the intervals' own 1 / √12. Both errors can stand still at their bounds for a minute (20 ppm at 100
Hz), a tick together, and twice the stated error covers that."""
CHECK_EVERY_NS: Final = NS_PER_S // 8
"""A device that is not on UTC is checked so often."""
REFERENCE_STEP: Final = 4
"""Change of a reference, in its errors, above which it was set anew: earlier intervals no longer hold."""
AGE_MOST_MS: Final = 2000
"""Oldest valid age: one pulse may be missing; an older age belongs to an input without pulses."""
STAMP_NS: Final = 50 * NS_PER_US
"""The host's stamp of a pulse may be late by so much."""
STALE_NS: Final = 3 * NS_PER_S
PULSES_KEPT: Final = 8


class DeviceUtc:
    """Detection that a device's counter is UTC, and the time of its samples by UTC."""

    __slots__ = ("_agreed", "_checked_ns", "_differed", "_tick_ns", "_turn_ns", "active", "intervals", "reference")

    def __init__(self, tick_ns: int, tick_modulus: int) -> None:
        self._tick_ns = tick_ns
        self._turn_ns = tick_ns * tick_modulus
        self._agreed = 0
        self._differed = 0
        self._checked_ns = 0
        self.reference: UtcReference | None = None
        """The host's estimate of UTC; None while it has none."""
        self.active = False
        """Whether the device is on UTC."""
        self.intervals = IntervalFit(tick_ns)  # device time itself is no finer than that

    @property
    def tick_error_ns(self) -> float:
        """Additional error: device time is as coarse as UTC now, and samples need not keep step with it."""
        return TICK_ERROR * self._tick_ns

    def set_reference(self, reference: UtcReference | None) -> None:
        """Set the host's present estimate of UTC."""
        before = self.reference
        if before and reference:
            step_ns = abs(reference.offset_ns - before.offset_ns)
            if step_ns > REFERENCE_STEP * (reference.error_ns + before.error_ns):
                self.intervals.clear()
        self.reference = reference
        if reference is None:
            self.reset()

    def reset(self) -> None:
        """Forget that the device was on UTC."""
        self.active = False
        self._agreed = self._differed = 0
        self._checked_ns = 0
        self.intervals.clear()

    def above(self, ticks: int, t_ns: int, error_ns: float) -> int | None:
        """How much later than `t_ns`, one sigma `error_ns`, the tick began by UTC; None when it does not agree."""
        reference = self.reference
        if reference is None:
            return None
        tolerance = min(SIGMAS * (error_ns + reference.error_ns) + SLACK_NS, TOLERANCE_MOST_NS)
        device_ns = ticks * self._tick_ns
        off_ns = device_ns - t_ns - reference.offset_ns
        for turn_ns in (self._turn_ns, DAY_NS):
            half = turn_ns // 2
            above = (off_ns + half) % turn_ns - half
            if -tolerance - self._tick_ns <= above <= tolerance and device_ns < turn_ns:
                return above
        return None

    def add_sample(
        self, ticks: int, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, slope: float, *,
        refused: bool,
    ) -> None:  # fmt: skip
        """Compare the sample at `device_ns`, by the fit at `fit_ns`, with UTC.

        Its message began at `arrival_ns` at the latest; `refused` when the device's status says it is not on UTC.
        """
        if refused or self.reference is None:
            if self.active or self._agreed:
                self.reset()
            return
        if not self.active:
            if 0 <= device_ns - self._checked_ns < CHECK_EVERY_NS:
                return
            self._checked_ns = device_ns
        above = self.above(ticks, fit_ns, fit_error_ns)
        if above is None:
            self._agreed = 0
            self._differed += 1
            if self.active and self._differed >= DISAGREEMENTS:
                self.reset()
            return
        self._differed = 0
        self._agreed += 1
        if self._agreed >= AGREEMENTS:
            self.active = True
        if self.active:
            self.intervals.add_interval(device_ns, fit_ns + above, fit_ns + above + self._tick_ns, arrival_ns, slope)

    def confirm(self) -> None:
        """Accept at once that the device is on UTC: its counter jumped to what agrees, which is no chance."""
        self.intervals.clear()
        self.active = True
        self._agreed, self._differed = AGREEMENTS, 0


class PpsAge:
    """Intervals for the time of samples, from pulses per second and from the samples' age since the newest pulse."""

    __slots__ = ("_pulses_ns", "_trusted", "intervals")

    def __init__(self) -> None:
        self._pulses_ns: deque[int] = deque(maxlen=PULSES_KEPT)
        self._trusted = False
        self.intervals = IntervalFit()

    def add_pulses(self, pulses_ns: Iterable[int]) -> None:
        """Add rising edges in their order, before the messages that follow them."""
        self._pulses_ns.extend(pulses_ns)

    def add_age(
        self, age_ms: int, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, slope: float,
        slope_error: float,
    ) -> None:  # fmt: skip
        """Add that a pulse was `age_ms` before the sample at `device_ns`, which is at `fit_ns` by the fit.

        Its message began at `arrival_ns` at the latest. A device ns is `slope` host ns, one sigma `slope_error`.
        """
        if age_ms > AGE_MOST_MS:
            return
        tolerance = min(SIGMAS * fit_error_ns + SLACK_NS, TOLERANCE_MOST_NS)
        tick = slope * NS_PER_MS
        age = age_ms * tick - fit_ns
        for t_ns in reversed(self._pulses_ns):
            above = t_ns + age
            if -tolerance - tick <= above <= tolerance:
                low, doubt = fit_ns + int(above), int(SIGMAS * slope_error * age_ms * NS_PER_MS)
                self.intervals.add_interval(
                    device_ns, low - STAMP_NS - doubt, low + int(tick) + doubt, arrival_ns, slope
                )
                return

    def is_better(self, device_ns: int, fit_error_ns: float) -> bool:
        """Whether fresh intervals are better than the fit; once they are, until they are half as good."""
        intervals = self.intervals
        if device_ns - intervals.newest_ns > STALE_NS:
            intervals.clear()
        own_ns = SIGMA_OF_RANGE * intervals.width_ns(device_ns)
        self._trusted = intervals.known and own_ns < fit_error_ns * (2 if self._trusted else 1)
        return self._trusted
