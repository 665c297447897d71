"""The thread of a bus: turns of scripts, devices that join and leave, no remaining resources, also in the daemon.
Times of reads: deadlines without drift, turns on a busy bus, edges of a data-ready line."""

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import monotonic_ns
from typing import Any

import pytest

from imud.config.model import Config
from imud.contracts.codec import Poll, Reading
from imud.contracts.script import Transfer, TransferScript
from imud.contracts.status import KernelCounters
from imud.daemon import Daemon
from imud.device.polled_bus import BusMember, PolledBuses
from imud.device.timetable import Deadlines, ReadySchedule, RoundRobin, Schedule
from imud.host.clock import HostClock
from imud.host.scope import INHERITED, Scope
from imud.model.errors import CommandError, DeviceRefused, LinkError, TransferError, Trouble
from imud.model.units import NS_PER_S
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.support.event_loops import VirtualClock, in_loop, run_virtually, virtual_buses
from tests.support.polled_bus_bench import PolledBusBench
from tests.support.stories import played

ASK = Transfer((b"\x01",), 1)


class Wire:
    """A link that replies with the number of the transfer."""

    title, writable, bus, shared, rate_hz, bit_rate = "wire", True, "wire", True, 2000.0, 0

    def __init__(self) -> None:
        self.target: int | None = None
        self.selected: int | None = None
        self.targets: list[int | None] = []  # the selected target of each transfer
        self.count = 0
        self.fail: Exception | None = None
        self.closed = 0
        self.threads: set[str] = set()
        self.takes_time: Callable[[], None] = lambda: None

    def absence(self) -> str:
        return ""

    async def wait_present(self) -> None: ...
    def open(self) -> None: ...
    def write(self, data: bytes) -> None: ...

    def select(self, target: int) -> None:
        self.selected = target

    def kernel_counters(self) -> KernelCounters:
        return KernelCounters()

    def serial_line(self) -> None: ...

    def place(self, target: int) -> str:
        return str(target)

    def transfer(self, transfer: Transfer) -> bytes:
        self.threads.add(threading.current_thread().name)
        self.count += 1
        self.targets.append(self.selected)
        self.takes_time()
        if self.fail is not None:
            raise self.fail
        return bytes([self.count % 256]) * transfer.read_bytes

    def close(self) -> None:
        self.closed += 1


