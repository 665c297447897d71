"""Device ticks that wrap, made into device time that does not, and finer than a tick where the rate allows it."""

from typing import Final

from imud.clock.gaps import EVERY_TICK, PeriodLearner

QUANTISED: Final = 0.29
"""One-sigma error of a truncated stamp, in ticks: 1 / √12."""
SETTLED_CHANGES: Final = 64
"""After so many steps that differ from the one before, the phase of an uneven rate within its ticks is known to a small
part of one. At 400 Hz in ms that is 64 samples; a rate 50 ppm off 100 Hz takes ten minutes."""


class DeviceTime:
    """Unwrapped device time in ns, of the sample taken last.

    A stamp is truncated to a tick, so at 400 Hz a millisecond counter steps 2, 3, 2, 3. The samples are even all the
    same: `even_ns` steps by the learned period and is only held inside the tick that the stamp names.
    """

    __slots__ = ("_modulus", "_phase_ns", "_ticks", "even_ns", "missed", "period", "raw_ns", "tick_ns")

    def __init__(self, tick_ns: int, tick_modulus: int) -> None:
        self.tick_ns = tick_ns
        self._modulus = tick_modulus
        self._ticks = 0
        self._phase_ns = 0.0
        self.period = PeriodLearner()
        self.raw_ns = 0
        """Unwrapped device time as stamped."""
        self.even_ns = 0
        """As `raw_ns`, with the part of a tick that an uneven rate gives away; never falls while the clock runs on."""
        self.missed = 0
        """Samples missing between the last two."""

    def begin(self, ticks: int) -> None:
        """Take the first stamp of a device, or the first after its clock started anew."""
        self._ticks = ticks
        self._phase_ns = 0.0
        self.missed = 0
        self.raw_ns = self.even_ns = ticks % self._modulus * self.tick_ns

    def peek_ns(self, ticks: int) -> int:
        """Device time from the last stamp to this one, if the counter only went forward and wrapped once at most."""
        return (ticks - self._ticks) % self._modulus * self.tick_ns

    def advance(self, ticks: int) -> None:
        """Take the next stamp."""
        step = (ticks - self._ticks) % self._modulus
        self._ticks = ticks
        tick_ns = self.tick_ns
        self.raw_ns += step * tick_ns
        period = self.period
        self.missed = period.step(step)
        if step != period.period_ticks and (step or period.period_ticks < EVERY_TICK):
            off_ns = ((self.missed + 1) * period.period_ticks - step) * tick_ns
            self._phase_ns = min(max(self._phase_ns + off_ns, 0.0), float(tick_ns))
        self.even_ns = self.raw_ns + int(self._phase_ns)

    @property
    def error_ns(self) -> float:
        """One-sigma error of `even_ns` by the length of a tick; 0 where every stamp is off by the same."""
        changes = self.period.changes
        if not changes:
            return 0.0
        return QUANTISED * self.tick_ns * min(1.0, SETTLED_CHANGES / changes)
