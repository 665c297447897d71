"""Device time from the device counter, without wraps and corrections, finer than a tick. Finds lost samples and jumps.

ticks ─▶ DeviceTime.advance ─▶ raw_ns, even_ns, missed        PeriodLearner: the step between samples
                │
                ├─ absorb_correction: the device corrected its counter, the samples continued
                └─ JumpDetector: the counter restarted, or has another time
"""

from collections.abc import Callable
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import SLOPE_HIGHEST, ArrivalFit
from imud.sampling.gaps import CounterLine, ExpectedRate

CONSISTENT: Final = 4  # number of consecutive equal steps that make a period
# Number of consecutive equal steps that make a longer period than the present one. If one of ten frames is lost at 1
# kHz, four consecutive steps of two ticks occur every second minute. A period of two ticks would shift the device time
# by one tick.
CONSISTENT_LONGER: Final = 12
OFF_MOST: Final = 2.0  # maximum difference between the steps of an uneven rate and the same number of periods, ticks
STEADY_STEPS: Final = 64  # number of consecutive equal steps after which another step is a change of the rate
# factor between adjacent steps above which the longer step contains a gap, if the period is unknown
GAP_FACTOR: Final = 1.5
# Maximum number of periods in a gap that improves the period. The number in a longer gap depends on the period itself.
LEARNED_STEPS: Final = 4
# Number of equal steps after which the period is a whole number of ticks. An earlier different step was a loss.
WHOLE_AFTER: Final = 64
WHOLE_OFF: Final = 0.5  # Maximum distance of a whole number of ticks from the mean. Beyond that, the rate changed.
# Maximum number of steps that are stored until the period is known. A device with an even rate needs a few.
UNJUDGED_MOST: Final = 64
# Minimum period of a device, ns. No device sends 10,000 samples per second. A shorter step is between two samples that
# a late task of the device has time-stamped together.
PERIOD_LEAST_NS: Final = 100 * NS_PER_US
# Maximum share of the period in a step between two late samples, which follow a longer step and make up for it.
LATE_SHARE: Final = 1 / 8
# Minimum period for late samples, ticks. With a shorter period, a step of 0 or 1 tick is usual.
LATE_LEAST_TICKS: Final = 16
# Period in ticks below which two samples can be in one tick. With a longer period, the tick contains the same sample.
EVERY_TICK: Final = 1.5
# Period in ticks up to which one step can be a single period or contain a lost sample: at 700 Hz and 1 ms, a step of
# two ticks. The position of the samples in their ticks then decides, and imud counts only a proven loss.
AMBIGUOUS_TICKS: Final = 2.0
# Distance of a sample from its tick, ticks, after which equal steps show a period of a whole number of ticks.
OUTSIDE_MOST: Final = 0.5
# Number of steps of two ticks, each after the same number of steps of one tick, that show an uneven rate (900 Hz at
# 1 ms). Frames that are lost at random are not regular.
REGULAR: Final = 8
# Number of steps that are not whole periods, less half of the other steps, after which the device time scatters. A
# change of the rate has at most CONSISTENT_LONGER such steps.
SCATTERED, SCATTERED_MOST = 16, 32
SCATTER_SHARE: Final = 1 / 8  # maximum difference between a step and whole periods, in periods, or one tick
MEMORY: Final = 4096  # Number of steps in the mean of an uneven period. After that, both sums are halved.


