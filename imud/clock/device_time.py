"""Device time from a counter: unwrapped, finer than its tick, without its corrections; missing samples; jumps.

    ticks ─▶ DeviceTime.advance ─▶ raw_ns, even_ns, missed        period_learner: the step between samples
                    │
                    ├─ absorb_correction: the counter was set by a little while the samples went on
                    └─ JumpDetector: the counter began anew, or is another time

Counters that number the samples and give no time are in `gaps`. Nothing here reads a clock.
"""

from collections.abc import Callable
from typing import Final

from imud.clock.arrival_fit import SLOPE_HIGHEST, ArrivalFit
from imud.clock.gaps import CounterLine
from imud.clock.period_learner import EVERY_TICK, GAP_FACTOR, PeriodLearner
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

# --- device time finer than a tick ----------------------------------------------------------------------------------
QUANTISED: Final = 0.29
"""One-sigma error of a truncated stamp, in ticks: 1 / √12."""
SETTLED_CHANGES: Final = 64
"""After so many steps that differ from the one before, the phase of an uneven rate within its ticks is known to a small
part of one. At 400 Hz in ms that is 64 samples; a rate 50 ppm off 100 Hz takes ten minutes."""
UNSETTLED_MOST: Final = 512
"""Number of samples of a new rate within which its phase may settle; one that takes longer drifts slowly."""
EVEN_FOR: Final = 64
"""Number of even samples after which one uneven step is the counter's, not the device's: its samples stay even."""
FOLLOWED_NS: Final = 15 * NS_PER_US
"""A sample that is outside its tick by no more shows the error of the learned period, which is followed."""
UNEVEN_NS: Final = 200 * NS_PER_US
"""A step that is off by less than this or a tick is no correction of the counter."""
UNEVEN_SHARE: Final = 0.25
WATCHED: Final = 256
"""Number of samples after an uneven step or a gap whose device time is compared with the arrivals."""

# --- corrections ----------------------------------------------------------------------------------------------------
CORRECTION_MOST_NS: Final = 250 * NS_PER_MS
"""A counter that moves by more jumped to another time. An hour and more without pulses at 50 ppm."""
CORRECTION_SPAN_NS: Final = 5 * NS_PER_S
"""A fit over less time swings by more than a correction."""
CORRECTION_SIGMAS: Final = 4
CORRECTION_TICKS: Final = 0.5
"""Distance below the fit at which a message came before its sample, if that was taken at its stamp."""
REPHASED_TICKS: Final = 1.05
"""The same for a step that may be the first of another rate: its samples may be anywhere in their ticks."""

# --- jumps ----------------------------------------------------------------------------------------------------------
JUMP_EARLY_NS: Final = 5.0 * NS_PER_MS
JUMP_EARLY_SIGMAS: Final = 10
"""A message so far below the fit shows that the device's clock jumped ahead."""
FIRST_EARLY_NS: Final = NS_PER_S
"""The same before the fit is used: the first message may have waited that long in a buffer."""
JUMP_LATE_NS: Final = NS_PER_S / 2
JUMP_LATE_READS: Final = 3
"""Number of late reads over a second that show a jump of the device's clock: fewer may be a busy host's queue."""


