"""Gaps between samples where the device's counter alone does not give their size.

`CounterLine` keeps where a counter of time was before its fit began anew: messages that waited while the host was busy
make a fit that is late, and a message on time then looks as if the counter had jumped. `ArrivalPace` is for devices
without time: the pace of their arrivals, learned from the messages that waited least, shows what is missing.
"""

from collections.abc import Callable
from math import inf
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.arrival_fit import ArrivalFit

# --- counters of time -----------------------------------------------------------------------------------------------
EARLY_NS: Final = 5 * NS_PER_MS
EARLY_SIGMAS: Final = 10
"""A message so far below the line came before its sample: the counter was set anew."""
LATE_NS: Final = NS_PER_S // 2
"""A counter that ran on while the link was away is this late at most; with more it may be another's."""
STEADY: Final = 2e-5
"""A slope known so well does not swing; while the host is starved it is known a hundred times worse."""
KEPT_NS: Final = 600 * NS_PER_S
"""Messages that are late for so long are no starvation: the counter stood still."""

GAP_PERIODS: Final = 1.5
"""With less host time since the sample before, none is missing."""

# --- arrivals -------------------------------------------------------------------------------------------------------
STEPS_ALWAYS: Final = 4
"""So many steps are accepted at any arrival: messages that waited arrive together."""
STEPS_FACTOR: Final = 1.5
"""Error of the rate over a longer gap, at most; a larger jump is a counter that began anew."""
QUEUED_NS: Final = NS_PER_S // 2
"""How long messages may wait and then arrive together; no device starts anew within that time."""
STEPS_UNKNOWN: Final = 1000
"""So many steps are accepted while the rate is not known."""
WINDOW_MESSAGES: Final = 16
WINDOW_NS: Final = NS_PER_S
"""So many messages over so much time contain one that hardly waited, if their lateness varies by no more than this: an
adapter's latency timer and a little of the host's own."""
SETTLED_SPREAD_NS: Final = 50 * NS_PER_MS
PACE_GAIN: Final = 0.5
"""Share of a window's drift that goes into the period."""
PACE_KNOWN: Final = 0.002
"""Relative error from which on samples are counted by the period."""
PACE_NEAR: Final = 0.05
"""A first estimate of the period that is off by no more is corrected; one that is off by more is made anew."""
PACE_FLOOR: Final = 1e-5
"""Relative error of the period at the least: crystals drift, and messages wait."""
OFF_WINDOWS: Final = 4
"""So many windows in a row that are late or early by more than the period explains are another rate."""
UNCERTAIN: Final = 0.75
"""A gap is certain within one sample while the error of the period over it is no more of one."""
RESUME_STEPS: Final = 8
"""How far from its due a number may be after the link was away."""


class CounterLine:
    """The host time of a counter, by the fit as it was when it was lowest: arrivals are above as long as that runs on.

    While the host is starved every message is late, and the fit follows them upwards; this line does not.
    """

    __slots__ = ("_device_ns", "_error_ns", "_fitted_ns", "_host_ns", "_slope_error", "slope")

    def __init__(self, fit: ArrivalFit, error_ns: float) -> None:
        self._set(fit, error_ns)

    def _set(self, fit: ArrivalFit, error_ns: float) -> None:
        self._device_ns, self._host_ns = fit.ref_device_ns, fit.ref_arrival_ns
        self.slope = fit.slope
        """Host ns per device ns."""
        self._fitted_ns, self._slope_error, self._error_ns = fit.fitted_ns, fit.slope_error, error_ns

    def follow(self, fit: ArrivalFit, error_ns: float) -> None:
        """Follow a fit that changed, unless it swings, or rests on messages that are later than those before."""
        device_ns = fit.fitted_ns
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        is_steady = fit.slope_error <= max(self._slope_error, STEADY)
        if (is_steady and self.above(device_ns, fit_ns) <= self.early_ns(device_ns)) or (
            device_ns - self._fitted_ns > KEPT_NS
        ):
            self._set(fit, error_ns)

    def above(self, device_ns: int, arrival_ns: float) -> float:
        """Return how far an arrival is above the line, ns."""
        return arrival_ns - self._host_ns - self.slope * (device_ns - self._device_ns)

    def early_ns(self, device_ns: int) -> float:
        """Return how far below the line an arrival can be at most."""
        return EARLY_NS + EARLY_SIGMAS * self._error_ns + 4 * self._slope_error * abs(device_ns - self._fitted_ns)

    def carries(self, device_ns: int, arrival_ns: float) -> bool:
        """Whether the counter can have run on to `device_ns`; the message may have waited."""
        return self.above(device_ns, arrival_ns) >= -self.early_ns(device_ns)

    def is_on_time(self, device_ns: int, arrival_ns: float) -> bool:
        """Whether the counter ran on to `device_ns`, and the message hardly waited."""
        return self.carries(device_ns, arrival_ns) and self.above(device_ns, arrival_ns) <= LATE_NS

    def turns(self, device_ns: int, arrival_ns: float, turn_ns: int) -> int:
        """Return how often the counter turned unseen before `device_ns`, each turn of `turn_ns`."""
        return max(round(self.above(device_ns, arrival_ns) / (self.slope * turn_ns)), 0)


