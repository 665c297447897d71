"""Device ticks that wrap, made into device time that does not, and finer than a tick where the rate allows it."""

from typing import Final

from imud.clock.gaps import EVERY_TICK, PeriodLearner
from imud.units import NS_PER_US

QUANTISED: Final = 0.29
"""One-sigma error of a truncated stamp, in ticks: 1 / √12."""
SETTLED_CHANGES: Final = 64
"""After so many steps that differ from the one before, the phase of an uneven rate within its ticks is known to a small
part of one. At 400 Hz in ms that is 64 samples; a rate 50 ppm off 100 Hz takes ten minutes."""

EVEN_FOR: Final = 64
"""After so many even samples one uneven step is the counter's, not the device's: its samples stay even."""
FOLLOWED_NS: Final = 15 * NS_PER_US
"""So little out of its tick is the period's own error, which is followed."""
UNEVEN_NS: Final = 200 * NS_PER_US
"""A step that is off by less than this or a tick is no correction of the counter."""
UNEVEN_SHARE: Final = 0.25
WATCHED: Final = 256
"""So many samples after an uneven step or a gap their arrivals are held against it."""


class DeviceTime:
    """Unwrapped device time in ns, of the sample taken last.

    A stamp is truncated to a tick, so at 400 Hz a millisecond counter steps 2, 3, 2, 3. The samples are even all the
    same: `even_ns` steps by the learned period and is held inside the tick that the stamp names. Where a device that
    was even so far leaves it, its counter was corrected, or had been before: then the ticks are shifted instead.
    """

    __slots__ = (
        "_even_for", "_modulus", "_phase_ns", "_shift_ns", "_ticks", "doubt_ns", "even_ns", "gap", "missed", "period",
        "raw_ns", "step_ns", "tick_ns", "uneven", "watched",
    )  # fmt: skip

    def __init__(self, tick_ns: int, tick_modulus: int) -> None:
        self.tick_ns = tick_ns
        self._modulus = tick_modulus
        self._ticks = 0
        self._phase_ns = 0.0
        self._shift_ns = 0.0
        """What corrections of the counter took from it, and which is still in `even_ns`."""
        self._even_for = 0
        self.step_ns = 0
        """The newest step of the counter; back where that is shorter than half a turn forward."""
        self.uneven = False
        """Whether the newest step, after many even ones, is no whole number of periods by more than a tick."""
        self.gap = 0
        """Samples missing in the last gap, while it is watched."""
        self.doubt_ns = 0.0
        """By how much even samples were preferred to stamps, as long as no arrival confirms it."""
        self.watched = 0
        """So many samples more are held against their arrivals."""
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
        self._phase_ns = self._shift_ns = self.doubt_ns = 0.0
        self.missed = self.gap = self.watched = self._even_for = 0
        self.uneven = False
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
        self.missed = missed = period.step(step)
        self._even_for += 1
        if self.watched:
            self.watched -= 1
            self.uneven = False
        if missed:
            self.gap, self.watched = missed, WATCHED
            if step > self._modulus // 2:
                self._uneven(step)
        if step != period.period_ticks and (step or period.period_ticks < EVERY_TICK):
            off_ns = ((missed + 1) * period.period_ticks - step) * tick_ns
            phase_ns = self._phase_ns + off_ns
            self._phase_ns = held_ns = min(max(phase_ns, 0.0), float(tick_ns))
            if phase_ns != held_ns:
                self._leave_tick(step, off_ns, phase_ns - held_ns)
        self.even_ns = self.raw_ns + int(self._phase_ns + self._shift_ns)

    def _leave_tick(self, step: int, off_ns: float, over_ns: float) -> None:
        """The samples are even only if the newest is `over_ns` outside of its tick."""
        off, over, tick_ns = abs(off_ns), abs(over_ns), self.tick_ns
        settled = self._even_for >= EVEN_FOR and self.period.period_ticks > 0
        if off > max(tick_ns * 1.01, UNEVEN_NS):
            self._uneven(step)
        elif settled and over > FOLLOWED_NS:
            self._shift_ns += over_ns
            self.doubt_ns = max(self.doubt_ns, over)
            self.watched = WATCHED
        if over > UNEVEN_SHARE * tick_ns:
            self._even_for = 0

    def _uneven(self, step: int) -> None:
        """Note a step that samples lost do not explain; back, if that is shorter than half a turn forward."""
        self.step_ns = (step - self._modulus if step > self._modulus // 2 else step) * self.tick_ns
        self.uneven = self.uneven or self._even_for >= EVEN_FOR
        self.watched = WATCHED
        self._even_for = 0

    def make_even(self, x_before: int, periods: int) -> None:
        """The counter was set: the newest sample is so many periods after the one before, which was at `x_before`."""
        period_ns = self.period.period_ticks * self.tick_ns
        if self.step_ns < 0:
            self.raw_ns -= self._modulus * self.tick_ns
        self.even_ns = x_before + round(periods * period_ns)
        self._shift_ns = self.even_ns - self.raw_ns - self._phase_ns
        self.missed, self.gap = periods - 1, 0
        self.doubt_ns = min(abs(self.step_ns - periods * period_ns), period_ns)
        self.uneven = False

    def take_back(self, periods: int) -> None:
        """So many of the samples in the last gap were not missing: the counter was set forward."""
        back_ns = round(periods * self.period.period_ticks * self.tick_ns)
        self._shift_ns -= back_ns
        self.even_ns -= back_ns
        self.missed = max(self.missed - periods, 0)
        self.gap -= periods
        self._even_for = 0

    @property
    def error_ns(self) -> float:
        """One-sigma error of `even_ns` by the length of a tick; 0 where every stamp is off by the same."""
        changes = self.period.changes
        if not changes:
            return 0.0
        return QUANTISED * self.tick_ns * min(1.0, SETTLED_CHANGES / changes)
