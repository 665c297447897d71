"""The delay of messages on a link: its constant part, which arrivals cannot show, and the spread of arrivals."""

from math import sqrt
from typing import Final

from imud.clock.arrival_fit import ArrivalFit
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

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
