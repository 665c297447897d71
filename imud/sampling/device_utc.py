"""Devices with UTC or with a pulse per second: the time of each sample is known within one millisecond.

`DeviceUtc`: with PPS and RMC, the ms counter of a HiPNUC device becomes "UTC in ms" (manual 1.2.1). The counter has 32
bits. It is therefore Unix time modulo 2³² or the time of day; no source defines which. A counter is UTC if it agrees
with the host's UTC within some milliseconds eight times in at least one second, or directly after a jump. GPS time is
18 s ahead and never agrees.

`PpsAge`: host and device receive the same pulse per second. `pps_age_ms` is the time from the pulse to the sample in
whole ms, assumed as truncated (the HiPNUC manual 3.3.1 says only "the time elapsed"; other counters are truncated).
Each sample is therefore between pulse + age and one millisecond later. Behind a UART without an adapter, the fit of
arrivals is more accurate. Behind a slow adapter, the pulse is more accurate.
"""

from collections import deque
from collections.abc import Iterable
from math import hypot, sqrt
from typing import Final

from imud.contracts.lines import UtcReference
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import Point, feasible_lines, lower_hull
from imud.sampling.arrival_time import SIGMA_OF_RANGE

# 32 s of intervals: a crystal that drifts by 0.1 ppm/s is then at most 13 µs off a straight line
BIN_NS: Final = NS_PER_S
BINS: Final = 32
NARROWEST_NS: Final = 60 * NS_PER_US
# maximum distance between fit and intervals without a contradiction, in standard errors: a constant delay can be √3.
APART_SIGMAS: Final = 1.75


class _Bin:
    """Narrowest bounds of the time in an interval of device time."""

    __slots__ = ("begin_ns", "high", "high_device_ns", "low", "low_device_ns")

    def __init__(self, device_ns: int, low: int, high: int) -> None:
        self.begin_ns = self.low_device_ns = self.high_device_ns = device_ns
        self.low = low
        self.high = high

    def narrow(self, device_ns: int, low: int, high: int, slope: float) -> None:
        """Add bounds at `device_ns`. `slope` is host ns per device ns."""
        if low - self.low > slope * (device_ns - self.low_device_ns):
            self.low, self.low_device_ns = low, device_ns
        if high - self.high < slope * (device_ns - self.high_device_ns):
            self.high, self.high_device_ns = high, device_ns


class IntervalFit:
    """Lowest and highest possible time of a sample, from the intervals of the last 32 s. The width of the result is at
    least `narrowest_ns`."""

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
        # width at `_ref_device_ns`, and its increase per device ns
        self._width_ns = self._fan = 0.0
        self.newest_ns = 0  # device time of the newest interval, ns
        self.known = False  # whether the fit has a result

    def clear(self) -> None:
        self._bins.clear()
        self.known = False

    def add_interval(self, device_ns: int, low: int, high: int, arrival_ns: int, slope: float) -> None:
        """Add that the sample at `device_ns` is between `low` and `high`, and not after the arrival of its frame.
        `slope` is the approximate host ns per device ns."""
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
        return self._width_ns + self._fan * (device_ns - self._ref_device_ns)

    def combined(self, device_ns: int, fit_ns: int, error_ns: float, common_ns: float) -> tuple[float, float]:
        """Return (correction of the fit of arrivals at `device_ns`, one-sigma error after the correction), ns."""
        # `error_ns` is the error of the fit, `common_ns` the error that all intervals share. The result is the weighted
        # mean of both, and is within the bounds. The same uneven ticks can affect both, so the error is the smaller of
        # both errors. A fit that is outside of the bounds has a larger error. If both contradict each other, the error
        # is half of the difference, because it is unknown which of them is wrong: a device without pulses reports for a
        # time that it is on UTC.
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
        """Fit all bins again. If no line passes through all bins, drop the older half."""
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
    return float(x), y - slope * x


DAY_NS: Final = 86_400 * NS_PER_S
SIGMAS: Final = 3
SLACK_NS: Final = 2 * NS_PER_MS
TOLERANCE_MOST_NS: Final = NS_PER_S // 4
AGREEMENTS: Final = 8
DISAGREEMENTS: Final = 8
# Additional one-sigma error, ticks: half a tick combined with the 1 / √12 of the intervals. Both errors can stay at
# their bounds for one minute (20 ppm at 100 Hz). Twice this error covers their sum, one tick.
TICK_ERROR: Final = 1 / sqrt(6)
CHECK_EVERY_NS: Final = NS_PER_S // 8  # time between checks of a device that is not on UTC, ns
REFERENCE_STEP: Final = 4  # change of the reference, in its errors, after which earlier intervals are invalid
# Maximum valid age, ms: one pulse may be lost. A larger age means that the input receives no pulses.
AGE_MOST_MS: Final = 2000
STAMP_NS: Final = 50 * NS_PER_US  # maximum delay of the host's time stamp of a pulse, ns
STALE_NS: Final = 3 * NS_PER_S
PULSES_KEPT: Final = 8


