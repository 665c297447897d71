"""The three paths with scripted codecs: batches, losses, faults, gaps, and the reports to an observer.
Edge of a read, by time stamps only."""

from collections.abc import Callable, Sequence
from math import sqrt
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason, PolledEvent, Reading, Vanished
from imud.contracts.lines import Edge, ReadyOptions, TriggerStamp
from imud.contracts.publisher import Batch
from imud.contracts.script import Message, ReplyFrame, TextLine
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.canfd import HipnucCanfdCodec, HipnucCanfdOptions, pack_fast
from imud.drivers.hipnuc.uart import ins
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions
from imud.formats.can import CanFrame
from imud.model.errors import TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_MS
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import CanPath, PathContext, PolledPath, PollTiming, ReadyEdges, StreamPath
from tests.support.event_loops import UTC_AHEAD_NS, VirtualClock
from tests.support.files import hi91

MS = NS_PER_MS
WAKE_NS = 50_000  # half of the maximum wake-up time of the host: the mean delay of an arrival without a latency timer
VALUES = Measurement(8, 0, None, accel_m_s2=(0.0, 0.0, 9.8), status=0b110)


class Noted:
    """An observer that notes its reports: method and arguments."""

    def __init__(self) -> None:
        self.reports: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given, **keywords: self.reports.append((name, *given, *keywords.items()))

    def named(self) -> list[tuple[Any, ...]]:
        return [report[:3] if report[0] == "call" else report[:1] for report in self.reports]


