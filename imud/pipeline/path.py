"""The hot path of one device: bytes → codec → clock → batch → publishers. Everything else happens around it.

Per read: one `feed`, one clock call and one record per sample, one batch; counters are plain integers.
Synchronization: the event loop's thread only.
"""

from collections.abc import Callable, Sequence
from time import monotonic_ns, time_ns

from imud.clock import SampleClock
from imud.kit.batch import Batch
from imud.kit.codec import BadFrame, BadReason, CodecEvent, StreamCodec, TextLine
from imud.ledger import Ledger
from imud.pipeline.meters import LatencyMeter, LossMeter
from imud.sample import Measurement, Sample


class SamplePath:
    """Turns what one link delivers into published samples."""

    def __init__(
        self,
        name: str,
        device_id: int,
        codec: StreamCodec,
        clock: SampleClock,
        ledger: Ledger,
        publish: Callable[[Batch], None],
        on_text: Callable[[str, int], None],
        on_bad: Callable[[BadFrame], None],
        overruns: Callable[[], int],
    ) -> None:
        self.codec = codec
        self.clock = clock
        self.latency = LatencyMeter()
        self.newest: Sample | None = None
        self.begun_ns = 0
        """CLOCK_MONOTONIC when the link was last given to this path."""
        self.last_data_ns = 0
        self.last_sample_ns = 0
        self._begun_samples = ledger.samples
        self._name = name
        self._device_id = device_id
        self._ledger = ledger
        self._publish = publish
        self._on_text = on_text
        self._on_bad = on_bad
        self._overruns = overruns
        self.loss = LossMeter(ledger)

    @property
    def fresh(self) -> bool:
        """Whether a sample came since the link was last given to this path."""
        return self._ledger.samples > self._begun_samples

    def begin(self, now_ns: int) -> None:
        """The link is open and found: what comes from now on is fresh."""
        self.begun_ns = self.last_data_ns = now_ns
        self._begun_samples = self._ledger.samples

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Take bytes as read, with CLOCK_MONOTONIC right after the read."""
        self.last_data_ns = t_rx_ns
        events = self.codec.feed(data)
        if events:
            self._handle(events, t_rx_ns)

    def flush(self, now_ns: int) -> None:
        """The line was idle for a while: take whole frames that wait inside a longer one that never came."""
        if self._ledger.bytes_pending:
            events = self.codec.flush()
            if events:
                self._handle(events, now_ns)

    def _handle(self, events: Sequence[CodecEvent], t_rx_ns: int) -> None:
        clock, loss = self.clock, self.loss
        utc_offset_ns = time_ns() - monotonic_ns()
        samples: list[Sample] = []
        for event in events:
            if type(event) is Measurement:
                samples.append(clock.sample(event, t_rx_ns, utc_offset_ns))
                if clock.missed:
                    loss.missed(clock.missed, self._overruns())
                loss.bad_frames = 0
            elif type(event) is TextLine:
                self._on_text(event.text, t_rx_ns)
            elif type(event) is BadFrame:
                if event.reason is not BadReason.NOT_FINITE:  # that one comes with its sample
                    loss.bad_frames += 1
                self._on_bad(event)
        if samples:
            self._finish(samples, t_rx_ns)

    def _finish(self, samples: list[Sample], t_rx_ns: int) -> None:
        self._ledger.samples += len(samples)
        self.newest = samples[-1]
        self.last_sample_ns = t_rx_ns
        self._publish(Batch(self._name, self._device_id, samples))
        now_ns = monotonic_ns()
        add = self.latency.add
        for sample in samples:
            add(now_ns - sample.t_ns)