class Sink:
    def __init__(self) -> None:
        self.readings: list[Reading] = []
        self.problem: LinkError | None = None
        self.calls = 0
        self.enough = asyncio.Event()

    def on_readings(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        self.calls += 1
        self.readings += readings
        self.problem = problem or self.problem
        if len(self.readings) > 20 or problem:
            self.enough.set()


def joined(buses: PolledBuses, wire: Wire, sink: Sink) -> BusMember:
    return buses.get(wire.bus).join(wire, Deadlines(), sink.on_readings)


def three() -> TransferScript[int]:
    total = 0
    for _ in range(3):
        total += (yield ASK)[0]
    return total


def stubborn() -> TransferScript[str]:
    try:
        yield ASK
    except TransferError as error:
        return f"after {error.trouble}"
    return "well"


def refusing() -> TransferScript[None]:
    yield ASK
    raise DeviceRefused("no")


class BusBench:
    """A bus with one device, in virtual time. A transfer takes `takes_ns`."""

    def __init__(self, takes_ns: int = 0) -> None:
        self.clock, self.wire, self.sink = VirtualClock(), Wire(), Sink()
        self.wire.takes_time = lambda: self.clock.advance(takes_ns)

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def whole() -> None:
            self.buses = virtual_buses(self.clock)
            self.member = joined(self.buses, self.wire, self.sink)
            try:
                await story()
            finally:
                self.buses.end()
                self.buses.end()

        run_virtually(self.clock, whole())


def moving() -> TransferScript[None]:
    yield replace(ASK, at=7)
    yield replace(ASK, then_at=9)
    yield ASK
    raise DeviceRefused("no")


@played(BusBench)
async def test_a_script_changes_the_target_and_reads_other_targets(it: BusBench) -> None:
    ended_at = list[int]()
    with pytest.raises(DeviceRefused):
        await it.member.run(moving(), 5, ended_at.append)
    assert (it.wire.targets, it.wire.selected, ended_at) == ([7, 5, 9], 9, [9])
    await it.member.run(three(), 5, ended_at.append)
    assert ended_at == [9, 5]
    it.wire.fail = TransferError(Trouble.ABSENT, "no")
    with pytest.raises(TransferError):
        await it.member.run(moving(), 5)
    assert (it.wire.targets[-1], it.wire.selected) == (7, 5)  # the next read is on the device


@played(lambda: BusBench(30_000))
async def test_readings_are_delivered_in_order_with_their_times(it: BusBench) -> None:
    """Reads at 2 kHz, 30 µs each; every sixth deadline has two reads."""
    it.member.start((Poll(ASK), Poll(Transfer((b"\x02",), 2), 3_000_000)))
    await it.sink.enough.wait()
    it.buses.end()
    readings = it.sink.readings
    firsts = [reading.start_ns for reading in readings if reading.poll == 0]
    steps = [after - before for before, after in pairwise(firsts)]
    assert steps == pytest.approx([500_000] * len(steps), abs=2)
    assert [r.poll for r in readings[:15]] == [0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    assert all(reading.end_ns - reading.start_ns == 30_000 for reading in readings)
    assert all(before.end_ns <= after.start_ns for before, after in pairwise(readings))


@pytest.mark.parametrize(("takes_ns", "most"), [(2_000_000, 40), (300_000_000, 5)])
@played(BusBench)
async def test_a_script_waits_for_few_reads_of_a_slow_device(it: BusBench, takes_ns: int, most: int) -> None:
    """A read is always due. Reads precede each of the three transfers, and the result."""
    it.member.start((Poll(ASK),))
    await it.sink.enough.wait()
    before = it.wire.count
    await it.member.run(three(), 5)
    assert it.wire.count - before <= 3 + most


@pytest.mark.parametrize(("latency_ns", "together"), [(0, 1), (460_000, 1), (5_000_000, 11), (5_100_000, 11)])
@played(lambda: BusBench(30_000))
async def test_a_hold_does_not_delay_reads(it: BusBench, latency_ns: int, together: int) -> None:
    """2 kHz: imud delivers the oldest reading before the end of its latency."""
    delivered: list[tuple[int, list[Reading]]] = []
    bus = it.buses.get(it.wire.bus)
    member = bus.join(it.wire, Deadlines(), lambda some, _problem: delivered.append((it.clock.now_ns(), list(some))))
    member.set_latency(latency_ns)
    member.start((Poll(ASK),))
    await asyncio.sleep(0.1)
    member.set_latency(0)
    count = len(delivered)
    await asyncio.sleep(0.002)
    assert len(delivered) >= count + 4  # the held readings, then each reading immediately
    it.buses.end()
    assert {len(some) for at_ns, some in delivered[:-6]} == {together}
    assert all(at_ns <= some[0].end_ns + latency_ns + 30_000 for at_ns, some in delivered)
    starts = [reading.start_ns for _, some in delivered for reading in some]
    assert [after - before for before, after in pairwise(starts)] == pytest.approx([500_000] * (len(starts) - 1), abs=2)


@played(BusBench)
async def test_a_failed_reading_ends_the_hold(it: BusBench) -> None:
    it.member.set_latency(40_000_000)
    it.member.start((Poll(ASK),))
    await asyncio.sleep(0.0024)
    assert it.sink.calls == 0
    it.wire.fail = TransferError(Trouble.ABSENT, "no")
    await asyncio.sleep(0.0005)
    assert it.sink.calls == 1
    assert [reading.error is not None for reading in it.sink.readings] == [False] * 5 + [True]


@played(BusBench)
async def test_a_script_gets_a_turn_on_a_busy_bus(it: BusBench) -> None:
    it.wire.rate_hz = 1e6
    it.member.start((Poll(ASK),))
    await it.sink.enough.wait()
    assert await it.member.run(three(), 1) > 0


@played(BusBench)
async def test_the_end_of_the_bus_is_reported_once_and_stops_reads(it: BusBench) -> None:
    it.wire.fail = LinkError("gone")
    it.member.start((Poll(ASK),))
    await it.sink.enough.wait()
    it.wire.fail = None
    count = it.wire.count
    assert await it.member.run(three(), 1) == 3 * count + 6  # no other transfer in the meantime
    assert (str(it.sink.problem), it.sink.calls) == ("gone", 1)


@played(BusBench)
async def test_the_thread_closes_the_link_of_a_device_that_has_left(it: BusBench) -> None:
    other = Wire()
    stays = joined(it.buses, other, Sink())
    it.member.start((Poll(ASK),))
    await it.sink.enough.wait()
    it.member.leave()
    it.member.leave()
    calls = it.sink.calls
    await stays.run(three(), 1)
    assert (it.sink.calls, it.wire.closed, other.closed) == (calls, 1, 0)


@played(BusBench)
async def test_scripts_return_raise_catch_or_are_cancelled(it: BusBench) -> None:
    failed = list[object]()
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: failed.append(context))
    for script in (three(), refusing()):
        running = asyncio.create_task(it.member.run(script, 1))
        await asyncio.sleep(0)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
    assert await it.member.run(three(), 1) == 5 + 6 + 7  # after the transfers
    assert failed == []
    assert await it.member.run(three(), 1) == 8 + 9 + 10
    with pytest.raises(DeviceRefused):
        await it.member.run(refusing(), 1)
    it.wire.fail = TransferError(Trouble.ABSENT, "no")
    assert await it.member.run(stubborn(), 1) == "after absent"
    with pytest.raises(TransferError):
        await it.member.run(three(), 1)
    it.wire.fail = LinkError("gone")
    with pytest.raises(LinkError):
        await it.member.run(stubborn(), 1)


@played(BusBench)
async def test_a_target_is_claimed_once(it: BusBench) -> None:
    a, b = it.member, joined(it.buses, Wire(), Sink())
    assert a.claim(0x18)
    assert a.claim(0x18)
    assert not b.claim(0x18)
    a.release()
    assert b.claim(0x18)
    b.leave()
    assert a.claim(0x18)


def holding(log: list[int], wire: Wire) -> TransferScript[None]:
    yield replace(ASK, holds=True)
    held_from = wire.count
    yield replace(ASK, holds=True)
    log.append(wire.count - held_from)
    yield ASK


@played(BusBench)
async def test_a_script_can_prevent_reads_of_its_device(it: BusBench) -> None:
    log = list[int]()
    it.wire.rate_hz = 0.0  # a read is always due
    it.member.start([Poll(ASK)])
    while it.wire.count < 20:
        await asyncio.sleep(0)
    await it.member.run(holding(log, it.wire), 5)
    assert log == [1]  # the error of the script
    read = it.wire.count
    while it.wire.count < read + 20:
        await asyncio.sleep(0)
    it.member.leave()


@pytest.mark.live
@in_loop
async def test_a_blocked_loop_does_not_delay_the_read_of_an_edge() -> None:
    """The thread waits for the line. It does not read the descriptor, and the loop is blocked."""
    edges, device = os.pipe2(os.O_NONBLOCK)
    buses, wire, read = PolledBuses(HostClock()), Wire(), threading.Event()
    wire.takes_time = read.set
    member = joined(buses, wire, Sink())
    schedule = ReadySchedule(1.0, monotonic_ns(), Deadlines())
    assert not member.watch(-1, lambda: None)
    assert member.watch(edges, lambda: schedule.noticed(monotonic_ns()))
    try:
        member.start((Poll(ASK),), schedule)
        for number in range(1, 51):
            assert read.wait(60)  # runs in the loop's thread
            assert wire.count == number
            read.clear()
            os.write(device, b"x")
        assert read.wait(60)
        member.unwatch(edges)
        member.unwatch(edges)
        os.write(device, b"x")
        await member.run(three(), 1)  # in the next rounds of the thread, after a read for the edge
    finally:
        buses.end()
        os.close(edges)
        os.close(device)
    assert (wire.count, wire.threads) == (51 + 3, {"wire"})
    assert [thread for thread in threading.enumerate() if thread.name == "wire"] == []


@pytest.mark.live
@in_loop
async def test_a_watched_line_does_not_delay_other_devices() -> None:
    edges, device = os.pipe2(os.O_NONBLOCK)
    buses, wire, sink = PolledBuses(HostClock()), Wire(), Sink()
    member = joined(buses, wire, sink)
    assert member.watch(edges, lambda: None)
    try:
        member.start((Poll(ASK),))
        await sink.enough.wait()
    finally:
        buses.end()
        os.close(edges)
        os.close(device)
    starts = [reading.start_ns for reading in sink.readings]
    assert min(b - a for a, b in pairwise(starts)) > 0
    assert starts[-1] - starts[0] >= 0.9 * (len(starts) - 1) * NS_PER_S / wire.rate_hz - NS_PER_S / wire.rate_hz


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, monkeypatch)


