"""Path of the samples of one device: bytes or frames → codec → clock → batch → publishers.

This is the code with the strictest limit on CPU time. For each read: one `feed` and one batch. For each sample: one
call of the clock and one record. Counters are plain integers. Synchronization: the event loop's thread only.
"""

import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from math import hypot, sqrt
from typing import Any, Final, NamedTuple, Protocol

from msgspec.structs import replace

from imud.attitude.conventions import AttitudeSource
from imud.attitude.published import PublishedAxes
from imud.contracts.codec import (
    BadFrame,
    BadReason,
    CanCodec,
    CodecEvent,
    KernelCodec,
    PolledCodec,
    Reading,
    StreamCodec,
    Vanished,
)
from imud.contracts.lines import Edge, ReadyOptions
from imud.contracts.observer import InputObserver
from imud.contracts.publisher import AS_SENT, Batch, SlotBatch
from imud.contracts.script import Message, ReplyFrame, TextLine
from imud.formats import kernel
from imud.formats.can import CanFrame
from imud.formats.slot import DEVICE_ID_MOST, SLOT_BYTES, decode_slots, encode_slot, slot_quality
from imud.host.clock import HostClock
from imud.model.errors import Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock, StartRun
from imud.sampling.gaps import GAP_PERIODS
from imud.sampling.meters import LatencyMeter, LossMeter
from imud.sampling.steering import STAMP_FLOOR_NS


@dataclass(frozen=True, slots=True)
class PathContext:
    """Parts of a device that its path needs in addition to codec and clock."""

    device: str  # name of the device in the configuration
    device_id: int
    ledger: Ledger
    publish: Callable[[Batch], None]
    # Called with a text line or reply frame, and with CLOCK_MONOTONIC of its arrival, ns.
    on_message: Callable[[Message, int], object]
    on_bad_frame: Callable[[BadFrame], None]
    overruns: Callable[[], int]  # returns the number of overruns that the kernel counted since the link was opened
    host: HostClock
    frame: PublishedAxes = AS_SENT  # axes and angles of the published samples
    attitude: AttitudeSource = AttitudeSource.DEVICE


