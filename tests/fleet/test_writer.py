"""Queue and thread of the spool: limits, no repetition, and few losses on a failed disk."""

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.contracts.lines import UtcReference
from imud.contracts.publisher import Batch, PublisherClock
from imud.fleet.accounts import FleetLedger, StreamCounts
from imud.fleet.broker import BrokerTurn, Will
from imud.fleet.messages import Stream, decode_message
from imud.fleet.sender import MqttSender
from imud.fleet.settings import Broker, MqttOptions
from imud.fleet.spool import Spool, SpoolError
from imud.fleet.streams import Gateway
from imud.fleet.writer import MissedEvents, SentState, SpoolWriter, WriterQueue
from imud.host.threads import BusThread, StartWorker
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.fleet.fake_broker import FakeBroker
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import VirtualClock
from tests.support.signal_bench import HandWorkers
from tests.support.socket_rig import device_status

SKIP_NS, COMMIT_NS, DISK_RETRY_NS = 60 * NS_PER_S, 1 * NS_PER_S, 10 * NS_PER_S

HOUR_NS = 3600 * NS_PER_S


class FailingSpool(Spool):
    fails, new_max = False, 1000

    def commit(self, new: Any, acknowledged: Any, now_ns: int, utc_ns: int) -> None:
        if self.fails or len(new) > self.new_max:
            raise SpoolError("No space left on device")
        super().commit(new, acknowledged, now_ns, utc_ns)


class WriterBench:
    def __init__(
        self, path: Path, boot: str = "1", messages_per_s: float | None = None, queue: WriterQueue | None = None,
        spool: Spool | None = None, start_worker: StartWorker | None = None, **settings: object,
    ) -> None:  # fmt: skip
        self.clock, self.broker = VirtualClock(), FakeBroker()
        self.reference: UtcReference | None = UtcReference(0, 0)
        self.utc_offset_ns = 0
        devices = {"bow": {"rate_hz": None, "whole": "slots", **settings}}
        made = msgspec.convert({"devices": devices, "messages_per_s": messages_per_s}, MqttOptions)
        self.queue = queue or WriterQueue()
        self.disk = FailingSpool(path, 100_000_000, HOUR_NS)
        self.spool = spool or self.disk
        turn = BrokerTurn([Broker("a", 1, False, False, "")], 60.0, lambda: 0.5)
        self.sender = MqttSender(made, "me", Will("t", b""), turn, self.broker.connect, self.clock.now_ns)
        self.workers = HandWorkers()
        clock = PublisherClock(self.clock.now_ns, lambda: self.utc_offset_ns, lambda: self.reference, lambda: 0)
        self.writer = SpoolWriter(made, Gateway("site", "gw", boot), self.queue, self.spool, self.sender, clock)
        self.writer.start(start_worker or self.workers.start)
        self.seq = 0

    def put(self, count: int) -> None:
        """Put samples of `count` milliseconds."""
        base_ns, made = self.clock.now_ns(), []
        for n in range(count):
            self.seq += 1
            t_ns = base_ns + n * NS_PER_MS
            made.append(Sample("bow", self.seq, t_ns, 0, Sync.EDGE, 0, 0, accel_m_s2=(self.seq / 3, 0, 1)))
        self.queue.put_batch(Batch("bow", 0, made))
        self.clock.advance(count * NS_PER_MS)

    def work(self, seconds: int = 1) -> None:
        for _ in range(seconds):
            self.workers[0].work()
            self.sender.work()
            self.workers[0].work()
            self.sender.work()
            self.clock.advance(COMMIT_NS)

    def arrived(self) -> list[bytes]:
        connections = self.broker.connections
        return [payload for each in connections for topic, payload, retain in each.sent if not retain]

    def counts(self) -> StreamCounts:
        ledger = FleetLedger(from_begin=True)
        self.spool.rewind()
        for payload in [*self.arrived(), *[row.payload for row in self.spool.after(1_000_000)]]:
            ledger.take(decode_message(payload), Stream.SAMPLES)
        (counts,) = ledger.counts.values()
        assert counts.balance == 0
        return counts