class PeriodLearner:
    """Estimate of the step between samples in device ticks. It counts the lost samples in a longer step.

    The period is measured, because the nominal rate is not accurate. `on_unknown_gap` is called for a step with an
    unknown number of lost samples: before the period is known, or after a gap so long that the error of the period
    matters.
    """

    __slots__ = (
        "_before", "_candidate", "_count", "_even", "_high", "_least", "_low", "_odd_at", "_on_unknown_gap", "_outside",
        "_owed", "_regular", "_run", "_run_sum", "_scatter", "_spacing", "_steady", "_sum", "_uneven", "_uneven_sum",
        "_unjudged", "changes", "is_late", "is_new", "period_ticks",
    )  # fmt: skip

    def __init__(self, on_unknown_gap: Callable[[], None] = lambda: None, least_ticks: int = 0) -> None:
        """`least_ticks`: maximum step that is not a period, ticks."""
        self._on_unknown_gap = on_unknown_gap
        self._least = least_ticks
        self._owed = 0  # number of samples that can be late since the last longer step
        self.is_late = False  # whether the newest sample is late: it makes up for a part of the last longer step
        self._scatter = 0.0
        self.period_ticks = 0.0  # mean step, ticks; 0 if unknown
        self._sum = self._count = 0.0
        self._even = self._candidate = self._run = self._run_sum = 0
        self._before = -1
        self._uneven = self._uneven_sum = 0  # consecutive steps that are not exactly the period, and their sum
        self._unjudged: list[int] = []  # steps before the first period
        self._odd_at = 0.0  # number of the last step of another length
        # whether many equal steps preceded it; a period from steps with losses is not a rate
        self._steady = False
        self.is_new = False  # Whether the device's rate changed. The owner resets it.
        # Number of changes of the step, if the period is not a whole number of ticks; else 0. They show the phase in
        # the tick.
        self.changes = 0
        # possible positions of the newest sample in its tick, for a period below `AMBIGUOUS_TICKS`
        self._low, self._high = 0.0, 1.0
        self._outside = 0.0  # how far equal steps moved the samples out of their ticks, ticks
        # number of equal steps before the last step of two ticks, and number of consecutive times it was the same
        self._spacing, self._regular = 0.0, 0

    @property
    def is_scattered(self) -> bool:
        """Whether the steps do not show lost samples, because the device time scatters."""
        return self._scatter >= SCATTERED

    @property
    def can_be_late(self) -> bool:
        """Whether the counter distinguishes late samples from usual samples."""
        return self.period_ticks >= LATE_LEAST_TICKS

    def add_step(self, ticks: int) -> int:
        """Add the step to the newest sample. Return the number of lost samples in the step."""
        period = self.period_ticks
        off = abs(ticks - max(round(ticks / period), 1) * period) if period else 0.0
        is_off = off > max(1.0, SCATTER_SHARE * period) or len(self._unjudged) == UNJUDGED_MOST
        self._scatter = min(self._scatter + 1, SCATTERED_MOST) if is_off else max(self._scatter - 0.5, 0.0)
        self.is_late = self._owed > 0 and self.can_be_late and ticks < LATE_SHARE * period
        if self.is_late:
            self._owed -= 1
            return 0
        lost = self._lost_in(ticks)
        self._owed = 0 if self.is_scattered else lost
        return self._owed

    def _lost_in(self, ticks: int) -> int:
        period = self.period_ticks
        if ticks <= self._least:  # two samples in one tick, or the same sample again
            if 0 < period < EVERY_TICK:
                self._refine(0)
            return 0
        if ticks == period:
            self.add_even_steps()
            return 0
        if period and abs(ticks - period) <= 1 and self._periods(ticks) == 1:  # an uneven rate
            self._refine(ticks)
            return 0
        if self._learn(ticks):
            return 0
        if not period:
            return 0
        return self.steps_in(ticks) - 1

    def restart(self, *, was_added: bool = False) -> None:
        """Forget the newest step: the counter restarted, or imud did not receive frames for a time. `was_added`: the
        newest step was already added, and it is not a step of one counter. The caller reports the gap."""
        if was_added and self._unjudged:
            self._unjudged.pop()
        self._run = self._owed = 0
        self._low, self._high = 0.0, 1.0

    def add_even_steps(self, count: int = 1) -> None:
        """Add `count` steps that equal the period exactly, at least one."""
        self._run = self._owed = 0
        self._even += count
        self._scatter = max(self._scatter - count / 2, 0.0) if self._scatter else 0.0

    def steps_in(self, ticks: int) -> int:
        """Return the number of periods in a longer step. The period must be known."""
        period = self.period_ticks
        steps = self._periods(ticks)
        self._move(steps, ticks)
        if not self.changes:
            return steps
        if steps <= LEARNED_STEPS and abs(ticks - steps * period) <= 1:
            self._average(ticks, steps)  # the mean without the lost steps is wrong by a thousandth
        elif (
            steps > (self._count + self._even) * period and not self.is_scattered
        ):  # the error of the mean exceeds one tick
            self._on_unknown_gap()
        return steps

    def _periods(self, ticks: int) -> int:
        """Return the number of periods in a step; of two possible numbers the smaller one."""
        period = self.period_ticks
        steps = max(int(ticks / period + 0.5), 1)
        if not 1 < period < AMBIGUOUS_TICKS:
            return 1 if period != 1 and ticks - period <= 1 else steps
        low, high = self._low - ticks, self._high - ticks
        for count in range(max(int((ticks - 1) / period), 1), int((ticks + 1) / period) + 1):
            if low + count * period <= 1 and high + count * period >= 0:
                return count
        return steps

    def _move(self, steps: int, ticks: int) -> None:
        """Limit the positions of the newest sample in its tick by a step of `steps` periods."""
        if not 1 < self.period_ticks < AMBIGUOUS_TICKS:
            return
        off, error = steps * self.period_ticks - ticks, 1 / (self._count + self._even)
        low, high = self._low + off - error, self._high + off + error
        self._low, self._high = min(max(low, 0.0), 1.0), max(min(high, 1.0), 0.0)
        outside = max(low - 1, -high, 0.0)
        self._outside = (self._outside + outside) if outside else 0.0

    def _average(self, ticks: int, steps: int) -> None:
        self._sum += ticks + int(self._even * self.period_ticks)
        self._count += steps + self._even
        self._even = 0
        self.period_ticks = self._sum / self._count

    def _refine(self, ticks: int) -> None:
        self._run = 0
        self._move(1, ticks)
        if self._even:
            self._uneven = self._uneven_sum = 0
        self._uneven += 1
        self._uneven_sum += ticks
        if self._uneven == CONSISTENT_LONGER:  # enough uneven steps for another rate
            count, total = self._uneven, self._uneven_sum
            self._uneven = self._uneven_sum = 0
            if abs(total - count * self.period_ticks) > OFF_MOST:
                self._note_odd(ticks)
                self._adopt(total, count, is_new=self._steady)
                return
        self._average(ticks, 1)
        same, self._before = ticks == self._before, ticks
        self.changes += not same
        is_whole = same and self.changes <= 1 and self._count >= WHOLE_AFTER
        if is_whole or (self._outside > OUTSIDE_MOST and ticks):  # a whole number of ticks
            self._outside = 0.0
            self.is_new = abs(ticks - self.period_ticks) > WHOLE_OFF
            self._odd_at = 0.0
            self.period_ticks, self._sum, self._count, self.changes = float(ticks), float(ticks), 1.0, 0
        while self._count >= MEMORY:
            self._sum /= 2
            self._count /= 2

    def _learn(self, ticks: int) -> bool:
        """Use another period if the last steps agree on it. Return whether they agree."""
        self._uneven = self._uneven_sum = 0
        is_first = not self.period_ticks
        if is_first and len(self._unjudged) < UNJUDGED_MOST:
            self._unjudged.append(ticks)
        if self._run and abs(ticks - self._candidate) <= 1:
            self._run += 1
            self._run_sum += ticks
        else:
            self._candidate, self._run, self._run_sum = ticks, 1, ticks
            if self._note_odd(ticks) and self.period_ticks == 1:
                self._adopt(int(self._spacing) + 2, int(self._spacing) + 1, is_new=False)
                return True
        longer = 0 < self.period_ticks < self._candidate
        if self._run < (CONSISTENT_LONGER if longer or self._steady else CONSISTENT):
            return False
        self._adopt(self._run_sum, self._run, is_new=self._steady)
        if is_first:
            self._judge()
        return True

    def _judge(self) -> None:
        """Report the gaps among the steps before the first period, unless shorter steps make up for them."""
        period = self.period_ticks
        gaps = sum(int(ticks / period + 0.5) > 1 and ticks - period >= 1 for ticks in self._unjudged)
        missing = sum(self._unjudged) / period - len(self._unjudged)
        for _ in range(min(gaps, max(round(missing), 0)) if not self.is_scattered else 0):
            self._on_unknown_gap()
        self._unjudged.clear()

    def _note_odd(self, ticks: int) -> bool:
        """Count a step of another length, and store whether many equal steps preceded it. Return whether steps of two
        ticks are regular."""
        even = self._count + self._even - self._odd_at
        self._regular = self._regular + 1 if ticks == 2 and even and abs(even - self._spacing) <= 1 else 0
        self._spacing = even
        if even:
            self._steady = not 0 < even < STEADY_STEPS
            self._odd_at += even
        return self._regular >= REGULAR

    def _adopt(self, ticks: int, steps: int, *, is_new: bool) -> None:
        self.is_new = is_new
        self._odd_at, self._steady = 0.0, False
        self._sum, self._count = float(ticks), float(steps)
        self.period_ticks = self._sum / self._count
        self._run = self._even = self._uneven = self._uneven_sum = self.changes = 0
        self._before, self._low, self._high = -1, 0.0, 1.0
        self._outside, self._regular = 0.0, 0


# --- device time finer than a tick ----------------------------------------------------------------------------------
QUANTISED: Final = 0.29  # one-sigma error of a truncated counter value, ticks: 1 / √12
# Number of changed steps after which the phase of an uneven rate within a tick is accurate to a small part of a tick.
# At 400 Hz and ticks of 1 ms, this takes 64 samples. A rate 50 ppm off 100 Hz takes ten minutes.
SETTLED_CHANGES: Final = 64
# Maximum number of samples until the phase of a new rate is accurate. A phase that takes longer drifts slowly.
UNSETTLED_MOST: Final = 512
# number of even samples after which an uneven step is a correction of the counter, not an uneven sample
EVEN_FOR: Final = 64
# Maximum distance of a sample from its tick, ns, that an error of the learned period can cause
FOLLOWED_NS: Final = 15 * NS_PER_US
# Maximum difference of a step, ns, or one tick. A larger difference is a correction of the counter.
UNEVEN_NS: Final = 200 * NS_PER_US
UNEVEN_SHARE: Final = 0.25
# Maximum number of periods in a step that shows a continued counter. A longer step can be near whole periods by chance.
CONTINUED_PERIODS: Final = 64
# number of samples after an uneven step or a gap whose device time the clock compares with the arrivals
WATCHED: Final = 256

# --- corrections ----------------------------------------------------------------------------------------------------
# Maximum correction of the counter, ns: more than an hour without pulses at 50 ppm. A larger step is a jump.
CORRECTION_MOST_NS: Final = 250 * NS_PER_MS
CORRECTION_SPAN_NS: Final = 5 * NS_PER_S  # Minimum span of a fit, ns. A shorter fit is less accurate than a correction.
CORRECTION_SIGMAS: Final = 4
CORRECTION_TICKS: Final = 0.5  # distance below the fit, ticks, at which a frame arrived before its sample
# distance below the fit, ticks, if the step may start another rate: the samples can be anywhere in their ticks
REPHASED_TICKS: Final = 1.05

# --- jumps ----------------------------------------------------------------------------------------------------------
JUMP_EARLY_NS: Final = 5.0 * NS_PER_MS
# distance below the fit, ns and standard errors, that shows a forward jump of the device counter
JUMP_EARLY_SIGMAS: Final = 10
# distance below the fit before it is in use, ns: the first frame may have waited in a buffer
FIRST_EARLY_NS: Final = NS_PER_S
JUMP_LATE_NS: Final = NS_PER_S / 2
DAY_NS: Final = 86_400 * NS_PER_S
DAY_WRAP_NS: Final = 3_600 * NS_PER_S  # maximum time without a sample in which the counter can wrap at 24 h, ns
# Number of late reads in one second that show a jump. Fewer can be the queue of a busy host.
JUMP_LATE_READS: Final = 3


def ticks_over_day(before: int, ticks: int, tick_ns: int) -> int:
    """Return the number of ticks from counter value `before` to `ticks` over a wrap at 24 h; 0 without such a wrap.

    Newer firmware of HiPNUC counts modulo 24 h, with and without UTC. `tick_ns` is 0 for a counter of samples.
    """
    if not tick_ns or ticks >= before:
        return 0
    day_ticks = DAY_NS // tick_ns
    step = ticks + day_ticks - before
    return step if before < day_ticks and step * tick_ns <= DAY_WRAP_NS else 0


class DeviceTime:
    """Unwrapped device time of the newest sample, ns.

    A counter value is truncated to a tick. At 400 Hz, a counter of milliseconds steps 2, 3, 2, 3, but the samples are
    even. `even_ns` therefore steps by the learned period and stays inside the tick of the counter value. If an even
    device leaves its tick, it corrected its counter, and the ticks are shifted instead.

    A device on UTC corrects the error of its crystal at the first pulse after a break: 0.9 ms after 30 s at 30 ppm, 30
    ms after ten minutes at 50 ppm. The samples do not move with the counter. `absorb_correction` therefore compares a
    step with the arrivals if it is not a whole number of periods, or if no samples were lost in it. If the arrivals do
    not confirm the step, the device time does not contain it, and the fit and the pairing of edges continue. A
    correction within a tick needs no arrivals, because the samples stay even.
    """

    __slots__ = (
        "_even_for", "_gap", "_open", "_phase_ns", "_shift_ns", "_step_ns", "_unsettled", "_unsure_ns", "change",
        "doubt_ns", "even_ns", "missed", "missed_before", "modulus", "period", "raw_ns", "rephased", "tick_ns",
        "ticks", "uneven", "watched",
    )  # fmt: skip

    def __init__(self, tick_ns: int, tick_modulus: int, on_unknown_gap: Callable[[], None] = lambda: None) -> None:
        """`on_unknown_gap` is called for each gap with an unknown number of lost samples."""
        self.tick_ns = tick_ns
        self.modulus = tick_modulus
        self.ticks = 0  # newest counter value
        self._phase_ns = self._shift_ns = 0.0  # parts of `even_ns`: phase in the tick, and corrections of the counter
        # part of `_shift_ns` without confirmation by an arrival: the first step of another rate looks like a correction
        self._unsure_ns = 0.0
        self._even_for = 0
        self._step_ns = 0  # newest step of the counter; negative if the backward step is shorter
        self._gap = 0  # lost samples in the last gap while arrivals are compared
        # Samples of the newest longer step without a decision: they are lost, or late and follow together
        self._open = 0
        # whether the newest step after many even steps differs from whole periods by more than a tick
        self.uneven = False
        self.doubt_ns = 0.0  # difference between even samples and counter values, ns, that no arrival has confirmed
        # number of samples in which the phase of a new rate can become accurate
        self._unsettled = 0
        self.change = ExpectedRate()
        # Whether the device's rate changed. The position of the samples in their ticks is then unknown.
        self.rephased = False
        self.watched = 0  # number of further samples whose device time is compared with the arrivals
        self.period = PeriodLearner(on_unknown_gap, PERIOD_LEAST_NS // tick_ns if tick_ns else 0)
        self.raw_ns = 0  # unwrapped device time according to the counter, ns
        # `raw_ns` plus the part of a tick that the even rate shows, ns. It does not fall while the counter continues.
        self.even_ns = 0
        # Number of samples that are certainly lost since the previous sample. The samples of a longer step can count at
        # the next step.
        self.missed = 0
        self.missed_before = 0  # part of `missed` that is from the previous step

    def begin(self, ticks: int) -> None:
        """Set the first counter value of a device, or the first value after a restart of its counter."""
        self.period.restart(was_added=ticks == self.ticks)
        self.ticks = ticks
        self._phase_ns = self._shift_ns = self._unsure_ns = self.doubt_ns = 0.0
        self.missed = self.missed_before = self._gap = self.watched = self._even_for = 0
        self.uneven = self.rephased = False
        self.raw_ns = ticks % self.modulus * self.tick_ns
        self.change.restart(self.even_ns, self.raw_ns)
        self.even_ns = self.raw_ns

    def elapsed_ns(self, ticks: int) -> int:
        """Return the device time from the newest counter value to `ticks`, ns, with at most one wrap."""
        return self._step(ticks) * self.tick_ns

    def _step(self, ticks: int) -> int:
        """Return the number of ticks from the newest counter value to `ticks`, with at most one wrap."""
        step = (ticks - self.ticks) % self.modulus
        if step > self.modulus // 2:
            return ticks_over_day(self.ticks, ticks, self.tick_ns) or step
        return step

    def missed_since(self, line: CounterLine, ticks: int, arrival_ns: int) -> int | None:
        """Return the number of lost samples since the newest sample; None if the counter did not continue to `ticks`.
        `arrival_ns` is the arrival of the frame. The counter may have wrapped several times."""
        step_ns, turn_ns, period = self.elapsed_ns(ticks), self.modulus * self.tick_ns, self.period
        turns = line.turns(self.even_ns + step_ns, arrival_ns, turn_ns)
        if not period.period_ticks or not line.is_on_time(self.even_ns + step_ns + turns * turn_ns, arrival_ns):
            return None
        return period.steps_in(step_ns // self.tick_ns + turns * self.modulus) - 1

    def advance(self, ticks: int) -> None:
        """Set the next counter value."""
        before = self.ticks
        step = (ticks - before) % self.modulus if ticks >= before else self._step(ticks)  # no call for usual steps
        self.ticks = ticks
        tick_ns, period = self.tick_ns, self.period
        self.raw_ns += step * tick_ns
        if step == period.period_ticks and step and not self.watched:  # fast path, in a third of the time
            period.add_even_steps()
            self.missed = self.missed_before = 0
            self._even_for += 1
            self.even_ns += step * tick_ns
            return
        before_ticks = period.period_ticks
        missed = period.add_step(step)
        if (missed or self.change.steps) and self.change.is_open(self.even_ns):
            self.missed = self.change.lost(step, missed, before_ticks, period.period_ticks)
            self.missed_before = 0
        else:
            self.missed = self._decide(missed)
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
            self._phase_ns = held_ns = min(max(phase_ns, 0.0), float(tick_ns))  # hold the sample inside its tick
            if phase_ns != held_ns:
                self._leave_tick(step, off_ns, phase_ns - held_ns)
        self.even_ns = self.raw_ns + int(self._phase_ns + self._shift_ns)

    def _decide(self, missed: int) -> int:
        """Return the number of samples of the previous longer step that are certainly lost. `missed`: of this step."""
        if self.period.is_late:
            self._open = max(self._open - 1, 0)
            self.missed_before = 0
            return 0
        self.missed_before = self._open
        self._open = missed if self.period.can_be_late else 0
        return self.missed_before + missed - self._open

    def has_continued(self, step_ns: int) -> bool:
        """Return whether a step of the device time, ns, shows that the counter continued: it is a small number of whole
        periods. A device that restarts sets its counter to another value."""
        period_ns = self.period.period_ticks * self.tick_ns
        if not period_ns or step_ns <= 0:
            return False
        most = CONTINUED_PERIODS if self.period.can_be_late else 1
        periods = round(step_ns / period_ns)
        return 1 <= periods <= most and abs(step_ns - periods * period_ns) <= self.tick_ns

    @property
    def has_open_gap(self) -> bool:
        """Whether samples of the newest longer step are without a decision."""
        return self._open > 0

    def take_open(self) -> int:
        """Return the samples of the newest longer step without a decision: no sample followed, so they are lost."""
        lost, self._open = self._open, 0
        return lost

    def advance_evenly(self, ticks: int, steps: int) -> None:
        """Set the newest of `steps` counter values, each one period after the other, while `watched` is 0."""
        self.ticks = ticks
        self.period.add_even_steps(steps)
        self.missed = 0
        self._even_for += steps
        elapsed_ns = steps * int(self.period.period_ticks) * self.tick_ns
        self.raw_ns += elapsed_ns
        self.even_ns += elapsed_ns

    def _rephase(self) -> None:
        """Mark the phase as unknown: the device time of earlier samples does not show the time of the next samples."""
        self.rephased, self.uneven = True, False
        self.watched = self._gap = 0
        self._shift_ns -= self._unsure_ns
        self._unsure_ns = self.doubt_ns = 0.0

    def _leave_tick(self, step: int, off_ns: float, over_ns: float) -> None:
        """Process a sample that is `over_ns` outside of its tick if it is even with the previous samples."""
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
        """Store a step that lost samples do not explain. It is backward if that is shorter than half a turn."""
        self._step_ns = (step - self.modulus if step > self.modulus // 2 else step) * self.tick_ns
        self.uneven = self.uneven or self._even_for >= EVEN_FOR
        self.watched = WATCHED
        self._even_for = 0

    def absorb_correction(self, fit: ArrivalFit, before_ns: int, arrival_ns: int) -> bool:
        """Remove a correction of the counter from the device time, at the newest sample or shortly before.

        `before_ns` is the device time of the previous sample. `arrival_ns` is the latest start of the frame. Return
        whether there was a correction. In this case, set `even_ns` and `missed` again.
        """
        period_ns = self.period.period_ticks * self.tick_ns
        if not period_ns or fit.span_ns < CORRECTION_SPAN_NS:
            return False
        slope, device_ns = fit.slope, self.even_ns
        due_ns = fit.ref_arrival_ns + slope * (before_ns - fit.ref_device_ns)  # due arrival of the previous sample
        early_ns = CORRECTION_SIGMAS * fit.error_ns
        early_ns += (REPHASED_TICKS if self.uneven else CORRECTION_TICKS) * self.tick_ns
        early_ns += fit.slope_error * max(min(device_ns - fit.fitted_ns, CORRECTION_MOST_NS), 0)
        above_ns = arrival_ns - due_ns - slope * (device_ns - before_ns)
        if self.uneven:
            return self._absorb_step(before_ns, (arrival_ns - due_ns) / slope, above_ns, early_ns, fit.hold_ns)
        if self._gap and above_ns < -early_ns:  # the counter was set forward: fewer samples are lost than the gap shows
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
        """Replace an uneven step by an even step if the arrival confirms it, `elapsed_ns` after the previous sample."""
        period_ns = self.period.period_ticks * self.tick_ns
        waited_ns = elapsed_ns - period_ns
        if waited_ns < -early_ns:  # earlier than one period
            return False
        periods = 1 + int(max(waited_ns - hold_ns, 0.0) / period_ns)
        moved_ns = self._step_ns - periods * period_ns
        if abs(moved_ns) > CORRECTION_MOST_NS:
            return False
        late_ns = elapsed_ns - periods * period_ns
        if -early_ns <= above_ns <= late_ns:  # the counter value fits better
            return False
        self._make_even(before_ns, periods)
        return True

    def _make_even(self, before_ns: int, periods: int) -> None:
        """Place the newest sample `periods` after the previous sample, which was at `before_ns`."""
        period_ns = self.period.period_ticks * self.tick_ns
        if self._step_ns < 0:
            self.raw_ns -= self.modulus * self.tick_ns
        self.even_ns = before_ns + round(periods * period_ns)
        shift_ns = self.even_ns - self.raw_ns - self._phase_ns
        self._unsure_ns += shift_ns - self._shift_ns
        self._shift_ns = shift_ns
        self._gap = 0
        self._open = periods - 1 if self.period.can_be_late else 0
        self.missed = self.missed_before + periods - 1 - self._open
        self.change.take_back(self._step_ns // self.tick_ns % self.modulus)
        self.doubt_ns = min(abs(self._step_ns - periods * period_ns), period_ns)
        self.uneven = False

    def _shorten_gap(self, periods: int) -> None:
        """Reduce the last gap by `periods` samples: the counter was set forward, and the samples are not lost."""
        back_ns = round(periods * self.period.period_ticks * self.tick_ns)
        self._shift_ns -= back_ns
        self.even_ns -= back_ns
        not_lost = min(self._open, periods)
        self._open -= not_lost
        self.missed = max(self.missed - (periods - not_lost), 0)
        self.change.take_back(round(periods * self.period.period_ticks))
        self._gap -= periods
        self._even_for = 0

    @property
    def error_ns(self) -> float:
        """Return the one-sigma error of `even_ns` from the length of a tick, ns."""
        # Without a change of the step, all counter values have the same error.
        changes = self.period.changes
        if not changes:
            return 0.0
        return QUANTISED * self.tick_ns * min(1.0, SETTLED_CHANGES / changes)


class JumpDetector:
    """Detector of jumps of the device counter: by one early frame, or by frames that stay late."""

    __slots__ = ("_since_ns", "first_step_ns", "late_reads")

    def __init__(self) -> None:
        self._since_ns = 0
        self.first_step_ns = 0  # device time between the first late frame and the previous frame
        self.late_reads = 0  # number of consecutive late reads

    def is_late_since_gap(self, period_ns: float) -> bool:
        """Return whether samples were lost before the first late frame: the counter may have restarted there."""
        return self.late_reads > 0 and self.first_step_ns > GAP_FACTOR * period_ns

    def reset(self) -> None:
        """Forget late reads: a new fit starts."""
        self.late_reads = 0

    def stood_still(self, fit: ArrivalFit, error_ns: float) -> bool:
        """Return whether all of the newest frames are late: the device counter stopped for a time."""
        return fit.recent_ns > JUMP_EARLY_NS + JUMP_EARLY_SIGMAS * error_ns

    def is_jump(
        self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, error_ns: float | None, t_rx_ns: int, t_before_ns: int
    ) -> bool:
        """Return whether a frame above or below the fit shows a jump of the device counter. `t_before_ns` is the read
        of the previous frame. `error_ns` is None before the fit is in use."""
        if above_ns < -JUMP_EARLY_NS:
            return self.is_early(fit, above_ns, elapsed_ns, error_ns)
        return self.is_late(fit, above_ns, elapsed_ns, t_rx_ns, new_read=t_rx_ns > t_before_ns)

    def is_early(self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, error_ns: float | None) -> bool:
        """Return whether a frame `above_ns` (negative) above the fit arrived too early."""
        if error_ns is None:
            return above_ns < -FIRST_EARLY_NS - (SLOPE_HIGHEST - 1) * (elapsed_ns + fit.span_ns)
        return above_ns < -JUMP_EARLY_SIGMAS * error_ns - JUMP_EARLY_NS - 4 * fit.slope_error * elapsed_ns

    def is_late(self, fit: ArrivalFit, above_ns: float, elapsed_ns: int, t_rx_ns: int, *, new_read: bool) -> bool:
        """Return whether frames have been late for so long that the device counter must have stopped."""
        if above_ns < JUMP_LATE_NS + fit.slope_error * elapsed_ns:
            self.late_reads = 0
            return False
        if not self.late_reads:
            self._since_ns, self.first_step_ns = t_rx_ns, elapsed_ns
        self.late_reads += new_read
        return self.late_reads >= JUMP_LATE_READS and t_rx_ns - self._since_ns > NS_PER_S
