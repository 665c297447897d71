"""Feeds a device RMC sentences over its own serial port, so that its time becomes UTC (HiPNUC manual 1.2.1).

A sentence names the second that a pulse began; the device takes it for the last pulse it saw. So it has to be through
the wire before the next one, else the device would be a second wrong, and it must not be believed if the receiver does
not stand by it. What is known of the present second, best first: the pulse line, what the host knows of UTC, nothing.
A sentence is written whole and only while no conversation with the device is going on; it waits for nothing.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from time import monotonic_ns
from typing import Final

from imud.contracts.timing import UtcReference
from imud.errors import LinkError
from imud.formats.rmc import Rmc, RmcFault, as_gprmc, parse
from imud.units import NS_PER_MS, NS_PER_S, uart_byte_ns

GUARD_NS: Final = 20 * NS_PER_MS
"""A sentence has to be through so long before the next second; the device has to read it as well."""
PULSE_FRESH_NS: Final = NS_PER_S + 100 * NS_PER_MS
"""An older pulse does not tell when the next one comes."""
AHEAD_NS: Final = 5 * NS_PER_MS
SIGMAS: Final = 3
DOUBT_MOST_NS: Final = NS_PER_S // 4
"""What knows UTC worse than this is not asked."""


class Refusal(StrEnum):
    """Why a sentence was not sent."""

    DAMAGED = "damaged"
    """It is no RMC sentence, or its checksum is wrong."""
    NOT_VALID = "not_valid"
    """The receiver does not stand by it (status V), or it has no time."""
    STALE = "stale"
    """It would not be through before the next second."""
    AHEAD = "ahead"
    """It names a time that has not been yet, by the pulse line or by what the host knows of UTC."""
    TOO_MANY = "too_many"
    """More came than the device is to be fed."""
    BUSY = "busy"
    """A conversation with the device was going on."""
    LINK = "link"
    """The port took no bytes."""


@dataclass(frozen=True, slots=True)
class RmcFeedStatus:
    """What became of the sentences so far."""

    sent: int
    refused: dict[str, int]
    """By `Refusal`."""
    last_sent_ns: int
    """CLOCK_MONOTONIC of the last one sent, 0 before."""


class RmcFeed:
    """Sentences in, sentences out on the device's port. Synchronization: the loop's thread only."""

    def __init__(
        self,
        write: Callable[[bytes], None],
        baud: Callable[[], int],
        busy: Callable[[], bool],
        rate_hz: int = 1,
        reference: Callable[[], UtcReference | None] = lambda: None,
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        """`write` is the link's, `baud` its present rate, `busy` whether a conversation is going on."""
        self.sent = 0
        self.refused: Counter[Refusal] = Counter()
        self._write, self._baud, self._busy = write, baud, busy
        self._rate_hz = rate_hz
        self._reference, self._now_ns = reference, now_ns
        self._pulse_ns: int | None = None
        self._last_slot = -1
        self._last_sent_ns = 0

    def pulse(self, t_ns: int) -> None:
        """A rising edge of the pulse that the device's SIN gets, at CLOCK_MONOTONIC `t_ns`."""
        self._pulse_ns = t_ns

    def on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """A sentence from the source; `t_rx_ns` is when it came."""
        refusal = self._feed(sentence, t_rx_ns)
        if refusal is None:
            self.sent += 1
        else:
            self.refused[refusal] += 1

    def status(self) -> RmcFeedStatus:
        """Counters since it was made."""
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
        """Whether the device, reading the sentence at `through_ns`, takes it for the right second."""
        second_ns, doubt_ns = self._second_ns(rmc, t_rx_ns, now_ns)
        if second_ns is None:
            return None if through_ns - t_rx_ns < NS_PER_S - GUARD_NS else Refusal.STALE
        if second_ns + rmc.fraction_ns > t_rx_ns + doubt_ns:
            return Refusal.AHEAD
        return None if through_ns < second_ns + NS_PER_S - GUARD_NS - doubt_ns else Refusal.STALE

    def _second_ns(self, rmc: Rmc, t_rx_ns: int, now_ns: int) -> tuple[int | None, int]:
        """CLOCK_MONOTONIC at which the second began that the sentence names, and how far that may be off."""
        reference, pulse_ns = self._reference(), self._pulse_ns
        if reference is not None and SIGMAS * reference.error_ns + AHEAD_NS <= DOUBT_MOST_NS:
            return rmc.unix_s * NS_PER_S - reference.offset_ns, SIGMAS * reference.error_ns + AHEAD_NS
        if pulse_ns is not None and now_ns - pulse_ns < PULSE_FRESH_NS:
            # a sentence whose time of the second was not yet since the last pulse names the second before it
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