class DeviceTime:
    """Unwrapped device time in ns, of the newest sample.

    A stamp is truncated to a tick, so at 400 Hz a millisecond counter steps 2, 3, 2, 3. The samples are even all the
    same: `even_ns` steps by the learned period and is held inside the tick that the stamp names. Where a device that
    was even so far leaves its tick, the counter was corrected, or had been before: then the ticks are shifted instead.

    A module on UTC takes back at the first pulse after a break what its crystal gathered: 0.9 ms after 30 s at 30 ppm,
    30 ms after ten minutes at 50 ppm. Its sampling does not move with the counter. A step that is no whole number of
    periods, or one over samples that were not lost, is therefore compared with the arrivals (`absorb_correction`):
    where they fit the next sample better than the stamp, the step is taken out of device time, and the fit and the
    pairing of edges go on undisturbed. Corrections within a tick need no arrivals: samples stay even over them.
    """

    __slots__ = (
        "_even_for", "_gap", "_phase_ns", "_shift_ns", "_step_ns", "_unsettled", "_unsure_ns", "doubt_ns", "even_ns",
        "missed", "modulus", "period", "raw_ns", "rephased", "tick_ns", "ticks", "uneven", "watched",
    )  # fmt: skip

    def __init__(self, tick_ns: int, tick_modulus: int, on_unknown_gap: Callable[[], None] = lambda: None) -> None:
        """`on_unknown_gap` is called for a gap in which the number of missing samples is not known."""
        self.tick_ns = tick_ns
        self.modulus = tick_modulus
        self.ticks = 0
        """The newest stamp."""
        self._phase_ns = 0.0
        self._shift_ns = 0.0
        """Part of the corrections of the counter that is still in `even_ns`."""
        self._unsure_ns = 0.0
        """Part of `_shift_ns` that no arrival has confirmed: the first step of another rate looks like a correction."""
        self._even_for = 0
        self._step_ns = 0
        """The newest step of the counter; negative where that is shorter than half a turn forward."""
        self._gap = 0
        """Samples missing in the last gap, while it is watched."""
        self.uneven = False
        """Whether the newest step, after many even ones, is no whole number of periods by more than a tick."""
        self.doubt_ns = 0.0
        """By how much even samples were preferred to stamps, until an arrival confirms it."""
        self._unsettled = 0
        """Number of further samples within which the phase of a new rate within its ticks may become known."""
        self.rephased = False
        """Whether the device's rate was changed: where in their ticks the samples are now is anew."""
        self.watched = 0
        """Number of further samples whose device time is compared with their arrivals."""
        self.period = PeriodLearner(on_unknown_gap)
        self.raw_ns = 0
        """Unwrapped device time as stamped."""
        self.even_ns = 0
        """`raw_ns` plus the part of a tick that an even rate reveals; never falls while the clock runs on."""
        self.missed = 0
        """Samples missing between the last two."""

    def begin(self, ticks: int) -> None:
        """Set the first stamp of a device, or the first after its clock started anew."""
        self.period.restart(was_added=ticks == self.ticks)
        self.ticks = ticks
        self._phase_ns = self._shift_ns = self._unsure_ns = self.doubt_ns = 0.0
        self.missed = self._gap = self.watched = self._even_for = 0
        self.uneven = self.rephased = False
        self.raw_ns = self.even_ns = ticks % self.modulus * self.tick_ns

    def elapsed_ns(self, ticks: int) -> int:
        """Device time from the newest stamp to `ticks`, if the counter only went forward and wrapped once at most."""
        return (ticks - self.ticks) % self.modulus * self.tick_ns

    def missed_since(self, line: CounterLine, ticks: int, arrival_ns: int) -> int | None:
        """Return how many samples are missing since the newest one; None where the counter did not run on to `ticks`.

        The message is at `arrival_ns` and not read at once after the newest one: the counter may have turned meanwhile.
        """
        step_ns, turn_ns, period = self.elapsed_ns(ticks), self.modulus * self.tick_ns, self.period
        turns = line.turns(self.even_ns + step_ns, arrival_ns, turn_ns)
        if not period.period_ticks or not line.is_on_time(self.even_ns + step_ns + turns * turn_ns, arrival_ns):
            return None
        return period.steps_in(step_ns // self.tick_ns + turns * self.modulus) - 1

    def advance(self, ticks: int) -> None:
        """Set the next stamp."""
        step = (ticks - self.ticks) % self.modulus
        self.ticks = ticks
        tick_ns, period = self.tick_ns, self.period
        self.raw_ns += step * tick_ns
        if step == period.period_ticks and step and not self.watched:  # the usual case, in a third of the time
            period.add_even_steps()
            self.missed = 0
            self._even_for += 1
            self.even_ns += step * tick_ns
            return
        self.missed = missed = period.add_step(step)
        if period.is_new:
            period.is_new, self._unsettled = False, UNSETTLED_MOST
            self._rephase()
        elif self._unsettled:
            self._unsettled -= 1
            if period.changes >= SETTLED_CHANGES:
                self._unsettled = 0
                self._rephase()
        self._even_for += 1
        if self.watched:
            self.watched -= 1
            self.uneven = False
        if missed:
            self._gap, self.watched = missed, WATCHED
            if step > self.modulus // 2:
                self._note_uneven(step)
        if step != period.period_ticks and (step or period.period_ticks < EVERY_TICK):
            off_ns = ((missed + 1) * period.period_ticks - step) * tick_ns
            phase_ns = self._phase_ns + off_ns
            self._phase_ns = held_ns = min(max(phase_ns, 0.0), float(tick_ns))
            if phase_ns != held_ns:
                self._leave_tick(step, off_ns, phase_ns - held_ns)
        self.even_ns = self.raw_ns + int(self._phase_ns + self._shift_ns)

    def advance_evenly(self, ticks: int, steps: int) -> None:
        """Set the newest of so many next stamps, each of which is exactly one period on; nothing may be watched."""
        self.ticks = ticks
        self.period.add_even_steps(steps)
        self.missed = 0
        self._even_for += steps
        elapsed_ns = steps * int(self.period.period_ticks) * self.tick_ns
        self.raw_ns += elapsed_ns
        self.even_ns += elapsed_ns

    def _rephase(self) -> None:
        """Note that device time before the newest sample does not show when the samples after it are."""
        self.rephased, self.uneven = True, False
        self.watched = self._gap = 0
        self._shift_ns -= self._unsure_ns
        self._unsure_ns = self.doubt_ns = 0.0

    def _leave_tick(self, step: int, off_ns: float, over_ns: float) -> None:
        """Handle a sample that is even with those before only if it is `over_ns` outside of its tick."""
        off, over, tick_ns = abs(off_ns), abs(over_ns), self.tick_ns
        settled = self._even_for >= EVEN_FOR and self.period.period_ticks > 0
        if off > max(tick_ns * 1.01, UNEVEN_NS):
            self._note_uneven(step)
        elif settled and over > FOLLOWED_NS:
            self._shift_ns += over_ns
            self._unsure_ns += over_ns
            self.doubt_ns = max(self.doubt_ns, over)
            self.watched = WATCHED
        if over > UNEVEN_SHARE * tick_ns:
            self._even_for = 0

    def _note_uneven(self, step: int) -> None:
        """Note a step that lost samples do not explain; backward, if that is shorter than half a turn forward."""
        self._step_ns = (step - self.modulus if step > self.modulus // 2 else step) * self.tick_ns
        self.uneven = self.uneven or self._even_for >= EVEN_FOR
        self.watched = WATCHED
        self._even_for = 0

    def absorb_correction(self, fit: ArrivalFit, before_ns: int, arrival_ns: int) -> bool:
        """Take a correction of the counter at the newest sample, or shortly before, out of device time.

        The sample before was at device time `before_ns`; the message began at `arrival_ns` at the latest. Returns
        whether there was one; `even_ns` and `missed` are then set anew.
        """
        period_ns = self.period.period_ticks * self.tick_ns
        if not period_ns or fit.span_ns < CORRECTION_SPAN_NS:
            return False
        slope, device_ns = fit.slope, self.even_ns
        due_ns = fit.ref_arrival_ns + slope * (before_ns - fit.ref_device_ns)
        early_ns = CORRECTION_SIGMAS * fit.error_ns
        early_ns += (REPHASED_TICKS if self.uneven else CORRECTION_TICKS) * self.tick_ns
        early_ns += fit.slope_error * max(min(device_ns - fit.fitted_ns, CORRECTION_MOST_NS), 0)
        above_ns = arrival_ns - due_ns - slope * (device_ns - before_ns)
        if self.uneven:
            return self._absorb_step(before_ns, (arrival_ns - due_ns) / slope, above_ns, early_ns, fit.hold_ns)
        if self._gap and above_ns < -early_ns:
            periods = min(round(-above_ns / (slope * period_ns)), self._gap)
            if (
                periods
                and above_ns + periods * slope * period_ns >= -early_ns
                and periods * period_ns <= CORRECTION_MOST_NS
            ):
                self._shorten_gap(periods)
                return True
        if -early_ns <= above_ns <= self.doubt_ns / 2:
            self._unsure_ns = self.doubt_ns = 0.0
        return False

    def _absorb_step(self, before_ns: int, elapsed_ns: float, above_ns: float, early_ns: float, hold_ns: int) -> bool:
        """Make an uneven step even, if the message, `elapsed_ns` after the sample before, fits that better."""
        period_ns = self.period.period_ticks * self.tick_ns
        waited_ns = elapsed_ns - period_ns
        if waited_ns < -early_ns:
            return False
        periods = 1 + int(max(waited_ns - hold_ns, 0.0) / period_ns)
        moved_ns = self._step_ns - periods * period_ns
        if abs(moved_ns) > CORRECTION_MOST_NS:
            return False
        late_ns = elapsed_ns - periods * period_ns
        if -early_ns <= above_ns <= late_ns:
            return False
        self._make_even(before_ns, periods)
        return True

    def _make_even(self, before_ns: int, periods: int) -> None:
        """Place the newest sample `periods` after the one before, which was at `before_ns`."""
        period_ns = self.period.period_ticks * self.tick_ns
        if self._step_ns < 0:
            self.raw_ns -= self.modulus * self.tick_ns
        self.even_ns = before_ns + round(periods * period_ns)
        shift_ns = self.even_ns - self.raw_ns - self._phase_ns
        self._unsure_ns += shift_ns - self._shift_ns
        self._shift_ns = shift_ns
        self.missed, self._gap = periods - 1, 0
        self.doubt_ns = min(abs(self._step_ns - periods * period_ns), period_ns)
        self.uneven = False

    def _shorten_gap(self, periods: int) -> None:
        """Count `periods` of the samples in the last gap as never missing: the counter was set forward."""
        back_ns = round(periods * self.period.period_ticks * self.tick_ns)
        self._shift_ns -= back_ns
        self.even_ns -= back_ns
        self.missed = max(self.missed - periods, 0)
        self._gap -= periods
        self._even_for = 0

    @property
    def error_ns(self) -> float:
        """One-sigma error of `even_ns` by the length of a tick; 0 where every stamp is off by the same."""
        changes = self.period.changes
        if not changes:
            return 0.0
        return QUANTISED * self.tick_ns * min(1.0, SETTLED_CHANGES / changes)


class JumpDetector:
    """Detector of jumps of the device's clock: early messages show them at once, late ones when they stay late."""

    __slots__ = ("_begin_ns", "_since_ns", "late_reads")

    def __init__(self) -> None:
        self._since_ns = 0
        self._begin_ns = 0
        """Device time between the first late message and the one before."""
        self.late_reads = 0
        """Number of late reads in a row."""

    def is_late_since_gap(self, period_ns: float) -> bool:
        """Whether samples were missing before the first late message: the counter may have begun anew there."""
        return self.late_reads > 0 and self._begin_ns > GAP_FACTOR * period_ns

    def reset(self) -> None:
        """Forget late reads: a new fit begins."""
        self.late_reads = 0

    def stood_still(self, fit: ArrivalFit, error_ns: float) -> bool:
        """Whether all of the newest messages are late: the device's clock stood still for a while."""
        return fit.recent_ns > JUMP_EARLY_NS + JUMP_EARLY_SIGMAS * error_ns

    def is_jump(
        self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, error_ns: float | None, t_rx_ns: int, t_before_ns: int
    ) -> bool:
        """Whether a message so far above or below the fit shows that the device's clock jumped.

        `t_before_ns` is when the message before was read. No `error_ns`: a young fit.
        """
        if above_ns < -JUMP_EARLY_NS:
            return self.is_early(fit, above_ns, elapsed_ns, error_ns)
        return self.is_late(fit, above_ns, elapsed_ns, t_rx_ns, new_read=t_rx_ns > t_before_ns)

    def is_early(self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, error_ns: float | None) -> bool:
        """Whether a message `above_ns` (negative) above the fit came before it could; no `error_ns`: a young fit."""
        if error_ns is None:
            return above_ns < -FIRST_EARLY_NS - (SLOPE_HIGHEST - 1) * (elapsed_ns + fit.span_ns)
        return above_ns < -JUMP_EARLY_SIGMAS * error_ns - JUMP_EARLY_NS - 4 * fit.slope_error * elapsed_ns

    def is_late(self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, t_rx_ns: int, *, new_read: bool) -> bool:
        """Whether messages have been so late for so long that the device's clock must have stood still."""
        if above_ns < JUMP_LATE_NS + fit.slope_error * elapsed_ns:
            self.late_reads = 0
            return False
        if not self.late_reads:
            self._since_ns, self._begin_ns = t_rx_ns, elapsed_ns
        self.late_reads += new_read
        return self.late_reads >= JUMP_LATE_READS and t_rx_ns - self._since_ns > NS_PER_S