def wait_until_running(daemon: Daemon, then: Callable[[], None]) -> Coroutine[Any, Any, None]:
    async def watch() -> None:
        while sum(device.ledger["samples"] for device in daemon.status()) < 5:
            await asyncio.sleep(0.005)
        then()

    return watch()


@pytest.mark.live
@in_loop
async def test_daemon_serves_a_polled_device(bench: PolledBusBench) -> None:
    bench.spi.device = Imu61xRegisters(monotonic_ns).spi
    daemon = Daemon(Config("info", "", {}, (bench.on_spi(),)))
    watching = asyncio.create_task(wait_until_running(daemon, daemon.stop))
    await asyncio.wait_for(daemon.run(), 60)
    await watching
    assert daemon.status()[0].driver == "imu61x-spi"
    assert not bench.spi.opened


FAILURES = [ZeroDivisionError("a mistake"), SystemExit(0), KeyboardInterrupt(), MemoryError(), GeneratorExit()]


@pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("place", ["transfer", "readings", "command", "close"])
@played(BusBench)
async def test_an_internal_error_of_one_device_leaves_the_bus(it: BusBench, place: str, error: BaseException) -> None:
    """An internal error in the thread of a bus ended the daemon."""

    def fail(*_: object) -> None:
        raise error

    failures: list[BaseException] = []
    wire, sink = Wire(), Sink()
    INHERITED.set(Scope("ex", failures.append))
    bad = it.buses.get("wire").join(wire, Deadlines(), fail if place == "readings" else sink.on_readings)
    if place == "transfer":
        wire.takes_time = fail
    if place == "command":
        bad.command(fail)
    if place == "close":
        wire.close = fail  # type: ignore[method-assign]
        bad.leave()
    bad.start([Poll(ASK)])
    it.member.start([Poll(ASK)])
    await it.sink.enough.wait()
    assert failures == ([] if place == "close" else [error])
    wire.close = lambda: None  # type: ignore[method-assign]


@pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
@played(BusBench)
async def test_an_internal_error_of_a_script_ends_the_script(it: BusBench, error: BaseException) -> None:
    def script() -> TransferScript[None]:
        yield ASK
        raise error

    with pytest.raises(CommandError, match=f"the script failed: internal error {type(error).__name__}"):
        await it.member.run(script(), 1)
    it.member.start([Poll(ASK)])
    await it.sink.enough.wait()


QUIET_NS = 500 * 10**6

MS = 1_000_000
BEGIN = 1000 * MS


def schedule(rate_hz: float = 1000.0, begin_ns: int = 5 * MS) -> Schedule:
    return Schedule(rate_hz, begin_ns, Deadlines())


def test_deadlines_do_not_drift_and_late_and_missed_ones_are_counted() -> None:
    one = schedule()
    for number in range(1000):
        assert one.due_ns == 5 * MS + number * MS
        one.begun(one.due_ns + 200_000)
        one.done(one.due_ns + 900_000)
    assert (one.counts.polls, one.counts.late, one.counts.missed) == (1000, 0, 0)
    assert (one.counts.sum_late_ns, one.counts.worst_ns) == (1000 * 200_000, 200_000)
    counts = Deadlines()
    for _ in range(2):
        one = Schedule(50.0, 0, counts)
        one.begun(0)
        one.done(1)
    assert counts.polls == 2
    one = schedule()
    for late_ns in (250_000, 250_001, 999_999):
        one.begun(one.due_ns + late_ns)
        one.done(one.due_ns + late_ns)
    assert one.counts.late == 2
    one = schedule()
    one.begun(5 * MS)
    one.done(5 * MS + 3_400_000)  # deadlines 6 and 7 have passed with their periods; 8 is 0.4 ms late
    assert (one.counts.missed, one.due_ns) == (2, 8 * MS)
    one.begun(8 * MS + 400_000)
    one.done(8 * MS + 500_000)
    assert (one.due_ns, one.counts.missed) == (9 * MS, 2)
    one = schedule()
    one.done(6 * MS + 999_999)
    assert (one.due_ns, one.counts.missed) == (6 * MS, 0)
    one.done(8 * MS)
    assert (one.due_ns, one.counts.missed) == (8 * MS, 1)