class ArrivalPace:
    """When messages of an even pace are due, from those that waited least; what stays late is missing.

    Messages that waited for a busy host arrive together and late. Where some of them were dropped, those after are late
    by the count of messages ever after: the lateness that a whole window shares is what is missing. `turn` is after how
    many samples a device's number begins anew: the arrivals need show only the whole turns then; 1 without a number.
    """

    __slots__ = (
        "_begin_ns", "_count", "_due_ns", "_error", "_has_phase", "_least_ns", "_most_ns", "_off_ns", "_off_windows",
        "_steps", "_turn", "_unjudged", "_until_ns", "period_ns",
    )  # fmt: skip

    def __init__(self, turn: int = 1) -> None:
        self._turn = turn
        self.period_ns = 0.0
        """Time between samples; 0.0 while unknown."""
        self._error = 1.0  # relative error of the period
        # windows in a row that were late or early: each lost samples or had a wrong phase, or the rate is another
        self._off_windows = 0
        # by how much the last of them in which no sample was missing was late; 0.0 where it was early
        self._off_ns = 0.0
        self.begin(0)

    @property
    def is_known(self) -> bool:
        """Whether the period is known well enough to count by."""
        return self._error < PACE_KNOWN

    def begin(self, arrival_ns: int) -> None:
        """Set the first message, or the first after a gap of unknown size; what is known of the period stays."""
        self._due_ns = float(arrival_ns)
        self._has_phase = False  # whether a window has shown how long the first message waited
        self._unjudged = 0  # samples since the window that was judged last
        self._begin_window(arrival_ns)

    def _begin_window(self, arrival_ns: int) -> None:
        self._count = self._steps = 0
        self._least_ns, self._most_ns = inf, -inf
        self._begin_ns, self._until_ns = arrival_ns, arrival_ns + WINDOW_NS

    def steps_most(self, arrival_ns: int) -> float:
        """Return how many samples after the newest one a message can be at most; the period must be known."""
        return STEPS_FACTOR * (arrival_ns - self._due_ns + QUEUED_NS) / self.period_ns

    def has_no_room(self, arrival_ns: int) -> bool:
        """Whether no sample can be missing between the newest one and a message."""
        return self.is_known and arrival_ns - self._due_ns < STEPS_FACTOR * self.period_ns

    def resume(self, steps: int, arrival_ns: int) -> int:
        """Return how many samples after the newest one a number is that is `steps` ahead, whole turns left out.

        0 where it does not fit the time that passed: the device need not be the same, or began anew.
        """
        if not self.is_known:
            return 0
        passed = (arrival_ns - self._due_ns) / self.period_ns
        steps += max(round((passed - steps) / self._turn), 0) * self._turn
        doubt = RESUME_STEPS + self._error * passed
        return steps if doubt < self._turn / RESUME_STEPS and abs(steps - passed) <= doubt else 0

    def add_arrival(self, arrival_ns: int, steps: int = 1) -> tuple[int, bool]:
        """Add a message `steps` samples after the newest one.

        Returns how many more samples are known by now to be missing before it, and whether that is certain within one
        sample (or, with a number, one turn).
        """
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
        """Judge a window, unless messages waited in it: then the next one shows what is missing.

        Where all were early none waited long: the phase or the rate is another.
        """
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
        """Set the first estimate of the period."""
        certain = not self.period_ns
        self.period_ns = (arrival_ns - self._begin_ns) / self._steps
        self._error = 1.0
        self.begin(arrival_ns)
        return 0, certain

    def _judge(self, arrival_ns: int) -> tuple[int, bool]:
        """Tell samples that are missing from a period that is a little off, by the lateness that a window shares."""
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
                self._due_ns += late_ns  # the same again: it is not the rate that changed, but the phase
                return turns * self._turn, not turns or sure or self._turn > 1
            if self._off_windows < OFF_WINDOWS:
                self._due_ns += turns * turn_ns if turns else min(late_ns, 0)  # late ones waited
                if turns:
                    return turns * self._turn, sure or self._turn > 1
                return 0, not has_phase or late_ns * -2 < turn_ns
        self._off_windows, self._off_ns = 0, 0.0
        if abs(off) > PACE_KNOWN and (self.is_known or abs(off) > PACE_NEAR or 2 * late_ns >= turn_ns):
            return self._learn(arrival_ns)
        self._due_ns += late_ns
        if has_phase:  # else late by as much as the one message waited that set the phase
            self.period_ns *= 1 + off * (PACE_GAIN if self.is_known else 1.0)
            self._error = max(abs(off), self._error * PACE_GAIN if self.is_known else abs(off), PACE_FLOOR)
        return 0, late_ns * -2 < turn_ns


