"""The hot path of one polled device: readings → codec → clock → batch → publishers.

The time of a sample is when its read began. What the device measured it has measured before: at most the time since
the read before (had it been there then, this one would have repeated it), or one update of its registers, if known.
With a data-ready line it is the edge that the read belongs to.

A sample is lost where a read failed, its frame was damaged, or none was made (`schedule`). While a device is
looked for it is not read, and nothing says what it measured meanwhile: the gap is one of unknown size.
Synchronization: the event loop's thread only.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Final

from imud.clock import SampleClock
from imud.contracts.codec import BadFrame, BadReason
from imud.contracts.polling import PolledCodec, Reading, Vanished
from imud.errors import Trouble
from imud.runtime.path import PathContext, SamplePath
from imud.sample import Measurement, Sample
from imud.signals.ready_edges import ReadyEdges, Stamp

FAULTS_MAX: Final = 3
"""Number of damaged or failed reads in a row after which the device is identified again."""
GAP_PERIODS: Final = 1.5
"""With less time since the read before, none is missing."""
SIGMA_OF_AGE: Final = 1 / sqrt(3)
"""Root mean square of an age that is anything from 0 to its bound."""


@dataclass(frozen=True, slots=True)
class PollTiming:
    """Timing of reads, as far as known."""

    period_ns: int
    """Time between two reads."""
    update_ns: int
    """Longest time between two updates of the device's registers; 0 where it is not known."""
    edges: ReadyEdges | None
    """Edges of the data-ready line; None without one."""


class PolledPath(SamplePath):
    """The path of a device that is polled."""

    def __init__(self, codec: PolledCodec, timing: PollTiming, clock: SampleClock, context: PathContext) -> None:
        super().__init__(clock, context)
        self.codec = codec
        self.failed = 0
        """Transfers that failed."""
        self._period_ns = timing.period_ns
        self._update_ns = timing.update_ns
        self._edges = timing.edges
        self._before_ns = 0
        self._faults = 0
        self._read_ns = 0
        """Begin of the newest read that gave a sample, a stale one or a lost one; 0 before the first."""
        self._is_back = False
        """Whether the device was identified and not read since."""
        self._gap_unknown = context.ledger.samples > 0
        """Whether the device was not read for a while since its newest sample."""

    @property
    def period_ns(self) -> int:
        """Time between two reads, ns."""
        return self._period_ns

    def begin(self, now_ns: int) -> None:
        """Start: the device was identified and set up."""
        super().begin(now_ns)
        self.reset()
        self._is_back = True

    def flush(self, now_ns: int) -> None:
        """No-op: what is read comes whole or not at all."""

    def reset(self) -> None:
        """Forget earlier data: the next frame is not compared with it."""
        self.codec.reset()
        self._before_ns = 0
        self._faults = 0

    def on_readings(self, readings: Sequence[Reading]) -> str:
        """Process readings, oldest first; return why the device must be identified again, or an empty string."""
        utc_offset_ns = self._utc_offset_ns()
        samples: list[Sample] = []
        gone = ""
        edges = self._edges
        for reading in readings:
            if gone:
                self.skip(reading)
                continue
            stamp = None
            if reading.poll == 0:
                stamp = edges.match(reading.start_ns, reading.end_ns) if edges is not None else None
                self._measure_gap(reading.start_ns)
            if reading.error is not None:
                gone = self._failed(reading)
            else:
                gone = self._decode(reading, stamp, utc_offset_ns, samples)
        if samples:
            self._finish(samples, samples[-1].t_rx_ns)
        return gone

    def skip(self, reading: Reading) -> None:
        """Count bytes of a device that is not identified as skipped."""
        self._ledger.bytes_in += len(reading.data)
        self._ledger.bytes_skipped += len(reading.data)

    def _decode(self, reading: Reading, stamp: Stamp | None, utc_offset_ns: int, samples: list[Sample]) -> str:
        gone, vanished = "", False
        for event in self.codec.decode(reading.poll, reading.data):
            if type(event) is Measurement:
                self._faults = 0
                if self._gap_unknown:
                    self._gap_unknown = False
                    self._ledger.add_unknown_gap()
                t_ns, error_ns, edge_seq = stamp or (reading.start_ns, self._error_ns(reading), None)
                sample = self.clock.sample_polled(event, t_ns, error_ns, reading.end_ns, utc_offset_ns, edge_seq)
                samples.append(sample)
            elif type(event) is Vanished:
                gone, vanished = event.why, True
            elif type(event) is BadFrame:
                self._on_bad_frame(event)
                if event.reason is not BadReason.NOT_FINITE:  # that one comes with its sample
                    self._ledger.lost_crc += 1
                    gone = gone or self._fault(f"{FAULTS_MAX} damaged frames in a row, the last by {event.reason}")
        if reading.poll == 0:
            self._before_ns = reading.start_ns
            if not vanished:
                self._read_ns = reading.start_ns
        return gone

    def _measure_gap(self, start_ns: int) -> None:
        """Look at a read of a sample: where the device was looked for right before, it ends a gap of unknown size."""
        if self._is_back:
            self._is_back = False
            if self._read_ns and start_ns - self._read_ns >= GAP_PERIODS * self._period_ns:
                self._gap_unknown = True

    def _failed(self, reading: Reading) -> str:
        error = reading.error
        assert error is not None
        self.failed += 1
        self._before_ns = 0
        if reading.poll == 0:
            self._ledger.lost_gap_device += 1
            self._read_ns = reading.start_ns
        for event in self.codec.on_silence(reading.poll):
            if type(event) is Vanished:
                return event.why
        if error.trouble is Trouble.DISTURBED:
            return self._fault(str(error))
        return str(error)

    def _fault(self, why: str) -> str:
        self._faults += 1
        return why if self._faults >= FAULTS_MAX else ""

    def _error_ns(self, reading: Reading) -> int:
        """One-sigma error of `start_ns` as the time of measurement."""
        age_ns = reading.start_ns - self._before_ns if self._before_ns else self._period_ns
        if self._update_ns and self._update_ns < age_ns:
            age_ns = self._update_ns
        return int(SIGMA_OF_AGE * (age_ns + reading.end_ns - reading.start_ns)) + 1
