"""Time stamps of frames without device time: from the arrival times, the constant rate and the number of a frame.

arrival, number ─▶ EvenArrivals: a fit below the arrivals ─▶ time, error
              │         before the fit: the arrival less half of the link's bias; the error is the spread
              └──▶ ArrivalLosses: lost samples before the frame
"""

from collections.abc import Callable
from math import hypot, sqrt
from typing import Final

from imud.contracts.status import ErrorPart
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_fit import ENOUGH_SPAN_NS, ArrivalFit
from imud.sampling.gaps import ArrivalLosses

# maximum of the shortest time from the interrupt to the reader, ns (30 to 100 µs on small boards)
WAKE_NS: Final = 100 * NS_PER_US
FIFO_BYTES: Final = 4  # number of byte times after which a 16550 or PL011 FIFO reports bytes below its trigger level
USB_POLL_NS: Final = 125 * NS_PER_US  # wait of a full adapter for the host's poll, ns: one micro-frame
FIRST_SPREAD_NS: Final = 2 * NS_PER_MS  # assumed spread of the first arrivals, ns
# one-sigma error of a value that is uniformly distributed in a range, per width of the range
SIGMA_OF_RANGE: Final = 1 / sqrt(12)
# One-sigma error of the delay in an adapter, per width of its range. In two of three cases the delay is anywhere in the
# range. In the third case it is at an end: the adapter sends packets immediately, or each packet starts its timer.
SIGMA_OF_HIDDEN: Final = sqrt((2 / 12 + 1 / 4) / 3)
SMOOTHING: Final = 1 / 32
# factor by which frames can be faster than the wire before imud assumes that no such wire exists
WIRE_SLACK: Final = 1.05
STILL_MOST: Final = 16  # number of frames with one arrival time after which the clock of a capture has stopped


class LinkDelay:
    """Bounds of the constant delay, which arrivals cannot show: from 0 to the largest bias of the link. `byte_ns` is
    the time of a byte on the wire, 0 if unknown. `hold_ns` is the period of an adapter's latency timer."""

    __slots__ = ("byte_ns", "hold_ns")

    def __init__(self, byte_ns: int, hold_ns: int) -> None:
        self.byte_ns = byte_ns
        self.hold_ns = hold_ns

    @property
    def floor_ns(self) -> int:
        if self.hold_ns:
            return WAKE_NS + USB_POLL_NS
        return WAKE_NS + FIFO_BYTES * self.byte_ns

    def carries(self, period_ns: float, size_bytes: int) -> bool:
        """Return whether the wire can carry frames at this rate. A pty or a USB device accepts any baud rate."""
        return not period_ns or period_ns * WIRE_SLACK >= size_bytes * self.byte_ns

    def corrected(self, fit: ArrivalFit, period_ns: float, size_bytes: int) -> "LinkDelay | None":
        """Return the delay according to the arrivals if it differs: no such wire, or a longer timer than reported."""
        if fit.span_ns >= NS_PER_S and not self.carries(period_ns, size_bytes):
            return LinkDelay(0, self.hold_ns)
        return LinkDelay(self.byte_ns, fit.measured_hold_ns) if fit.measured_hold_ns else None

    def held_ns(self, period_ns: float, size_bytes: int) -> float:
        """Return the maximum time that an adapter's timer can hide, ns."""
        # A read ends in the pause after a frame or inside the next frame. The bytes after a frame show the delay except
        # for the pause. The hidden time is therefore at most the pause between two frames, and at most the timer.
        if not period_ns:
            return self.hold_ns
        return min(self.hold_ns, max(period_ns - size_bytes * self.byte_ns, 0.0))

    def bias_error_ns(self, hidden_ns: float) -> float:
        """Return the one-sigma error of the middle of the hidden delay, ns. An adapter hides `hidden_ns` of it."""
        return SIGMA_OF_RANGE * self.floor_ns + SIGMA_OF_HIDDEN * hidden_ns

    def before(self, arrival_ns: int, size_bytes: int, period_ns: float, sigma_ns: float) -> tuple[int, float]:
        """Return (time of transmission, its error), ns, of a frame that arrived at `arrival_ns`. `sigma_ns` is the
        spread of the arrivals."""
        bias_ns = self.floor_ns + self.held_ns(period_ns, size_bytes)
        return arrival_ns - int(bias_ns / 2), SIGMA_OF_RANGE * bias_ns + sigma_ns


