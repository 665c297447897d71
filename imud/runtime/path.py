"""The hot path of one device: bytes or frames → codec → clock → batch → publishers. Everything else happens around it.

Per read: one `feed`, one clock call and one record per sample, one batch; counters are plain integers.
Synchronization: the event loop's thread only.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from imud.clock import SampleClock
from imud.clock.steering import AidingSources
from imud.config import DeviceConfig
from imud.contracts.can import CanCodec
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, Message, ReplyFrame, StreamCodec, TextLine
from imud.contracts.driver import Driver
from imud.contracts.publisher import AS_SENT, Batch
from imud.formats.can import CanFrame
from imud.frames.published import PublishedFrame
from imud.host_clock import UNSTEERED, HostClock, SteadyTime
from imud.ledger import Ledger
from imud.runtime.meters import LatencyMeter, LossMeter
from imud.sample import Measurement, Sample
from imud.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class PathContext:
    """Parts that every sample path of one device needs in addition to its codec and clock."""

    device: str
    """Name in the configuration."""
    device_id: int
    ledger: Ledger
    publish: Callable[[Batch], None]
    on_message: Callable[[Message, int], None]
    """Called with a text line or reply frame, and CLOCK_MONOTONIC of its arrival."""
    on_bad_frame: Callable[[BadFrame], None]
    overruns: Callable[[], int]
    """Overruns that the kernel counted since the link was opened."""
    host: HostClock
    frame: PublishedFrame = AS_SENT
    """Axes and angles of what is published."""


class SamplePath(ABC):
    """Path from the data of one device to published samples; subclasses receive the data."""

    def __init__(self, clock: SampleClock, context: PathContext) -> None:
        self.clock = clock
        self.latency = LatencyMeter()
        self.loss = LossMeter(context.ledger)
        self.newest: Sample | None = None
        """As the device sent it, in the sensor's own axes."""
        self.frame = context.frame
        self.begun_ns = 0
        """CLOCK_MONOTONIC when the link was last given to this path."""
        self.last_data_ns = 0
        self.last_sample_ns = 0
        self._begun_samples = context.ledger.samples
        self._status_mask = self._status_seen = 0
        self._device = context.device
        self._device_id = context.device_id
        self._ledger = context.ledger
        self._rotation = context.frame.rotation
        self._publish = context.publish
        self._on_message = context.on_message
        self._on_bad_frame = context.on_bad_frame
        self._overruns = context.overruns
        self._now_ns = context.host.now_ns
        self._utc_offset_ns = context.host.utc_offset_ns

    def watch_status(self, mask: int) -> None:
        """Gather these bits of the status of all samples from now on."""
        self._status_mask, self._status_seen = mask, 0

    def take_status(self) -> int:
        """Return the gathered bits that any sample had since the last call."""
        seen, self._status_seen = self._status_seen, 0
        return seen

    @property
    def fresh(self) -> bool:
        """Whether a sample came since the link was last given to this path."""
        return self._ledger.samples > self._begun_samples

    @property
    def period_ns(self) -> int:
        """Expected time between two samples, ns; 0 while it is not known."""
        expected_hz = self.clock.expected_rate_hz
        return int(NS_PER_S / expected_hz) if expected_hz else 0

    def begin(self, now_ns: int) -> None:
        """Start on a link whose device is found."""
        self.begun_ns = self.last_data_ns = now_ns
        self._begun_samples = self._ledger.samples

    @abstractmethod
    def flush(self, now_ns: int) -> None:
        """Process what waits for a rest that did not come: the link is idle."""

    @abstractmethod
    def reset(self) -> None:
        """Discard what is incomplete: the link ended."""

    def publish_events(self, events: Sequence[CodecEvent], t_rx_ns: int) -> None:
        """Publish the samples in what a codec made of something that came at `t_rx_ns`, as one batch."""
        samples: list[Sample] = []
        self._sort(events, t_rx_ns, self._utc_offset_ns(), samples)
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
        """Pass each event to where it belongs; append samples. `t_begin_ns` is that of `SampleClock.sample`."""
        clock, loss = self.clock, self.loss
        at, count = 0, len(events)
        while at < count:
            if t_begin_ns is None and count - at > 1:
                after = clock.add_run(samples, events, at, t_rx_ns, utc_offset_ns)
                if after > at:
                    loss.bad_frames, at = 0, after
                    continue
            event = events[at]
            at += 1
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
                self._on_bad_frame(event)

    def _finish(self, samples: list[Sample], t_rx_ns: int) -> None:
        self._ledger.samples += len(samples)
        self.newest = samples[-1]
        self.last_sample_ns = t_rx_ns
        if self._rotation is not None:
            samples = self._rotation.samples(samples)
        self._publish(Batch(self._device, self._device_id, samples, self.frame))
        if mask := self._status_mask:
            for sample in samples:
                if sample.status is not None:
                    self._status_seen |= sample.status & mask
        self.latency.add(self._now_ns(), samples)


class SampleListener(Protocol):
    """Listener to measurements as a codec makes them, before they are samples: a command waits for one."""

    wants_samples: bool
    """Whether it listens now."""

    def on_sample(self, sample: Measurement) -> None:
        """Process one measurement."""
        ...


