"""The lines of one device one by one: who is told what and when, what fails, and that nothing is held afterwards."""

from collections.abc import Sequence

import pytest

from imud.clock import SampleClock
from imud.contracts.lines import (
    DeviceLines,
    DividedSettings,
    Edge,
    InputSettings,
    PpsSettings,
    SoutSettings,
    TriggerSettings,
)
from imud.errors import CommandError, LinkBusy, LinkError
from imud.event import Event, EventKind
from imud.ledger import Ledger
from imud.runtime.notices import Notices
from imud.sample import Measurement
from imud.signals import sync_signals as wires_module
from imud.signals.sync_signals import ALARM_STATUS, SyncSignals
from imud.signals.trigger import Trigger
from imud.signals.watched_line import RETRY_NS
from imud.sim.ports.lines import MemoryInput, MemoryLines
from imud.units import NS_PER_MS, NS_PER_S
from tests.support.in_loop import in_loop
from tests.support.virtual_time import LoopWorker, VirtualClock

ALL = DeviceLines(
    sout=SoutSettings(line="A"),
    sout_div=DividedSettings(line="B"),
    pps=PpsSettings(line="C"),
    alarm=InputSettings(line="D"),
    sin=TriggerSettings(line="E", rate_hz=0, pulse_ms=2),
)


