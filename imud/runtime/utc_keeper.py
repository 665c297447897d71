"""UTC of one device: sentences from a source to its port, and what the host knows of UTC to its clock.

source ──RMC──▶ feed ──▶ the device's port            (its time becomes UTC)
          └───▶ PpsReference ◀── pulses of the line ──▶ chronyd
                     └─ or the system clock, whichever is the better ──▶ clock.reference
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec

from imud.clock import SampleClock
from imud.config import DeviceConfig
from imud.contracts.lines import Edge
from imud.contracts.link import StreamLink
from imud.contracts.status import UtcStatus
from imud.contracts.timing import UtcReference
from imud.links import LINKS
from imud.units import NS_PER_S
from imud.utc import RMC_SOURCES
from imud.utc.adjtimex import kernel_clock, realtime_offset_ns, system_reference
from imud.utc.chrony import ChronyFeed
from imud.utc.pps import PpsReference
from imud.utc.rmc_feed import RmcFeed
from imud.utc.source import RmcSource

ASK_NS = NS_PER_S
"""How often the system clock is asked how good it is."""


def system_utc() -> UtcReference | None:
    """What the system clock says of UTC, None while nothing keeps it."""
    return system_reference(kernel_clock(), realtime_offset_ns())


@dataclass(frozen=True, slots=True)
class DevicePort:
    """The device's port, as far as sentences need it."""

    write: Callable[[bytes], None]
    baud: Callable[[], int]
    busy: Callable[[], bool]
    """Whether a conversation with the device is going on."""


class UtcKeeper:
    """Synchronization: the loop's thread only."""

    def __init__(
        self,
        source: RmcSource | None,
        port: DevicePort | None,
        rate_hz: int = 1,
        chrony: ChronyFeed | None = None,
        system: Callable[[], UtcReference | None] = system_utc,
    ) -> None:
        """`source` is None where the device is fed nothing; `port` None where it has none that can be written to."""
        self._source = source
        self._chrony = chrony
        self._pps = PpsReference(self._on_second if chrony is not None else None)
        self._system = system
        self._reference: UtcReference | None = None
        self._clock: SampleClock | None = None
        self._due_ns = 0
        self._feed: RmcFeed | None = None
        if port is not None:
            self._feed = RmcFeed(port.write, port.baud, port.busy, rate_hz, lambda: self._reference)

    def start(self) -> None:
        """Take sentences from now on."""
        if self._source is not None:
            self._source.start(self._on_sentence)

    def pulses(self, edges: Sequence[Edge]) -> None:
        """Edges of the pulse per second that the device's SIN gets."""
        for edge in edges:
            if edge.rising:
                self._pps.pulse(edge.t_ns)
                if self._feed is not None:
                    self._feed.pulse(edge.t_ns)

    def tick(self, now_ns: int, clock: SampleClock | None) -> None:
        """Ten times a second: what is known of UTC now, for the clock."""
        if clock is not self._clock or now_ns >= self._due_ns:
            self._clock = clock
            self._refer(now_ns)

    async def close(self) -> None:
        """Let go of everything; may be called twice."""
        if self._source is not None:
            await self._source.close()
        if self._chrony is not None:
            self._chrony.close()

    def status(self) -> UtcStatus:
        """How it is doing."""
        source, feed, chrony = self._source, self._feed, self._chrony
        return UtcStatus(
            source=source.title if source is not None else "",
            problem=(source.problem if source is not None else "") or (chrony.problem if chrony is not None else ""),
            sentences=source.sentences if source is not None else 0,
            sent=feed.sent if feed is not None else 0,
            refused=feed.status().refused if feed is not None else {},
            pulses=self._pps.pulses,
            pulses_ignored=self._pps.pulses_ignored,
            chrony_sent=chrony.sent if chrony is not None else 0,
            chrony_refused=chrony.refused if chrony is not None else 0,
        )

    def _refer(self, now_ns: int) -> None:
        self._due_ns = now_ns + ASK_NS
        self._reference = _better(self._pps.reference(now_ns), self._system())
        if self._clock is not None:
            self._clock.reference = self._reference

    def _on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """The sentence that tells the device which second it is may tell the host so too: the clock has to know UTC
        before the device's time turns into it, or it takes that for a jump."""
        self._pps.sentence(sentence, t_rx_ns)
        if self._reference is None:
            self._refer(t_rx_ns)
        if self._feed is not None:
            self._feed.on_sentence(sentence, t_rx_ns)

    def _on_second(self, t_ns: int, unix_s: int) -> None:
        if self._chrony is not None:
            self._chrony.pulse(t_ns, unix_s)


def _better(one: UtcReference | None, other: UtcReference | None) -> UtcReference | None:
    """The reference with the smaller error; the first where they are equal."""
    if one is None or other is None:
        return one or other
    return one if one.error_ns <= other.error_ns else other


def make_keeper(config: DeviceConfig, port: DevicePort) -> UtcKeeper | None:
    """What a device needs by its configuration; None where it has neither sentences nor a pulse per second."""
    rmc, pps = config.rmc, config.lines.pps if config.lines is not None else None
    if rmc is None and pps is None:
        return None
    chrony = ChronyFeed(pps.chrony) if pps is not None and pps.chrony else None
    if rmc is None:
        return UtcKeeper(None, None, chrony=chrony)
    return UtcKeeper(RMC_SOURCES[rmc.source](rmc, _serial_port), port, rmc.rate_hz, chrony)


def _serial_port(path: str, baud: int) -> StreamLink:
    """The port of a GNSS receiver."""
    row = LINKS["uart"]
    return row.make(msgspec.convert({"port": path, "baud": baud}, row.settings))
