"""A device whose counter is UTC: recognised by agreement with what the host knows, and given up when that ends.

With PPS and RMC the ms counter of a HiPNUC module turns into "UTC in ms" (manual 1.2.1); of 32 bits, so either Unix
time modulo 2³² or the time of day, no source says which. A counter that agrees with the host's UTC within milliseconds
eight times in a second or more, or right after it jumped, is UTC. GPS time, which is 18 s ahead, never agrees.
"""

from math import sqrt
from typing import Final

from imud.clock.bounds import Bounds
from imud.contracts.timing import UtcReference
from imud.units import NS_PER_MS, NS_PER_S

DAY_NS: Final = 86_400 * NS_PER_S
SIGMAS: Final = 3
SLACK_NS: Final = 2 * NS_PER_MS
TOLERANCE_MOST_NS: Final = NS_PER_S // 4
AGREEMENTS: Final = 8
DISAGREEMENTS: Final = 8
TICK_ERROR: Final = 1 / sqrt(6)
"""Half a tick with the corridor's own 1 / √12. Both errors can stand still at their bounds for a minute (20 ppm at 100
Hz), a tick together, and twice the stated error covers that."""
CHECK_EVERY_NS: Final = NS_PER_S // 8
"""A device that is not on UTC is looked at so often."""


class DeviceUtc:
    """Whether a device's counter is UTC, and where samples lie by it."""

    __slots__ = ("_agreed", "_check_x", "_differed", "_tick_ns", "_turn_ns", "bounds", "on", "reference")

    def __init__(self, tick_ns: int, tick_modulus: int) -> None:
        self._tick_ns = tick_ns
        self._turn_ns = tick_ns * tick_modulus
        self._agreed = 0
        self._differed = 0
        self._check_x = 0
        self.reference: UtcReference | None = None
        self.on = False
        """Whether the device is on UTC."""
        self.bounds = Bounds(tick_ns)  # device time itself is no finer than that

    @property
    def tick_error_ns(self) -> float:
        """Device time is as coarse as UTC now, and samples need not keep step with it: so much besides the corridor."""
        return TICK_ERROR * self._tick_ns

    def off(self) -> None:
        """The device is not on UTC, or nobody can tell any more."""
        self.on = False
        self._agreed = self._differed = 0
        self._check_x = 0
        self.bounds.clear()

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

    def take(
        self, ticks: int, x: int, y: int, fit_ns: int, fit_error_ns: float, slope: float, *, refused: bool
    ) -> None:
        """A sample at device time `x`, by the fit at `fit_ns`; `refused` when the device says it is not on UTC.

        Its message began no later than `y`.
        """
        if refused or self.reference is None:
            if self.on or self._agreed:
                self.off()
            return
        if not self.on:
            if 0 <= x - self._check_x < CHECK_EVERY_NS:
                return
            self._check_x = x
        above = self.above(ticks, fit_ns, fit_error_ns)
        if above is None:
            self._agreed = 0
            self._differed += 1
            if self.on and self._differed >= DISAGREEMENTS:
                self.off()
            return
        self._differed = 0
        self._agreed += 1
        if self._agreed >= AGREEMENTS:
            self.on = True
        if self.on:
            self.bounds.add(x, fit_ns + above, fit_ns + above + self._tick_ns, y, slope)

    def turned(self) -> None:
        """The counter jumped to what agrees with UTC: no chance does that."""
        self.bounds.clear()
        self.on = True
        self._agreed, self._differed = AGREEMENTS, 0
