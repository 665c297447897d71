"""SIN: deadlines without drift, accurate time stamps, and skipped edges if the time is too short."""

import asyncio
from collections.abc import Sequence
from time import monotonic_ns

import pytest

from imud.contracts.lines import TriggerStamp
from imud.lines.trigger import SquareWave, Trigger, TriggerCounts
from imud.model.errors import LinkError, LinkMissing
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports.pins import MemoryOutput
from tests.support.event_loops import in_loop
from tests.support.signal_bench import SignalBench

IDLE_NS = 60 * 10**9
PULSE_NS = 1 * 10**6
STAMPS_MAX = 10_000

LIMIT_S = 60
CALL_NS = 2_000
"""Time of one clock reading in these tests, ns."""


class Time:
    """A clock that advances by CALL_NS with each reading, and by the steps of the test."""

    def __init__(self) -> None:
        self.t_ns = 1_000_000 * NS_PER_MS

    def __call__(self) -> int:
        self.t_ns += CALL_NS
        return self.t_ns


class SquareWaveBench:
    def __init__(self, rate_hz: float, pulse_ns: int = PULSE_NS) -> None:
        self.time = Time()
        self.line = MemoryOutput(now_ns=lambda: self.time.t_ns)
        self.line.open()
        self.counts = TriggerCounts()
        self.wave = SquareWave(self.line, rate_hz, self.counts, self.time, pulse_ns)
        self.begin_ns = self.time.t_ns

    def run(self, duration_ns: int, late_ns: int = 0) -> None:
        """Work like a thread that wakes up `late_ns` late."""
        end_ns = self.time.t_ns + duration_ns
        while self.time.t_ns < end_ns:
            rest_ns = self.wave.work()
            if rest_ns > 0:
                self.time.t_ns = min(self.time.t_ns + rest_ns + late_ns, end_ns)

    @property
    def rises_ns(self) -> list[int]:
        return [t_ns - self.begin_ns for t_ns, active in self.line.history if active]


