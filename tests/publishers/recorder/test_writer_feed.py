"""Feed of a recording: only the selected devices, limited work per tick, and losses at their position."""

from imud.formats import records
from imud.formats.records import NO_DEVICE, Kind, Record
from imud.model.event import Event, EventKind
from imud.publishers.recorder.writer import RecordFeed, RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench

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
    assert records.decode_object(found[1], records.EndRecord).reason == "that is all"
    assert bench.source.listening == []
    whole = FeedBench()
    whole.feed.follow()
    assert [record.kind for record in records.records_of(whole.feed.finish(""))] == [Kind.END]
    assert whole.kinds() == [Kind.DEVICE, Kind.DEVICE, Kind.CHECK, Kind.CHECK]
