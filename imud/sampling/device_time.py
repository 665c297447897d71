"""Device time from a counter: unwrapped, finer than its tick, without its corrections; missing samples; jumps.

    ticks ─▶ DeviceTime.advance ─▶ raw_ns, even_ns, missed        period_learner: the step between samples
                    │
                    ├─ absorb_correction: the counter was set by a little while the samples went on
                    └─ JumpDetector: the counter began anew, or is another time

Counters that number the samples and give no time are in `gaps`. Nothing here reads a clock.
"""

from collections.abc import Callable
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import SLOPE_HIGHEST, ArrivalFit
from imud.sampling.gaps import CounterLine

CONSISTENT: Final = 4
"""Number of equal steps in a row that make a rate."""
CONSISTENT_LONGER: Final = 12
"""The same for a longer step than before: where one of ten messages is lost, every second minute at 1 kHz leaves the
same hole four times in a row, and a period of two ticks for one would shift device time by a tick."""
OFF_MOST: Final = 2.0
"""Ticks by which steps of an uneven rate can differ from as many periods: one, and the error of the period."""
STEADY_STEPS: Final = 64
"""Number of equal steps in a row that were a rate: another one afterwards is a change of it."""
GAP_FACTOR: Final = 1.5
"""While the period is not known, a step that is so much longer than the one before or after has a gap in it."""
LEARNED_STEPS: Final = 4
"""A gap of more periods is not learned from: how many it has rests on the period itself."""
WHOLE_AFTER: Final = 64
"""Number of equal steps after which the period is a whole number of ticks: a different step before was a loss."""
WHOLE_OFF: Final = 0.5
"""A whole number of ticks that is further from the mean is another rate."""
UNJUDGED_MOST: Final = 64
"""Steps from before there is a period that are kept until there is one; a device of an even rate has a few."""
EVERY_TICK: Final = 1.5
"""With a shorter period two samples can be in one tick; with a longer one it is the same sample."""
MEMORY: Final = 4096
"""Steps in the mean of a period that is no whole number of ticks; then both sums are halved."""


