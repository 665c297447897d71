"""UTC of one device: RMC sentences for its port, and the UTC reference of the host for its clock.

source ──RMC──▶ RmcFeed ──▶ port of the device           (UTC becomes the device time)
          └───▶ PpsReference ◀── pulses of the line ──▶ chronyd
                     └─ or the system clock, if its error is smaller ──▶ clock
"""

import logging
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Final

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.lines import Edge, UtcReference
from imud.contracts.link import DeviceLink, StreamLink
from imud.contracts.status import UtcStatus
from imud.formats.nmea0183 import Rmc, parse
from imud.host.clock import HostClock
from imud.links import LINKS
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock
from imud.utc import RMC_SOURCES
from imud.utc.chrony import ChronyFeed
from imud.utc.pps import PpsReference
from imud.utc.receivers import RmcSource, SourceContext
from imud.utc.rmc_feed import Refusal, RmcFeed
from imud.utc.system_clock import kernel_clock, system_reference
from imud.utc.time_progress import CONFIRM_NS, TimeProgress

log = logging.getLogger(__name__)

ASK_NS = NS_PER_S  # interval between two updates of the reference, ns
# 2026-11-01. A receiver after a GPS week rollover is 1024 weeks early: its dates precede the release of imud.
RELEASE_NS: Final = 1_793_491_200 * NS_PER_S
SENTENCE_LATE_NS: Final = 2 * NS_PER_S  # maximum delay of a sentence that does not contradict the system clock, ns
PULSE_OFF_NS: Final = NS_PER_S // 2  # maximum difference of the start of a second from the system clock, ns
# Time without a usable sentence after which the status reports it, ns. Receivers send each second.
SILENT_NS: Final = 10 * NS_PER_S
# Minimum time between two log lines about sentences or pulses, ns. A hostile server can send good and bad sentences in
# turn.
LOG_NS: Final = 60 * NS_PER_S
SIGMAS: Final = 3


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
        self._doubts: dict[str, str] = {}  # why imud rejects sentences or pulses, one sentence each
        self._progress = TimeProgress()
        self._arrival_ns = 0  # CLOCK_MONOTONIC of the last sentence, valid or not; of the start before the first
        self._usable_ns = 0  # CLOCK_MONOTONIC of the last sentence with a valid and plausible time
        self._silence = ""  # problem of a source without usable sentences
        self._logged_ns: dict[str, int] = {}  # CLOCK_MONOTONIC of the last log line about sentences and pulses
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
            self._arrival_ns = self._usable_ns = now_ns
            if self._source is not None:
                self._source.start(self._on_sentence)
        self._silence = self._find_silence(now_ns)
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
                    offset_ns = unix_s * NS_PER_S - edge.t_ns
                    if not self._is_doubtful("pulses", edge.t_ns, offset_ns, PULSE_OFF_NS, self._system()):
                        self._chrony.send_pulse(edge.t_ns, unix_s)
                if self._feed is not None:
                    self._feed.on_pulse(edge.t_ns)

    @property
    def problem(self) -> str:
        """Present fault of the source or of the connection to chronyd; empty if there is no fault."""
        source, chrony = self._source, self._chrony
        faults = (source.problem if source is not None else "", *self._doubts.values(), self._silence)
        return next((one for one in faults if one), chrony.problem if chrony is not None else "")

    def status(self) -> UtcStatus:
        source, feed, chrony = self._source, self._feed, self._chrony
        return UtcStatus(
            source=source.title if source is not None else "",
            problem=self.problem,
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
        if by_pulses is None:
            self._doubts.pop("pulses", None)
        else:
            by_pulses = UtcReference(by_pulses.offset_ns - self._steady.offset_ns, by_pulses.error_ns)
            if self._is_doubtful("pulses", now_ns, by_pulses.offset_ns, PULSE_OFF_NS, by_system):
                by_pulses = None
        if by_system is not None:
            # the clock of the device uses this reference in steady time until the next update
            steered_ns = round(abs(self._steady.rate) * ASK_NS)
            by_system = UtcReference(by_system.offset_ns, by_system.error_ns + steered_ns)
        self._reference = _better(by_pulses, by_system)
        if self._feed is not None:
            self._feed.reference = self._reference
        if self._clock is not None:
            self._clock.set_utc_reference(self._reference)

    def _find_silence(self, now_ns: int) -> str:
        """Return the problem of a connected source without usable sentences; empty if its sentences are usable."""
        source = self._source
        if source is None or now_ns - self._usable_ns <= SILENT_NS:
            return ""
        duration = f"for more than {SILENT_NS // NS_PER_S} s"
        if now_ns - self._arrival_ns <= SILENT_NS:
            return (
                f"the time sentences (RMC) of {source.title} have no valid time {duration}: does the receiver have a "
                f"view of the sky?"
            )
        return f"{source.title} has sent no time sentence (RMC) {duration}: is the receiver connected and sending?"

    def _on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        self._arrival_ns = t_rx_ns
        rmc = parse(sentence)
        if isinstance(rmc, Rmc) and rmc.valid:
            refusal = self._find_refusal(rmc.utc_ns, t_rx_ns)
            if refusal is not None:
                if self._feed is not None:
                    self._feed.refused[str(refusal)] += 1
                return
            self._usable_ns = t_rx_ns
            # the clock must know UTC before UTC becomes the device time: otherwise it assumes a jump of the device time
            self._pps.on_sentence(sentence, self._steady.steady_ns(t_rx_ns))
            if self._reference is None:
                self._update_reference(t_rx_ns)
        if self._feed is not None:
            self._feed.on_sentence(sentence, t_rx_ns)

    def _find_refusal(self, utc_ns: int, t_rx_ns: int) -> Refusal | None:
        """Return the reason to reject the time of a sentence; None if it is plausible. Log a new problem."""
        system = self._system()
        offset_ns = utc_ns - t_rx_ns
        if self._is_doubtful("sentences", t_rx_ns, offset_ns, SENTENCE_LATE_NS, system, utc_ns):
            return Refusal.IMPLAUSIBLE
        late_ns = None if system is None else system.offset_ns - offset_ns
        if late_ns is not None and 0 <= late_ns < NS_PER_S:  # this second of the synchronized system clock
            self._progress.accept(offset_ns, t_rx_ns)
            return None
        if self._progress.is_steady(offset_ns, t_rx_ns):
            return None
        title = self._source.title if self._source is not None else "the receiver"
        doubt = (
            f"imud ignores the sentences of {title}: their time leaps against the clock of the host; imud accepts a "
            f"new time after {CONFIRM_NS // NS_PER_S} s without a leap"
        )
        self._set_doubt("sentences", t_rx_ns, doubt)
        return Refusal.LEAP

    def _is_doubtful(
        self, kind: str, t_ns: int, offset_ns: int, most_ns: int, system: UtcReference | None, utc_ns: int = RELEASE_NS
    ) -> bool:
        """Return whether UTC minus CLOCK_MONOTONIC of the receiver differs from the synchronized system clock by more
        than `most_ns`, or `utc_ns` precedes the release of imud. Log a new problem. `t_ns` is CLOCK_MONOTONIC."""
        title, doubt = self._source.title if self._source is not None else "the receiver", ""
        if utc_ns < RELEASE_NS:
            date = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC).date()
            doubt = (
                f"imud ignores the {kind} of {title}: its date {date} precedes the release of imud; does the receiver "
                f"have a GPS week rollover?"
            )
        elif system is not None and abs(offset_ns - system.offset_ns) > most_ns + SIGMAS * system.error_ns:
            off_s = (offset_ns - system.offset_ns) / NS_PER_S
            doubt = (
                f"imud ignores the {kind} of {title}: they differ by {off_s:+.1f} s from the synchronized system "
                f"clock; check the receiver, and `chronyc tracking`"
            )
        self._set_doubt(kind, t_ns, doubt)
        return bool(doubt)

    def _set_doubt(self, kind: str, t_ns: int, doubt: str) -> None:
        """Set the reason why imud rejects sentences or pulses. Log a new reason, at most one each LOG_NS."""
        is_new = bool(doubt) and not self._doubts.get(kind)
        logged_ns = self._logged_ns.get(kind)
        if is_new and (logged_ns is None or t_ns - logged_ns >= LOG_NS):
            log.warning("%s", doubt)
            self._logged_ns[kind] = t_ns
        self._doubts[kind] = doubt


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
    chrony = None
    if pps is not None and pps.chrony:
        chrony = ChronyFeed(pps.chrony, host.utc_offset_ns, pps.chrony_sample_bytes)

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
