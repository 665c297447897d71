"""The thread of a bus: turns of scripts, devices that join and leave, no remaining resources."""

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from itertools import pairwise
from time import monotonic_ns
from typing import Any

import pytest

from imud.contracts.codec import Poll, Reading
from imud.contracts.script import Transfer, TransferScript
from imud.contracts.status import KernelCounters
from imud.device.polled_bus import BusMember, Deadlines, PolledBuses, ReadySchedule
from imud.host.clock import HostClock
from imud.model.errors import DeviceRefused, LinkError, TransferError, Trouble
from imud.model.units import NS_PER_S
from tests.support.event_loops import VirtualClock, in_loop, run_virtually, virtual_buses
from tests.support.stories import played

ASK = Transfer((b"\x01",), 1)


class Wire:
    """A link that replies with the number of the transfer."""

    title, writable, bus, shared, rate_hz, bit_rate = "wire", True, "wire", True, 2000.0, 0

    def __init__(self) -> None:
        self.target: int | None = None
        self.selected: int | None = None
        self.targets: list[int | None] = []
        """The selected target of each transfer."""
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


@played(BusBench)
async def test_scripts_return_raise_and_catch(it: BusBench) -> None:
    assert await it.member.run(three(), 1) == 1 + 2 + 3
    with pytest.raises(DeviceRefused):
        await it.member.run(refusing(), 1)
    it.wire.fail = TransferError(Trouble.ABSENT, "no")
    assert await it.member.run(stubborn(), 1) == "after absent"
    with pytest.raises(TransferError):
        await it.member.run(three(), 1)
    it.wire.fail = LinkError("gone")
    with pytest.raises(LinkError):
        await it.member.run(stubborn(), 1)


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
    assert it.sink.calls == calls
    assert it.wire.closed == 1
    assert other.closed == 0


@played(BusBench)
async def test_a_cancelled_script_has_no_result(it: BusBench) -> None:
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
