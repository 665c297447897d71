"""The time of messages without device time, by the even pace of their arrivals.

A device samples evenly also where its messages do not say so. A fit of arrivals over the count of samples
(`ArrivalFit`) is therefore a better time than a single arrival, which a busy host delays by anything:

    count of samples × first estimate of the period ─▶ "device time" ─┐
    arrival ──────────────────────────────────────────────────────────┴▶ fit; the message is `above_ns` above it

A message that is late by whole periods was delayed, or messages before it are missing: which of both, the next ones
show. Until then half of what it is above the line is in its error: the truth is between line and arrival. The same
where a module is triggered, because its samples are as even as the triggers. Nothing here reads a clock.
"""

from math import hypot
from typing import Final

from imud.clock.arrival_fit import ENOUGH_SPAN_NS, ArrivalFit
from imud.clock.link_delay import LinkDelay

LEARNING_MESSAGES: Final = 32
"""Number of messages whose mean step is the first estimate of the period."""
HALF: Final = 0.5
"""A message that is further from the line, in periods, is another sample's or was delayed by whole samples."""
AGREEING: Final = 4
"""So many messages that come at pace, all late by the same number of periods, show that so many samples are missing."""
UNDECIDED_MOST: Final = 32
"""After so many messages that come at pace and do not agree the rate is another."""
EVEN_SHARE: Final = 0.25
"""Mean distance above the line, in periods, of arrivals that follow a pace; where it is more their times are better."""
MEAN_SMOOTHING: Final = 1 / 128
LOST_MOST: Final = 3
NEAR_SHARE: Final = 0.02
"""A message that is late by so few periods within this share of one is more likely another sample's, on a host where
others are late by no more on the average."""
HOLD_SHARE: Final = 0.25
"""An adapter that may hold messages for longer, in periods, hides how many of them are missing."""


class EvenArrivals:
    """A line under the arrivals of messages without device time."""

    __slots__ = (
        "_above_mean", "_agreeing", "_arrival_ns", "_begin_ns", "_device_ns", "_fit", "_late_periods", "_learned",
        "_period_ns", "_undecided", "error_ns", "t_ns",
    )  # fmt: skip

    def __init__(self) -> None:
        self.t_ns = 0
        """Time of the newest message by the line; `add_arrival` returns whether it is to be used."""
        self.error_ns = 0.0
        """One-sigma error of that."""
        self.restart()

    def restart(self) -> None:
        """Begin anew: the device or its link was away, or its rate is another."""
        self._fit: ArrivalFit | None = None
        self._period_ns = 0.0
        self._learned = 0
        self._begin_ns = self._arrival_ns = self._device_ns = 0
        self._late_periods = self._agreeing = self._undecided = 0
        self._above_mean = 0.0

    def add_arrival(self, delay: LinkDelay, arrival_ns: int, number: int, *, triggered: bool) -> bool:
        """Add a message `number` samples after the one before; return whether the line dates it better.

        0 for a message without a number, which may have samples missing before it. Samples that are `triggered` need
        not be even. `delay` is that of the link.
        """
        steps = number or 1
        before_ns, self._arrival_ns = self._arrival_ns, arrival_ns
        fit, period_ns = self._fit, self._period_ns
        if fit is None:
            self._learn(delay, arrival_ns, steps)
            return False
        device_ns = self._device_ns + int(steps * period_ns)
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        above_ns = arrival_ns - fit_ns
        at_pace = arrival_ns - before_ns > HALF * period_ns
        if above_ns < -HALF * period_ns:
            self.restart()
            return False
        if above_ns > HALF * period_ns and not number:
            late = round(above_ns / period_ns)
            if not self._are_missing(late, at_pace=at_pace):
                self._device_ns = device_ns
                if self._undecided > UNDECIDED_MOST:
                    self.restart()
                    return False
                near_ns = NEAR_SHARE * period_ns
                is_near = abs(above_ns - late * period_ns) < near_ns and self._above_mean < near_ns
                if at_pace and late <= LOST_MOST and is_near:
                    fit_ns += late * period_ns
                return self._use(delay, fit, device_ns, fit_ns, above_ns)
            device_ns += int(late * period_ns)
            fit_ns += late * period_ns * fit.slope
            above_ns = arrival_ns - fit_ns
        self._late_periods = self._agreeing = self._undecided = 0
        self._device_ns = device_ns
        if at_pace:
            self._above_mean += (min(above_ns, period_ns) - self._above_mean) * MEAN_SMOOTHING
        if fit.add_arrival(device_ns, arrival_ns, 0, above_ns):
            fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        return self._use(delay, fit, device_ns, fit_ns, max(above_ns, 0.0) if triggered else 0.0)

    def _learn(self, delay: LinkDelay, arrival_ns: int, steps: int) -> None:
        """Measure the period by the first messages, unless an adapter hides what is missing."""
        if not self._begin_ns:
            self._begin_ns = arrival_ns
            return
        self._learned += steps
        if self._learned < LEARNING_MESSAGES:
            return
        period_ns = (arrival_ns - self._begin_ns) / self._learned
        if period_ns <= 0 or delay.hold_ns > HOLD_SHARE * period_ns:
            self.restart()
            return
        self._period_ns = period_ns
        self._fit = ArrivalFit(0, arrival_ns, delay.hold_ns)

    def _are_missing(self, late: int, *, at_pace: bool) -> bool:
        """Whether the last messages agree that so many samples are missing."""
        if not at_pace:
            self._agreeing = 0
            return False
        self._undecided += 1
        self._agreeing = self._agreeing + 1 if late == self._late_periods else 1
        self._late_periods = late
        return self._agreeing >= AGREEING

    def _use(self, delay: LinkDelay, fit: ArrivalFit, device_ns: int, line_ns: float, doubt_ns: float) -> bool:
        """Set the newest time by the line, or up to `doubt_ns` later; return whether that is to be used."""
        self.t_ns = int(line_ns - delay.floor_ns / 2 - fit.shift_ns)
        self.error_ns = hypot(fit.error_ns, delay.bias_error_ns(fit.hidden_ns)) + HALF * doubt_ns
        self.error_ns += fit.slope_error * (device_ns - fit.fitted_ns)
        return fit.is_known(ENOUGH_SPAN_NS) and self._above_mean < EVEN_SHARE * self._period_ns
