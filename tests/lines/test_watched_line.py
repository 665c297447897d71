"""Input line that imud keeps open: due openings, failures reported once, and reads of the level."""

import asyncio
from collections.abc import Sequence

from imud.contracts.lines import Edge, InputOptions, OnEdges, OnLineEnd
from imud.lines.watched_line import WatchedLine, watching
from imud.model.errors import LinkBusy, LinkError, LinkMissing
from imud.sim.ports.pins import MemoryInput, MemoryLines
from tests.support.event_loops import VirtualClock, in_loop

RETRY_NS = 5 * 10**9

BUSY = LinkBusy("gpiochip0 line 3 is in use by gpiomon: stop it")


class Watched:
    def __init__(self, line: MemoryInput | None = None, *, watch: bool = True) -> None:
        self.clock = VirtualClock()
        self.line = line or MemoryInput()
        self.edges: list[Edge] = []
        self.levels: list[bool | None] = []
        self.reports: list[str] = []
        self.watched = WatchedLine(self.line, "sout", self, self.clock.host, watch=watch)

    def on_edges(self, _key: str, edges: Sequence[Edge]) -> None:
        self.edges += edges

    def on_level(self, _key: str, active: bool | None) -> None:
        self.levels.append(active)

    def on_line_report(self, _key: str, message: str) -> None:
        self.reports.append(message)


@in_loop
async def test_it_is_opened_at_once_its_level_is_read_after_lost_edges_and_the_tick_delivers() -> None:
    it = Watched()
    it.watched.drain()  # no edges before it is open
    it.watched.tick(0)
    assert it.line.is_open
    assert it.levels == [False]
    it.line.edge(10, True)
    it.watched.drain()
    it.line.edge(20, False)
    await asyncio.sleep(0)
    assert it.edges == [Edge(10, True, 1), Edge(20, False, 2)]
    assert (it.watched.edges, it.reports, it.watched.problem) == (2, [], "")
    it.watched.tick(1)
    assert it.levels == [False]  # edges show all later changes
    it = Watched()
    it.watched.tick(0)
    it.line.edge(5, True)
    it.line.lose(3)
    it.watched.tick(1)
    it.watched.tick(2)
    assert it.levels == [False, True]

    it = Watched(watch=False)
    it.watched.tick(0)
    it.line.edge(10, True)
    await asyncio.sleep(0)
    assert it.edges == []
    it.watched.tick(1)
    assert it.edges == [Edge(10, True, 1)]


@in_loop
async def test_a_line_that_fails_to_open_is_reported_once_and_opened_again() -> None:
    it = Watched()
    it.line.open_error = BUSY
    it.watched.tick(0)
    it.watched.tick(RETRY_NS - 1)
    assert it.reports == [str(BUSY)]
    it.watched.tick(RETRY_NS)
    assert it.reports == [str(BUSY)]
    it.line.open_error = LinkMissing("gpiochip0 is not there")
    it.watched.tick(2 * RETRY_NS)
    assert (it.reports[1:], it.watched.problem) == (["gpiochip0 is not there"], "gpiochip0 is not there")
    it.line.open_error = None
    it.watched.tick(3 * RETRY_NS - 1)
    assert not it.line.is_open
    it.watched.tick(3 * RETRY_NS)
    assert it.line.is_open
    assert (it.watched.problem, it.reports[2:], it.levels) == ("", ["watched again"], [False])


@in_loop
async def test_a_line_that_goes_has_no_level_and_comes_back() -> None:
    it = Watched()
    it.watched.tick(it.clock.now_ns())
    it.line.edge(5, True)
    it.line.vanish(LinkMissing("it was pulled out"))
    assert (it.levels, it.reports) == ([False, None], ["it was pulled out"])
    it.watched.tick(it.clock.now_ns() + RETRY_NS - 1)
    assert not it.line.is_open
    it.watched.tick(it.clock.now_ns() + RETRY_NS)
    assert it.levels == [False, None, True]
    it.line.edge(30, False)
    it.watched.drain()
    assert it.edges == [Edge(30, False, 2)]  # the numbers continue: a lost edge is visible


class Unstartable(MemoryInput):
    """A line that opens and then fails to start."""

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        raise LinkError("it does not start")


class Blind(MemoryInput):
    def level(self) -> bool:
        raise LinkError("no level")


@in_loop
async def test_a_line_that_cannot_start_or_whose_level_cannot_be_read_is_closed() -> None:
    it = Watched(Unstartable())
    for now_ns in (0, RETRY_NS):
        it.watched.tick(now_ns)
        assert not it.line.is_open
    assert (it.reports, it.levels) == (["it does not start"], [])

    it = Watched(Blind())
    it.watched.tick(it.clock.now_ns())
    assert not it.line.is_open
    assert (it.watched.problem, it.levels) == ("no level", [None])
    it = Watched()
    it.watched.tick(0)
    it.watched.close()
    it.watched.close()
    assert not it.line.is_open
    assert it.reports == []
    it.watched.tick(1)
    assert it.line.is_open


@in_loop
async def test_a_line_of_no_device_is_kept_open_by_its_settings() -> None:
    it = Watched()
    memory = MemoryLines(it.clock.now_ns)
    watched = watching(memory.maker, it.clock.host)(InputOptions(line="GPIO5"), "flight recorder", it)
    line = memory.inputs["flight recorder"]
    line.open_error = BUSY
    watched.tick(0)
    assert it.reports == [str(BUSY)]
    line.open_error = None
    watched.tick(RETRY_NS)
    line.pulse(10, 5)
    await asyncio.sleep(0)
    assert it.edges == [Edge(10, True, 1)]  # imud requests only rising edges
    watched.close()
    assert not line.is_open