class PeriodLearner:
    """Estimate of the step between samples in device ticks; counts the samples missing in a longer one.

    The period is measured, not taken from the nominal rate. `on_unknown_gap` is called for a step whose missing samples
    are not known within one: before there is a period, or where its error over many periods is too large.
    """

    __slots__ = (
        "_before", "_candidate", "_count", "_even", "_odd_at", "_on_unknown_gap", "_run", "_run_sum", "_steady", "_sum",
        "_uneven", "_uneven_sum", "_unjudged", "changes", "is_gap", "is_new", "period_ticks",
    )  # fmt: skip

    def __init__(self, on_unknown_gap: Callable[[], None] = lambda: None) -> None:
        self._on_unknown_gap = on_unknown_gap
        self.is_gap = False
        """Whether the newest step that was no period was noted as a gap of unknown size."""
        self.period_ticks = 0.0
        """Mean step; 0 while unknown."""
        self._sum = 0.0
        self._count = 0.0
        self._even = 0
        self._before = -1
        self._candidate = 0
        self._run = 0
        self._run_sum = 0
        self._uneven = self._uneven_sum = 0  # steps in a row that are not the period exactly, and their sum
        self._unjudged: list[int] = []  # steps from before there was a period that were not noted as gaps
        self._odd_at = 0.0  # number of the last step that was no period
        # whether there were many periods in a row before it; a period learned of steps with losses is no rate
        self._steady = False
        self.is_new = False
        """Whether the period is another since this was set to False: the device's rate was changed."""
        self.changes = 0
        """Times that a period of no whole number of ticks showed where in a tick it is; 0 where it is a whole one."""

    def add_step(self, ticks: int) -> int:
        """Add the step to the newest sample; return how many samples are missing in it."""
        period = self.period_ticks
        if ticks <= 0:
            if 0 < period < EVERY_TICK:
                self._refine(0)
            return 0
        if ticks == period:
            self.add_even_steps()
            return 0
        if period and abs(ticks - period) <= 1 and int(ticks / period + 0.5) == 1:
            self._refine(ticks)
            return 0
        if self._learn(ticks):
            return 0
        if not period:
            return 0
        return self.steps_in(ticks) - 1

    def restart(self, *, was_added: bool = False) -> None:
        """Forget the newest step: the counter began anew, or was not read for a while.

        `was_added`: what was added last was no step of one counter; whoever calls notes the gap.
        """
        if was_added and self._unjudged and not self.is_gap:
            self._unjudged.pop()
        self._run, self.is_gap = 0, False

    def add_even_steps(self, count: int = 1) -> None:
        """Add so many steps that are exactly the period, at least one."""
        self._run = 0
        self._even += count

    def steps_in(self, ticks: int) -> int:
        """Return how many periods are in a longer step; the period must be known."""
        period = self.period_ticks
        steps = max(int(ticks / period + 0.5), 1)
        if not self.changes:
            return steps
        if steps <= LEARNED_STEPS and abs(ticks - steps * period) <= 1:
            self._average(ticks, steps)  # the mean of what is left, where one of ten is lost, is off by a thousandth
        elif steps > (self._count + self._even) * period:  # the mean is off by a tick over all it was made of
            self._on_unknown_gap()
        return steps

    def _average(self, ticks: int, steps: int) -> None:
        """Add `steps` periods of `ticks` in all to the mean."""
        self._sum += ticks + int(self._even * self.period_ticks)
        self._count += steps + self._even
        self._even = 0
        self.period_ticks = self._sum / self._count

    def _refine(self, ticks: int) -> None:
        self._run = 0
        if self._even:
            self._uneven = self._uneven_sum = 0
        self._uneven += 1
        self._uneven_sum += ticks
        if self._uneven == CONSISTENT_LONGER:
            count, total = self._uneven, self._uneven_sum
            self._uneven = self._uneven_sum = 0
            if abs(total - count * self.period_ticks) > OFF_MOST:
                self._note_odd()
                self._adopt(total, count, is_new=self._steady)
                return
        self._average(ticks, 1)
        same, self._before = ticks == self._before, ticks
        self.changes += not same
        if same and self.changes <= 1 and self._count >= WHOLE_AFTER:
            self.is_new = abs(ticks - self.period_ticks) > WHOLE_OFF
            self._odd_at = 0.0
            self.period_ticks, self._sum, self._count, self.changes = float(ticks), float(ticks), 1.0, 0
        while self._count >= MEMORY:
            self._sum /= 2
            self._count /= 2

    def _learn(self, ticks: int) -> bool:
        """Adopt another period when the last steps agree on it; return whether they do."""
        self._uneven, self._uneven_sum, self.is_gap = 0, 0, False
        is_first = not self.period_ticks
        if is_first and len(self._unjudged) < UNJUDGED_MOST:
            self._unjudged.append(ticks)
        if self._run and abs(ticks - self._candidate) <= 1:
            self._run += 1
            self._run_sum += ticks
        else:
            if self._run and is_first:
                shorter, longer = sorted((ticks, self._candidate))
                if longer > GAP_FACTOR * shorter + 1:
                    self.is_gap = True
                    self._on_unknown_gap()
                    if longer in self._unjudged:
                        self._unjudged.remove(longer)
            self._candidate, self._run, self._run_sum = ticks, 1, ticks
            self._note_odd()
        longer = 0 < self.period_ticks < self._candidate
        if self._run < (CONSISTENT_LONGER if longer or self._steady else CONSISTENT):
            return False
        self._adopt(self._run_sum, self._run, is_new=self._steady)
        if is_first:
            self._judge()
        return True

    def _judge(self) -> None:
        """Note the gaps among the steps from before the first period: two beside each other can be of a like length."""
        for ticks in self._unjudged:
            if int(ticks / self.period_ticks + 0.5) > 1 and ticks - self.period_ticks >= 1:
                self._on_unknown_gap()
        self._unjudged.clear()

    def _note_odd(self) -> None:
        """Note a step that is no period, and whether there were many before."""
        even = self._count + self._even - self._odd_at
        if even:
            self._steady = not 0 < even < STEADY_STEPS
            self._odd_at += even

    def _adopt(self, ticks: int, steps: int, *, is_new: bool) -> None:
        """Take `ticks` over so many steps for the period from now on."""
        self.is_new = is_new
        self._odd_at, self._steady = 0.0, False
        self._sum, self._count = float(ticks), float(steps)
        self.period_ticks = self._sum / self._count
        self._run = self._even = self._uneven = self._uneven_sum = self.changes = 0
        self._before = -1


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
        self._shift_ns = 0.0  # part of the corrections of the counter that is still in `even_ns`
        # part of `_shift_ns` that no arrival has confirmed: the first step of another rate looks like a correction
        self._unsure_ns = 0.0
        self._even_for = 0
        self._step_ns = 0  # the newest step of the counter; negative where that is shorter than half a turn forward
        self._gap = 0  # samples missing in the last gap, while it is watched
        self.uneven = False
        """Whether the newest step, after many even ones, is no whole number of periods by more than a tick."""
        self.doubt_ns = 0.0
        """By how much even samples were preferred to stamps, until an arrival confirms it."""
        # number of further samples within which the phase of a new rate within its ticks may become known
        self._unsettled = 0
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
        self._begin_ns = 0  # device time between the first late message and the one before
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