class Scripted:
    """A codec for bytes, CAN frames and polls whose next results are set by the test."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.results: list[tuple[Sequence[Any], int]] = []  # events and pending frames after each frame
        self.silence: Sequence[PolledEvent] = ()
        self.flush: Callable[[], Sequence[Any]] = tuple
        self.resets = 0
        self.unknown = {7: 1}

    def feed_frame(self, *_frame: object) -> Sequence[Any]:
        events, self.ledger.frames_pending = self.results.pop(0)
        return events

    counts_losses = False

    def decode(self, *_poll: object) -> Sequence[Any]:
        return self.results.pop(0)[0]

    feed = decode

    def on_silence(self, _poll: int) -> Sequence[PolledEvent]:
        return self.silence

    def reset(self) -> None:
        self.resets += 1
        self.ledger.frames_pending = 0


class PathRig:
    """The parts around a path."""

    def __init__(self, driver: str) -> None:
        self.clock = VirtualClock()
        self.now = self.clock.now_ns()
        self.ledger = Ledger()
        self.noted: Any = Noted()
        self.codec: Any = Scripted(self.ledger)
        self.batches: list[list[Sample]] = []
        self.reported: list[int] = []  # number of reports to the observer before each batch
        self.messages: list[tuple[Message, int]] = []
        self.bad: list[BadReason] = []
        self.overruns = 0
        self.sample_clock = make_clock("bow", None, DRIVERS[driver], None, on_unknown_gap=self.ledger.add_unknown_gap)
        self.context = PathContext(
            "bow", 3, self.ledger, self._publish, lambda message, t_ns: self.messages.append((message, t_ns)),
            lambda frame: self.bad.append(frame.reason), lambda: self.overruns, self.clock.host,
        )  # fmt: skip

    def _publish(self, batch: Batch) -> None:
        self.batches.append(list(batch.samples))
        self.reported.append(len(self.noted.reports))

    @property
    def sizes(self) -> list[int]:
        return [len(samples) for samples in self.batches]

    def stream(self) -> StreamPath:
        return StreamPath(HipnucCodec(self.ledger, HipnucOptions()), self.sample_clock, self.context)

    def can(self) -> CanPath:
        return CanPath(self.codec, self.sample_clock, self.context)

    def polled(self, update_ns: int = 0, edges: ReadyEdges | None = None) -> PolledPath:
        return PolledPath(self.codec, PollTiming(10 * MS, update_ns, edges), self.sample_clock, self.context)

    def reading(self, at_ms: float, results: Sequence[Any], error: TransferError | None = None) -> Reading:
        """Return a reading of 1 ms at a time, and let the codec return `results` for it."""
        if error is None:
            self.codec.results.append((results, 0))
        start_ns = self.now + round(at_ms * MS)
        return Reading(0, b"12345678", error, start_ns, start_ns + MS)


# --- bytes ------------------------------------------------------------------------------------------------------------


def test_bytes_are_published_on_arrival_or_together() -> None:
    rig = PathRig("hipnuc-uart")
    path, now = rig.stream(), rig.now
    path.watch_status(0b10)
    path.begin(now)
    assert (path.begun_ns, path.last_data_ns, path.fresh, path.period_ns, path.quality) == (
        now,
        now,
        False,
        0,
        (None, 0),
    )
    assert (path.gather(b"O", now + MS), path.held_by_fit, path.unknown is path.codec.unknown) == (False, False, True)
    path.on_data(b"K\r\n" + hi91(1000), now + 2 * MS)
    assert rig.messages == [("OK", now + 2 * MS)]
    assert (path.last_data_ns, path.last_sample_ns, path.fresh) == (now + 2 * MS, now + 2 * MS, True)
    assert path.gather(hi91(1010), now + 12 * MS)
    assert path.gather(hi91(1020), now + 22 * MS, waited_ns=MS)
    assert (path.clock.waited_ns, path.held_by_fit) == (0, False)
    assert rig.sizes == [1]
    path.publish_gathered()
    path.publish_gathered()
    assert (rig.sizes, rig.ledger.samples) == ([1, 2], 3)
    newest = rig.batches[-1][-1]
    assert (path.newest, path.last_sample_ns, path.quality) == (newest, now + 22 * MS, (newest.sync, newest.t_err_ns))
    assert (path.clock.t_ns, path.clock.t_rx_ns()) == (newest.t_ns, now + 22 * MS)
    assert make_clock("bow", None, DRIVERS["hipnuc-uart"], path.clock).t_ns == newest.t_ns
    assert sum(path.latency.buckets) == 3
    head = hi91(1030)[:3]
    path.on_data(head + hi91(1030), now + 32 * MS)  # the length of the cut frame contains the next frame
    path.flush(now + 40 * MS)
    assert rig.sizes == [1, 2, 1]
    path.on_data(hi91(1040)[:9], now + 42 * MS)
    path.reset()
    assert rig.ledger.bytes_pending == 0
    assert rig.ledger.closes()


def test_samples_come_in_order_between_messages_and_edges_come_first() -> None:
    rig = PathRig("hipnuc-uart")
    path = StreamPath(rig.codec, rig.sample_clock, rig.context)
    reply = ReplyFrame(1, b"")
    bad = [BadFrame(reason, b"") for reason in (BadReason.CRC, BadReason.NOT_FINITE)]
    rig.codec.results = [([VALUES, TextLine("a"), VALUES, reply, *bad], 0), ([VALUES], 0), ([VALUES], 0)]
    path.on_data(b"1", rig.now)
    assert [sample.seq for sample in rig.batches[0]] == [1, 2]
    assert [message for message, _ in rig.messages] == ["a", reply]
    assert rig.bad == [BadReason.CRC, BadReason.NOT_FINITE]
    assert path.loss.bad_frames == 1  # the sample of a frame with NaN follows
    path.on_data(b"2", rig.now)
    assert path.loss.bad_frames == 0
    assert path.take_status() == 0
    path.watch_status(0b010)
    path.on_data(b"3", rig.now)
    assert (path.take_status(), path.take_status()) == (0b010, 0)
    rig, order = PathRig("hipnuc-uart"), list[str]()
    listener = SimpleNamespace(wants_samples=True, on_sample=lambda m: order.append(f"sample {m.dev_ticks}"))
    codec = HipnucCodec(rig.ledger, HipnucOptions())
    path = StreamPath(codec, rig.sample_clock, rig.context, lambda: order.append("edges"), listener)
    path.on_data(hi91(7) + b"OK\r\n", rig.now)
    listener.wants_samples = False
    path.on_data(hi91(17), rig.now + 10 * MS)
    assert order == ["edges", "sample 7", "edges"]


def test_cause_of_a_gap_that_the_next_sample_decides() -> None:
    """The counter of an IMU61x has microseconds, so the samples of a gap can be late and follow together."""
    rig = PathRig("imu61x-uart")
    path = StreamPath(rig.codec, rig.sample_clock, rig.context)

    def receive(number: int, step_us: int, *events: Any) -> None:
        rig.codec.results = [([*events, Measurement(40, 0, step_us)], 0)]
        path.on_data(b"x", rig.now + 10 * number * MS)

    for number in range(100):
        receive(number, 10_000 * number)
    receive(102, 1_020_000, BadFrame(BadReason.CRC, b""))
    assert (rig.ledger.lost(), path.loss.bad_frames) == (0, 1)
    receive(103, 1_030_000)
    assert (rig.ledger.lost_crc, rig.ledger.lost_gap_device, path.loss.bad_frames) == (1, 1, 0)
    receive(106, 1_060_000)
    path.flush(rig.now + 1200 * MS)  # no sample follows
    assert (rig.ledger.lost_crc, rig.ledger.lost_gap_device) == (1, 3)
    receive(200, 2_000_000)
    path.reset()
    assert rig.ledger.lost() == 4 + 93


def test_an_observer_receives_overruns_and_each_input_of_path_and_clock() -> None:
    rig = PathRig("hipnuc-uart")
    path = rig.stream()
    path.observe(rig.noted)
    rig.overruns = 4
    for number in (0, 1, 2, 3, 4, 5, 6, 7, 10):
        path.on_data(hi91(1000 + 10 * number), rig.now + 10 * number * MS)
    assert (rig.ledger.lost_overrun, rig.ledger.lost()) == (2, 2)
    assert ("overruns", 4) in rig.noted.reports
    rig = PathRig("hipnuc-uart")
    path, now = rig.stream(), rig.now
    path.observe(rig.noted)
    path.begin(now)
    path.link_opened()
    path.on_data(hi91(1000), now)
    path.gather(b"x", now + 1, 7)
    path.publish_gathered()
    path.flush(now + 2)
    path.reset()
    clock, edges, triggers = path.clock, [Edge(now, True, 1)], [TriggerStamp(now, 1, 1)]
    for line in ("sout", "sout_div", "pps"):
        clock.add_edges(line, edges)
    clock.add_triggers(triggers)
    clock.set_utc_reference(None)
    clock.set_own_status(4)
    clock.link_changed(byte_ns=1, hold_ns=2)
    clock.restart()
    clock.expect_rate()
    assert rig.noted.reports == [
        ("call", "ledger", "set", Ledger().snapshot()), ("call", "path", "begin", now), ("call", "loss", "link_opened"),
        ("data", hi91(1000), now, -1), ("data", b"x", now + 1, 7), ("call", "path", "publish_gathered"),
        ("call", "path", "flush", now + 2), ("call", "path", "reset"),
        *(("edges", line, edges) for line in ("sout", "sout_div", "pps")),
        ("call", "aiding", "on_trigger_stamps", triggers), ("call", "clock", "set_utc_reference", None),
        ("call", "clock", "set_own_status", 4), ("call", "clock", "link_changed", ("byte_ns", 1), ("hold_ns", 2)),
        ("call", "clock", "restart"), ("call", "clock", "expect_rate"),
    ]  # fmt: skip
    path.observe(None)
    path.on_data(hi91(1010), now + 10 * MS)
    clock.restart()
    assert len(rig.noted.reports) == 17


# --- CAN frames -------------------------------------------------------------------------------------------------------


def frame(t_rx_ns: int, after_loss: bool = False) -> CanFrame:
    return CanFrame(1, False, b"", t_rx_ns, after_loss)


def since(t_first_ns: int) -> Measurement:
    """Return values whose first frame arrived at `t_first_ns`."""
    return msgspec.structs.replace(VALUES, t_first_ns=t_first_ns)


def test_a_loss_that_the_codec_counts_is_not_counted_by_the_clock() -> None:
    """Three of 80 frames with system time and sequence number are lost."""
    rig = PathRig("hipnuc-canfd")
    rig.codec = HipnucCanfdCodec(rig.ledger, HipnucCanfdOptions())
    path, now, bitmap = rig.can(), rig.now, 1 << ins.ACCEL | 1 << ins.TIME
    path.begin(now)
    for n in (n for n in range(80) if n not in (50, 51, 60)):
        data = pack_fast(Measurement(0, 0, None, (0.0, 0.0, n / 8)), bitmap, n, time_us=10_000 * n)
        path.on_frames([CanFrame(0x0CFF5B08, True, data, now + 10 * n * MS)])
    assert (rig.ledger.samples, rig.ledger.lost()) == (77, 3)
    newest = rig.batches[-1][-1]
    assert (newest.seq, newest.t_dev_ns, newest.accel_m_s2) == (77, 790 * MS, (0.0, 0.0, 79 / 8))


def test_samples_of_can_frames_start_before_the_first_frame_and_end_at_a_loss() -> None:
    """Three frames at 0, 1 and 2 ms, 0.2 ms each on the wire: the first one started at -0.2 ms."""
    rig = PathRig("imu61x-can")
    path, now = rig.can(), rig.now
    path.observe(rig.noted)
    path.set_frame_time(200_000)
    rig.codec.results = [((), 1), ((), 2), ((since(now),), 0)]
    path.on_frames([frame(now + at * MS) for at in (0, 1, 2)])
    (sample,) = rig.batches.pop()
    begin_ns = now - 200_000 - WAKE_NS
    assert (sample.t_ns, sample.t_rx_ns, sample.utc_ns) == (begin_ns, now + 2 * MS, begin_ns + UTC_AHEAD_NS)
    assert (path.last_data_ns, path.last_sample_ns) == (now + 2 * MS, now + 2 * MS)
    # the frame at 13 ms completes the sample from 10 ms, and is the first frame of the next sample
    rig.codec.results = [((), 1), ((), 2), ((since(now + 10 * MS),), 1), ((since(now + 13 * MS),), 0)]
    path.on_frames([frame(now + at * MS) for at in (10, 11, 13, 14)])
    (samples,) = rig.batches
    assert [sample.t_rx_ns - now for sample in samples] == [13 * MS, 14 * MS]
    assert [sample.t_ns - now for sample in samples] == [at * MS - 200_000 - WAKE_NS for at in (10, 13)]
    assert rig.noted.named() == [("call", "path", "set_frame_time"), ("frames",), ("frames",)]
    rig = PathRig("imu61x-can")
    path, now, clock_reads = rig.can(), rig.now, list[int]()
    rig.context.host.on_measured = lambda *_: clock_reads.append(1)
    path.flush(now)  # no frame yet: a recording gets no clock reading
    assert not clock_reads
    rig.codec.results = [((), 1), ((), 1), ((since(now + MS),), 0)]
    path.on_frames([frame(now), frame(now + MS, after_loss=True), frame(now + 2 * MS)])
    assert rig.codec.resets == 1
    assert [sample.t_ns for sample in rig.batches[0]] == [now + MS - WAKE_NS]
    path.reset()
    assert rig.codec.resets == 2
    rig.codec.flush = lambda: [since(now + 2 * MS)]
    path.flush(now + 5 * MS)
    assert rig.sizes == [1]
    path.flush(now + 6 * MS)  # no frame since the previous call
    assert (rig.sizes, rig.batches[1][0].t_rx_ns) == ([1, 1], now + 2 * MS)
    path.reset()  # no frame of the waiting sample follows
    assert (rig.sizes, path.unknown) == ([1, 1, 1], {7: 1})
    rig.codec.results = [((since(now + at * MS),), 0) for at in range(10, 410, 10)]
    path.on_frames([frame(now + at * MS) for at in range(10, 410, 10)])
    due_ns = now + 400 * MS + 2 * path.period_ns
    for at_ns, sizes in ((now + 400 * MS, [40]), (due_ns - 1, [40]), (due_ns, [40, 1])):
        path.flush(at_ns)
        assert rig.sizes[3:] == sizes


def test_each_input_is_reported_before_its_samples_are_published() -> None:
    """An output can read the host clocks when it receives samples. A recording has this reading after the input."""
    rig = PathRig("hipnuc-uart")
    stream, now = rig.stream(), rig.now
    stream.observe(rig.noted)
    stream.on_data(hi91(0), now)
    stream.gather(hi91(10), now + 10 * MS)
    stream.publish_gathered()
    stream.on_data(b"\x5a\xa5\x00\x01" + hi91(20), now + 20 * MS)  # 256 bytes by its length
    stream.flush(now + 70 * MS)
    assert [name for name, *_ in rig.noted.reports] == ["data", "data", "call", "data", "call"]
    assert rig.reported == [1, 3, 5]
    rig = PathRig("imu61x-can")
    can = rig.can()
    can.observe(rig.noted)
    rig.codec.results, rig.codec.flush = [((since(now),), 0)], lambda: [since(now)]
    can.on_frames([frame(now)])
    can.flush(now + 5 * MS)
    can.flush(now + 50 * MS)
    assert [report[0] for report in rig.noted.reports] == ["frames", "call", "call"]
    assert rig.reported == [1, 3]
    rig = PathRig("imu61x-i2c")
    polled = rig.polled()
    polled.observe(rig.noted)
    polled.on_readings([rig.reading(0, [VALUES])])
    assert (rig.noted.reports[0][0], rig.reported) == ("readings", [1])


# --- polled devices ---------------------------------------------------------------------------------------------------


def sigma_ns(age_ms: float) -> int:
    """Standard error of an instant that is uniform over an interval, ns, rounded up."""
    return int(age_ms * MS / sqrt(3)) + 1


@pytest.mark.parametrize(("update_ms", "errors_ms"), [(0, [11, 11, 21]), (4, [5, 5, 5])])
def test_the_error_of_a_read_covers_the_age_of_its_registers(update_ms: int, errors_ms: list[int]) -> None:
    """A read of 1 ms: the registers are as old as the time since the last read, or one update."""
    rig = PathRig("imu61x-i2c")
    path = rig.polled(update_ms * MS)
    path.begin(rig.now)
    assert path.period_ns == 10 * MS
    for at in (0, 10, 30):
        assert path.on_readings([rig.reading(at, [VALUES])]) == ""
    samples = [sample for batch in rig.batches for sample in batch]
    assert [sample.t_ns - rig.now for sample in samples] == [0, 10 * MS, 30 * MS]
    assert [sample.t_rx_ns - sample.t_ns for sample in samples] == [MS] * 3
    assert [sample.t_err_ns for sample in samples] == [sigma_ns(error_ms) for error_ms in errors_ms]


def test_readings_of_one_turn_are_one_batch_and_end_at_an_error_or_a_vanished_device() -> None:
    rig = PathRig("imu61x-i2c")
    path = rig.polled()
    path.observe(rig.noted)
    path.begin(rig.now)
    readings = [rig.reading(at, [VALUES]) for at in (0, 10)]
    gone = rig.reading(20, [Vanished("another device")])
    later = [rig.reading(30, [VALUES])]
    assert path.on_readings([*readings, gone, *later]) == "another device"
    assert rig.sizes == [2]
    assert (rig.ledger.bytes_in, rig.ledger.bytes_skipped) == (8, 8)  # only the path counts the bytes of `later`
    path.skip(readings[0])
    assert (rig.ledger.bytes_in, rig.ledger.bytes_skipped) == (16, 16)
    assert rig.noted.reports[-2:] == [("readings", [*readings, gone, *later]), ("call", "path", "skip", 8)]
    rig = PathRig("imu61x-i2c")
    path = rig.polled()
    missing = rig.reading(0, [], TransferError(Trouble.ABSENT, "no reply"))
    assert path.on_readings([missing]) == "no reply"
    rig.codec.silence = [Vanished("silent")]
    assert path.on_readings([missing]) == "silent"
    path.on_readings([rig.reading(10, [VALUES])])
    assert rig.batches[0][0].t_err_ns == sigma_ns(11)  # the age counts from the period, because the last read failed


@pytest.mark.parametrize(
    ("starts_ms", "period_ms"), [([0], 10), ([0, 5], 10), ([0, 700], 700), ([0, 700, 1400], 700), ([0, 60_000], 9000)]
)
def test_the_period_follows_the_reads_of_a_slow_device(starts_ms: list[int], period_ms: int) -> None:
    """The time without a sample that makes a device silent is a multiple of the period."""
    rig = PathRig("imu61x-i2c")
    path = rig.polled()
    path.begin(rig.now)
    path.on_readings([rig.reading(at, [VALUES]) for at in starts_ms])
    assert path.period_ns == period_ms * MS


@pytest.mark.parametrize("kind", ["damaged", "disturbed"])
def test_three_faults_in_a_row_identify_the_device_again(kind: str) -> None:
    rig = PathRig("imu61x-i2c")
    path = rig.polled()
    disturbed = TransferError(Trouble.DISTURBED, "noise")
    fault = rig.reading(0, [], disturbed) if kind == "disturbed" else None

    def turn() -> str:
        return path.on_readings([fault or rig.reading(0, [BadFrame(BadReason.CRC, b"")])])

    assert [bool(turn()) for _ in range(2)] == [False, False]
    path.on_readings([rig.reading(0, [VALUES])])  # a good read ends the row
    assert [bool(turn()) for _ in range(3)] == [False, False, True]
    path.begin(rig.now)  # so does a new begin
    assert not turn()
    assert (rig.ledger.lost_crc, rig.ledger.lost_gap_device) == ((6, 0) if kind == "damaged" else (0, 6))
    assert path.failed == (0 if kind == "damaged" else 6)
    path.on_readings([rig.reading(0, [BadFrame(BadReason.NOT_FINITE, b"")])])
    assert rig.ledger.lost() == 6  # the sample of this frame follows


@pytest.mark.parametrize(("pause_ms", "gaps"), [(14, 0), (15, 1)])
def test_a_long_pause_before_an_identified_device_is_an_unknown_gap(pause_ms: int, gaps: int) -> None:
    """One and a half periods of 10 ms, only for the first read after the identification."""
    rig = PathRig("imu61x-i2c")
    path = rig.polled()
    path.begin(rig.now)
    path.on_readings([rig.reading(0, [VALUES])])
    path.on_readings([rig.reading(20_000, [VALUES])])  # imud did not identify the device again
    assert rig.ledger.lost_unknown == 0
    path.begin(rig.now)
    path.on_readings([rig.reading(20_000 + pause_ms, [VALUES]), rig.reading(20_010 + pause_ms, [VALUES])])
    assert rig.ledger.lost_unknown == gaps
    rig.ledger.samples = 1  # another path of the device published a sample
    rig.polled().on_readings([rig.reading(20_020 + pause_ms, [VALUES])])
    assert rig.ledger.lost_unknown == gaps + 1


def test_edges_of_a_data_ready_line_time_stamp_the_reads() -> None:
    rig = PathRig("imu61x-i2c")
    edges = ReadyEdges(ReadyOptions(line="Y", bias_us=0), 10 * MS)
    path = rig.polled(edges=edges)
    path.observe(rig.noted)
    path.begin(rig.now)
    edges.restart()
    edges.on_edges([Edge(rig.now - MS, True, 7)])
    path.on_readings([rig.reading(0, [VALUES]), rig.reading(1, [VALUES])])
    first, second = rig.batches[0]
    assert (first.t_ns, first.sync, first.edge_seq) == (rig.now - MS, Sync.EDGE, 7)
    assert second.seq == 2
    assert rig.noted.named()[-3:] == [("call", "edges", "restart"), ("edges",), ("readings",)]
    path.observe(None)
    assert edges.observer is None


KEPT = 1024

EXACT = ReadyOptions(line="Y", bias_us=0)


def edge(number: int, t_ns: int | None = None) -> Edge:
    """Return an edge at number · 1 ms by default."""
    return Edge(number * MS if t_ns is None else t_ns, True, number)


def edges(*numbers: int, settings: ReadyOptions = EXACT) -> ReadyEdges:
    made = ReadyEdges(settings, MS)
    made.on_edges([edge(number) for number in numbers])
    return made


def read(made: ReadyEdges, start_ms: float, end_ms: float) -> tuple[int, int] | None:
    """Return the number of the edge and its time, ns."""
    stamp = made.match(round(start_ms * MS), round(end_ms * MS))
    return (stamp.number, stamp.t_ns) if stamp is not None else None


def test_a_read_is_of_the_newest_edge_before_it_and_others_are_missed_once() -> None:
    made = edges(1, 2, 3)
    assert [read(made, at, at + 0.2) for at in (1.1, 2.0, 3.3)] == [(1, MS), (2, 2 * MS), (3, 3 * MS)]
    assert made.missed == 0
    made = edges(1, 2, 3, 4)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 4.2, 4.3) == (4, 4 * MS)
    assert made.missed == 2
    made = edges(1, 5)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 5.1, 5.2) == (5, 5 * MS)
    assert (made.missed, made.interval_ns) == (3, MS)
    made = edges(1, 2)
    assert [read(made, at, at + 0.1) for at in (1.1, 1.5, 2.1)] == [(1, MS), (1, MS), (2, 2 * MS)]
    assert made.missed == 0
    made = edges(1, 2, 3, 4)
    read(made, 1.1, 1.2)
    made.restart()
    assert read(made, 4.1, 4.2) == (4, 4 * MS)
    assert made.missed == 0


def test_a_read_without_an_edge_has_no_time_stamp_and_the_error_is_that_of_the_stamp() -> None:
    made = edges(2, 3)
    assert read(made, 1.9, 1.95) is None
    assert read(made, 4.5, 4.6) == (3, 3 * MS)
    assert read(made, 4.6, 4.7) is None
    assert read(ReadyEdges(EXACT, MS), 1, 2) is None
    made = edges(1, 2, 3)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 400, 401) == (3, 3 * MS)
    assert read(made, 402, 403) is None
    made.on_edges([edge(4, 500 * MS)])
    assert read(made, 1300, 1301) is None
    made = edges(*range(1, 3 * KEPT))
    assert read(made, 2 * KEPT - 0.5, 2 * KEPT - 0.4) is None
    assert read(made, 2 * KEPT + 0.1, 2 * KEPT + 0.2) == (2 * KEPT, 2 * KEPT * MS)
    assert read(made, 3 * KEPT - 0.9, 3 * KEPT - 0.8) == (3 * KEPT - 1, (3 * KEPT - 1) * MS)
    plain, assumed = edges(1).match(MS, MS + 1), edges(1, settings=ReadyOptions(line="Y")).match(MS, MS + 1)
    assert plain is not None
    assert assumed is not None
    assert plain.err_ns == pytest.approx(3_000, abs=2)
    assert assumed.err_ns == pytest.approx(3_000 + 100_000 / sqrt(3), abs=2)


@pytest.mark.parametrize(("end_ms", "either"), [(1.999, False), (2.0, True), (2.7, True)])
def test_new_values_during_a_read_may_be_those_that_were_read(end_ms: float, either: bool) -> None:
    stamp = edges(1, 2).match(round(1.9 * MS), round(end_ms * MS))
    assert stamp is not None
    assert stamp.number == 1
    assert stamp.err_ns == pytest.approx(MS / sqrt(2) if either else 3_000, abs=10)


@pytest.mark.parametrize(("offset_us", "t_ns"), [(-400, 600_000), (50, 1_050_000), (500, 1_100_000)])
def test_the_offset_moves_the_stamp_but_not_behind_the_read(offset_us: float, t_ns: int) -> None:
    stamp = edges(1, settings=ReadyOptions(line="Y", offset_us=offset_us)).match(round(1.1 * MS), 2 * MS)
    assert stamp is not None
    assert stamp.t_ns == t_ns
