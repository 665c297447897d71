"""Feed of RMC sentences to a device over its own serial port, so that its time becomes UTC (HiPNUC manual 1.2.1).

A sentence names the second that a pulse began; the device assigns it to the last pulse it saw. It therefore has to be
transmitted before the next pulse, or the device would be wrong by one second, and only if the receiver marks it valid.
The begin of the present second is known from the host's UTC reference, else from the pulse line, else not at all.
A sentence is written whole, at once or never, and not while a request script runs on the device.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from imud.contracts.lines import UtcReference
from imud.formats.nmea0183 import Rmc, RmcFault, as_gprmc, parse
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

GUARD_NS: Final = 20 * NS_PER_MS
"""A sentence is transmitted at least this long before the next second: the device has to process it as well."""
PULSE_FRESH_NS: Final = NS_PER_S + 100 * NS_PER_MS
"""An older pulse does not predict the next one."""
AHEAD_NS: Final = 5 * NS_PER_MS
"""A sentence may name a time that is this far ahead of the reference."""
SIGMAS: Final = 3
DOUBT_MOST_NS: Final = NS_PER_S // 4
"""A reference with a larger error is not used."""


class Refusal(StrEnum):
    """Reasons for not sending a sentence."""

    DAMAGED = "damaged"
    """No RMC sentence, or a wrong checksum."""
    NOT_VALID = "not_valid"
    """Marked as not valid by the receiver (status V), or without time."""
    STALE = "stale"
    """Transmission would not end before the next second."""
    AHEAD = "ahead"
    """The sentence names a time in the future, by the pulse line or the host's UTC reference."""
    TOO_MANY = "too_many"
    """Above the configured rate."""
    BUSY = "busy"
    """A request script was running on the device."""
    LINK = "link"
    """The port accepted no bytes."""


@dataclass(frozen=True, slots=True)
class RmcFeedStatus:
    """Counters of the sentences."""

    sent: int
    refused: dict[str, int]
    """By `Refusal`."""
    last_sent_ns: int
    """CLOCK_MONOTONIC of the last sentence sent, 0 if none."""


class RmcFeed:
    """Feed of sentences to the device's port. Synchronization: the loop's thread only."""

    def __init__(
        self,
        write: Callable[[bytes], None],
        baud: Callable[[], int],
        busy: Callable[[], bool],
        now_ns: Callable[[], int],
        rate_hz: int = 1,
        reference: Callable[[], UtcReference | None] = lambda: None,
    ) -> None:
        """`write` and `baud` are those of the link, `busy` returns whether a request script is running."""
        self.sent = 0
        self.refused: Counter[Refusal] = Counter()
        self._write, self._baud, self._busy = write, baud, busy
        self._rate_hz = rate_hz
        self._reference, self._now_ns = reference, now_ns
        self._pulse_ns: int | None = None
        self._last_slot = -1
        self._last_sent_ns = 0

    def on_pulse(self, t_ns: int) -> None:
        """Note a rising edge of the PPS that the device's SIN receives, at CLOCK_MONOTONIC `t_ns`."""
        self._pulse_ns = t_ns

    def on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """Send a sentence of the source if it is timely; `t_rx_ns` is CLOCK_MONOTONIC of its arrival."""
        refusal = self._feed(sentence, t_rx_ns)
        if refusal is None:
            self.sent += 1
        else:
            self.refused[refusal] += 1

    def status(self) -> RmcFeedStatus:
        """Return the counters since the start."""
        return RmcFeedStatus(self.sent, {str(kind): count for kind, count in self.refused.items()}, self._last_sent_ns)

    def _feed(self, sentence: bytes, t_rx_ns: int) -> Refusal | None:
        rmc = parse(sentence)
        if isinstance(rmc, RmcFault):
            return Refusal.NOT_VALID if rmc is RmcFault.CONTENT else Refusal.DAMAGED
        if not rmc.valid:
            return Refusal.NOT_VALID
        slot = rmc.utc_ns * self._rate_hz // NS_PER_S
        if slot == self._last_slot:
            return Refusal.TOO_MANY
        now_ns, data = self._now_ns(), as_gprmc(sentence)
        refusal = self._timely(rmc, t_rx_ns, now_ns, now_ns + len(data) * uart_byte_ns(self._baud()))
        if refusal is None:
            refusal = self._send(data)
        if refusal is None:
            self._last_slot, self._last_sent_ns = slot, now_ns
        return refusal

    def _timely(self, rmc: Rmc, t_rx_ns: int, now_ns: int, through_ns: int) -> Refusal | None:
        """Return why the device would assign the sentence, received at `through_ns`, to a wrong second, or None."""
        second_ns, doubt_ns = self._second_ns(rmc, t_rx_ns, now_ns)
        if second_ns is None:
            return None if through_ns - t_rx_ns < NS_PER_S - GUARD_NS else Refusal.STALE
        if second_ns + rmc.fraction_ns > t_rx_ns + doubt_ns:
            return Refusal.AHEAD
        return None if through_ns < second_ns + NS_PER_S - GUARD_NS - doubt_ns else Refusal.STALE

    def _second_ns(self, rmc: Rmc, t_rx_ns: int, now_ns: int) -> tuple[int | None, int]:
        """Return CLOCK_MONOTONIC at the begin of the second that the sentence names, and its uncertainty (ns)."""
        reference, pulse_ns = self._reference(), self._pulse_ns
        if reference is not None and SIGMAS * reference.error_ns + AHEAD_NS <= DOUBT_MOST_NS:
            return rmc.unix_s * NS_PER_S - reference.offset_ns, SIGMAS * reference.error_ns + AHEAD_NS
        if pulse_ns is not None and now_ns - pulse_ns < PULSE_FRESH_NS:
            # a fraction of a second not yet reached since the last pulse belongs to the second before it
            before = t_rx_ns - pulse_ns < rmc.fraction_ns
            return pulse_ns - before * NS_PER_S, 0
        return None, 0

    def _send(self, data: bytes) -> Refusal | None:
        if self._busy():
            return Refusal.BUSY
        try:
            self._write(data)
        except LinkError:
            return Refusal.LINK
        return None
