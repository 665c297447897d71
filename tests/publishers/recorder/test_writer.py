"""Queue and thread of the recorder: limited size, order, and complete blocks despite failing disks."""

import errno
import os
from pathlib import Path

import pytest

from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import NO_DEVICE, Kind, Record
from imud.model.event import Event, EventKind
from imud.publishers.recorder.writer import RecordFeed, RecordingWriter, RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench
from tests.support.event_loops import VirtualClock
from tests.support.signal_bench import HandWorkers

RING_BYTES, SYNC_NS = 256 << 10, 5_000_000_000


class WriterBench:
    def __init__(self, bytes_max: int = 1 << 24) -> None:
        self.clock = VirtualClock()
        self.queue = RecordQueue[Path](bytes_max)
        self.workers = HandWorkers()
        self.writer = RecordingWriter(self.queue, self.clock.now_ns, self.workers.start)

    def work(self) -> None:
        self.workers[0].work()


def record(number: int, size: int = 20) -> bytes:
    return records.encode_data(0, number.to_bytes(4, "little") * (size // 4), number, -1)


def read(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        found = RecordingReader(file, path.name)
        return [records.encode(records.Kind(one.kind), one.device, one.body) for one in found]


def test_records_are_in_their_file_after_a_round(tmp_path: Path) -> None:
    bench = WriterBench()
    first, second = tmp_path / "1", tmp_path / "2"
    bench.queue.mark(first)
    for number in range(5):
        bench.queue.put(record(number))
    bench.work()
    assert read(first) == [record(number) for number in range(5)]
    bench.queue.put(record(5))
    bench.queue.mark(second)
    bench.queue.put(record(6))
    bench.work()
    assert read(first) == [record(number) for number in range(6)]
    assert read(second) == [record(6)]
    assert bench.writer.written_bytes == first.stat().st_size + second.stat().st_size
    assert bench.writer.records == 7
    bench.writer.close()


def test_records_without_room_are_dropped_and_counted(tmp_path: Path) -> None:
    bench = WriterBench(bytes_max=4 * len(record(0)))
    bench.queue.mark(tmp_path / "1")
    for number in range(10):
        bench.queue.put(record(number))
    assert (bench.queue.dropped, bench.queue.dropped_bytes) == (6, 6 * len(record(0)))
    assert not bench.queue.is_easy
    bench.work()
    assert bench.queue.is_easy
    assert read(tmp_path / "1") == [record(number) for number in range(4)]
    bench.writer.close()
    bench = WriterBench()
    size = len(record(0, 1000))
    for number in range(RING_BYTES // size + 1):
        bench.queue.put(record(number, 1000))
    assert bench.workers[0].rung == 1
    queue = RecordQueue[Path]()
    for _ in range(17):
        queue.put(bytes(1 << 20))
    assert (queue.dropped, queue.waiting_bytes) == (1, 16 << 20)


def test_a_full_disk_leaves_complete_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, write = WriterBench(), os.write
    bench.queue.mark(tmp_path / "1")
    bench.queue.put(record(0))
    bench.work()
    whole = (tmp_path / "1").stat().st_size
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:10]))
    bench.queue.put(record(1))
    bench.work()
    assert bench.writer.problem == os.strerror(errno.ENOSPC)
    assert (tmp_path / "1").stat().st_size == whole
    monkeypatch.undo()
    bench.queue.put(record(2))
    bench.work()
    assert read(tmp_path / "1") == [record(0)]
    assert bench.queue.waiting_bytes == 0
    bench.queue.mark(tmp_path / "2")
    bench.queue.put(record(3))
    bench.work()
    assert bench.writer.problem == ""
    assert read(tmp_path / "2") == [record(3)]
    bench.writer.close()
    bench = WriterBench()
    (tmp_path / "3").write_bytes(b"mine")
    bench.queue.mark(tmp_path / "3")
    bench.queue.put(record(0))
    bench.work()
    assert bench.writer.problem == os.strerror(errno.EEXIST)
    assert (tmp_path / "3").read_bytes() == b"mine"


def test_the_file_is_synchronized_periodically(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, synced = WriterBench(), list[int]()
    monkeypatch.setattr(os, "fdatasync", synced.append)
    bench.queue.mark(tmp_path / "1")
    for number in range(12):
        bench.clock.advance(SYNC_NS // 4)
        bench.queue.put(record(number))
        bench.work()
    assert len(synced) == 3
    bench.writer.close()
    assert len(synced) == 4


BEGIN_NS, CHECK_NS = 2_000_000, 1_000_000_000


class FeedBench(RecordingBench):
    def __init__(self, *devices: str, bytes_max: int = 1 << 20) -> None:
        super().__init__()
        self.queue = RecordQueue[None](bytes_max)
        self.feed = RecordFeed(self.context, self.queue, devices or None)

    def taken(self) -> list[Record]:
        found: list[Record] = []
        while (item := self.queue.take()) is not None:
            found += records.records_of(item)
        return found

    def kinds(self) -> list[int]:
        return [record.kind for record in self.taken()]


def test_the_description_of_devices_is_limited_per_tick() -> None:
    bench = FeedBench()
    bench.source.present = [f"imu{number}" for number in range(5)]
    bench.source.on_begin = lambda: bench.clock.advance(BEGIN_NS // 2)
    found = []
    for _ in range(4):
        bench.feed.follow()
        found.append(len(bench.taken()))
    assert found == [2, 2, 1, 0]


def test_events_and_checks_belong_to_the_selected_devices() -> None:
    bench = FeedBench("mast")
    bench.feed.add_device("bow", 0)
    bench.feed.add_device("mast", 1)
    for device in ("bow", "mast", ""):
        bench.feed.event(Event(1, device, EventKind.UP, "up"))
    bench.feed.follow()
    bench.feed.check()
    found = [(record.kind, record.device) for record in bench.taken()]
    assert found == [(Kind.EVENT, 1), (Kind.EVENT, NO_DEVICE), (Kind.DEVICE, 1), (Kind.CHECK, 1)]


def test_devices_with_a_pending_description_have_no_check() -> None:
    bench = FeedBench()
    bench.feed.follow()
    bench.feed.describe(at_once=False)
    bench.taken()
    bench.feed.check()
    assert bench.kinds() == []
    bench.feed.follow()
    bench.feed.check()
    assert bench.kinds() == [Kind.DEVICE, Kind.DEVICE, Kind.CHECK, Kind.CHECK]


def test_checks_are_due_once_a_second() -> None:
    bench = FeedBench()
    bench.feed.follow()
    assert bench.feed.check_if_due(bench.clock.now_ns())
    assert not bench.feed.check_if_due(bench.clock.now_ns() + CHECK_NS - 1)
    assert bench.feed.check_if_due(bench.clock.now_ns() + CHECK_NS)


def test_losses_are_recorded_with_the_states_when_there_is_room() -> None:
    bench = FeedBench(bytes_max=500)
    bench.feed.follow()
    bench.taken()
    for _ in range(20):
        bench.source.deliver(100)
    dropped = bench.queue.dropped
    assert dropped
    assert bench.feed.note_losses(bench.advance(1)) == 0  # the queue has no room for the record of the loss
    begun_ns = bench.clock.now_ns()
    bench.taken()
    assert bench.feed.note_losses(bench.advance(1)) == dropped
    lost, *states = bench.taken()
    assert records.decode_lost(lost.body) == (dropped, dropped * 124, begun_ns)
    assert [record.kind for record in states] == [Kind.CALL, Kind.DEVICE, Kind.DEVICE]
    assert bench.feed.note_losses(bench.advance(1)) == 0


def test_the_end_contains_the_losses_of_a_full_queue() -> None:
    bench = FeedBench(bytes_max=500)
    bench.feed.follow()
    for _ in range(20):
        bench.source.deliver(100)
    found = list(records.records_of(bench.feed.finish("that is all")))
    assert [record.kind for record in found] == [Kind.LOST, Kind.END]
    assert records.decode_lost(found[0].body).records == bench.queue.dropped
    assert (records.decode_object(found[1], records.EndRecord).reason, bench.source.listening) == ("that is all", [])
    whole = FeedBench()
    whole.feed.follow()
    assert [record.kind for record in records.records_of(whole.feed.finish(""))] == [Kind.END]
    assert whole.kinds() == [Kind.DEVICE, Kind.DEVICE, Kind.CHECK, Kind.CHECK]