# --- turns ------------------------------------------------------------------------------------------------------------


def test_devices_alternate_even_after_a_return() -> None:
    counts = [Deadlines() for _ in range(3)]
    turns = [RoundRobin(100, one) for one in counts]
    now_ns, order = 100, []
    for number in range(30):
        first = min(turns, key=lambda turn: turn.due_ns)
        assert first.due_ns <= now_ns  # a turn is always due
        order.append(turns.index(first))
        first.begun(now_ns)
        now_ns += 1000 if number % 7 else 500_000
        first.done(now_ns)
    assert (order, [one.polls for one in counts]) == ([0, 1, 2] * 10, [10] * 3)
    assert [one.late + one.missed + one.worst_ns for one in counts] == [0] * 3
    busy, back = RoundRobin(0, Deadlines()), RoundRobin(50, Deadlines())
    busy.done(49)
    assert busy.due_ns < back.due_ns
    busy.done(60)
    assert back.due_ns < busy.due_ns


def test_a_busy_bus_delivers_each_reading_immediately() -> None:
    """A read is always due, so that the thread is never idle."""
    clock = VirtualClock()

    async def body() -> None:
        buses, sinks = virtual_buses(clock), [Sink(), Sink()]
        for sink in sinks:
            wire = Wire()
            wire.rate_hz, wire.takes_time = 0.0, lambda: clock.advance(1000)
            buses.get("wire").join(wire, Deadlines(), sink.on_readings).start((Poll(ASK),))
        for sink in sinks:
            await sink.enough.wait()
            assert sink.calls == len(sink.readings) > 20
        buses.end()

    run_virtually(clock, body())


# --- edges ------------------------------------------------------------------------------------------------------------


def by_edges(rate_hz: float = 100.0) -> ReadySchedule:
    """Return a schedule after its first, immediate read."""
    made = ReadySchedule(rate_hz, BEGIN, Deadlines())
    assert made.due_ns == BEGIN
    read(made, BEGIN, 0)
    return made