class ArrivalSpread:
    """Mean and spread of the steps between arrivals, for devices without device time."""

    __slots__ = ("_last_ns", "_spread", "_still", "period_ns")

    def __init__(self) -> None:
        self._last_ns = 0
        self._spread = 0.0
        self._still = 0  # number of successive frames with the same arrival
        self.period_ns = 0.0  # mean step between frames, ns; 0 if unknown

    def add_arrival(self, arrival_ns: int, steps: int = 1) -> None:
        """Add the arrival of a frame less its time on the wire, `steps` frames after the previous frame."""
        last_ns, self._last_ns = self._last_ns, arrival_ns
        self._still = self._still + 1 if arrival_ns <= last_ns else 0
        if not last_ns or self._still > STILL_MOST:
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
        """Return the one-sigma spread of one arrival, ns."""
        # The mean absolute deviation of a step equals the spread of exponentially distributed delays. Their mean above
        # the shortest delay is as large.
        return 1.5 * self._spread if self.period_ns else FIRST_SPREAD_NS


LEARNING_MESSAGES: Final = 32  # number of frames for the first estimate of the period
# Maximum distance of a frame from the fit, in periods. Beyond that, the frame is another sample, or was delayed.
HALF: Final = 0.5
# number of frames at normal pace that must be late by the same number of periods before imud counts lost samples
AGREEING: Final = 4
# Maximum number of late frames at normal pace without agreement. After that, imud measures the rate again.
UNDECIDED_MOST: Final = 32
# Maximum mean distance above the fit, in periods. Beyond that, the arrival time is better than the fit.
EVEN_SHARE: Final = 0.25
MEAN_SMOOTHING: Final = 1 / 128
LOST_MOST: Final = 3
# Maximum distance of a late frame from whole periods, as a share of a period, that counts as another sample. The mean
# distance of the other frames must be as small.
NEAR_SHARE: Final = 0.02
HOLD_SHARE: Final = 0.25  # Maximum delay in an adapter, in periods. A longer delay hides the number of lost samples.


class EvenArrivals:
    """Fit below the arrivals of frames without device time, over the sample count.

    A busy host delays single frames by an unknown time. The fit is therefore more accurate than one arrival time. A
    frame that is late by whole periods was delayed, or samples before it are lost. The next frames decide between both
    cases. Until then, half of the distance from the fit to the arrival is part of the time stamp error.
    """

    __slots__ = (
        "_above_mean", "_agreeing", "_arrival_ns", "_begin_ns", "_device_ns", "_late_periods", "_learned",
        "_period_ns", "_undecided", "error_ns", "fit", "t_ns",
    )  # fmt: skip

    def __init__(self) -> None:
        self.t_ns = 0  # Time of the newest frame according to the fit, ns. `add_arrival` returns whether it is valid.
        self.error_ns = 0.0  # one-sigma error of `t_ns`, ns
        self.restart()

    def restart(self) -> None:
        """Discard the fit and the period: the device or its link was missing, or the rate changed."""
        self.fit: ArrivalFit | None = None
        self._period_ns = 0.0
        self._learned = 0
        self._begin_ns = self._arrival_ns = self._device_ns = 0
        self._late_periods = self._agreeing = self._undecided = 0
        self._above_mean = 0.0

    def add_arrival(self, delay: LinkDelay, arrival_ns: int, number: int, *, triggered: bool) -> bool:
        """Add a frame. Return whether the fit is better than the arrival time.

        The frame is `number` samples after the previous frame; 0 for a frame without a number, before which samples may
        be lost. `triggered` samples need not have a constant rate. `delay` is the delay of the link.
        """
        steps = number or 1
        before_ns, self._arrival_ns = self._arrival_ns, arrival_ns
        fit, period_ns = self.fit, self._period_ns
        if fit is None:
            self._learn(delay, arrival_ns, steps)
            return False
        device_ns = self._device_ns + int(steps * period_ns)
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        above_ns = arrival_ns - fit_ns
        at_pace = arrival_ns - before_ns > HALF * period_ns
        if above_ns < -HALF * period_ns:  # half a period early: the rate changed
            self.restart()
            return False
        if above_ns > HALF * period_ns and not number:
            late = round(above_ns / period_ns)  # delay in whole periods
            if not self._are_missing(late, at_pace=at_pace):
                self._device_ns = device_ns  # undecided: count no loss yet
                if self._undecided > UNDECIDED_MOST:
                    self.restart()
                    return False
                near_ns = NEAR_SHARE * period_ns
                is_near = abs(above_ns - late * period_ns) < near_ns and self._above_mean < near_ns
                # use the time of the other sample, but count no loss yet
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
        """Measure the period with the first frames, unless an adapter hides lost samples."""
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
        self.fit = ArrivalFit(0, arrival_ns, delay.hold_ns)

    def _are_missing(self, late: int, *, at_pace: bool) -> bool:
        """Return whether the last AGREEING frames are all late by `late` periods: then `late` samples are lost."""
        if not at_pace:
            self._agreeing = 0
            return False
        self._undecided += 1
        self._agreeing = self._agreeing + 1 if late == self._late_periods else 1
        self._late_periods = late
        return self._agreeing >= AGREEING

    def _use(self, delay: LinkDelay, fit: ArrivalFit, device_ns: int, line_ns: float, doubt_ns: float) -> bool:
        """Set `t_ns` and `error_ns`. Return whether the fit is better than the arrival time."""
        # The truth is up to `doubt_ns` after `line_ns`.
        self.t_ns = int(line_ns - delay.floor_ns / 2 - fit.shift_ns)
        self.error_ns = hypot(fit.error_ns, delay.bias_error_ns(fit.hidden_ns)) + HALF * doubt_ns
        self.error_ns += fit.slope_error * (device_ns - fit.fitted_ns)
        return fit.is_known(ENOUGH_SPAN_NS) and self._above_mean < EVEN_SHARE * self._period_ns


