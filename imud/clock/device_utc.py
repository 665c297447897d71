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
from math import sqrt
from typing import Final

from imud.clock.intervals import IntervalFit
from imud.clock.link_delay import SIGMA_OF_RANGE
from imud.contracts.timing import UtcReference
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

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