def read(made: ReadySchedule, start_ns: int, takes_ns: int = MS // 5) -> None:
    made.begun(start_ns)
    made.done(start_ns + takes_ns)


def test_a_read_is_late_after_a_quarter_of_the_interval() -> None:
    made = by_edges()
    assert made.due_ns == BEGIN + QUIET_NS
    for number in range(1, 100):
        t_ns = BEGIN + number * MS
        made.on_edges([t_ns], MS)
        assert (made.due_ns, made.period_ns) == (t_ns, MS)
        read(made, t_ns + 100_000)
        assert made.due_ns == t_ns + QUIET_NS
    assert (made.counts.polls, made.counts.late, made.counts.missed) == (100, 0, 0)
    assert (made.counts.sum_late_ns, made.counts.worst_ns) == (99 * 100_000, 100_000)
    made = by_edges()
    for number, late_ns in enumerate((250_000, 250_001, 900_000), 1):
        made.on_edges([BEGIN + number * MS], MS)
        read(made, BEGIN + number * MS + late_ns, 0)
    assert made.counts.late == 2


def test_an_edge_is_read_once_and_counted_by_its_time() -> None:
    """The loop reports the edge late: a read after the edge already has its values."""
    made = by_edges()
    made.on_edges([BEGIN + MS], MS)
    read(made, BEGIN + 2 * MS + 100_000)
    made.on_edges([BEGIN + 2 * MS + 100_000], MS)
    assert made.due_ns == BEGIN + 2 * MS + 100_000 + QUIET_NS
    made.on_edges([BEGIN + 2 * MS + 100_001], MS)
    assert made.due_ns == BEGIN + 2 * MS + 100_001
    made = by_edges()
    for number in range(1, 100):
        t_ns = BEGIN + number * MS
        made.noticed(t_ns + 30_000)
        assert made.due_ns == t_ns + 30_000
        told_first = number % 3 == 0  # the loop knows the time before the read starts
        if told_first:
            made.on_edges([t_ns], MS)
            assert made.due_ns == t_ns
        read(made, t_ns + 100_000)
        assert made.has_read(t_ns + 100_000)
        assert not made.has_read(t_ns + 100_001)
        assert made.due_ns == t_ns + (0 if told_first else 30_000) + QUIET_NS
        if not told_first:
            made.on_edges([t_ns], MS)
            assert made.due_ns == t_ns + QUIET_NS  # no second read
    made.on_edges([BEGIN + 100 * MS], MS)
    assert (made.counts.polls, made.counts.late, made.counts.missed) == (100, 0, 0)
    assert (made.counts.sum_late_ns, made.counts.worst_ns) == (99 * 100_000, 100_000)
    made = by_edges()
    for number in range(1, 6):
        made.noticed(BEGIN + number * MS + 10_000)
        read(made, BEGIN + number * MS + (300_000 if number == 4 else 20_000))
    assert made.counts.polls == 1
    made.on_edges([BEGIN + number * MS for number in range(1, 7)], MS)
    assert (made.counts.polls, made.counts.late, made.counts.worst_ns) == (6, 1, 300_000)
    made.noticed(BEGIN + 8 * MS + 10_000)  # no read for 6 and 7
    read(made, BEGIN + 8 * MS + 20_000)
    made.on_edges([BEGIN + 7 * MS, BEGIN + 8 * MS], MS)
    assert (made.counts.polls, made.counts.sum_late_ns) == (7, 4 * 20_000 + 300_000 + 20_000)


def test_missing_edges_start_and_two_edges_end_the_use_of_deadlines() -> None:
    made = by_edges(100.0)
    at_ns = made.due_ns + 7
    read(made, at_ns)
    assert not made.by_edges
    for number in range(1, 5):
        assert made.due_ns == at_ns + number * 10 * MS
        read(made, made.due_ns)
    assert (made.period_ns, made.counts.polls, made.counts.worst_ns) == (10 * MS, 6, 0)
    made = by_edges()
    made.on_edges([BEGIN + 400 * MS], 400 * MS)
    read(made, BEGIN + 400 * MS)
    assert made.due_ns == BEGIN + 1600 * MS
    made = by_edges(100.0)
    read(made, made.due_ns, 35 * MS)
    assert made.counts.missed == 2
    made = by_edges()
    made.noticed(BEGIN + MS)
    read(made, BEGIN + MS)
    read(made, made.due_ns)
    assert not made.by_edges
    made.noticed(BEGIN + 600 * MS)  # a single edge can be a disturbance: no read
    assert made.due_ns < BEGIN + 600 * MS
    made.on_edges([BEGIN + 600 * MS], 600 * MS)
    assert not made.by_edges
    made.on_edges([BEGIN + 601 * MS], MS)
    assert made.by_edges
    made.noticed(BEGIN + 602 * MS)
    assert made.due_ns == BEGIN + 602 * MS
    made = by_edges()
    read(made, made.due_ns)
    t_ns = made.due_ns + 3 * MS
    deadline_ns = made.due_ns
    made.on_edges([t_ns], QUIET_NS)
    assert (made.by_edges, made.due_ns) == (False, deadline_ns)
    made.on_edges([t_ns + QUIET_NS + 1], QUIET_NS)
    assert not made.by_edges
    made.on_edges([t_ns + 2 * QUIET_NS + 1], MS)
    assert (made.by_edges, made.due_ns) == (True, t_ns + 2 * QUIET_NS + 1)