PULSE_TICKS: Final = 1000
"""From pulse to pulse, in ms."""
EARLY_NS: Final = 100 * NS_PER_MS
"""A message so far before the earliest possible one was not measured then: a pulse came."""
DRIFT: Final = 200e-6
"""Rate error of a device's crystal against the host's, at most."""
LATE_NS: Final = 400 * NS_PER_MS
"""How far from whole turns the lateness of live messages may be."""
LIVE_TICKS: Final = 640
LIVE_SHARE: Final = 0.04
LIVE_BREAK_NS: Final = 40 * NS_PER_MS
"""Messages over so many ticks that come at the pace of their stamps, within this share, are read as they come; a step
that differs from the time between arrivals by more than an adapter's latency timer begins that count anew."""
STUCK_MESSAGES: Final = 8
"""With so many equal stamps the stamp is no time: each message follows a pulse of its own (triggers on SIN)."""
FOREIGN_NS: Final = 1000 * NS_PER_MS
"""After so long without a message that carries time, those with a stamp alone are dated by it."""
WRAP: Final = 1 << 32


class StampTime:
    """Ticks of 1 ms from stamps of 1 ms that begin anew after `modulus`, modulo 2³²."""

    __slots__ = (
        "_arrival_ns", "_foreign_since_ns", "_foreign_ticks", "_live_arrival_ns", "_live_ticks", "_lowest_ns",
        "_modulus", "_origin_ns", "_pulsed", "_stamp", "_stuck", "_ticks", "before", "in_use",
    )  # fmt: skip

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._stamp = -1  # the newest stamp; -1 before the first
        self.before = 0
        """Ticks of the message before the newest one."""
        self._ticks = 0  # ticks of the newest message, not wrapped
        self._arrival_ns = 0
        self._origin_ns = 0  # arrival that lateness is relative to
        self._lowest_ns = 0.0  # least arrival minus ticks so far, from the origin; it rises by DRIFT
        self._live_ticks = self._live_arrival_ns = 0  # the message since which arrivals have kept pace with the ticks
        self._stuck = 0
        self._pulsed = False  # whether a pulse per second sets the stamp to zero
        self._foreign_ticks: int | None = None
        self._foreign_since_ns = 0
        self.in_use = False
        """Whether ticks come from stamps now."""

    def ticks(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> int | None:
        """Return the ticks of a message; None where the stamp does not show its time.

        `known_ticks` are those that the clock knows last, None for none: if they are not from here, other messages
        carry time, and those are preferred.
        """
        if self._is_foreign(known_ticks, arrival_ns):
            return None
        if self._stamp < 0:
            self._begin(stamp, arrival_ns, known_ticks)
            return None
        elapsed_ns, before = arrival_ns - self._arrival_ns, self._stamp
        self._stamp, self._arrival_ns = stamp, arrival_ns
        self._stuck = self._stuck + 1 if stamp == before and elapsed_ns > NS_PER_MS else 0
        if self._stuck >= STUCK_MESSAGES or (self._stuck and not self.in_use):
            self.in_use = False
            return None
        step, self.before = self._step(stamp, before, arrival_ns, elapsed_ns), self._ticks % WRAP
        self._ticks += step
        if abs(elapsed_ns - step * NS_PER_MS) > LIVE_BREAK_NS:
            self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns
        self._follow(arrival_ns, elapsed_ns)
        self.in_use = True
        return self._ticks % WRAP

    def restart(self) -> None:
        """Begin anew: the device or its link was away."""
        self._stamp = -1
        self.in_use = self._pulsed = False
        self._foreign_ticks = None

    def _is_foreign(self, known_ticks: int | None, arrival_ns: int) -> bool:
        """Whether messages that carry time come as well."""
        if known_ticks is None or (self.in_use and known_ticks == self._ticks % WRAP):
            self._foreign_ticks = None
            return False
        if known_ticks != self._foreign_ticks:
            self.restart()
            self._foreign_ticks, self._foreign_since_ns = known_ticks, arrival_ns
        return arrival_ns - self._foreign_since_ns < FOREIGN_NS

    def _begin(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> None:
        """Set the first stamp; ticks go on from those that other messages carried."""
        since_ms = round((arrival_ns - self._foreign_since_ns) / NS_PER_MS)
        self._ticks = stamp if known_ticks is None else known_ticks + since_ms
        self._stamp, self._arrival_ns, self._origin_ns = stamp, arrival_ns, arrival_ns - self._ticks * NS_PER_MS
        self._lowest_ns, self._stuck = 0.0, 0
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns

    def _late_ns(self, ticks: int, arrival_ns: int) -> float:
        """Lateness of a message at `ticks` against the one that was least late."""
        return arrival_ns - self._origin_ns - ticks * NS_PER_MS - self._lowest_ns

    def _step(self, stamp: int, before: int, arrival_ns: int, elapsed_ns: int) -> int:
        """Ticks since the message before; the stamp may have turned or been set to zero between.

        The first pulse comes at any stamp: the arrivals show how long ago the message before was.
        """
        turned = (stamp - before) % self._modulus
        if stamp >= before:
            return turned
        pulsed = (stamp - before) % PULSE_TICKS
        late_ns = self._late_ns(self._ticks + turned, arrival_ns)
        if self._pulsed:
            nearer = abs(late_ns) < abs(self._late_ns(self._ticks + pulsed, arrival_ns))
            self._pulsed = not (nearer and before > PULSE_TICKS)
        elif late_ns < -EARLY_NS:
            self._pulsed = True
            if abs(elapsed_ns - pulsed * NS_PER_MS) > LIVE_BREAK_NS:
                return max(round(elapsed_ns / NS_PER_MS), 1)
        return pulsed if self._pulsed else turned

    def _follow(self, arrival_ns: int, elapsed_ns: int) -> None:
        """Note how late the message is; add the turns that live messages show to be missing."""
        self._lowest_ns += DRIFT * elapsed_ns
        if self._ticks - self._live_ticks >= LIVE_TICKS:
            self._add_turns(arrival_ns)
        self._lowest_ns += min(self._late_ns(self._ticks, arrival_ns), 0.0)

    def _add_turns(self, arrival_ns: int) -> None:
        """Add whole turns by which messages are late that come at the pace of their stamps."""
        pace = (arrival_ns - self._live_arrival_ns) / ((self._ticks - self._live_ticks) * NS_PER_MS)
        late_ns = self._late_ns(self._ticks, arrival_ns)
        turn = PULSE_TICKS if self._pulsed else self._modulus
        turns = round(late_ns / (turn * NS_PER_MS))
        if turns > 0 and abs(pace - 1) <= LIVE_SHARE and abs(late_ns - turns * turn * NS_PER_MS) <= LATE_NS:
            self._ticks += turns * turn
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns
