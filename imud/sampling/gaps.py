"""Gaps between samples, if the device counter alone does not show their size.

`CounterLine` keeps the position of a device counter from before the present fit. Frames that waited for a busy host
make a fit that is late. A frame in time then looks like a jump of the counter. `ExpectedRate` distinguishes lost
samples from a lower rate that imud has requested. `ArrivalPace` is for devices without device time: the pace of the
frames with the shortest wait shows the lost samples.
"""

from collections.abc import Callable
from math import inf
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.arrival_fit import ArrivalFit

# --- counters of time -----------------------------------------------------------------------------------------------
EARLY_NS: Final = 5 * NS_PER_MS
# distance below the line, ns and standard errors, at which a frame arrived before its sample: the counter was set
EARLY_SIGMAS: Final = 10
# Maximum lateness of a counter that continued while the link was missing, ns. Beyond that, it can be another counter.
LATE_NS: Final = NS_PER_S // 2
# Maximum error of a slope that is stable. On an overloaded host, the error is a hundred times larger.
STEADY: Final = 2e-5
# Time after which late frames mean that the counter stopped, ns. Until then, the host may be overloaded.
KEPT_NS: Final = 600 * NS_PER_S

GAP_PERIODS: Final = 1.5  # minimum host time since the previous sample, in periods, that counts as a gap

# --- another rate ---------------------------------------------------------------------------------------------------
# Device time after a request in which the first step of another rate can arrive, ns: the reply and a restart
RATE_WAIT_NS: Final = 3 * NS_PER_S
LONGER: Final = 1.25  # minimum ratio of a period to the previous period that shows a lower rate
LONGER_MOST: Final = 64  # maximum number of steps without a decision; a lower rate needs twelve

# --- arrivals -------------------------------------------------------------------------------------------------------
STEPS_ALWAYS: Final = 4  # number of counter steps accepted at any arrival time, because delayed frames arrive together
STEPS_FACTOR: Final = 1.5  # Maximum error of the rate over a longer gap. A larger jump is a restart of the counter.
# Maximum wait of frames that then arrive together, ns. No device restarts within this time.
QUEUED_NS: Final = NS_PER_S // 2
STEPS_UNKNOWN: Final = 1000  # number of counter steps accepted while the rate is unknown
# a window contains a frame with a very short wait if it has this number of frames, has this length, and its lateness
# varies by at most SETTLED_SPREAD_NS (a latency timer and a short delay of the host)
WINDOW_MESSAGES: Final = 16
WINDOW_NS: Final = NS_PER_S
SETTLED_SPREAD_NS: Final = 50 * NS_PER_MS
PACE_GAIN: Final = 0.5  # share of a window's drift that corrects the period
PACE_KNOWN: Final = 0.002  # relative error of the period below which it counts samples
# Maximum relative error of a first estimate of the period that is corrected. A larger error restarts the measurement.
PACE_NEAR: Final = 0.05
PACE_FLOOR: Final = 1e-5  # minimum relative error of the period, because crystals drift and frames wait
# number of consecutive windows that are later or earlier than the period allows, after which the rate counts as changed
OFF_WINDOWS: Final = 4
UNCERTAIN: Final = 0.75  # maximum error of the period over a gap, in samples, for a gap of known size
RESUME_STEPS: Final = 8  # maximum distance of a number from its due value after the link was missing


class CounterLine:
    """Host time of a device counter, from the fit with the smallest delay. Arrivals are above the line if the counter
    continues. On an overloaded host, all frames are late and the fit follows them. This line does not follow them."""

    __slots__ = ("_device_ns", "_error_ns", "_fitted_ns", "_host_ns", "_slope_error", "slope")

    def __init__(self, fit: ArrivalFit, error_ns: float) -> None:
        self._set(fit, error_ns)

    def _set(self, fit: ArrivalFit, error_ns: float) -> None:
        self._device_ns, self._host_ns = fit.ref_device_ns, fit.ref_arrival_ns
        self.slope = fit.slope  # host ns per device ns
        self._fitted_ns, self._slope_error, self._error_ns = fit.fitted_ns, fit.slope_error, error_ns

    def follow(self, fit: ArrivalFit, error_ns: float) -> None:
        """Follow a changed fit, unless the fit is inaccurate or its frames are later than the previous frames."""
        device_ns = fit.fitted_ns
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        is_steady = fit.slope_error <= max(self._slope_error, STEADY)
        if (is_steady and self.above(device_ns, fit_ns) <= self.early_ns(device_ns)) or (
            device_ns - self._fitted_ns > KEPT_NS
        ):
            self._set(fit, error_ns)

    def above(self, device_ns: int, arrival_ns: float) -> float:
        return arrival_ns - self._host_ns - self.slope * (device_ns - self._device_ns)

    def early_ns(self, device_ns: int) -> float:
        """Return the maximum distance of an arrival below the line, ns."""
        return EARLY_NS + EARLY_SIGMAS * self._error_ns + 4 * self._slope_error * abs(device_ns - self._fitted_ns)

    def carries(self, device_ns: int, arrival_ns: float) -> bool:
        """Return whether the counter can have continued to `device_ns`. The frame may have waited."""
        return self.above(device_ns, arrival_ns) >= -self.early_ns(device_ns)

    def is_on_time(self, device_ns: int, arrival_ns: float) -> bool:
        """Return whether the counter continued to `device_ns` and the frame waited only for a short time."""
        return self.carries(device_ns, arrival_ns) and self.above(device_ns, arrival_ns) <= LATE_NS

    def turns(self, device_ns: int, arrival_ns: float, turn_ns: int) -> int:
        """Return the number of lost turns of the counter before `device_ns`. A turn is `turn_ns` long."""
        return max(round(self.above(device_ns, arrival_ns) / (self.slope * turn_ns)), 0)


class ExpectedRate:
    """Steps that contain lost samples or show a lower rate, after a request of imud that can set the rate.

    A step that is longer than the period counts as soon as a step of the previous period follows. If the steps make a
    longer period, only the losses by the longer period count. The counter does not show all losses of a change. Not
    counted: samples of the previous rate in the step with the change, less than one period of the new rate, and equal
    gaps directly before the change that look like the new rate.
    """

    __slots__ = ("_until_ns", "steps")

    def __init__(self) -> None:
        self._until_ns = -1  # device time until which the rate can change, ns
        self.steps: list[int] = []  # longer steps without a decision, ticks

    def expect(self, device_ns: int) -> None:
        """Expect another rate after the sample at `device_ns`."""
        self._until_ns = device_ns + RATE_WAIT_NS

    def restart(self, before_ns: int, device_ns: int) -> None:
        """Continue at a new value of the counter, `device_ns`. Its caller reports the gap. `before_ns`: the value of
        the previous sample."""
        self._until_ns = device_ns + RATE_WAIT_NS if self.is_open(before_ns) else -1
        self.steps.clear()

    def is_open(self, device_ns: int) -> bool:
        """Return whether the step after the sample at `device_ns` can show another rate."""
        return device_ns <= self._until_ns or bool(self.steps)

    def lost(self, ticks: int, missed: int, before_ticks: float, period_ticks: float) -> int:
        """Add a step with `missed` lost samples by the previous period, `before_ticks`. Return the number of lost
        samples that are now certain. `period_ticks` is the period with this step."""
        longer = self.steps
        if missed and len(longer) < LONGER_MOST:
            longer.append(ticks)
            return 0
        if period_ticks > LONGER * before_ticks > 0:
            first = [] if not longer else [int((longer[0] - before_ticks - 1) / period_ticks)]
            found = [*first, *(round(one / period_ticks) - 1 for one in longer[1:])]
        elif not missed and ticks > LONGER * before_ticks:  # the device time scatters: no decision
            return 0
        else:
            found = [round(one / before_ticks) - 1 for one in longer]
        longer.clear()
        return missed + sum(max(one, 0) for one in found)

    def take_back(self, ticks: int) -> None:
        """Shorten the newest step without a decision: the counter was set forward by `ticks`."""
        if self.steps:
            self.steps[-1] -= ticks


