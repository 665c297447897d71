"""Lines of one device: the edges and their order, failures, and the release of all lines."""

import asyncio
from collections.abc import Sequence

import pytest

from imud.contracts import lines as contract
from imud.contracts.lines import DeviceLines, DividedOptions, Edge, InputOptions, SoutOptions
from imud.lines.sync import LineVerbs, SyncSignals
from imud.model.errors import BadArgument, CommandError, LinkBusy, LinkError
from imud.model.event import EventKind
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from tests.support.event_loops import in_loop
from tests.support.signal_bench import DEVICE, SignalBench

RETRY_NS = 5 * 10**9
ALARM_STATUS = 1 << 31  # docs/lines.md

ALL = DeviceLines(
    sout=SoutOptions(line="A"), sout_div=DividedOptions(line="B"), pps=contract.PpsOptions(line="C"),
    alarm=InputOptions(line="D"), sin=contract.TriggerOptions(line="E", rate_hz=0, pulse_ms=2),
)  # fmt: skip


class SyncBench(SignalBench):
    def __init__(self, lines: DeviceLines = ALL) -> None:
        super().__init__()
        self.pulses: list[Edge] = []
        self.signals = SyncSignals(DEVICE, lines, self.factory, self.raise_event, self.clock.host, self)
        self.sample_clock = sample_clock()

    def on_pulses(self, edges: Sequence[Edge]) -> None:
        self.pulses += edges

    def start(self) -> None:
        self.signals.start(self.sample_clock)

    def tick(self, ahead_ns: int = 0) -> None:
        self.clock.advance(ahead_ns)
        self.signals.tick(self.clock.now_ns(), None)

    def status_of_sample(self, own: int | None) -> int | None:
        now_ns = self.clock.now_ns()
        return self.sample_clock.sample(Measurement(82, 0, now_ns // NS_PER_MS, status=own), now_ns, 0).status


def sample_clock() -> SampleClock:
    return SampleClock(DEVICE, tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)


@in_loop
async def test_lines_are_watched_before_there_is_a_clock_and_delivered_to_it_afterwards() -> None:
    bench = SyncBench()
    assert not any(line.is_open for line in bench.memory.inputs.values())
    bench.tick()
    assert all(line.is_open for line in bench.memory.inputs.values())
    assert not bench.output("sin").is_open
    bench.input("sout").pulse(bench.clock.now_ns(), 80_000)
    bench.signals.drain()
    assert bench.sample_clock.status().edges == 0
    bench.start()
    assert bench.output("sin").is_open
    for key in ("sout", "sout_div", "pps"):
        bench.input(key).pulse(bench.clock.now_ns(), 80_000)
    assert bench.sample_clock.status().edges == 0
    bench.signals.drain()  # now, before the next turn of the event loop
    assert bench.sample_clock.status().edges == 1
    assert [edge.rising for edge in bench.pulses] == [True]  # imud does not request falling edges
    status = bench.signals.status()
    assert status.edges == {"sout": 2, "sout_div": 1, "pps": 1, "alarm": 0}
    assert status.edges_lost == {"sout": 0, "sout_div": 0, "pps": 0, "alarm": 0}
    bench.input("pps").lose(4)
    assert bench.signals.status().edges_lost["pps"] == 4
    bench.signals.close()


@in_loop
async def test_the_alarm_is_in_the_samples_of_each_clock() -> None:
    bench = SyncBench(DeviceLines(alarm=InputOptions(line="D")))
    bench.start()
    assert bench.status_of_sample(None) is None
    assert bench.status_of_sample(5) == 5
    bench.input("alarm").edge(bench.clock.now_ns(), True)
    bench.input("alarm").drain()
    assert bench.status_of_sample(None) == ALARM_STATUS
    assert bench.status_of_sample(5) == ALARM_STATUS | 5
    bench.sample_clock = sample_clock()
    bench.start()
    assert bench.status_of_sample(5) == ALARM_STATUS | 5
    bench.input("alarm").edge(bench.clock.now_ns(), False)
    bench.input("alarm").drain()
    assert bench.status_of_sample(5) == 5
    bench.input("alarm").edge(bench.clock.now_ns(), True)
    bench.input("alarm").drain()
    bench.input("alarm").vanish(LinkError("gone"))
    assert bench.status_of_sample(5) == 5
    status = bench.signals.status()
    assert (status.alarm, status.alarms, status.problems) == (None, 2, {"alarm": "gone"})
    assert bench.messages(EventKind.LINK) == ["line alarm: gone"]
    bench.signals.close()


@in_loop
async def test_one_edge_by_command_where_there_is_sin() -> None:
    bench = SyncBench()
    assert bench.signals.can_trigger
    verbs = LineVerbs(None, bench.signals)
    assert [*verbs.rows] == [contract.TRIGGER_VERB]
    with pytest.raises(CommandError, match="trigger: bow sin is not driven"):
        await verbs.run(contract.TRIGGER_VERB, {})
    bench.start()
    with pytest.raises(BadArgument, match="pulse_ms"):
        await verbs.run(contract.TRIGGER_VERB, {"pulse_ms": 1})
    await verbs.run(contract.TRIGGER_VERB, {})
    (worker,) = bench.workers
    worker.work()
    for _ in range(2):
        assert bench.output("sin").active
        bench.clock.advance(NS_PER_MS)
        worker.work()
    history = bench.output("sin").history
    assert [level for _, level in history] == [True, False]
    assert history[1][0] - history[0][0] == 2 * NS_PER_MS  # pulse_ms
    bench.signals.drain()
    status = bench.signals.status()
    assert (status.sin, status.triggers, bench.sample_clock.status().edges) == (True, 1, 1)
    bench.signals.close()
    assert not bench.output("sin").is_open
    bench = SyncBench(DeviceLines(sout=SoutOptions(line="A")))
    assert not bench.signals.can_trigger
    assert not LineVerbs(None, bench.signals).rows
    assert not LineVerbs(None, None).rows
    with pytest.raises(CommandError, match=r"expected the key lines\.sin"):
        bench.signals.trigger_once()
    assert bench.signals.status().sin is False


@in_loop
async def test_sin_that_fails_is_reported_once_and_opened_again() -> None:
    bench = SyncBench()
    bench.output("sin").open_error = LinkBusy("line 5 is in use")
    bench.start()
    bench.tick(RETRY_NS - 1)
    bench.tick(RETRY_NS)
    assert bench.messages() == ["line sin: line 5 is in use"]
    assert bench.signals.status().problems == {"sin": "line 5 is in use"}
    bench.output("sin").open_error = None
    bench.tick(RETRY_NS)
    assert bench.signals.status().problems == {}
    bench.signals.trigger_once()
    bench.signals.close()
    bench = SyncBench()
    bench.start()
    output = bench.output("sin")
    output.set_error = LinkError("SIN is gone")
    bench.signals.trigger_once()
    bench.workers[0].work()
    await asyncio.sleep(0)
    assert bench.signals.status().problems == {"sin": "SIN is gone"}
    assert not output.is_open
    output.set_error = None
    bench.tick(RETRY_NS - 1)
    assert not output.is_open
    bench.tick(1)
    assert output.is_open
    assert bench.signals.status().problems == {}
    bench.signals.close()


@in_loop
async def test_at_the_end_of_the_link_sin_is_released_and_closed_lines_stay_closed() -> None:
    bench = SyncBench()
    bench.start()
    bench.signals.stop()
    assert not bench.output("sin").is_open
    assert bench.input("sout").is_open
    bench.input("sout").pulse(bench.clock.now_ns(), 80_000)
    bench.signals.drain()
    assert bench.sample_clock.status().edges == 0
    bench.tick(NS_PER_S)
    assert not bench.output("sin").is_open
    bench.start()
    assert bench.output("sin").is_open
    bench.signals.close()
    # After the end of a replay, `tick` still runs ten times per second
    bench = SyncBench()
    bench.start()
    bench.signals.close()
    bench.signals.close()
    bench.tick(RETRY_NS)
    assert not any(line.is_open for line in bench.memory.inputs.values())
    assert not bench.output("sin").is_open


@in_loop
async def test_marks_are_raised_with_their_samples() -> None:
    bench = SyncBench(DeviceLines(sout_div=DividedOptions(line="B")))
    bench.start()
    for i in range(60):
        bench.clock.advance(10 * NS_PER_MS)
        if i % 8 == 0:
            bench.input("sout_div").pulse(bench.clock.now_ns(), 80_000)
        bench.signals.drain()
        bench.clock.advance(100_000)
        bench.sample_clock.sample(Measurement(82, 0, bench.clock.now_ns() // NS_PER_MS), bench.clock.now_ns(), 0)
    bench.tick()
    marks = [event for event in bench.events if event.kind is EventKind.MARK]
    last = marks[-1]
    assert (last.detail["edge_seq"], last.detail["seq"]) == (8, 57)
    assert last.message == "pulse 8 on SOUT_DIV belongs to sample 57"
    bench.tick()
    assert len(bench.messages(EventKind.MARK)) == len(marks)
    bench.signals.close()