class SamplePath(ABC):
    """Path from the data of one device to published samples. The subclasses receive the data."""

    # `HostAttitude`; None if imud does not compute it. In the class, because more than 30 attributes are slower.
    attitude: Any = None

    def __init__(self, clock: SampleClock, context: PathContext) -> None:
        self.clock = clock
        self.latency = LatencyMeter()
        self.loss = LossMeter(context.ledger)
        # Observer of the input; None if no recording runs. Set by `observe`.
        self.observer: InputObserver | None = None
        self._newest: Sample | bytes | None = None  # sample object, or slots of the kernel
        self.frame = context.frame
        self.begun_ns = 0  # CLOCK_MONOTONIC at the last `begin`, ns
        self.last_data_ns = 0
        self.last_sample_ns = 0
        self._begun_samples = context.ledger.samples
        self._status_mask = self._status_seen = 0
        self._device = context.device
        self._device_id = context.device_id
        self._ledger = context.ledger
        if context.attitude is AttitudeSource.HOST:
            self.attitude = import_module("imud.sampling.attitude").HostAttitude(context.frame.device)
        self._changes = self.frame.rotation is not None or self.attitude is not None
        self._publish = context.publish
        self._on_message = context.on_message
        self._on_bad_frame = context.on_bad_frame
        self._overruns = context.overruns
        self._now_ns = context.host.now_ns
        self._utc_offset_ns = context.host.utc_offset_ns
        self._frame_ns = 0  # shortest time of a CAN frame on the wire

    @property
    def unknown(self) -> Mapping[int, int]:
        """Number of valid frames of each unknown type. Empty for a polled device, which sends only requested frames."""
        return {}

    def set_frame(self, frame: PublishedAxes) -> None:
        """Publish the following samples in other axes."""
        if self.attitude is not None and frame.device != self.frame.device:
            self.attitude.set_axes(frame.device)
        self.frame = frame
        self._changes = self.frame.rotation is not None or self.attitude is not None

    def observe(self, observer: InputObserver | None) -> None:
        """Report each input of the path and of its clock to `observer`. None stops the reports."""
        self.observer = self.clock.observer = observer

    def watch_status(self, mask: int) -> None:
        """Collect these bits of the status of each sample. `take_status` returns them."""
        self._status_mask, self._status_seen = mask, 0

    def take_status(self) -> int:
        """Return the collected status bits of all samples since the previous call."""
        seen, self._status_seen = self._status_seen, 0
        return seen

    @property
    def newest(self) -> Sample | None:
        """Newest sample, in the axes of the sensor."""
        newest = self._newest
        if isinstance(newest, bytes):
            (newest,) = decode_slots(newest[-SLOT_BYTES:], self._device)
            self._newest = newest
        return newest

    @property
    def quality(self) -> tuple[Sync | None, int]:
        """Return `sync` and `t_err_ns` of the newest sample; (None, 0) without a sample. Cheaper than `newest`."""
        newest = self._newest
        if isinstance(newest, bytes):
            return slot_quality(newest[-SLOT_BYTES:])
        return (newest.sync, newest.t_err_ns) if newest is not None else (None, 0)

    @property
    def fresh(self) -> bool:
        """Return whether a sample arrived since the last `begin`."""
        return self._ledger.samples > self._begun_samples

    @property
    def period_ns(self) -> int:
        """Return the expected time between two samples, ns; 0 if unknown."""
        expected_hz = self.clock.expected_rate_hz
        return int(NS_PER_S / expected_hz) if expected_hz else 0

    def begin(self, now_ns: int) -> None:
        """Start on an open link after detection of the device."""
        self.begun_ns = self.last_data_ns = now_ns
        self._begun_samples = self._ledger.samples
        self._on_begin()
        if self.observer is not None:  # the counters include a search, which no recording contains
            self.observer.call("ledger", "set", self._ledger.snapshot())
            self.observer.call("path", "begin", now_ns)

    def link_opened(self) -> None:
        """Reset the kernel's counters: the link was opened."""
        self.loss.link_opened()
        if self.observer is not None:
            self.observer.call("loss", "link_opened")

    def flush(self, now_ns: int) -> None:
        """Process an incomplete frame or sample: the link is idle."""
        samples: list[Sample] = []
        try:
            self._flush(now_ns, samples)
        finally:
            self._close_gap()
            if self.observer is not None:
                self.observer.call("path", "flush", now_ns)
        if samples:
            self._finish(samples, self.last_data_ns)

    def reset(self) -> None:
        """Discard an incomplete frame, and publish an incomplete sample: the link was closed."""
        samples: list[Sample] = []
        try:
            self._reset(samples)
        finally:
            self._close_gap()
            if self.observer is not None:
                self.observer.call("path", "reset")
        if samples:
            self._finish(samples, self.last_data_ns)

    def _close_gap(self) -> None:
        """Count the samples of an open gap: no late sample follows it."""
        if self.clock.has_open_gap:
            self._add_loss(self.clock.take_open_gap())

    def _on_begin(self) -> None:  # noqa: B027 - most paths have nothing to prepare
        """Prepare for the data of a link after `begin`."""

    @abstractmethod
    def _flush(self, now_ns: int, samples: list[Sample]) -> None:
        """Append the samples that waited for more data to `samples`."""

    @abstractmethod
    def _reset(self, samples: list[Sample]) -> None:
        """Discard an incomplete frame. Append an incomplete sample to `samples`."""

    def _sort(
        self,
        events: Sequence[CodecEvent],
        t_rx_ns: int,
        utc_offset_ns: int,
        samples: list[Sample],
    ) -> None:
        """Append the samples of `events` to `samples`. Pass messages and bad frames to the device."""
        clock, loss = self.clock, self.loss
        at, count = 0, len(events)
        while at < count:
            if count - at > 1:
                after = clock.add_run(samples, events, at, t_rx_ns, utc_offset_ns)
                if after > at:
                    loss.bad_frames, at = 0, after
                    continue
            event = events[at]
            at += 1
            if type(event) is Measurement:
                begin_ns = None if event.t_first_ns is None else event.t_first_ns - self._frame_ns
                samples.append(clock.sample(event, t_rx_ns, utc_offset_ns, begin_ns))
                if clock.missed:
                    self._add_loss(clock.missed)
                if not clock.has_open_gap:
                    loss.bad_frames = 0
            elif type(event) is TextLine:
                self._on_message(event.text, t_rx_ns)
            elif type(event) is ReplyFrame:
                self._on_message(event, t_rx_ns)
            elif type(event) is BadFrame:
                if event.reason is not BadReason.NOT_FINITE:  # the sample of this frame follows
                    loss.bad_frames += 1
                self._on_bad_frame(event)

    def _add_loss(self, count: int) -> None:
        overruns = self._overruns()
        self.loss.missed(count, overruns)
        if self.observer is not None:
            self.observer.overruns(overruns)

    def _finish(self, samples: list[Sample], t_rx_ns: int) -> None:
        """Publish samples as one batch. Their data arrived at `t_rx_ns`, and the path has reported it to its observer:
        an output may read the host clocks, and this reading must follow the data in a recording."""
        self._ledger.samples += len(samples)
        self.last_sample_ns = t_rx_ns
        if self._changes:
            samples = self._changed(samples)
        else:
            self._newest = samples[-1]
        self._publish(Batch(self._device, self._device_id, samples, self.frame))
        if mask := self._status_mask:
            for sample in samples:
                if sample.status is not None:
                    self._status_seen |= sample.status & mask
        if len(samples) == 1:  # the usual case, without a list of the time stamps
            self.latency.add_one(self._now_ns() - samples[0].t_ns)
        else:
            self.latency.add(self._now_ns(), [sample.t_ns for sample in samples])

    def _changed(self, samples: list[Sample]) -> list[Sample]:
        """Return the samples with the attitude of the host, in the published axes. `newest` keeps the sensor axes."""
        if self.attitude is not None:
            samples = self.attitude.samples(samples)
        self._newest = samples[-1]
        rotation = self.frame.rotation
        return samples if rotation is None else rotation.samples(samples)

    def _finish_slots(self, packed: bytes, t_rx_ns: int) -> None:
        """Publish slots of the kernel as one batch, as `_finish`."""
        if self._changes:
            self._finish(decode_slots(packed, self._device), t_rx_ns)
            return
        self._ledger.samples += len(packed) // SLOT_BYTES
        self._newest = packed
        self.last_sample_ns = t_rx_ns
        publish, now_ns = self._publish, self._now_ns  # a call of a function in an attribute of `self` is slower
        publish(SlotBatch(self._device, self._device_id, packed, self.frame))
        if status := self.latency.add_slots(now_ns(), packed):
            self._status_seen |= status & self._status_mask