class Bench:
    """SyncSignals, their far ends, and what they tell."""

    def __init__(self, lines: DeviceLines = ALL, clock: VirtualClock | None = None) -> None:
        self.time = clock or VirtualClock()
        self.memory = MemoryLines(self.time.now_ns)
        self.events: list[Event] = []
        self.pulses: list[Edge] = []
        notices = Notices("bow", Ledger(), self.events.append)
        self.wires = SyncSignals("bow", lines, self.memory.maker, notices.tell, self._on_pulses)
        self.clock = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)

    def _on_pulses(self, edges: Sequence[Edge]) -> None:
        self.pulses += edges

    def line(self, key: str) -> MemoryInput:
        return self.memory.inputs[f"bow {key}"]

    def start(self) -> None:
        self.wires.start(self.clock)

    def tick(self, ahead_ns: int = 0) -> None:
        self.time.advance(ahead_ns)
        self.wires.tick(self.time.now_ns())

    def status_of_sample(self, own: int | None) -> int | None:
        now_ns = self.time.now_ns()
        return self.clock.sample(Measurement(82, 0, now_ns // NS_PER_MS, status=own), now_ns, 0).status


@pytest.fixture(autouse=True)
def time(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    made = VirtualClock()
    made.stand_for_monotonic(monkeypatch, "imud.signals.sync_signals", "imud.signals.watched_line")

    def virtual(*arguments: object, **more: object) -> Trigger:
        return Trigger(*arguments, now_ns=made.now_ns, start_worker=LoopWorker, **more)  # type: ignore[arg-type]  # as given

    monkeypatch.setattr(wires_module, "Trigger", virtual)
    return made


@in_loop
async def test_lines_are_watched_before_there_is_a_clock_and_told_to_it_afterwards(time: VirtualClock) -> None:
    bench = Bench(clock=time)
    assert not any(line.is_open for line in bench.memory.inputs.values())
    bench.tick()
    assert all(line.is_open for line in bench.memory.inputs.values())
    assert not bench.memory.outputs["bow sin"].is_open
    bench.line("sout").pulse(time.now_ns(), 80_000)
    bench.wires.drain()
    assert bench.clock.status().edges == 0
    bench.start()
    assert bench.memory.outputs["bow sin"].is_open
    for key in ("sout", "sout_div", "pps"):
        bench.line(key).pulse(time.now_ns(), 80_000)
    assert bench.clock.status().edges == 0
    bench.wires.drain()  # now, not when the loop comes round
    assert bench.clock.status().edges == 1
    assert [edge.rising for edge in bench.pulses] == [True]  # the falling edges are not even asked for
    status = bench.wires.status()
    assert status.edges == {"sout": 2, "sout_div": 1, "pps": 1, "alarm": 0}
    assert status.edges_lost == {"sout": 0, "sout_div": 0, "pps": 0, "alarm": 0}
    bench.line("pps").lose(4)
    assert bench.wires.status().edges_lost["pps"] == 4
    bench.wires.stop()


@in_loop
async def test_the_alarm_is_in_the_samples_of_whatever_clock(time: VirtualClock) -> None:
    bench = Bench(DeviceLines(alarm=InputSettings(line="D")), time)
    bench.start()
    assert bench.status_of_sample(None) is None
    assert bench.status_of_sample(5) == 5
    bench.line("alarm").edge(time.now_ns(), True)
    bench.line("alarm").drain()
    assert bench.status_of_sample(None) == ALARM_STATUS
    assert bench.status_of_sample(5) == ALARM_STATUS | 5
    bench.clock = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)
    bench.start()
    assert bench.status_of_sample(5) == ALARM_STATUS | 5
    bench.line("alarm").edge(time.now_ns(), False)
    bench.line("alarm").drain()
    assert bench.status_of_sample(5) == 5
    bench.line("alarm").edge(time.now_ns(), True)
    bench.line("alarm").drain()
    bench.line("alarm").vanish(LinkError("gone"))
    assert bench.status_of_sample(5) == 5
    status = bench.wires.status()
    assert (status.alarm, status.alarms, status.problems) == (None, 2, {"alarm": "gone"})
    assert [event.message for event in bench.events if event.kind is EventKind.LINK] == ["line alarm: gone"]
    bench.wires.stop()


@in_loop
async def test_one_edge_by_command(time: VirtualClock) -> None:
    bench = Bench(clock=time)
    assert bench.wires.can_trigger
    with pytest.raises(CommandError, match="trigger: bow sin is not driven"):
        bench.wires.trigger_once()
    bench.start()
    bench.wires.trigger_once()
    worker = bench.wires._trigger
    assert worker is not None
    worker._round()
    for _ in range(2):
        assert bench.memory.outputs["bow sin"].active
        time.advance(NS_PER_MS)
        worker._round()
    history = bench.memory.outputs["bow sin"].history
    assert [level for _, level in history] == [True, False]
    assert history[1][0] - history[0][0] == 2 * NS_PER_MS  # pulse_ms
    bench.wires.drain()
    status = bench.wires.status()
    assert (status.sin, status.triggers, bench.clock.status().edges) == (True, 1, 1)
    bench.wires.stop()
    assert not bench.memory.outputs["bow sin"].is_open


@in_loop
async def test_without_sin_there_is_nothing_to_trigger(time: VirtualClock) -> None:
    bench = Bench(DeviceLines(sout=SoutSettings(line="A")), time)
    assert not bench.wires.can_trigger
    with pytest.raises(CommandError, match="expected the key sin"):
        bench.wires.trigger_once()
    assert bench.wires.status().sin is False


@in_loop
async def test_sin_that_cannot_be_had_is_told_once_and_tried_again(time: VirtualClock) -> None:
    bench = Bench(clock=time)
    output = bench.memory.maker.make_output(ALL.sin, "bow sin")
    assert output is bench.memory.outputs["bow sin"]
    bench.memory.outputs["bow sin"].open_error = LinkBusy("line 5 is in use")
    bench.start()
    bench.tick(RETRY_NS - 1)
    bench.tick(RETRY_NS)
    assert [event.message for event in bench.events] == ["line sin: line 5 is in use"]
    assert bench.wires.status().problems == {"sin": "line 5 is in use"}
    bench.memory.outputs["bow sin"].open_error = None
    bench.tick(RETRY_NS)
    assert bench.wires.status().problems == {}
    bench.wires.trigger_once()
    bench.wires.stop()


@in_loop
async def test_sin_that_breaks_while_driven_is_driven_again(time: VirtualClock) -> None:
    bench = Bench(clock=time)
    bench.start()
    output = bench.memory.outputs["bow sin"]
    output.set_error = LinkError("SIN is gone")
    bench.wires.trigger_once()
    trigger = bench.wires._trigger
    assert trigger is not None
    trigger._round()
    trigger._end()
    assert bench.wires.status().problems == {"sin": "SIN is gone"}
    assert not output.is_open
    output.set_error = None
    bench.tick(RETRY_NS - 1)
    assert not output.is_open
    bench.tick(1)
    assert output.is_open
    assert bench.wires.status().problems == {}
    bench.wires.stop()


@in_loop
async def test_at_the_end_of_the_link_sin_rests_and_edges_are_for_nobody(time: VirtualClock) -> None:
    bench = Bench(clock=time)
    bench.start()
    bench.wires.rest()
    assert not bench.memory.outputs["bow sin"].is_open
    assert bench.line("sout").is_open
    bench.line("sout").pulse(time.now_ns(), 80_000)
    bench.wires.drain()
    assert bench.clock.status().edges == 0
    bench.tick(NS_PER_S)
    assert not bench.memory.outputs["bow sin"].is_open
    bench.start()
    assert bench.memory.outputs["bow sin"].is_open
    bench.wires.stop()


@in_loop
async def test_what_was_stopped_stays_stopped(time: VirtualClock) -> None:
    """A replay that came to its end is looked at ten times a second as before."""
    bench = Bench(clock=time)
    bench.start()
    bench.wires.stop()
    bench.wires.stop()
    bench.tick(RETRY_NS)
    assert not any(line.is_open for line in bench.memory.inputs.values())
    assert not bench.memory.outputs["bow sin"].is_open


@in_loop
async def test_marks_are_told_with_their_samples(time: VirtualClock) -> None:
    bench = Bench(DeviceLines(sout_div=DividedSettings(line="B")), time)
    bench.start()
    for i in range(60):
        time.advance(10 * NS_PER_MS)
        if i % 8 == 0:
            bench.line("sout_div").pulse(time.now_ns(), 80_000)
        bench.wires.drain()
        time.advance(100_000)
        bench.clock.sample(Measurement(82, 0, time.now_ns() // NS_PER_MS), time.now_ns(), 0)
    bench.tick()
    marks = [event for event in bench.events if event.kind is EventKind.MARK]
    last = marks[-1]
    assert last.detail["edge_seq"] == 8
    assert last.detail["seq"] == 57
    assert last.message == "pulse 8 on SOUT_DIV belongs to sample 57"
    bench.tick()
    assert len([event for event in bench.events if event.kind is EventKind.MARK]) == len(marks)
    bench.wires.stop()