class ArrivalPace:
    """Expected arrival of frames with a constant rate, from the frames with the shortest wait.

    Frames that waited for a busy host arrive together and late. If some of them are lost, the next frames stay late by
    the number of lost frames. The lateness that all frames of a window share therefore counts as lost samples. `turn`
    is the modulus of the frame number, 1 without a number: with a number, the arrivals only show whole turns.
    """

    __slots__ = (
        "_begin_ns", "_count", "_due_ns", "_error", "_has_phase", "_least_ns", "_most_ns", "_off_ns", "_off_windows",
        "_steps", "_turn", "_unjudged", "_until_ns", "period_ns",
    )  # fmt: skip

    def __init__(self, turn: int = 1) -> None:
        self._turn = turn
        self.period_ns = 0.0  # time between samples, ns; 0.0 if unknown
        self._error = 1.0  # relative error of the period
        # consecutive windows that were late or early: samples were lost, the phase was wrong, or the rate changed
        self._off_windows = 0
        # lateness of the newest of these windows without lost samples, 0.0 if it was early
        self._off_ns = 0.0
        self.begin(0)

    @property
    def is_known(self) -> bool:
        """Return whether the period is accurate enough to count samples."""
        return self._error < PACE_KNOWN

    def begin(self, arrival_ns: int) -> None:
        """Start with the first frame, or with the first frame after a gap of unknown size. Keep the period."""
        self._due_ns = float(arrival_ns)
        self._has_phase = False  # whether a window has shown the wait of the first frame
        self._unjudged = 0  # samples since the newest judged window
        self._begin_window(arrival_ns)

    def _begin_window(self, arrival_ns: int) -> None:
        self._count = self._steps = 0
        self._least_ns, self._most_ns = inf, -inf
        self._begin_ns, self._until_ns = arrival_ns, arrival_ns + WINDOW_NS

    def steps_most(self, arrival_ns: int) -> float:
        """Return the maximum number of samples from the newest sample to a frame. The period must be known."""
        return STEPS_FACTOR * (arrival_ns - self._due_ns + QUEUED_NS) / self.period_ns

    def has_no_room(self, arrival_ns: int) -> bool:
        """Return whether no sample can be lost between the newest sample and a frame."""
        return self.is_known and arrival_ns - self._due_ns < STEPS_FACTOR * self.period_ns

    def resume(self, steps: int, arrival_ns: int) -> int:
        """Return the number of samples to a frame whose number is `steps` ahead, with lost whole turns. Return 0 if the
        number does not fit the elapsed time: the device restarted, or is another device."""
        if not self.is_known:
            return 0
        passed = (arrival_ns - self._due_ns) / self.period_ns
        steps += max(round((passed - steps) / self._turn), 0) * self._turn
        doubt = RESUME_STEPS + self._error * passed
        return steps if doubt < self._turn / RESUME_STEPS and abs(steps - passed) <= doubt else 0

    def add_arrival(self, arrival_ns: int, steps: int = 1) -> tuple[int, bool]:
        """Add a frame `steps` samples after the newest sample. Return (number of lost samples, is certain). Losses that
        earlier frames have shown are not counted again. The number is certain within one sample or turn."""
        self._due_ns += steps * self.period_ns
        late_ns = arrival_ns - self._due_ns
        self._count += 1
        self._steps += steps
        if late_ns < self._least_ns:  # noqa: PLR1730 - a call of min() costs 60 ns on the sample path
            self._least_ns = late_ns
        if late_ns > self._most_ns:  # noqa: PLR1730 - as above
            self._most_ns = late_ns
        if self._count < WINDOW_MESSAGES or arrival_ns < self._until_ns:
            return 0, True
        return self._close(arrival_ns)

    def _close(self, arrival_ns: int) -> tuple[int, bool]:
        """Compute the losses of a window. If frames waited in this window, the next window shows its losses."""
        # If all frames were early, none waited for long: the phase or the rate changed.
        if not self.period_ns:
            return self._learn(arrival_ns)
        self._unjudged += self._steps
        found = 0, True
        if self._most_ns < 0 or self._most_ns - self._least_ns <= SETTLED_SPREAD_NS + self.period_ns / 2:
            found = self._judge(arrival_ns)
            self._unjudged = 0
        self._begin_window(arrival_ns)
        return found

    def _learn(self, arrival_ns: int) -> tuple[int, bool]:
        certain = not self.period_ns
        self.period_ns = (arrival_ns - self._begin_ns) / self._steps
        self._error = 1.0
        self.begin(arrival_ns)
        return 0, certain

    def _judge(self, arrival_ns: int) -> tuple[int, bool]:
        """Distinguish lost samples from an inaccurate period, by the lateness of all frames of a window."""
        late_ns, turn_ns = self._least_ns, self._turn * self.period_ns
        off = late_ns / (self._unjudged * self.period_ns)
        has_phase, self._has_phase = self._has_phase, True
        if self.is_known and (2 * late_ns >= turn_ns or abs(off) > PACE_KNOWN):
            self._off_windows += 1
            turns, before_ns = max(round(late_ns / turn_ns), 0), self._off_ns
            rest_ns, sure = late_ns - turns * turn_ns, (turns + self._unjudged) * self._error < UNCERTAIN
            if not turns:
                self._off_ns = max(late_ns, 0.0)
            if before_ns and abs(rest_ns - before_ns) <= PACE_KNOWN * self._unjudged * self.period_ns:
                self._off_windows, self._off_ns = 0, 0.0
                self._due_ns += late_ns  # the same lateness twice: the phase changed, not the rate
                return turns * self._turn, not turns or sure or self._turn > 1
            if self._off_windows < OFF_WINDOWS:
                self._due_ns += turns * turn_ns if turns else min(late_ns, 0)  # the late frames waited
                if turns:
                    return turns * self._turn, sure or self._turn > 1
                return 0, not has_phase or late_ns * -2 < turn_ns
        self._off_windows, self._off_ns = 0, 0.0
        if abs(off) > PACE_KNOWN and (self.is_known or abs(off) > PACE_NEAR or 2 * late_ns >= turn_ns):
            return self._learn(arrival_ns)
        self._due_ns += late_ns
        if has_phase:  # otherwise the lateness is the wait of the first frame
            self.period_ns *= 1 + off * (PACE_GAIN if self.is_known else 1.0)
            self._error = max(abs(off), self._error * PACE_GAIN if self.is_known else abs(off), PACE_FLOOR)
        return 0, late_ns * -2 < turn_ns