class ArrivalTime:
    """Time of a device's frames without device time. `modulus` is the modulus of their number, 0 without a number."""

    __slots__ = ("_even", "_losses", "_numbered", "delay", "error_ns", "missed", "spread")

    def __init__(self, delay: LinkDelay, modulus: int, on_unknown_gap: Callable[[], None]) -> None:
        """`on_unknown_gap` is called for each gap with an unknown number of lost samples."""
        self.delay = delay  # delay of the present link
        self.spread = ArrivalSpread()
        self._even = EvenArrivals()
        self._losses = ArrivalLosses(modulus, on_unknown_gap)
        self._numbered = modulus > 0
        self.error_ns = 0.0  # one-sigma error of the newest time, ns
        self.missed = 0  # number of lost samples directly before the newest frame

    @property
    def resets(self) -> int:
        return self._losses.resets

    @property
    def fit(self) -> ArrivalFit | None:
        """Return the fit that made the newest time; None if the arrival made it."""
        return self._even.fit if self.error_ns and self.error_ns == self._even.error_ns else None

    def restart(self) -> None:
        """Start again after the device or the link was missing."""
        self._losses.restart()
        self.missed = 0
        self.change_link(self.delay)

    def change_link(self, delay: LinkDelay) -> None:
        """Continue on a link with another delay."""
        self.delay = delay
        self.spread = ArrivalSpread()
        self._even.restart()

    def time_stamp(
        self, number: int | None, arrival_ns: int, size_bytes: int, *, alone: bool, triggered: bool, is_first: bool
    ) -> int:
        """Return the time of a frame that started to arrive at `arrival_ns`. Set `error_ns` and `missed`.

        `alone`: no other frames of the device contain the time. `triggered`: each frame follows its own pulse.
        `is_first`: the first frame of the device.
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


PARTS: Final = {
    "arrivals": ("The link or this host delays the frames unequally.", "Reduce the load of this host or connect SOUT."),
    "link": ("The arrival times do not show the constant delay of the link.", "Connect SOUT, which shows the delay."),
    "adapter": ("The latency timer of the USB adapter delays the bytes.", "Reduce the latency timer or connect SOUT."),
    "device": ("The device counts its time in steps.", "Connect SOUT."),
    "poll": ("A read does not show the time of the measurement.", "Connect the data-ready line."),
    "pulses": ("The interrupt latency of the kernel delays the time stamps of the pulses.", ""),
    "utc": ("The UTC of this host has an error.", "Improve the UTC source of this host."),
    "other": ("Frames wait, or the clock removes a correction slowly.", ""),
}  # fmt: skip
"""Causes of the time stamp error: sentence and next step."""


def error_parts(
    sync: Sync, t_err_ns: int, delay: LinkDelay, fit: ArrivalFit | None, spread_ns: float, tick_error_ns: float | None
) -> tuple[ErrorPart, ...]:
    """Return the causes of a time stamp error, the largest first.

    `fit` is the fit that made the time stamp, None without a fit. `spread_ns` is the spread of the arrivals.
    `tick_error_ns` is the error from the length of a tick; None for a polled device.
    """
    if sync in (Sync.EDGE, Sync.UTC) or tick_error_ns is None:
        sizes = {"poll" if sync is Sync.ARRIVAL else "utc" if sync is Sync.UTC else "pulses": float(t_err_ns)}
    elif fit is not None:
        hidden_ns = SIGMA_OF_HIDDEN * fit.hidden_ns
        sizes = {
            "arrivals": fit.error_ns,
            "adapter": hidden_ns,
            "link": delay.bias_error_ns(0.0),
            "device": tick_error_ns,
        }
        sizes["other"] = t_err_ns - hypot(fit.error_ns, delay.bias_error_ns(fit.hidden_ns)) - tick_error_ns
    else:
        link_ns = SIGMA_OF_RANGE * delay.floor_ns
        rest_ns = max(t_err_ns - spread_ns - link_ns, 0.0)
        sizes = {"arrivals": spread_ns, "link": link_ns, "adapter" if delay.hold_ns else "other": rest_ns}
    parts = [ErrorPart(name, min(int(size_ns), t_err_ns), *PARTS[name]) for name, size_ns in sizes.items()]
    return tuple(sorted((one for one in parts if one.value_ns > 0), key=lambda one: -one.value_ns))
