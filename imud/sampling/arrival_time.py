"""The time of messages that carry none: by their arrival, by their even pace, by their number; and what is missing.

    arrival, number ─▶ EvenArrivals: a line under the arrivals ─▶ time, error
                  │         while there is none: the arrival less half of the link's bias, and its spread as error
                  └──▶ ArrivalLosses: samples missing before the message

Nothing here reads a clock.
"""

from collections.abc import Callable
from math import hypot, sqrt
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import ENOUGH_SPAN_NS, ArrivalFit
from imud.sampling.gaps import ArrivalLosses

WAKE_NS: Final = 100 * NS_PER_US
"""Shortest way from the interrupt to the reader, at most (30–100 µs on small boards)."""
FIFO_BYTES: Final = 4
"""A 16550 or PL011 receive FIFO reports a tail below its trigger level after up to four byte times."""
USB_POLL_NS: Final = 125 * NS_PER_US
"""One micro-frame: the wait of a full adapter for the host's poll."""
FIRST_SPREAD_NS: Final = 2 * NS_PER_MS
"""Spread assumed of arrivals before any is known."""
SIGMA_OF_RANGE: Final = 1 / sqrt(12)
"""One-sigma error of a value that can be anywhere in a range, per width of the range."""
SIGMA_OF_HIDDEN: Final = sqrt((2 / 12 + 1 / 4) / 3)
"""The same of what an adapter hides: anywhere in two cases of three; in the third at an end, where packets go at once,
or a timer begins with each."""
SMOOTHING: Final = 1 / 32
WIRE_SLACK: Final = 1.05
"""Messages that follow each other this much faster than the wire can carry them did not come over such a wire."""


class LinkDelay:
    """Bounds of the constant part of the delay, which arrivals cannot show: from 0 to the largest bias of the link.

    `byte_ns` is the time of a byte on the wire (0: unknown), `hold_ns` the period of an adapter's latency timer.
    """

    __slots__ = ("byte_ns", "hold_ns")

    def __init__(self, byte_ns: int, hold_ns: int) -> None:
        self.byte_ns = byte_ns
        self.hold_ns = hold_ns

    @property
    def floor_ns(self) -> int:
        """Upper bound of the delay of the message that was delayed least."""
        if self.hold_ns:
            return WAKE_NS + USB_POLL_NS
        return WAKE_NS + FIFO_BYTES * self.byte_ns

    def carries(self, period_ns: float, size_bytes: int) -> bool:
        """Whether the wire time fits the rate; a pty or a USB device accepts any baud rate."""
        return not period_ns or period_ns * WIRE_SLACK >= size_bytes * self.byte_ns

    def corrected(self, fit: ArrivalFit, period_ns: float, size_bytes: int) -> "LinkDelay | None":
        """Return the delay that arrivals show, where it is another: no such wire, or a longer timer than reported."""
        if fit.span_ns >= NS_PER_S and not self.carries(period_ns, size_bytes):
            return LinkDelay(0, self.hold_ns)
        return LinkDelay(self.byte_ns, fit.measured_hold_ns) if fit.measured_hold_ns else None

    def held_ns(self, period_ns: float, size_bytes: int) -> float:
        """Longest time that an adapter's timer can hide behind bytes that follow.

        A read ends either in the pause after a message or inside the next one, and then counting back the bytes that
        trail leaves the pause: with messages every `period_ns`, no more than that pause, and never more than the timer.
        """
        if not period_ns:
            return self.hold_ns
        return min(self.hold_ns, max(period_ns - size_bytes * self.byte_ns, 0.0))

    def bias_error_ns(self, hidden_ns: float) -> float:
        """One-sigma error of the middle of what arrivals cannot show, of which an adapter hides `hidden_ns`."""
        return SIGMA_OF_RANGE * self.floor_ns + SIGMA_OF_HIDDEN * hidden_ns

    def before(self, arrival_ns: int, size_bytes: int, period_ns: float, sigma_ns: float) -> tuple[int, float]:
        """Return (when a message was sent that arrived at `arrival_ns`, its error); arrivals spread by `sigma_ns`."""
        bias_ns = self.floor_ns + self.held_ns(period_ns, size_bytes)
        return arrival_ns - int(bias_ns / 2), SIGMA_OF_RANGE * bias_ns + sigma_ns