class SampleNumber:
    """Wrapping counter that numbers the samples of a device without device time. The pace of arrivals shows whether a
    number is plausible, and the number of turns while imud received no frames."""

    __slots__ = ("_arrival_ns", "_modulus", "_number", "_pace", "_was_known", "known")

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._number = 0
        self._arrival_ns = 0
        self._pace = ArrivalPace(modulus)
        self._was_known = False
        self.known = False  # whether a previous sample exists

    def restart(self) -> None:
        """Continue the count from the newest sample only if the next number fits the elapsed time."""
        self._was_known = self._was_known or self.known
        self.known = False

    def steps(self, number: int, arrival_ns: int, period_ns: float) -> int:
        """Return the number of samples from the newest sample to this number. Return 0 for the first number and after a
        restart. `period_ns` replaces the period while the pace is unknown."""
        steps = (number - self._number) % self._modulus
        if not self.known:
            return self._pace.resume(steps, arrival_ns) if self._was_known else 0
        if steps <= STEPS_ALWAYS:
            return steps
        if self._pace.is_known:
            most = self._pace.steps_most(arrival_ns)
        else:
            waited_ns = arrival_ns - self._arrival_ns + QUEUED_NS
            most = STEPS_FACTOR * waited_ns / period_ns if period_ns else STEPS_UNKNOWN
        return steps if steps <= most else 0

    def is_sure(self, arrival_ns: int) -> bool:
        """Return whether no sample is missing before a number for which `steps` returns 0."""
        # no sample is missing before the first number, or after a very short time
        if not self.known:
            return not self._was_known
        return self._pace.has_no_room(arrival_ns)

    def advance(self, number: int, arrival_ns: int, steps: int) -> int:
        """Set the newest sample, `steps` after the previous sample. Return the number of samples in lost turns."""
        was_known = self.known or self._was_known
        self._number, self._arrival_ns, self.known, self._was_known = number, arrival_ns, True, False
        if steps and was_known:
            return self._pace.add_arrival(arrival_ns, steps)[0]
        self._pace.begin(arrival_ns)
        return 0


class ArrivalLosses:
    """Counter of lost samples for a device without device time: by the frame number, else by the pace. `modulus` is the
    modulus of the number, 0 without a number. `on_unknown_gap` is called for each gap of unknown size."""

    __slots__ = ("_number", "_on_unknown_gap", "_pace", "missed", "resets")

    def __init__(self, modulus: int, on_unknown_gap: Callable[[], None]) -> None:
        self._on_unknown_gap = on_unknown_gap
        self._number = SampleNumber(modulus) if modulus else None
        self._pace: ArrivalPace | None = None
        self.missed = 0  # lost samples directly before the newest number, and earlier lost samples that it shows
        self.resets = 0  # number of restarts of the frame number

    def restart(self) -> None:
        """Start again after the device or the link was missing."""
        self._pace = None
        if self._number is not None:
            self._number.restart()

    def add_number(self, number: int, arrival_ns: int, period_ns: float) -> int:
        """Add a frame with a number. Return its distance from the newest sample in samples; 0 after a restart."""
        counter = self._number
        assert counter is not None
        steps, goes_on = counter.steps(number, arrival_ns, period_ns), counter.known
        if not steps:
            self.resets += counter.known
            if not counter.is_sure(arrival_ns):
                self._on_unknown_gap()
        self.missed = max(steps - 1, 0) + counter.advance(number, arrival_ns, steps)
        return steps if goes_on else 0

    def add_arrival(self, arrival_ns: int, *, is_first: bool) -> int:
        """Add a frame without a number. Return the number of lost samples that it shows. `is_first`: the first frame of
        the device."""
        pace = self._pace
        if pace is None:
            self._pace = pace = ArrivalPace()
            pace.begin(arrival_ns)
            if not is_first:
                self._on_unknown_gap()
            return 0
        missed, certain = pace.add_arrival(arrival_ns)
        if not certain:
            self._on_unknown_gap()
        return missed
