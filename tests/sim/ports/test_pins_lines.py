"""Lines in memory fulfill the contract of real lines."""

from collections.abc import Sequence

import pytest

from imud.contracts.lines import Edge, InputLine, InputOptions, OutputLine, OutputOptions
from imud.model.errors import LinkBusy, LinkError, LinkMissing
from imud.sim.ports.pins import MemoryInput, MemoryLines, MemoryOutput
from tests.support.event_loops import in_loop


def test_lines_and_levels() -> None:
    lines: tuple[InputLine, OutputLine] = (MemoryInput(), MemoryOutput())
    assert [line.title for line in lines] == ["memory line", "memory line"]

    line = MemoryInput("bow alarm")
    line.edge(1, True)
    with pytest.raises(LinkError, match="bow alarm is not open"):
        line.level()
    line.open()
    assert line.level()
    line.edge(2, False)
    assert not line.level()

    for busy in (MemoryInput(), MemoryOutput()):
        busy.open_error = LinkBusy("gpiomon has it")
        with pytest.raises(LinkBusy):
            busy.open()
        assert not busy.is_open

    memory = MemoryLines(now_ns=lambda: 5)
    made = memory.maker.make_input(InputOptions(line="A"), "bow sout", True)
    assert made is memory.inputs["bow sout"]
    assert memory.maker.make_input(InputOptions(line="A"), "bow sout", True) is made
    output = memory.maker.make_output(OutputOptions(line="B"), "bow sin")
    output.open()
    output.set(True)
    assert memory.outputs["bow sin"].history == [(5, True)]


@in_loop
async def test_edges() -> None:
    line, found, calls = MemoryInput(), list[Edge](), list[int]()

    def on_edges(edges: Sequence[Edge]) -> None:
        found.extend(edges)
        calls.append(len(edges))

    line.edge(1, True)  # no program has requested the line
    line.open()
    line.edge(10, False)
    line.drain()
    assert found == []
    line.start(on_edges, lambda _error: None)
    line.pulse(20, 80_000)
    line.drain()
    assert found == [Edge(10, False, 1), Edge(20, True, 2), Edge(80_020, False, 3)]
    line.lose(2)
    line.edge(30, True)
    line.edge(40, False)
    await _rounds()
    assert found[3:] == [Edge(30, True, 6), Edge(40, False, 7)]
    assert (calls, line.edges_lost) == ([3, 2], 2)
    line.edge(50, True)
    line.close()
    line.close()
    await _rounds()
    line.drain()
    assert len(found) == 5


@in_loop
async def test_edges_before_start_come_with_the_next_round() -> None:
    line, found = MemoryInput(), list[Edge]()
    line.open()
    line.edge(10, True)
    line.start(found.extend, lambda _error: None)
    await _rounds()
    assert found == [Edge(10, True, 1)]


@in_loop
async def test_the_end() -> None:
    line, ends = MemoryInput(), list[LinkError]()
    line.open()
    line.start(lambda _edges: None, ends.append)
    gone = LinkMissing("pulled out")
    line.vanish(gone)
    line.vanish(gone)
    assert ends == [gone]
    assert not line.is_open


def test_output() -> None:
    times = iter(range(100, 200))
    seen: list[tuple[int, bool]] = []
    line = MemoryOutput(now_ns=lambda: next(times), on_change=lambda t_ns, active: seen.append((t_ns, active)))
    with pytest.raises(LinkError, match="not open"):
        line.set(True)
    line.open()
    line.set(True)
    line.set(True)
    line.set(False)
    line.set(True)
    line.close()
    line.close()
    assert line.history == seen == [(100, True), (101, False), (102, True), (103, False)]
    line.open()
    line.set_error = LinkMissing("gone")
    with pytest.raises(LinkMissing):
        line.set(True)
    assert not line.active


async def _rounds() -> None:
    import asyncio

    for _ in range(3):
        await asyncio.sleep(0)