class StreamPath(SamplePath):
    """The path of a device that sends bytes."""

    def __init__(
        self,
        codec: StreamCodec,
        clock: SampleClock,
        context: PathContext,
        drain_edges: Callable[[], None] | None = None,
        listener: SampleListener | None = None,
    ) -> None:
        """`drain_edges` gives the clock the edges of lines that precede the bytes; called before they are decoded."""
        super().__init__(clock, context)
        self.codec = codec
        self._listener = listener
        self._drain_edges = drain_edges
        self.gathered: list[Sample] = []
        """Samples that are not published yet, oldest first."""

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes as read, with CLOCK_MONOTONIC right after the read."""
        self.last_data_ns = t_rx_ns
        if self._drain_edges is not None:
            self._drain_edges()
        events = self.codec.feed(data)
        if events:
            self.publish_events(events, t_rx_ns)
            if self._listener is not None and self._listener.wants_samples:
                self._pass_on(events, self._listener)

    def gather(self, data: bytes, t_rx_ns: int, waited_ns: int = 0) -> bool:
        """Process bytes, and keep their samples for `publish_gathered`; returns whether there are any.

        The bytes waited in the kernel for up to `waited_ns`; 0: they were read as they came.
        """
        self.last_data_ns = t_rx_ns
        events = self.codec.feed(data)
        if not events:
            return False
        before = len(self.gathered)
        self.clock.waited_ns = waited_ns
        self._sort(events, t_rx_ns, self._utc_offset_ns(), self.gathered)
        self.clock.waited_ns = 0
        return len(self.gathered) > before

    def publish_gathered(self) -> None:
        """Publish the samples that were kept, as one batch."""
        samples, self.gathered = self.gathered, []
        if samples:
            self._finish(samples, samples[-1].t_rx_ns)

    def _pass_on(self, events: Sequence[CodecEvent], listener: SampleListener) -> None:
        for event in events:
            if type(event) is Measurement:
                listener.on_sample(event)

    def flush(self, now_ns: int) -> None:
        """Process whole frames that wait inside a longer one that never came."""
        if self._ledger.bytes_pending:
            events = self.codec.flush()
            if events:
                self.publish_events(events, now_ns)

    def reset(self) -> None:
        """Count bytes that wait for the rest of their frame as skipped."""
        self.codec.reset()


class CanPath(SamplePath):
    """The path of a device on a CAN bus."""

    def __init__(self, codec: CanCodec, clock: SampleClock, context: PathContext) -> None:
        super().__init__(clock, context)
        self.codec = codec
        self._frame_ns = 0
        self._first_ns = 0

    def set_frame_time(self, frame_ns: int) -> None:
        """Set the shortest time of a frame on the wire, ns; 0 where the bit rate is not known."""
        self._frame_ns = frame_ns

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Process frames as read in one go, each with its own time of arrival.

        What a device measured at one instant begins to arrive with the first frame that waits for others; frames of
        other devices come between them.
        """
        feed, ledger, samples = self.codec.feed_frame, self._ledger, list[Sample]()
        utc_offset_ns = self._utc_offset_ns()
        t_rx_ns = self.last_data_ns
        for can_id, extended, data, t_rx_ns, after_loss in frames:
            if after_loss:
                self.codec.reset()
            pending = ledger.frames_pending
            if not pending:
                self._first_ns = t_rx_ns
            events = feed(can_id, extended, data, t_rx_ns)
            if events:
                self._sort(events, t_rx_ns, utc_offset_ns, samples, self._first_ns - self._frame_ns)
            if pending and ledger.frames_pending == 1:  # what waited is over, and this frame waits for others now
                self._first_ns = t_rx_ns
        self.last_data_ns = t_rx_ns
        if samples:
            self._finish(samples, t_rx_ns)

    def flush(self, now_ns: int) -> None:
        """Process what need not wait for frames that did not come."""
        events = self.codec.flush()
        if events:
            self.publish_events(events, now_ns)

    def reset(self) -> None:
        """Drop frames that wait for the rest of their sample."""
        self.codec.reset()


class DeviceClock(SampleClock):
    """A clock whose methods can be replaced on the object itself: a recording hears its calls (`recording.tap`)."""

    heard_aiding: Callable[[AidingSources], AidingSources] | None = None
    """Returns what stands for the aiding sources while a recording hears their calls; None while none does."""

    @property
    def aiding(self) -> AidingSources:
        """Where edges and triggers are added."""
        made = super().aiding
        return made if self.heard_aiding is None else self.heard_aiding(made)


def make_clock(
    config: DeviceConfig,
    driver: Driver,
    before: SampleClock | None,
    *,
    host: SteadyTime = UNSTEERED,
    byte_ns: int = 0,
    hold_ns: int = 0,
    on_unknown_gap: Callable[[], None] = lambda: None,
) -> SampleClock:
    """Return the clock of a device that `driver` decodes; it continues the numbers and stamps of the one before."""
    lines = config.lines
    clock = DeviceClock(
        config.name,
        tick_ns=driver.tick_ns,
        tick_modulus=driver.tick_modulus,
        byte_ns=byte_ns,
        hold_ns=hold_ns,
        stamp_modulus=driver.stamp_modulus,
        bits=driver.time_bits,
        sout=lines.sout.timing if lines is not None and lines.sout is not None else None,
        sin=lines.sin.timing if lines is not None and lines.sin is not None else None,
        host=host,
        on_unknown_gap=on_unknown_gap,
    )
    if before is not None:
        clock.continue_from(before)
    return clock