def test_everything_is_spooled_sent_and_removed(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    for _ in range(5):
        bench.put(1000)
        bench.work()
    bench.work(4)
    counts = bench.counts()
    assert ((counts.whole, counts.duplicates, counts.missing), bench.spool.messages) == ((5000, 0, 0), 0)
    assert bench.sender.acknowledged == bench.spool.spooled == 10
    bench.disk.fails = True
    bench.put(2000)
    bench.work(3)
    assert len(bench.arrived()) == 10, "what is not stored is not sent"
    assert bench.writer.problem == "No space left on device"


def test_samples_of_a_refused_topic_wait_in_the_spool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = WriterBench(tmp_path)
    bench.broker.refuses = {"imud/site/gw/bow/samples"}
    for number in range(3):
        bench.put(1000)
        bench.queue.put_event(Event(number, "bow", EventKind.UP, ""))
        bench.work(2)
    sent = [topic for topic, _, _ in bench.broker.connections[0].sent]
    assert sent.count("imud/site/gw/bow/events") == 3
    assert sent.count("imud/site/gw/bow/samples") <= 2
    assert (bench.spool.messages, bench.sender.acknowledged) == (6, 3)
    monkeypatch.setattr("imud.fleet.sender.OUTBOX_MAX", 8)
    for _ in range(10):
        bench.put(1000)
        bench.work()
    bench.spool.rewind()
    bench.queue.put_event(Event(9, "bow", EventKind.UP, ""))
    bench.work()
    assert bench.sender.acknowledged == 4, "waiting samples do not delay an event"
    bench.broker.refuses = set()
    bench.clock.advance(SKIP_NS)
    bench.work(20)
    assert (bench.spool.messages, bench.sender.acknowledged) == (0, bench.spool.spooled)
    assert (len(bench.broker.connections), bench.sender.refused) == (1, {})


def test_waiting_messages_are_sent_in_order_with_the_allowed_rate(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path, messages_per_s=3)
    bench.broker.problem = "no route"
    for _ in range(10):
        bench.put(1000)
        bench.work()
    bench.broker.problem = ""
    sent = []
    for _ in range(30):
        bench.work()
        sent.append(len(bench.arrived()))
    assert sent[-1] == 20
    assert max(b - a for a, b in pairwise([0, *sent])) <= 6  # the allowance of one second and the accumulated allowance
    begun = next(number for number, count in enumerate(sent) if count)
    assert 3 * 5 <= sent[begun + 5] <= 3 * 7
    firsts = [decode_message(payload).first for payload in bench.arrived()]
    assert firsts == list(range(1, 10_000, 500))
    assert bench.counts().missing == 0


def test_a_rate_below_one_message_per_second_works(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path, messages_per_s=0.25)
    bench.put(5000)
    bench.work(21)
    assert len(bench.arrived()) in (5, 6)
    bench, commits = WriterBench(tmp_path / "other", batch_s=0.1), []
    bench.spool.commit = lambda new, *_: commits.append(len(new))  # type: ignore[method-assign]
    for _ in range(100):
        bench.put(100)
        bench.workers[0].work()
    assert len(commits) in (9, 10), "there is one transaction a second"
    bench.clock.advance(3 * NS_PER_S)
    for _ in range(2):
        bench.workers[0].work()
        bench.clock.advance(NS_PER_S)
    assert 0 not in commits, "a gateway without messages does not write to the disk"


def test_messages_without_acknowledgement_are_sent_again_in_order(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    bench.broker.answers = 1
    bench.put(3000)
    bench.work(3)
    assert len(bench.arrived()) == 5
    bench.broker.problem = "gone"
    bench.work(2)
    bench.broker.problem, bench.broker.answers = "", 1000
    bench.work(5)
    firsts = [decode_message(payload).first for payload in bench.arrived()]
    assert firsts == [1, 501, 1001, 1501, 2001, 501, 1001, 1501, 2001, 2501]
    counts = bench.counts()
    assert ((counts.whole, counts.duplicates), bench.spool.messages) == ((3000, 2000), 0)
    # the sender ignores an acknowledgement of an earlier connection
    bench.put(1000)
    bench.work(2)
    bench.broker.problem = "gone"
    bench.sender.work()
    bench.broker.problem = ""
    bench.sender.work()
    bench.work(3)
    assert bench.spool.messages == 0
    assert bench.counts().whole == 4000


def test_samples_without_room_are_counted_and_reported(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    for _ in range(25):
        bench.put(1000)
    assert bench.queue.waiting == 20_000
    bench.work()
    bench.put(1000)
    bench.work(12)
    assert bench.queue.dropped == 5000
    assert bench.counts() == StreamCounts(1, 26_000, whole=21_000, dropped={"queue": 5000})


def test_a_short_failure_and_a_full_disk_lose_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bench = WriterBench(tmp_path)
    bench.put(1000)
    bench.work()
    bench.disk.fails = True
    bench.put(1000)
    bench.work(2)
    bench.disk.fails = False
    bench.work(DISK_RETRY_NS // NS_PER_S + 1)
    assert bench.writer.problem == ""
    bench.work(3)
    assert bench.counts() == StreamCounts(1, 2000, whole=2000)
    bench.put(1000)
    bench.disk.fails = True
    bench.writer.close()
    assert "2 messages are lost at the end because the spool failed: No space left" in caplog.text
    bench = WriterBench(tmp_path / "full")
    bench.disk.new_max = 1
    bench.put(5000)
    bench.workers[0].work()
    assert bench.writer.problem
    bench.clock.advance(DISK_RETRY_NS)
    bench.workers[0].work()
    assert (bench.writer.problem, bench.spool.spooled) == ("", 10)
    assert bench.counts().whole == 5000


def test_a_long_failure_of_the_disk_keeps_only_the_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.writer.PENDING_BYTES", 1 << 17)
    bench = WriterBench(tmp_path)
    bench.disk.fails = True
    while not bench.writer.lost_on_disk:
        bench.put(1000)
        bench.work(DISK_RETRY_NS // NS_PER_S)
        assert bench.seq < 20_000
    bench.disk.fails = False
    bench.work(DISK_RETRY_NS // NS_PER_S + 5)
    counts = bench.counts()
    assert (counts.missing, counts.dropped["disk"]) == (0, bench.writer.lost_on_disk)
    assert counts.whole + counts.dropped["disk"] == bench.seq


def test_a_device_with_a_restarted_count_gets_its_own_boot(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    bench.put(1000)
    bench.seq = 0
    bench.put(500)
    bench.work(4)
    bench.writer.close()
    boots = {position.boot: position.last for position in bench.writer.positions}
    assert boots == {"1": 1000, "1-2": 500}
    again = WriterBench(tmp_path)
    again.seq = 600
    again.put(10)
    again.work(4)
    again.writer.close()
    assert {one.boot: one.last for one in again.writer.positions} == {"1": 1000, "1-2": 610}
    newest = [decode_message(payload) for payload in again.arrived()][-2:]
    assert [(one.boot, one.kind, one.first, one.last) for one in newest] == [
        ("1-2", "dropped", 501, 600), ("1-2", "slots", 601, 610),
    ]  # fmt: skip


def test_waiting_messages_are_stored_at_the_end(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path, boot="1")
    bench.broker.problem = "no network"
    bench.put(2000)
    bench.work(3)
    bench.writer.close()
    again = WriterBench(tmp_path, boot="2")
    again.work(3)
    assert sum(decode_message(payload).count for payload in again.arrived()) == 2000
    again.put(123)
    again.writer.close()
    spool = Spool(tmp_path, 1_000_000, HOUR_NS)
    spool.open()
    assert [row.items for row in spool.after(9)] == [123]


def test_events_of_the_gateway_and_of_devices(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    for device in ("", "bow", "unknown"):
        bench.queue.put_event(Event(1, device, EventKind.LINK, "x"))
    bench.work(4)
    topics = [topic for connection in bench.broker.connections for topic, _, _ in connection.sent]
    assert topics == ["imud/site/gw/events", "imud/site/gw/bow/events"]
    bench = WriterBench(tmp_path / "limited", queue=WriterQueue(events_max=2))
    for _ in range(2):
        for device in ("bow", "", "bow", "bow", "", "bow"):
            bench.queue.put_event(Event(bench.clock.now_ns(), device, EventKind.LINK, "x"))
        bench.work(4)
    ledgers = FleetLedger(from_begin=True)
    for payload in bench.arrived():
        ledgers.take(decode_message(payload), Stream.EVENTS)
    counts = {key.device: one for key, one in ledgers.counts.items()}
    assert counts == {
        "bow": StreamCounts(1, 8, whole=2, dropped={"queue": 6}),
        "": StreamCounts(1, 4, whole=2, dropped={"queue": 2}),
    }
    assert bench.queue.dropped == 8
    bench.writer.close()


def test_the_queues_of_events_and_states_are_limited() -> None:
    queue = WriterQueue(samples_max=10, events_max=2)
    for number in range(1000):
        queue.put_event(Event(number, "", EventKind.LINK, "x"))
    assert (queue.queued, queue.dropped) == (1000, 998)
    queue.take()
    queue.put_event(Event(1, "", EventKind.LINK, "x"))
    assert queue.dropped == 998
    taken = list(iter(queue.take, None))
    assert [type(one) for one in taken] == [Event, MissedEvents, Event], "all that were missed are one item"
    assert isinstance(taken[1], MissedEvents)
    assert (taken[1].count, taken[1].t_ns) == (998, 999)
    queue = WriterQueue(events_max=0)
    for number in range(1000):
        queue.put_state(SentState({"a": device_status("a", number)}, {"b": number, "c": number}))
    queue.put_state(SentState({"b": device_status("b", 1)}, {"a": None}))
    assert queue.take() == SentState({"b": device_status("b", 1)}, {"c": 999, "a": None})
    assert (queue.take(), queue.dropped) == (None, 0)


LIFTED_NS = 1_750_000_000 * NS_PER_S  # time to which systemd sets a clock without a battery: after 2020, but wrong


def test_each_message_contains_the_clock_of_its_creation(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    bench.utc_offset_ns, bench.reference, begin_ns = LIFTED_NS, None, bench.clock.now_ns()
    bench.put(1000)
    bench.work(2)
    bench.reference = UtcReference(2 * LIFTED_NS, 30)
    bench.put(1000)
    bench.work(3)
    clocks = [clock for payload in bench.arrived() if (clock := decode_message(payload).clock)]
    states = [(clock.utc_offset_ns, clock.synchronised, clock.error_ns) for clock in clocks]
    assert states == [(LIFTED_NS, False, None)] * 2 + [(2 * LIFTED_NS, True, 30)] * 2
    assert begin_ns < clocks[0].t_ns < clocks[-1].t_ns < bench.clock.now_ns()


def test_messages_spooled_before_the_clock_was_set_do_not_expire(tmp_path: Path) -> None:
    bench = WriterBench(tmp_path)
    bench.broker.problem = "no route"
    bench.utc_offset_ns, bench.reference = LIFTED_NS, None
    bench.put(1000)
    bench.work(2)
    bench.utc_offset_ns += 10_000 * HOUR_NS
    bench.reference = UtcReference(bench.utc_offset_ns, 30)
    bench.put(1000)
    bench.work(2)
    assert bench.counts().dropped == {}
    bench.reference = None
    bench.clock.advance(2 * HOUR_NS)
    bench.put(1000)
    bench.work(2)
    assert bench.counts().dropped == {"age": 1000}, "of what was spooled while the clock was set"


def test_positions_of_this_boot_are_kept_with_an_unset_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.spool.POSITIONS_MAX", 20)
    old = WriterBench(tmp_path, "old")
    old.utc_offset_ns = LIFTED_NS
    for _ in range(20):
        old.queue.put_batch(Batch("bow", 0, [Sample("bow", 1, 1, 0, Sync.EDGE, 0, 0)]))
        old.workers[0].work()
        old.clock.advance(COMMIT_NS)
    old.writer.close()
    new = WriterBench(tmp_path, "new")
    new.reference = None
    for _ in range(3):
        new.put(1000)
        new.work()
    found = [one for one in new.writer.positions if one.boot == "new"]
    assert [(one.begin, one.last) for one in found] == [(1, 2500)]


class HangingSpool(Spool):
    """Spool on a disk that blocks the first transaction until the test continues."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, 100_000_000, HOUR_NS)
        self.hangs, self.goes_on = threading.Event(), threading.Event()

    def commit(self, new: object, acknowledged: object, now_ns: int, utc_ns: int) -> None:
        if threading.current_thread().name == "mqtt spool" and not self.goes_on.is_set():
            self.hangs.set()
            assert self.goes_on.wait(LIMIT_S)
        super().commit(new, acknowledged, now_ns, utc_ns)  # type: ignore[arg-type]


@pytest.mark.live
def test_a_thread_blocked_by_the_disk_keeps_the_spool_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("imud.host.threads.END_LIMIT_S", 0.1)
    spool, closed = HangingSpool(tmp_path), threading.Event()
    bench = WriterBench(tmp_path, spool=spool, start_worker=BusThread)
    bench.writer.closed = closed.set
    bench.put(1000)
    bench.clock.advance(COMMIT_NS)
    bench.sender.wanting()
    assert spool.hangs.wait(LIMIT_S)
    bench.put(500)
    bench.writer.close()
    assert not closed.is_set()
    assert "the thread of the spool did not end" in caplog.text
    assert "500 samples wait" in caplog.text
    spool.goes_on.set()
    assert closed.wait(LIMIT_S)
    assert bench.writer.failure is None
    again = Spool(tmp_path, 100_000_000, HOUR_NS)
    again.open()
    assert sum(row.items for row in again.after(99)) == 1500
