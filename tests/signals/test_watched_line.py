"""A line that is kept open: opened when due, its troubles told once, its level asked for when it may have changed."""

import asyncio

import pytest

from imud.contracts.lines import Edge
from imud.errors import LinkBusy, LinkError, LinkMissing
from imud.signals.watched_line import RETRY_NS, WatchedLine
from imud.sim.ports.lines import MemoryInput
from tests.support.in_loop import in_loop
from tests.support.virtual_time import VirtualClock

BUSY = LinkBusy("gpiochip0 line 3 is in use by gpiomon: stop that")


class Bench:
    """One watched line and everything it tells."""

    def __init__(self, line: MemoryInput | None = None) -> None:
        self.line = line or MemoryInput()
        self.edges: list[Edge] = []
        self.levels: list[bool | None] = []
        self.told: list[str] = []
        self.watched = WatchedLine(self.line, self.edges.extend, self.levels.append, self.told.append)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    made = VirtualClock()
    made.stand_for_monotonic(monkeypatch, "imud.signals.watched_line")
    return made


@in_loop
async def test_it_is_opened_at_once_and_its_level_told() -> None:
    bench = Bench()
    bench.watched.drain()  # before it is open there is nothing
    bench.watched.tick(0)
    assert bench.line.is_open
    assert bench.levels == [False]
    bench.line.edge(10, True)
    bench.watched.drain()
    bench.line.edge(20, False)
    await asyncio.sleep(0)
    assert bench.edges == [Edge(10, True, 1), Edge(20, False, 2)]
    assert (bench.watched.edges, bench.told, bench.watched.problem) == (2, [], "")
    bench.watched.tick(1)
    assert bench.levels == [False]  # edges say the rest


@in_loop
async def test_a_line_that_cannot_be_had_is_told_once_and_tried_again() -> None:
    bench = Bench()
    bench.line.open_error = BUSY
    bench.watched.tick(0)
    bench.watched.tick(RETRY_NS - 1)
    assert bench.told == [str(BUSY)]
    bench.watched.tick(RETRY_NS)
    assert bench.told == [str(BUSY)]
    bench.line.open_error = LinkMissing("gpiochip0 is not there")
    bench.watched.tick(2 * RETRY_NS)
    assert bench.told[1:] == ["gpiochip0 is not there"]
    assert bench.watched.problem == "gpiochip0 is not there"
    bench.line.open_error = None
    bench.watched.tick(3 * RETRY_NS - 1)
    assert not bench.line.is_open
    bench.watched.tick(3 * RETRY_NS)
    assert bench.line.is_open
    assert bench.watched.problem == ""
    assert bench.told[2:] == ["watched again"]
    assert bench.levels == [False]


@in_loop
async def test_a_line_that_goes_is_nobodys_level_and_comes_back(clock: VirtualClock) -> None:
    bench = Bench()
    bench.watched.tick(clock.now_ns())
    bench.line.edge(5, True)
    bench.line.vanish(LinkMissing("it was pulled out"))
    assert bench.levels == [False, None]
    assert bench.told == ["it was pulled out"]
    bench.watched.tick(clock.now_ns() + RETRY_NS - 1)
    assert not bench.line.is_open
    bench.watched.tick(clock.now_ns() + RETRY_NS)
    assert bench.levels == [False, None, True]
    bench.line.edge(30, False)
    bench.watched.drain()
    assert bench.edges == [Edge(30, False, 2)]  # numbers go on; the one that was not delivered shows


@in_loop
async def test_after_lost_edges_the_level_is_asked_once() -> None:
    bench = Bench()
    bench.watched.tick(0)
    bench.line.edge(5, True)
    bench.line.lose(3)
    bench.watched.tick(1)
    bench.watched.tick(2)
    assert bench.levels == [False, True]


class Blind(MemoryInput):
    """Its level cannot be read."""

    def level(self) -> bool:
        raise LinkError("no level")


@in_loop
async def test_a_level_that_cannot_be_read_ends_it(clock: VirtualClock) -> None:
    bench = Bench(Blind())
    bench.watched.tick(clock.now_ns())
    assert not bench.line.is_open
    assert bench.watched.problem == "no level"
    assert bench.levels == [None]


@in_loop
async def test_closing_is_no_trouble_and_the_next_look_opens_again() -> None:
    bench = Bench()
    bench.watched.tick(0)
    bench.watched.close()
    bench.watched.close()
    assert not bench.line.is_open
    assert bench.told == []
    bench.watched.tick(1)
    assert bench.line.is_open