class SampleNumber:
    """A wrapping counter that numbers a device's samples and gives no time.

    The pace of arrivals shows whether a number can be right, and how often it turned while nothing was read.
    """

    __slots__ = ("_arrival_ns", "_modulus", "_number", "_pace", "_was_known", "known")

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._number = 0
        self._arrival_ns = 0
        self._pace = ArrivalPace(modulus)
        self._was_known = False
        self.known = False
        """Whether there is a sample before."""

    def restart(self) -> None:
        """Count on from the newest sample only if the next number fits the time that passed."""
        self._was_known = self._was_known or self.known
        self.known = False

    def steps(self, number: int, arrival_ns: int, period_ns: float) -> int:
        """Number of samples from the newest one to this; 0 for the first one and after a counter began anew.

        `period_ns` is used while the pace is not known.
        """
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
        """Whether a number that counts no step leaves no gap: it is the first one, or there was no time for one."""
        if not self.known:
            return not self._was_known
        return self._pace.has_no_room(arrival_ns)

    def advance(self, number: int, arrival_ns: int, steps: int) -> int:
        """Set the newest sample, `steps` after the one before; return how many more are missing: turns not seen."""
        was_known = self.known or self._was_known
        self._number, self._arrival_ns, self.known, self._was_known = number, arrival_ns, True, False
        if steps and was_known:
            return self._pace.add_arrival(arrival_ns, steps)[0]
        self._pace.begin(arrival_ns)
        return 0


class ArrivalLosses:
    """Counts what is missing between messages of a device without time: by their number, else by their pace.

    `modulus` is that of the number, 0 without one. `on_unknown_gap` is called for a gap whose size is not known.
    """

    __slots__ = ("_number", "_on_unknown_gap", "_pace", "missed", "resets")

    def __init__(self, modulus: int, on_unknown_gap: Callable[[], None]) -> None:
        self._on_unknown_gap = on_unknown_gap
        self._number = SampleNumber(modulus) if modulus else None
        self._pace: ArrivalPace | None = None
        self.missed = 0
        """Samples missing right before the newest number, or known by it to be missing before."""
        self.resets = 0
        """How often the number began anew."""

    def restart(self) -> None:
        """Begin anew after the device or the link was away."""
        self._pace = None
        if self._number is not None:
            self._number.restart()

    def add_number(self, number: int, arrival_ns: int, period_ns: float) -> int:
        """Add a numbered message; return how many samples after the newest one it is, 0 where it begins anew."""
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
        """Add a message without a number; return how many samples are known by it to be missing before.

        `is_first` where the device has sent none before.
        """
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
