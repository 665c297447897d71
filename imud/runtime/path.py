"""The hot path of one device: bytes or frames → codec → clock → batch → publishers. Everything else happens around it.

Per read: one `feed`, one clock call and one record per sample, one batch; counters are plain integers.
Synchronization: the event loop's thread only.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from time import monotonic_ns, time_ns
from typing import Any

from imud.clock import SampleClock
from imud.contracts.can import CanCodec
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, Message, ReplyFrame, StreamCodec, TextLine
from imud.contracts.publisher import Batch
from imud.formats.can import CanFrame
from imud.ledger import Ledger
from imud.runtime.meters import LatencyMeter, LossMeter
from imud.sample import Measurement, Sample


class SamplePath(ABC):
    """Turns what one device says into published samples; how it says it is its subclasses' part."""

    def __init__(
        self,
        name: str,
        device_id: int,
        clock: SampleClock,
        ledger: Ledger,
        publish: Callable[[Batch], None],
        on_message: Callable[[Message, int], None],
        on_bad: Callable[[BadFrame], None],
        overruns: Callable[[], int],
    ) -> None:
        self.clock = clock
        self.drain: Callable[[], None] | None = None
        """Called before what was read is fed: edges of lines come to the clock before the frames that follow them."""
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
        self._on_message = on_message
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

    @abstractmethod
    def flush(self, now_ns: int) -> None:
        """Nothing came for a while: take what waits for something that will not come."""

    @abstractmethod
    def reset(self) -> None:
        """The link ended: what is pending stays incomplete."""

    def take(self, events: Sequence[CodecEvent], t_rx_ns: int) -> None:
        """Take what a codec made of something that came at `t_rx_ns`; publish the samples in it as one batch."""
        samples: list[Sample] = []
        self._sort(events, t_rx_ns, time_ns() - monotonic_ns(), samples)
        if samples:
            self._finish(samples, t_rx_ns)

    def _sort(
        self,
        events: Sequence[CodecEvent],
        t_rx_ns: int,
        utc_offset_ns: int,
        samples: list[Sample],
        t_begin_ns: int | None = None,
    ) -> None:
        """Each event where it belongs; samples are appended. `t_begin_ns` as `SampleClock.sample` takes it."""
        clock, loss = self.clock, self.loss
        for event in events:
            if type(event) is Measurement:
                samples.append(clock.sample(event, t_rx_ns, utc_offset_ns, t_begin_ns))
                if clock.missed:
                    loss.missed(clock.missed, self._overruns())
                loss.bad_frames = 0
            elif type(event) is TextLine:
                self._on_message(event.text, t_rx_ns)
            elif type(event) is ReplyFrame:
                self._on_message(event, t_rx_ns)
            elif type(event) is BadFrame:
                if event.reason is not BadReason.NOT_FINITE:  # that one comes with its sample
                    loss.bad_frames += 1
                self._on_bad(event)

    def _finish(self, samples: list[Sample], t_rx_ns: int) -> None:
        self._ledger.samples += len(samples)
        self.newest = samples[-1]
        self.last_sample_ns = t_rx_ns
        self._publish(Batch(self._name, self._device_id, samples))
        now_ns = monotonic_ns()
        add = self.latency.add
        for sample in samples:
            add(now_ns - sample.t_ns)


class StreamPath(SamplePath):
    """The path of a device that sends bytes."""

    def __init__(self, codec: StreamCodec, *parts: Any) -> None:
        """`parts` are those of `SamplePath`."""
        super().__init__(*parts)
        self.codec = codec

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Take bytes as read, with CLOCK_MONOTONIC right after the read."""
        self.last_data_ns = t_rx_ns
        if self.drain is not None:
            self.drain()
        events = self.codec.feed(data)
        if events:
            self.take(events, t_rx_ns)

    def flush(self, now_ns: int) -> None:
        """Take whole frames that wait inside a longer one that never came."""
        if self._ledger.bytes_pending:
            events = self.codec.flush()
            if events:
                self.take(events, now_ns)

    def reset(self) -> None:
        """Bytes that wait for the rest of their frame become skipped."""
        self.codec.reset()


class CanPath(SamplePath):
    """The path of a device on a CAN bus."""

    def __init__(self, codec: CanCodec, *parts: Any) -> None:
        """`parts` are those of `SamplePath`."""
        super().__init__(*parts)
        self.codec = codec
        self.frame_ns = 0
        """Shortest time of a frame on the wire, ns."""
        self._first_ns = 0

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Take frames as read in one go, each with its own time of arrival.

        What a device measured at one instant begins to arrive with the first frame that waits for others; frames of
        other devices come between them.
        """
        feed, ledger, samples = self.codec.feed_frame, self._ledger, list[Sample]()
        utc_offset_ns = time_ns() - monotonic_ns()
        t_rx_ns = self.last_data_ns
        for can_id, extended, data, t_rx_ns, after_loss in frames:
            if after_loss:
                self.codec.reset()
            pending = ledger.frames_pending
            if not pending:
                self._first_ns = t_rx_ns
            events = feed(can_id, extended, data, t_rx_ns)
            if events:
                self._sort(events, t_rx_ns, utc_offset_ns, samples, self._first_ns - self.frame_ns)
            if pending and ledger.frames_pending == 1:  # what waited is over, and this frame waits for others now
                self._first_ns = t_rx_ns
        self.last_data_ns = t_rx_ns
        if samples:
            self._finish(samples, t_rx_ns)

    def flush(self, now_ns: int) -> None:
        """Take what need not wait for frames that did not come."""
        events = self.codec.flush()
        if events:
            self.take(events, now_ns)

    def reset(self) -> None:
        """Frames that wait for the rest of their sample are given up."""
        self.codec.reset()