class SampleListener(Protocol):
    """Listener to the measurements of a codec, for a command that waits for one. `imud.device` implements it, and this
    part may not import `imud.device`."""

    wants_samples: bool  # whether the listener is active

    def on_sample(self, sample: Measurement) -> object:
        """Process one measurement."""
        ...


class StreamPath(SamplePath):
    """Path of a device that sends bytes."""

    def __init__(
        self,
        codec: StreamCodec,
        clock: SampleClock,
        context: PathContext,
        drain_edges: Callable[[], None] | None = None,
        listener: SampleListener | None = None,
    ) -> None:
        """`drain_edges` passes the buffered edges of the lines to the clock. The path calls it before decoding."""
        super().__init__(clock, context)
        self.codec = codec
        self._listener = listener
        self._drain_edges = drain_edges
        self._start_run: StartRun | None = None  # None if Python decodes all frames
        if isinstance(codec, KernelCodec) and context.device_id <= DEVICE_ID_MOST and kernel.present.module is not None:
            self._start_run = partial(kernel.present.module.start, context.device_id)
        # samples that `publish_gathered` will publish, oldest first: packed slots of the kernel, then sample objects.
        # Not two lists: an object with more than 30 attributes is slower.
        self.gathered: list[Sample | bytes] = []

    @property
    def unknown(self) -> Mapping[int, int]:
        return self.codec.unknown

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process the bytes of one read. `t_rx_ns` is CLOCK_MONOTONIC right after the read."""
        self.last_data_ns = t_rx_ns
        samples: list[Sample] = []
        packed, listener = b"", self._listener
        try:
            if self._drain_edges is not None:
                self._drain_edges()
            # a listener needs measurements, which only Python makes
            packed, events = self._stamp(data, t_rx_ns, samples, listener is None or not listener.wants_samples)
        finally:  # a recording must contain the data that caused an exception
            if self.observer is not None:
                self.observer.data(data, t_rx_ns, -1)
        if samples:
            self._finish([*decode_slots(packed, self._device), *samples] if packed else samples, t_rx_ns)
        elif packed:
            self._finish_slots(packed, t_rx_ns)
        if events and listener is not None and listener.wants_samples:
            for event in events:
                if type(event) is Measurement:
                    listener.on_sample(event)

    def gather(self, data: bytes, t_rx_ns: int, waited_ns: int = 0) -> bool:
        """Process bytes, and hold their samples until `publish_gathered`. Return whether the bytes contained samples.
        `waited_ns` is the maximum time of the bytes in the kernel's buffer; 0 if imud read them on arrival."""
        self.last_data_ns = t_rx_ns
        samples: list[Sample] = []
        held, clock = self.gathered, self.clock
        try:
            clock.waited_ns = waited_ns
            packed, _ = self._stamp(data, t_rx_ns, samples, not held or type(held[-1]) is bytes)
            if packed:
                held.append(packed)
            held += samples
            clock.waited_ns = 0
            return bool(packed or samples)
        finally:
            if self.observer is not None:
                self.observer.data(data, t_rx_ns, waited_ns)

    def publish_gathered(self) -> bool:
        """Publish the held samples as one batch. Return `held_by_fit` of them."""
        held, self.gathered = self.gathered, []
        if self.observer is not None:
            self.observer.call("path", "publish_gathered")
        if len(held) == 1 and type(held[0]) is bytes:  # the usual case
            self._finish_slots(held[0], self.clock.t_rx_ns())
            return True
        packed = b"".join([one for one in held if isinstance(one, bytes)])
        samples = [one for one in held if not isinstance(one, bytes)]
        if not samples:
            if packed:
                self._finish_slots(packed, self.clock.t_rx_ns())
            return bool(packed)
        self._finish([*decode_slots(packed, self._device), *samples], samples[-1].t_rx_ns)
        return samples[-1].sync is Sync.REGRESSION

    @property
    def held_by_fit(self) -> bool:
        """Whether the fit has time-stamped the newest held sample."""
        if not self.gathered:
            return False
        newest = self.gathered[-1]
        return isinstance(newest, bytes) or newest.sync is Sync.REGRESSION

    def _stamp(
        self, data: bytes, t_rx_ns: int, samples: list[Sample], use_kernel: bool
    ) -> tuple[bytes, Sequence[CodecEvent]]:
        """Process usual frames with the kernel, and a frame that changes the fit as `_sort`; then the rest as `_sort`.
        Return the slots of the frames before the rest, and the events of the rest."""
        codec: Any = self.codec  # a KernelCodec if `_start_run` is not None
        packed, start, utc_offset = b"", self._start_run, self._utc_offset_ns
        utc_offset_ns = utc_offset()  # in all cases: the result must not depend on the use of the kernel
        while start is not None and use_kernel and (frames := codec.usual_frames(data)):
            slots = self.clock.stamp_frames(
                start, codec.kernel_format, frames, codec.word_is_status, t_rx_ns, utc_offset_ns
            )
            if slots:
                self.loss.bad_frames = 0
                data, frames = codec.take(frames, len(slots) // SLOT_BYTES, data), b""
                packed = packed + slots if packed else slots
                if not data:
                    return packed, ()
            end = codec.kernel_format.size_bytes - max(len(frames) - len(data), 0)  # of the first frame
            if (packed and not slots) or not 0 < end <= len(data) or self.quality[0] is not Sync.REGRESSION:
                break
            slot = self._stamp_one(data[:end], len(data) - end, t_rx_ns, utc_offset_ns, samples)
            packed, data = packed + slot, data[end:]
            if not (slot and data):
                break
        events = codec.feed(data)
        if events:
            self._sort(events, t_rx_ns, utc_offset_ns, samples)
        return packed, events

    def _stamp_one(
        self, data: bytes, trailing_bytes: int, t_rx_ns: int, utc_offset_ns: int, samples: list[Sample]
    ) -> bytes:
        """Process a frame as `_sort`. Return its slot; if that is impossible, append its samples to `samples`."""
        events = [
            replace(event, trailing_bytes=event.trailing_bytes + trailing_bytes)
            if type(event) is Measurement else event for event in self.codec.feed(data)
        ]  # fmt: skip
        self._sort(events, t_rx_ns, utc_offset_ns, samples)
        if len(samples) == 1 and samples[0].sync is Sync.REGRESSION:
            with suppress(struct.error):  # a value that does not fit into a slot
                slot = encode_slot(samples[0], self._device_id)
                samples.clear()
                return slot
        return b""

    def _flush(self, now_ns: int, samples: list[Sample]) -> None:
        """Process complete frames inside an incomplete longer frame."""
        if self._ledger.bytes_pending:
            events = self.codec.flush()
            if events:
                self._sort(events, now_ns, self._utc_offset_ns(), samples)

    def _reset(self, _samples: list[Sample]) -> None:
        self.codec.reset()


FLUSH_PERIODS: Final = 2  # time without frames after which imud publishes an incomplete sample, in periods


class CanPath(SamplePath):
    """Path of a device on a CAN bus."""

    def __init__(self, codec: CanCodec, clock: SampleClock, context: PathContext) -> None:
        super().__init__(clock, context)
        self.codec = codec
        self._idle_ns = 0  # arrival of the newest frame at the previous `flush`, ns

    @property
    def unknown(self) -> Mapping[int, int]:
        return self.codec.unknown

    def set_frame_time(self, frame_ns: int) -> None:
        """Set the shortest time of a frame on the wire, ns; 0 if the bit rate is unknown."""
        self._frame_ns = frame_ns
        if self.observer is not None:
            self.observer.call("path", "set_frame_time", frame_ns)

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Process the CAN frames of one read. Each frame has its own arrival time."""
        # A sample can consist of several frames. The measurement was made before the arrival of its first frame. Frames
        # of other devices can arrive between the frames of a sample.
        samples: list[Sample] = []
        t_rx_ns = self.last_data_ns
        try:
            feed, utc_offset_ns = self.codec.feed_frame, None  # one read of the clocks for all samples
            for can_id, extended, data, t_rx_ns, after_loss in frames:
                if after_loss:
                    utc_offset_ns = utc_offset_ns or self._utc_offset_ns()
                    self._sort(self.codec.flush(), t_rx_ns, utc_offset_ns, samples)
                    self.codec.reset()
                events = feed(can_id, extended, data, t_rx_ns)
                if events:  # most frames only add values to a sample
                    utc_offset_ns = utc_offset_ns or self._utc_offset_ns()
                    self._sort(events, t_rx_ns, utc_offset_ns, samples)
            self.last_data_ns = t_rx_ns
        finally:
            if self.observer is not None:
                self.observer.frames(frames)
        if samples:
            self._finish(samples, t_rx_ns)

    def _flush(self, now_ns: int, samples: list[Sample]) -> None:
        """Append an incomplete sample if the next sample is overdue, and no frame arrived since the previous call."""
        # the arrival times of a replay at maximum speed are in the past
        was_idle, self._idle_ns = self._idle_ns == self.last_data_ns, self.last_data_ns
        if was_idle and now_ns - self.last_data_ns >= FLUSH_PERIODS * self.period_ns:
            self._take_incomplete(samples)

    def _add_loss(self, count: int) -> None:
        if not self.codec.counts_losses:
            super()._add_loss(count)

    def _reset(self, samples: list[Sample]) -> None:
        self._take_incomplete(samples)
        self.codec.reset()

    def _take_incomplete(self, samples: list[Sample]) -> None:
        if events := self.codec.flush():
            self._sort(events, self.last_data_ns, self._utc_offset_ns(), samples)


# Time without edges after which the line counts as stopped, ns. It is shorter than the time until a device is silent.
QUIET_NS: Final = 500 * NS_PER_MS
# Maximum interval of the reads of a slow device that the period follows, ns: three devices with replies of 3 s on a bus
READ_INTERVAL_MAX_NS: Final = 9 * NS_PER_S
KEPT: Final = 1024  # number of buffered edges without a read: the capacity of the kernel's event buffer
# Maximum time from an edge to a second read of its values, in intervals. After that, an edge may have been lost.
AGE_LIMIT: Final = 1.5
EITHER: Final = 1 / sqrt(2)  # root mean square of an error that is 0 or 1 with equal probability


class Stamp(NamedTuple):
    """Time stamp of the values of one read."""

    t_ns: int  # CLOCK_MONOTONIC, ns; at most the start of the read
    err_ns: int  # one-sigma error of `t_ns`, ns
    number: int  # number of the edge (`Edge.number`)


class ReadyEdges:
    """Edges of one data-ready line. Synchronization: the event loop's thread only."""

    def __init__(self, settings: ReadyOptions, period_ns: int) -> None:
        """`period_ns` is the expected interval of the edges, ns, until two edges have arrived."""
        self.missed = 0  # number of edges without a read: the next edge arrived first, or the kernel dropped the edge
        self.interval_ns = period_ns  # interval of the two newest edges, ns
        # Observer of the edges; None if no recording runs. Set by `PolledPath.observe`.
        self.observer: InputObserver | None = None
        self._offset_ns = round(settings.offset_us * NS_PER_US)
        self._error_ns = settings.bias_us * NS_PER_US / sqrt(3) + STAMP_FLOOR_NS
        self._edges: deque[Edge] = deque(maxlen=KEPT)
        self._newest: Edge | None = None
        self._read: int | None = None  # number of the edge of the newest read

    def on_edges(self, edges: Sequence[Edge]) -> None:
        """Add edges, oldest first. New values are ready after each edge."""
        for edge in edges:
            before, self._newest = self._newest, edge
            if before is not None:
                self.interval_ns = max(1, (edge.t_ns - before.t_ns) // max(1, edge.number - before.number))
            self._edges.append(edge)
        if self.observer is not None:
            self.observer.edges("data_ready", edges)

    def restart(self) -> None:
        """Start the reads, possibly of another device. Do not count earlier edges as missed."""
        self._read = None
        if self.observer is not None:
            self.observer.call("edges", "restart")

    def match(self, start_ns: int, end_ns: int) -> Stamp | None:
        """Return the time stamp of a read from `start_ns` to `end_ns`; None without an edge. Failed reads count too.
        Call this method in the order of the reads."""
        edges = self._edges
        while len(edges) > 1 and edges[1].t_ns <= start_ns:
            edges.popleft()
        if not edges or edges[0].t_ns > start_ns:
            return None
        t_ns, _, number = edges[0]
        limit_ns = AGE_LIMIT * self.interval_ns
        if self._read is not None and number != self._read:
            self.missed += max(0, number - self._read - 1)
            limit_ns = max(limit_ns, QUIET_NS)  # first read of this edge: the host may be late
        self._read = number
        if start_ns - t_ns > limit_ns:
            return None
        error_ns = self._error_ns
        if (
            len(edges) > 1 and edges[1].t_ns <= end_ns
        ):  # the registers changed during the read: the values are old or new
            newest_ns = max(edge.t_ns for edge in edges if edge.t_ns <= end_ns)
            error_ns = hypot(error_ns, EITHER * (newest_ns - t_ns))
        return Stamp(min(t_ns + self._offset_ns, start_ns), int(error_ns) + 1, number)


FAULTS_MAX: Final = 3  # number of consecutive damaged or failed reads after which imud identifies the device again
SIGMA_OF_AGE: Final = 1 / sqrt(3)  # root mean square of an age that is uniformly distributed from 0 to 1


@dataclass(frozen=True, slots=True)
class PollTiming:
    period_ns: int  # time between two reads, ns
    update_ns: int  # maximum time between two updates of the device's registers, ns; 0 if unknown
    edges: ReadyEdges | None  # edges of the data-ready line; None without a line


class PolledPath(SamplePath):
    """Path of a device that imud polls."""

    def __init__(self, codec: PolledCodec, timing: PollTiming, clock: SampleClock, context: PathContext) -> None:
        super().__init__(clock, context)
        self.codec = codec
        self.failed = 0  # number of failed transfers
        self.edges = timing.edges  # edges of the data-ready line; None without a line
        self._period_ns = timing.period_ns
        self._interval_ns = 0  # time between the two newest successful reads, or duration of the first read, ns
        self._update_ns = timing.update_ns
        self._before_ns = 0  # start of the previous successful read
        self._faults = 0  # consecutive damaged or disturbed reads
        self._read_ns = 0  # start of the newest read with a new, stale or lost sample, ns; 0 before the first read
        self._is_back = False  # whether imud has identified the device and has not read a sample yet
        # whether imud stopped its reads for a time after the newest sample
        self._gap_unknown = context.ledger.samples > 0

    @property
    def period_ns(self) -> int:
        """Expected time between two reads, ns. It follows the reads of slow devices, up to READ_INTERVAL_MAX_NS."""
        return max(self._period_ns, min(self._interval_ns, READ_INTERVAL_MAX_NS))

    def observe(self, observer: InputObserver | None) -> None:
        """Report each input of the path, of its clock and of its data-ready line to `observer`."""
        super().observe(observer)
        if self.edges is not None:
            self.edges.observer = observer

    def _on_begin(self) -> None:
        self._reset([])
        self._is_back = True

    def _flush(self, now_ns: int, samples: list[Sample]) -> None:
        """Do nothing. A reading is complete or failed."""

    def _reset(self, _samples: list[Sample]) -> None:
        """Discard the previous reading: the codec does not compare the next reading with it."""
        self.codec.reset()
        self._before_ns = 0
        self._faults = 0

    def on_readings(self, readings: Sequence[Reading]) -> str:
        """Process readings, oldest first. Return the reason to identify the device again; empty without a reason."""
        samples: list[Sample] = []
        gone = ""
        try:
            utc_offset_ns = self._utc_offset_ns()
            edges = self.edges
            for reading in readings:
                if gone:
                    self._skip(reading)
                    continue  # imud counts the bytes as skipped until it has identified the device again
                stamp = None
                if reading.poll == 0:
                    stamp = edges.match(reading.start_ns, reading.end_ns) if edges is not None else None
                    self._measure_gap(reading.start_ns)
                if reading.error is not None:
                    gone = self._failed(reading)
                else:
                    gone = self._decode(reading, stamp, utc_offset_ns, samples)
        finally:
            if self.observer is not None:
                self.observer.readings(readings)
        if samples:
            self._finish(samples, samples[-1].t_rx_ns)
        return gone

    def skip(self, reading: Reading) -> None:
        """Count the bytes of an unidentified device as skipped."""
        self._skip(reading)
        if self.observer is not None:
            self.observer.call("path", "skip", len(reading.data))

    def _skip(self, reading: Reading) -> None:
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
                if event.reason is not BadReason.NOT_FINITE:  # the sample of this frame follows
                    self._ledger.lost_crc += 1
                    gone = gone or self._fault(f"{FAULTS_MAX} damaged frames in a row, the last by {event.reason}")
        if reading.poll == 0:
            first_ns = self._before_ns or reading.start_ns
            self._interval_ns = max(reading.start_ns - first_ns, reading.end_ns - reading.start_ns)
            self._before_ns = reading.start_ns
            if not vanished:
                self._read_ns = reading.start_ns
        return gone

    def _measure_gap(self, start_ns: int) -> None:
        """Check the first read after an identification: a long time since the last read is a gap of unknown size."""
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
        """Return the one-sigma error of `reading.start_ns` as the time of the measurement, ns."""
        # the registers are up to one update old, or up to one read
        age_ns = reading.start_ns - self._before_ns if self._before_ns else self._period_ns
        if self._update_ns and self._update_ns < age_ns:
            age_ns = self._update_ns
        return int(SIGMA_OF_AGE * (age_ns + reading.end_ns - reading.start_ns)) + 1