def test_the_period_is_kept_without_drift_and_a_pulse_is_a_millisecond_or_half_a_period() -> None:
    bench = SquareWaveBench(300.0)
    bench.run(10 * NS_PER_S, late_ns=60_000)
    rises_ns = bench.rises_ns
    assert len(rises_ns) in (3000, 3001)
    assert all(0 <= t_ns - n * 3_333_333 <= 100_000 for n, t_ns in enumerate(rises_ns))
    assert (bench.counts.missed, bench.counts.singles, bench.counts.edges) == (0, 0, len(rises_ns))
    assert 60_000 <= bench.counts.mean_late_ns <= bench.counts.worst_late_ns <= 100_000

    for rate_hz, pulse_ns in ((1.0, NS_PER_MS), (400.0, NS_PER_MS), (1000.0, NS_PER_MS // 2)):
        bench = SquareWaveBench(rate_hz)
        bench.run(int(3 * NS_PER_S / rate_hz))
        history = bench.line.history
        widths_ns = [down - up for (up, _), (down, _) in zip(history[::2], history[1::2], strict=False)]
        assert len(widths_ns) >= 3
        assert all(pulse_ns <= width_ns < pulse_ns + 10 * CALL_NS for width_ns in widths_ns)


def test_stamps_are_numbered_and_each_is_the_middle_of_the_call() -> None:
    bench = SquareWaveBench(100.0)

    class Slow(MemoryOutput):
        def set(self, active: bool) -> None:
            bench.time.t_ns += 30_000
            super().set(active)
            bench.time.t_ns += 70_001

    line = Slow(now_ns=lambda: bench.time.t_ns)
    line.open()
    wave = SquareWave(line, 100.0, bench.counts, bench.time, PULSE_NS)
    wave.work()
    (stamp,) = wave.stamps
    ((edge_ns, _),) = line.history
    assert (stamp.number, stamp.err_ns) == (1, 51_001)
    assert stamp.t_ns - stamp.err_ns == edge_ns - 30_001
    assert stamp.t_ns + stamp.err_ns == edge_ns + 70_001 + CALL_NS
    bench = SquareWaveBench(100.0)
    bench.run(NS_PER_S)
    assert [stamp.number for stamp in bench.wave.stamps] == list(range(1, len(bench.rises_ns) + 1))
    assert [stamp.t_ns - CALL_NS // 2 - bench.begin_ns for stamp in bench.wave.stamps] == bench.rises_ns


@pytest.mark.parametrize("stall_ms", [7.0, 12.0, 25.0, 33.0, 1000.0])
def test_deadlines_that_cannot_be_kept_are_counted_and_the_grid_stays(stall_ms: float) -> None:
    """At 100 Hz, an edge may be up to 2.5 ms late."""
    bench = SquareWaveBench(100.0)
    bench.run(15 * NS_PER_MS)
    bench.time.t_ns += int(stall_ms * NS_PER_MS)
    bench.run(2 * NS_PER_S)
    counts = bench.counts
    assert counts.missed == (15 + stall_ms - 2.5) // 10 - 1
    rises_ns = bench.rises_ns
    slots = [round(t_ns / 1e7) for t_ns in rises_ns]
    assert all(-CALL_NS <= t_ns - slot * 1e7 <= 2.6e6 for t_ns, slot in zip(rises_ns, slots, strict=True))
    assert (slots, slots[-1] + 1) == (sorted(set(slots)), counts.edges + counts.missed)


def test_a_long_pulse_gets_its_pause_and_old_stamps_are_dropped() -> None:
    bench = SquareWaveBench(1000.0)
    bench.wave.work()
    bench.time.t_ns += 1_150_000  # sleeps longer than the next deadline
    bench.run(5 * NS_PER_MS)
    history = bench.line.history
    lows_ns = [up - down for (down, _), (up, _) in zip(history[1::2], history[2::2], strict=False)]
    assert min(lows_ns) >= 250_000
    assert bench.counts.missed == 1
    bench = SquareWaveBench(1000.0)
    bench.run((STAMPS_MAX + 50) * NS_PER_MS)
    assert len(bench.wave.stamps) == STAMPS_MAX
    assert bench.wave.stamps[-1].number == bench.counts.edges > STAMPS_MAX


def test_single_edges_without_a_rate_and_between_those_of_the_rate() -> None:
    bench = SquareWaveBench(0.0)
    assert bench.wave.work() > IDLE_NS - NS_PER_MS
    bench.wave.once()
    bench.wave.once()
    bench.run(10 * NS_PER_MS)
    first_ns, second_ns = bench.rises_ns
    assert second_ns - first_ns >= 2 * PULSE_NS
    assert (bench.counts.edges, bench.counts.singles, bench.counts.missed) == (2, 2, 0)
    assert bench.counts.mean_late_ns == 0
    bench = SquareWaveBench(10.0)
    bench.run(50 * NS_PER_MS)
    bench.time.t_ns = bench.begin_ns + 50 * NS_PER_MS
    bench.wave.once()
    bench.run(NS_PER_S)
    assert bench.rises_ns[1] == pytest.approx(50 * NS_PER_MS, abs=10 * CALL_NS)
    assert (bench.counts.singles, bench.counts.missed) == (1, 0)
    assert bench.counts.worst_late_ns < 10 * CALL_NS


class TriggerBench:
    def __init__(self, rate_hz: float) -> None:
        self.time = Time()
        self.line = MemoryOutput(now_ns=lambda: self.time.t_ns)
        self.line.open()
        signals = SignalBench()
        self.workers = signals.workers
        self.trigger = Trigger(self.line, rate_hz, self.time, start_worker=signals.workers.start)
        self.batches: list[Sequence[TriggerStamp]] = []
        self.ends: list[LinkError] = []

    def start(self) -> None:
        self.trigger.start(self.batches.append, self.ends.append)

    async def run(self, duration_ns: int) -> None:
        end_ns = self.time.t_ns + duration_ns
        while self.time.t_ns < end_ns:
            self.time.t_ns = min(self.time.t_ns + max(self.workers[-1].work(), 0), end_ns)
            await asyncio.sleep(0)
        await asyncio.sleep(0)


@in_loop
async def test_the_loop_is_woken_for_many_stamps_and_drain_delivers_at_once() -> None:
    rig = TriggerBench(200.0)
    rig.start()
    await rig.run(NS_PER_S)
    numbers = [stamp.number for batch in rig.batches for stamp in batch]
    assert numbers == list(range(1, len(numbers) + 1))
    assert 190 <= len(numbers) <= 201
    assert len(rig.batches) <= 21
    rig.trigger.stop()

    rig = TriggerBench(1.0)
    rig.trigger.drain()
    rig.start()
    rig.workers[0].work()
    assert rig.line.active
    rig.trigger.drain()
    rig.trigger.drain()
    assert [[stamp.number for stamp in batch] for batch in rig.batches] == [[1]]
    rig.trigger.stop()
    rig = TriggerBench(0.0)
    with pytest.raises(LinkError, match="is not driven"):
        rig.trigger.once()
    rig.start()
    for _ in range(2):
        rig.trigger.once()
        await rig.run(3 * NS_PER_MS)
    assert rig.workers[0].rung == 2
    assert [[stamp.number for stamp in batch] for batch in rig.batches] == [[1], [2]]


@in_loop
async def test_stop_leaves_the_line_inactive_and_delivers_the_rest() -> None:
    rig = TriggerBench(100.0)
    rig.start()
    rig.workers[0].work()
    assert rig.line.active
    rig.trigger.stop()
    rig.trigger.stop()
    assert rig.workers[0].ended
    assert not rig.line.active
    assert rig.line.is_open
    assert [len(batch) for batch in rig.batches] == [1]
    rig.start()
    rig.workers[1].work()
    rig.trigger.drain()
    assert rig.batches[-1][0].number == 2
    rig.trigger.stop()


@in_loop
async def test_an_unexpected_exception_reaches_the_event_loop() -> None:
    rig, found = TriggerBench(100.0), list[object]()
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: found.append(context["exception"]))
    rig.start()
    mistake = ValueError("by the test")
    rig.workers[0].failed(mistake)
    await asyncio.sleep(0)
    assert found == [mistake]
    rig.trigger.stop()


@in_loop
async def test_a_line_that_vanishes_ends_this_start_of_the_trigger_once() -> None:
    rig = TriggerBench(100.0)
    rig.start()
    await rig.run(15 * NS_PER_MS)
    gone = rig.line.set_error = LinkMissing("pulled out")
    rig.time.t_ns += 6 * NS_PER_MS
    assert [rig.workers[0].work() for _ in range(2)] == [IDLE_NS, IDLE_NS]
    with pytest.raises(LinkMissing):
        rig.trigger.once()
    for _ in range(3):
        await asyncio.sleep(0)
    assert rig.ends == [gone]
    assert rig.workers[0].ended
    rig.trigger.stop()
    rig = TriggerBench(100.0)
    rig.start()
    rig.line.set_error = LinkMissing("pulled out")
    rig.workers[0].work()
    rig.trigger.stop()
    rig.line.set_error = None
    rig.start()
    for _ in range(3):
        await asyncio.sleep(0)
    assert not rig.workers[1].ended
    assert rig.ends == []
    rig.trigger.stop()


@pytest.mark.live
@in_loop
async def test_on_a_real_thread() -> None:
    line, enough, found = MemoryOutput(now_ns=monotonic_ns), asyncio.Event(), list[TriggerStamp]()
    line.open()

    def on_stamps(stamps: Sequence[TriggerStamp]) -> None:
        found.extend(stamps)
        if len(found) >= 5:
            enough.set()

    trigger = Trigger(line, 200.0, monotonic_ns)
    trigger.start(on_stamps, lambda error: pytest.fail(str(error)))
    trigger.once()
    await asyncio.wait_for(enough.wait(), LIMIT_S)
    trigger.stop()
    rises_ns = [t_ns for t_ns, active in line.history if active]
    assert len(found) == len(rises_ns) == trigger.counts.edges
    for stamp, rise_ns in zip(found, rises_ns, strict=True):
        assert abs(stamp.t_ns - rise_ns) <= stamp.err_ns + 1
    assert trigger.counts.singles == 1
    assert not line.active
