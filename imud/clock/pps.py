"""A pulse per second that the host and the device both see: the device says how long before a sample it was.

`pps_age_ms` is in whole ms, taken as cut off (the HiPNUC manual 3.3.1 says "the time elapsed"; that it is cut and not
rounded is assumed, as in its other stamps), so each sample lies between pulse + age and a millisecond later. Behind a
plain UART the fit of arrivals knows more than that; behind a slow adapter the pulse does.
"""

from collections import deque
from collections.abc import Iterable
from typing import Final

from imud.clock.bounds import SIGMA_OF_RANGE, Bounds
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

AGE_MOST_MS: Final = 2000
"""One pulse may be missing; an older age belongs to a line that nobody drives."""
STAMP_NS: Final = 50 * NS_PER_US
"""The host's stamp of a pulse may be late by so much."""
SLACK_NS: Final = 2 * NS_PER_MS
SIGMAS: Final = 3
TOLERANCE_MOST_NS: Final = NS_PER_S // 4
STALE_NS: Final = 3 * NS_PER_S
KEPT: Final = 8


class PpsAge:
    """Intervals for the time of samples out of pulses and the ages of the newest one."""

    __slots__ = ("_pulses", "bounds", "trusted")

    def __init__(self) -> None:
        self._pulses: deque[int] = deque(maxlen=KEPT)
        self.bounds = Bounds()
        self.trusted = False
        """Whether the pulses say more than the fit."""

    def give(self, pulses_ns: Iterable[int]) -> None:
        """Rising edges in their order, before the messages that follow them."""
        self._pulses.extend(pulses_ns)

    def take(
        self, age_ms: int, x: int, y: int, fit_ns: int, fit_error_ns: float, slope: float, slope_error: float
    ) -> None:
        """A sample at device time `x`, by the fit at `fit_ns`, says that a pulse was `age_ms` before it.

        Its message began no later than `y`. A device ns is `slope` host ns, one sigma `slope_error`.
        """
        if age_ms > AGE_MOST_MS:
            return
        tolerance = min(SIGMAS * fit_error_ns + SLACK_NS, TOLERANCE_MOST_NS)
        tick = slope * NS_PER_MS
        age = age_ms * tick - fit_ns
        for t_ns in reversed(self._pulses):
            above = t_ns + age
            if -tolerance - tick <= above <= tolerance:
                low, doubt = fit_ns + int(above), int(SIGMAS * slope_error * age_ms * NS_PER_MS)
                self.bounds.add(x, low - STAMP_NS - doubt, low + int(tick) + doubt, y, slope)
                return

    def helps(self, x: int, fit_error_ns: float) -> bool:
        """Whether there are fresh intervals that know more than the fit; once they do, until they know half as much."""
        bounds = self.bounds
        if x - bounds.fresh_x > STALE_NS:
            bounds.clear()
        own_ns = SIGMA_OF_RANGE * bounds.width_ns(x)
        self.trusted = bounds.known and own_ns < fit_error_ns * (2 if self.trusted else 1)
        return self.trusted