class DeviceUtc:
    """Detection of a device counter that is UTC, and the time of its samples by UTC."""

    __slots__ = ("_agreed", "_checked_ns", "_differed", "_tick_ns", "_turn_ns", "active", "intervals", "reference")

    def __init__(self, tick_ns: int, tick_modulus: int) -> None:
        self._tick_ns = tick_ns
        self._turn_ns = tick_ns * tick_modulus
        self._agreed = 0
        self._differed = 0
        self._checked_ns = 0
        self.reference: UtcReference | None = None  # the host's estimate of UTC; None if unknown
        self.active = False  # whether the device is on UTC
        self.intervals = IntervalFit(tick_ns)  # device time is not finer than a tick

    @property
    def tick_error_ns(self) -> float:
        """Return the one-sigma error of the device time, ns. Samples can be anywhere in a tick."""
        return TICK_ERROR * self._tick_ns

    def set_reference(self, reference: UtcReference | None) -> None:
        """Set the host's present estimate of UTC. Discard the intervals if it changed by a step."""
        before = self.reference
        if before and reference:
            step_ns = abs(reference.offset_ns - before.offset_ns)
            if step_ns > REFERENCE_STEP * (reference.error_ns + before.error_ns):
                self.intervals.clear()
        self.reference = reference
        if reference is None:
            self.reset()

    def reset(self) -> None:
        """Mark the device as not on UTC."""
        self.active = False
        self._agreed = self._differed = 0
        self._checked_ns = 0
        self.intervals.clear()

    def above(self, ticks: int, t_ns: int, error_ns: float) -> int | None:
        """Return the time from `t_ns` to the start of the tick by UTC, ns; None if the counter does not agree with UTC.
        `error_ns` is the one-sigma error of `t_ns`."""
        reference = self.reference
        if reference is None:
            return None
        tolerance = min(SIGMAS * (error_ns + reference.error_ns) + SLACK_NS, TOLERANCE_MOST_NS)
        device_ns = ticks * self._tick_ns
        off_ns = device_ns - t_ns - reference.offset_ns
        for turn_ns in (self._turn_ns, DAY_NS):  # Unix time modulo 2³², or the time of day
            half = turn_ns // 2
            above = (off_ns + half) % turn_ns - half
            if -tolerance - self._tick_ns <= above <= tolerance and device_ns < turn_ns:
                return above
        return None

    def add_sample(
        self, ticks: int, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, slope: float, *,
        refused: bool,
    ) -> None:  # fmt: skip
        """Compare the sample at `device_ns`, at `fit_ns` according to the fit, with UTC. `arrival_ns` is the latest
        start of its frame. `refused`: the device reports that it is not on UTC."""
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
        """Mark the device as on UTC immediately: its counter jumped to a value that agrees."""
        self.intervals.clear()
        self.active = True
        self._agreed, self._differed = AGREEMENTS, 0


class PpsAge:
    """Intervals for the time of samples, from the pulses per second and the age of each sample."""

    __slots__ = ("_pulses_ns", "_trusted", "intervals")

    def __init__(self) -> None:
        self._pulses_ns: deque[int] = deque(maxlen=PULSES_KEPT)
        self._trusted = False
        self.intervals = IntervalFit()

    def add_pulses(self, pulses_ns: Iterable[int]) -> None:
        """Add rising edges in order, before the frames that follow them."""
        self._pulses_ns.extend(pulses_ns)

    def add_age(
        self, age_ms: int, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, slope: float,
        slope_error: float,
    ) -> None:  # fmt: skip
        """Add that a pulse was `age_ms` before the sample at `device_ns`, at `fit_ns` according to the fit.

        `arrival_ns` is the latest start of its frame. `slope` is host ns per device ns, `slope_error` its one-sigma
        error.
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
        """Return whether the intervals are more accurate than the fit, or up to half as accurate if they are in use."""
        intervals = self.intervals
        if device_ns - intervals.newest_ns > STALE_NS:
            intervals.clear()
        own_ns = SIGMA_OF_RANGE * intervals.width_ns(device_ns)
        self._trusted = intervals.known and own_ns < fit_error_ns * (2 if self._trusted else 1)
        return self._trusted