class ArrivalSpread:
    """Mean and spread of the steps between arrivals, for devices that send no time."""

    __slots__ = ("_last_ns", "_spread", "period_ns")

    def __init__(self) -> None:
        self._last_ns = 0
        self._spread = 0.0
        self.period_ns = 0.0
        """Mean step between messages; 0 while unknown."""

    def add_arrival(self, arrival_ns: int, steps: int = 1) -> None:
        """Add the arrival of a message, less its wire time; `steps` messages after the one before."""
        last_ns, self._last_ns = self._last_ns, arrival_ns
        if not last_ns:
            return
        step = (arrival_ns - last_ns) / steps
        if not self.period_ns:
            self.period_ns = step
            self._spread = FIRST_SPREAD_NS
            return
        off = step - self.period_ns
        self.period_ns += off * SMOOTHING
        self._spread += (abs(off) - self._spread) * SMOOTHING

    @property
    def sigma_ns(self) -> float:
        """One-sigma spread of a single arrival.

        Mean absolute deviation of a step; for delays that fall off exponentially it equals their scale, which is
        their spread, and their mean above the floor is as large again.
        """
        return 1.5 * self._spread if self.period_ns else FIRST_SPREAD_NS


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


class ArrivalTime:
    """Time of a device's messages without device time. `modulus` is that of their number, 0 without one."""

    __slots__ = ("_even", "_losses", "_numbered", "delay", "error_ns", "missed", "spread")

    def __init__(self, delay: LinkDelay, modulus: int, on_unknown_gap: Callable[[], None]) -> None:
        """`on_unknown_gap` is called for a gap in which the number of missing samples is not known."""
        self.delay = delay
        """Of the link now."""
        self.spread = ArrivalSpread()
        self._even = EvenArrivals()
        self._losses = ArrivalLosses(modulus, on_unknown_gap)
        self._numbered = modulus > 0
        self.error_ns = 0.0
        """One-sigma error of the newest time."""
        self.missed = 0
        """Samples missing right before the newest message."""

    @property
    def resets(self) -> int:
        """How often the number began anew."""
        return self._losses.resets

    def restart(self) -> None:
        """Begin anew after the device or the link was away."""
        self._losses.restart()
        self.missed = 0
        self.change_link(self.delay)

    def change_link(self, delay: LinkDelay) -> None:
        """Go on over a link with other delays."""
        self.delay = delay
        self.spread = ArrivalSpread()
        self._even.restart()

    def date(
        self, number: int | None, arrival_ns: int, size_bytes: int, *, alone: bool, triggered: bool, is_first: bool
    ) -> int:
        """Return the time of a message of `size_bytes` that began to arrive at `arrival_ns`.

        `alone`: no other messages of the device carry time; `triggered`: each follows a pulse of its own; `is_first`:
        the device has sent none before. Sets `error_ns` and `missed`.
        """
        missed = steps = 0
        if self._numbered and number is not None:
            steps = self._losses.add_number(number, arrival_ns, self.spread.period_ns)
            if not steps:
                self.change_link(self.delay)
            missed = self._losses.missed
        elif alone and not self._numbered:
            missed = self._losses.add_arrival(arrival_ns, is_first=is_first)
        self.missed, spread = missed, self.spread
        spread.add_arrival(arrival_ns, steps or 1)
        if alone and self._even.add_arrival(self.delay, arrival_ns, steps, triggered=triggered):
            self.error_ns = self._even.error_ns
            return self._even.t_ns
        t_ns, self.error_ns = self.delay.before(arrival_ns, size_bytes, spread.period_ns, spread.sigma_ns)
        return t_ns
