"""A polled device with a data-ready line: reads and time stamps at its edges, at deadlines without edges."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import pairwise
from math import dist
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.lines import DeviceLines, LineFactory, OnEdges, OnLineEnd, ReadyOptions
from imud.contracts.status import DeviceState
from imud.device.polled_bus import Deadlines, ReadySchedule
from imud.device.polled_transport import DataReady
from imud.host.clock import HostClock
from imud.model.errors import LinkMissing
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.pins import MemoryInput, MemoryOutput
from tests.support.device_rig import DeviceRig
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.polled_bus_bench import PolledBusBench
from tests.support.stories import in_bench

MS = 1_000_000
EVERY_NS = 2 * MS
"""Period of the device, ns: 500 Hz; `rate_hz` is 100."""
RATE_HZ = 100.0


class Signal:
    """The line of the device: an edge at each update of its registers."""

    def __init__(self, bench: PolledBusBench, device: Imu61xRegisters) -> None:
        self.stamps: list[int] = []
        """Number of edges since the line was opened."""
        self.quiet = False
        self._stage, self._device = bench, device

    @property
    def line(self) -> MemoryInput:
        return self._stage.lines.inputs["imu data_ready"]

    @property
    def newest_ns(self) -> int:
        """Time of the last update of the registers."""
        epoch_ns = self._device.epoch_ns
        return epoch_ns + (self._stage.clock.now_ns() - epoch_ns) // EVERY_NS * EVERY_NS

    def at_once(self, t_ns: int, *, heard: bool = True) -> None:
        """Add an edge to the buffer of the kernel. With `heard` the loop processes the edge."""
        self.line.edge(t_ns, True)
        if heard:
            asyncio.get_running_loop().call_soon(self.line.drain)
        if self.line.is_open:
            self.stamps.append(t_ns)

    async def run(self) -> None:
        clock = self._stage.clock
        while True:
            t_ns = self.newest_ns + EVERY_NS
            await asyncio.sleep((t_ns - clock.now_ns()) / NS_PER_S)
            if not self.quiet and clock.now_ns() >= t_ns and t_ns not in self.stamps[-20:]:
                self.at_once(t_ns)


class Scene:
    def __init__(self, rig: DeviceRig, signal: Signal, device: Imu61xRegisters, bench: PolledBusBench) -> None:
        self.rig, self.signal, self.device, self.bench = rig, signal, device, bench

    def told(self, words: str) -> Callable[[], bool]:
        return lambda: any(e.kind is EventKind.LINK and words in e.message for e in self.rig.events)

    @property
    def missed(self) -> int:
        return self.rig.polling.missed

    def dated(self, sample: Sample) -> int:
        """Check time stamp and values of a sample. Return the index of its edge."""
        assert sample.edge_seq is not None
        assert sample.sync is Sync.EDGE
        stamp_ns = self.signal.stamps[sample.edge_seq - 1]
        assert sample.t_ns == stamp_ns
        assert sample.accel_m_s2 is not None
        assert dist(sample.accel_m_s2, self.device.truth_at(stamp_ns).accel_m_s2) < 4e-5
        return sample.edge_seq


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, monkeypatch, VirtualClock())


def with_line(bench: PolledBusBench, **more: Any) -> DeviceConfig:
    return replace(
        bench.on_spi(RATE_HZ, burst="standard"), lines=DeviceLines(data_ready=ReadyOptions(line="Y", **more))
    )


@asynccontextmanager
async def scene(bench: PolledBusBench, **more: Any) -> AsyncIterator[Scene]:
    device = bench.registers(update_ns=EVERY_NS)
    bench.spi.device = device.spi
    signal = Signal(bench, device)
    async with bench.running(with_line(bench, **more)) as (rig,):
        task = asyncio.create_task(signal.run())
        try:
            yield Scene(rig, signal, device, bench)
        finally:
            task.cancel()


@in_bench
async def test_each_edge_is_a_sample_with_its_time(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(200)
        status = it.rig.device.status()
        assert status.expected_rate_hz == 500
        assert status.clock.sync is Sync.EDGE
        assert status.lines is not None
        assert status.lines.edges["data_ready"] >= 199
        assert status.lines.edges_lost == {"data_ready": 0}
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert all(sample.t_err_ns < 62_000 for sample in it.rig.samples[1:])  # 100 us / √3 and 3 us
        assert it.missed == it.rig.device.ledger.lost_queue == 0
        assert EventKind.LINK not in it.rig.kinds
    it.rig.device.tick(bench.clock.now_ns())
    assert not it.signal.line.is_open, "it is let go of at the end"


@in_bench
async def test_an_inverted_line_has_the_same_edges(bench: PolledBusBench) -> None:
    asked: list[Any] = []
    make = bench.lines.input

    def keep(settings: Any, purpose: str, rising_only: bool = False) -> MemoryInput:
        asked.append((settings.edge, settings.active_low, rising_only))
        return make(settings, purpose, rising_only)

    bench.lines.maker = replace(bench.lines.maker, make_input=keep)
    for edge, active_low in (("falling", False), ("falling", True), ("rising", True)):
        async with bench.running(with_line(bench, edge=edge, active_low=active_low)):
            pass
    assert asked == [("rising", True, True), ("rising", False, True), ("rising", True, True)]


@in_bench
async def test_a_stalled_loop_misses_edges(bench: PolledBusBench) -> None:
    """After a blocked loop the kernel has ten more edges: one read, for the newest edge."""
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        newest = len(it.signal.stamps)
        for _ in range(10):
            bench.clock.advance(EVERY_NS)
            it.signal.at_once(it.signal.stamps[-1] + EVERY_NS)
        await it.rig.until_samples(20)
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        gaps = [b for a, b in pairwise(numbers) if b != a + 1]
        assert gaps == [newest + 10]
        lost = numbers[-1] - numbers[0] + 1 - len(numbers)
        assert lost in (9, 10)
        assert it.missed == it.rig.device.ledger.lost_queue == lost
        await it.rig.until(lambda: EventKind.LOSS in it.rig.kinds, "told")


class Unheard(MemoryInput):
    """A line with edges that do not wake the loop."""

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        super().start(on_edges, on_end, watch=False)


@in_bench
async def test_an_edge_in_the_kernel_time_stamps_its_read(bench: PolledBusBench) -> None:
    """The edge is in the kernel before the read for the previous edge starts: no second read."""

    def make(_settings: Any, purpose: str, rising_only: bool = False) -> MemoryInput:
        return bench.lines.inputs.setdefault(purpose, Unheard(purpose, rising_only))

    bench.lines.maker = replace(bench.lines.maker, make_input=make)
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.signal.quiet = True
        await asyncio.sleep(0.01)
        before = it.rig.polling
        stamp_ns = it.signal.newest_ns

        def at_the_beginning_of_the_read() -> None:
            bench.clock.advance(EVERY_NS)
            it.signal.at_once(stamp_ns + EVERY_NS, heard=False)

        it.signal.at_once(stamp_ns)
        bench.before_next_time = at_the_beginning_of_the_read
        await asyncio.sleep(0.01)
        assert bench.before_next_time is None
        after = it.rig.polling
        assert it.dated(it.rig.samples[-1]) == len(it.signal.stamps)
        assert (after.polls - before.polls, after.missed - before.missed) == (1, 1)
        assert after.stale == before.stale


@in_bench
async def test_edges_stop_and_return(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.signal.quiet = True
        await it.rig.until(it.told("no edges: imud reads at 100 Hz"), "told")
        count = len(it.rig.samples)
        await it.rig.until_samples(50)
        assert it.rig.device.status().expected_rate_hz == RATE_HZ
        by_deadlines = it.rig.samples[count + 1 :]
        assert {sample.sync for sample in by_deadlines} == {Sync.ARRIVAL}
        assert {sample.edge_seq for sample in by_deadlines} == {None}
        steps = [b.t_ns - a.t_ns for a, b in pairwise(by_deadlines)]
        assert sum(steps) / len(steps) == pytest.approx(10 * MS, rel=0.01)
        it.signal.quiet = False
        await it.rig.until(it.told("edges have returned"), "told")
        count = len(it.rig.samples)
        await it.rig.until_samples(50)
        numbers = [it.dated(sample) for sample in it.rig.samples[count:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert it.rig.state is DeviceState.RUNNING
        assert EventKind.DOWN not in it.rig.kinds
        assert it.missed <= 1
        stamps = [sample.t_ns for sample in it.rig.samples]
        assert stamps == sorted(set(stamps))


@in_bench
async def test_a_missing_line_causes_reads_at_deadlines(bench: PolledBusBench) -> None:
    bench.lines.input(ReadyOptions(line="Y"), "imu data_ready", True).open_error = LinkMissing("no such line")
    async with scene(bench) as it:
        await it.rig.until(it.told("line data_ready: no such line"), "told")
        await it.rig.until(it.told("no edges"), "told")
        await it.rig.until_samples(20)
        status = it.rig.device.status()
        assert status.lines is not None
        assert status.lines.problems == {"data_ready": "no such line"}
        it.signal.line.open_error = None
        await it.rig.until(it.told("edges have returned"), "told")
        await it.rig.until_samples(20)
        it.dated(it.rig.samples[-1])


@in_bench
async def test_edges_before_the_identification_are_not_missed(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.device.faults.line = 0xFF
        await it.rig.until(lambda: EventKind.DOWN in it.rig.kinds, "down")
        await asyncio.sleep(0.5)
        it.device.faults.line = None
        await it.rig.until_samples(20)
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        assert max(b - a for a, b in pairwise(numbers)) > 200
        assert it.missed == 0


class DescriptorLine(MemoryInput):
    def fileno(self) -> int:
        return 77 if self.is_open else -1


class WatchingMember:
    def __init__(self) -> None:
        self.watched: dict[int, Callable[[], None]] = {}
        self.noted = self.commands = 0

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        if fd < 0:
            return False
        assert not self.watched
        self.watched[fd] = callback
        return True

    def unwatch(self, fd: int) -> None:
        del self.watched[fd]

    def start(self, _polls: object, schedule: ReadySchedule) -> None:
        self.schedule = schedule

    def note(self, command: Callable[[], None]) -> None:
        self.noted += 1
        command()

    def command(self, command: Callable[[], None]) -> None:
        self.commands += 1
        command()


@in_loop
async def test_the_thread_watches_an_open_line_during_reads() -> None:
    line, clock, member, told = DescriptorLine(), VirtualClock(), WatchingMember(), list[str]()
    device_events: Any = SimpleNamespace(raise_event=lambda _t, _kind, message, **_detail: told.append(message))
    maker = LineFactory(lambda *_: line, lambda *_: MemoryOutput())
    ready = DataReady("imu", ReadyOptions(line="Y"), maker, RATE_HZ, device_events, HostClock(clock.now_ns))
    some: Any = member
    line.open_error = LinkMissing("not there")
    ready.read(some, (), Deadlines(), clock.now_ns())
    assert not member.watched
    line.open_error = None
    clock.advance(10 * NS_PER_S)
    ready.tick(clock.now_ns(), None)
    assert set(member.watched) == {77}
    clock.advance(EVERY_NS)
    member.schedule.begun(clock.now_ns())
    member.schedule.done(clock.now_ns())
    clock.advance(EVERY_NS)
    member.watched[77]()
    assert member.schedule.due_ns == clock.now_ns()
    line.edge(clock.now_ns(), True)
    clock.advance(1000)
    member.schedule.begun(clock.now_ns())
    ready.drain()
    assert (member.noted, member.commands) == (1, 0)  # a read already covers it
    line.edge(clock.now_ns() + 1, True)
    ready.drain()
    assert (member.noted, member.commands) == (1, 1)
    line.vanish(LinkMissing("pulled out"))
    assert not member.watched
    clock.advance(10 * NS_PER_S)
    ready.tick(clock.now_ns(), None)
    assert set(member.watched) == {77}
    ready.stop()
    assert not member.watched
    ready.read(some, (), Deadlines(), clock.now_ns())
    assert set(member.watched) == {77}
    ready.close()
    assert not member.watched
    assert len(told) == 4
