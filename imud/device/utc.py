"""UTC of one device: RMC sentences for its port, and the UTC reference of the host for its clock.

source ──RMC──▶ RmcFeed ──▶ port of the device           (UTC becomes the device time)
          └───▶ PpsReference ◀── pulses of the line ──▶ chronyd
                     └─ or the system clock, if its error is smaller ──▶ clock
"""

from collections.abc import Callable, Sequence

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.lines import Edge, UtcReference
from imud.contracts.link import DeviceLink, StreamLink
from imud.contracts.status import UtcStatus
from imud.host.clock import HostClock
from imud.links import LINKS
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock
from imud.utc import RMC_SOURCES
from imud.utc.pps import ChronyFeed, PpsReference
from imud.utc.receivers import RmcSource, SourceContext
from imud.utc.rmc_feed import RmcFeed
from imud.utc.system_clock import kernel_clock, system_reference

ASK_NS = NS_PER_S  # interval between two updates of the reference, ns


class UtcFeed:
    """Feed of UTC to the port and the clock of a device. Synchronization: the loop's thread only."""

    def __init__(
        self,
        source: RmcSource | None,
        feed: RmcFeed | None,
        system: Callable[[], UtcReference | None],
        host: HostClock,
        chrony: ChronyFeed | None = None,
    ) -> None:
        """`source` and `feed` are None if the device receives no sentences. `system` reads the system clock."""
        self._source = source
        self._feed = feed
        self._chrony = chrony
        self._pps = PpsReference()
        self._system = system
        self._steady = host.steady  # pulses drift against a clock that NTP slews
        self._reference: UtcReference | None = None
        self._clock: SampleClock | None = None
        self._due_ns = 0
        self._begun = self._closed = False

    def start(self, clock: SampleClock) -> None:
        """Deliver the reference to the clock of the device."""
        self._clock = clock
        clock.set_utc_reference(self._reference)
        self._due_ns = 0

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Start the source at the first call. Update the reference if this is due. Called at 10 Hz."""
        if self._closed:
            return
        if not self._begun:
            self._begun = True
            if self._source is not None:
                self._source.start(self._on_sentence)
        if now_ns >= self._due_ns:
            self._update_reference(now_ns)

    def stop(self) -> None:
        self._clock = None

    def close(self) -> None:
        self._closed = True
        self.stop()
        if self._source is not None:
            self._source.close()
        if self._chrony is not None:
            self._chrony.close()

    def on_pulses(self, edges: Sequence[Edge]) -> None:
        """Add edges of the pulse per second at the SIN input of the device."""
        for edge in edges:
            if edge.rising:
                accepted = self._pps.on_pulse(self._steady.steady_ns(edge.t_ns))
                if accepted and self._chrony is not None and (unix_s := self._pps.second_s) is not None:
                    self._chrony.send_pulse(edge.t_ns, unix_s)
                if self._feed is not None:
                    self._feed.on_pulse(edge.t_ns)

    def status(self) -> UtcStatus:
        source, feed, chrony = self._source, self._feed, self._chrony
        return UtcStatus(
            source=source.title if source is not None else "",
            problem=(source.problem if source is not None else "") or (chrony.problem if chrony is not None else ""),
            sentences=source.sentences if source is not None else 0,
            sent=feed.sent if feed is not None else 0,
            refused=dict(feed.refused) if feed is not None else {},
            pulses=self._pps.pulses,
            pulses_ignored=self._pps.pulses_ignored,
            chrony_sent=chrony.sent if chrony is not None else 0,
            chrony_refused=chrony.refused if chrony is not None else 0,
        )

    def _update_reference(self, now_ns: int) -> None:
        self._due_ns = now_ns + ASK_NS
        by_system, by_pulses = self._system(), self._pps.reference(self._steady.steady_ns(now_ns))
        if by_pulses is not None:
            by_pulses = UtcReference(by_pulses.offset_ns - self._steady.offset_ns, by_pulses.error_ns)
        if by_system is not None:
            # the clock of the device uses this reference in steady time until the next update
            steered_ns = round(abs(self._steady.rate) * ASK_NS)
            by_system = UtcReference(by_system.offset_ns, by_system.error_ns + steered_ns)
        self._reference = _better(by_pulses, by_system)
        if self._feed is not None:
            self._feed.reference = self._reference
        if self._clock is not None:
            self._clock.set_utc_reference(self._reference)

    def _on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        # the clock must know UTC before UTC becomes the device time: otherwise it assumes a jump of the device time
        self._pps.on_sentence(sentence, self._steady.steady_ns(t_rx_ns))
        if self._reference is None:
            self._update_reference(t_rx_ns)
        if self._feed is not None:
            self._feed.on_sentence(sentence, t_rx_ns)


def _better(one: UtcReference | None, other: UtcReference | None) -> UtcReference | None:
    """Return the reference with the smaller error; the first if the errors are equal."""
    if one is None or other is None:
        return one or other
    return one if one.error_ns <= other.error_ns else other


def make_utc_feed(config: DeviceConfig, port: DeviceLink, host: HostClock) -> UtcFeed | None:
    """Return the feed of a device; None if neither sentences nor a pulse per second are configured."""
    rmc, pps = config.rmc, config.lines.pps if config.lines is not None else None
    if rmc is None and pps is None:
        return None
    chrony = ChronyFeed(pps.chrony, host.utc_offset_ns) if pps is not None and pps.chrony else None

    def system() -> UtcReference | None:
        return system_reference(kernel_clock(), host.utc_offset_ns())

    if rmc is None:
        return UtcFeed(None, None, system, host, chrony)
    source = RMC_SOURCES[rmc.source](rmc, SourceContext(_serial_port, host.now_ns, host.utc_offset_ns))
    return UtcFeed(source, RmcFeed(port, host.now_ns, rmc.rate_hz), system, host, chrony)


def _serial_port(path: str, baud: int) -> StreamLink:
    """Return the port of a GNSS receiver."""
    row = LINKS["uart"]
    return row.make(msgspec.convert({"port": path, "baud": baud}, row.settings))
