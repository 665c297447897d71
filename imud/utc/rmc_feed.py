"""Feed of RMC sentences to a device over its own serial port: the device time becomes UTC (HiPNUC manual 1.2.1).

A sentence contains the second that a pulse started. The device assigns it to the last pulse. imud must therefore
transmit the sentence before the next pulse, or the device would be wrong by one second, and only if the receiver marks
it as valid. The start of the present second comes from the host's UTC reference, otherwise from the PPS line. imud
writes a sentence completely or not at all, and never while a script runs on the device.
"""

from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Final

from imud.contracts.lines import UtcReference
from imud.contracts.link import DeviceLink
from imud.formats.nmea0183 import Rmc, RmcFault, as_gprmc, parse
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

# minimum time from the end of the transmission to the next second, ns: the device also has to process the sentence
GUARD_NS: Final = 20 * NS_PER_MS
PULSE_FRESH_NS: Final = NS_PER_S + 100 * NS_PER_MS  # maximum age of a pulse that predicts the next pulse, ns
AHEAD_NS: Final = 5 * NS_PER_MS  # maximum time that a sentence may be ahead of the reference, ns
SIGMAS: Final = 3
# The rate counts real time. A sentence may be early by half a period, because its delay changes. The feed permits 1 %
# more sentences than the configured rate, because the oscillators of receiver and host differ.
EARLY_PERIODS: Final = 0.5
PERIOD_FACTOR: Final = 0.99
DOUBT_MOST_NS: Final = NS_PER_S // 4  # maximum error of a usable reference, ns


class Refusal(StrEnum):
    """Reasons to reject a sentence."""

    DAMAGED = "damaged"  # not an RMC sentence, or a wrong checksum
    NOT_VALID = "not_valid"  # marked as invalid by the receiver (status V), or without a time
    # before the release of imud, or in contradiction to a synchronized system clock: `imud.device.utc` rejects them
    IMPLAUSIBLE = "implausible"
    # the time did not advance like CLOCK_MONOTONIC since the previous sentence: `imud.device.utc` rejects the sentence
    LEAP = "leap"
    STALE = "stale"  # the transmission would not end before the next second
    AHEAD = "ahead"  # the time is in the future according to the PPS line or to the host's UTC reference
    TOO_MANY = "too_many"  # above the configured rate, in real time or in the time of the sentences
    BUSY = "busy"  # A script was running on the device
    LINK = "link"  # the port did not accept the bytes


class RmcFeed:
    """Feed of sentences to the device's port. Synchronization: the event loop's thread only."""

    def __init__(self, port: DeviceLink, now_ns: Callable[[], int], rate_hz: int = 1) -> None:
        """`rate_hz` is the maximum rate of sentences to the device."""
        self.sent = 0
        self.refused: Counter[str] = Counter()  # number of rejected sentences for each `Refusal`
        self.reference: UtcReference | None = None  # UTC reference of the host; set by the owner
        self._port = port
        self._rate_hz = rate_hz
        self._now_ns = now_ns
        self._pulse_ns: int | None = None
        self._last_slot = -1
        self._period_ns = round(PERIOD_FACTOR * NS_PER_S / rate_hz)
        self._early_ns = round(EARLY_PERIODS * NS_PER_S / rate_hz)
        self._due_ns: int | None = None  # time of the next sentence at the configured rate; None before the first

    def on_pulse(self, t_ns: int) -> None:
        """Store a rising edge of the PPS on the device's SIN, at CLOCK_MONOTONIC `t_ns`."""
        self._pulse_ns = t_ns

    def on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """Send a sentence of the source if it is in time. `t_rx_ns` is CLOCK_MONOTONIC of its arrival."""
        refusal = self._feed(sentence, t_rx_ns)
        if refusal is None:
            self.sent += 1
        else:
            self.refused[str(refusal)] += 1

    def _feed(self, sentence: bytes, t_rx_ns: int) -> Refusal | None:
        rmc = parse(sentence)
        if isinstance(rmc, RmcFault):
            return Refusal.NOT_VALID if rmc is RmcFault.CONTENT else Refusal.DAMAGED
        if not rmc.valid:
            return Refusal.NOT_VALID
        slot = rmc.utc_ns * self._rate_hz // NS_PER_S
        now_ns = self._now_ns()
        due_ns = now_ns if self._due_ns is None else self._due_ns
        if slot == self._last_slot or now_ns < due_ns - self._early_ns:
            return Refusal.TOO_MANY
        data = as_gprmc(sentence)
        refusal = self._timely(rmc, t_rx_ns, now_ns, now_ns + len(data) * uart_byte_ns(self._port.bit_rate))
        if refusal is None:
            refusal = self._send(data)
        if refusal is None:
            self._last_slot = slot
            self._due_ns = max(due_ns, now_ns) + self._period_ns
        return refusal

    def _timely(self, rmc: Rmc, t_rx_ns: int, now_ns: int, through_ns: int) -> Refusal | None:
        """Return the reason to reject a sentence that the device receives at `through_ns`; None if it is in time."""
        second_ns, doubt_ns = self._second_ns(rmc, t_rx_ns, now_ns)
        if second_ns is None:
            return None if through_ns - t_rx_ns < NS_PER_S - GUARD_NS else Refusal.STALE
        if second_ns + rmc.fraction_ns > t_rx_ns + doubt_ns:
            return Refusal.AHEAD
        return None if through_ns < second_ns + NS_PER_S - GUARD_NS - doubt_ns else Refusal.STALE

    def _second_ns(self, rmc: Rmc, t_rx_ns: int, now_ns: int) -> tuple[int | None, int]:
        """Return (CLOCK_MONOTONIC at the start of the sentence's second, its error), ns; None if unknown."""
        reference, pulse_ns = self.reference, self._pulse_ns
        if reference is not None and SIGMAS * reference.error_ns + AHEAD_NS <= DOUBT_MOST_NS:
            return rmc.unix_s * NS_PER_S - reference.offset_ns, SIGMAS * reference.error_ns + AHEAD_NS
        if pulse_ns is not None and now_ns - pulse_ns < PULSE_FRESH_NS:
            # a fraction later than the time since the pulse belongs to the second before the pulse
            before = t_rx_ns - pulse_ns < rmc.fraction_ns
            return pulse_ns - before * NS_PER_S, 0
        return None, 0

    def _send(self, data: bytes) -> Refusal | None:
        if not self._port.is_free:
            return Refusal.BUSY
        try:
            self._port.write(data)
        except LinkError:
            return Refusal.LINK
        return None
