"""The memory link, which only tests use."""

import asyncio

import msgspec
import pytest

from imud.contracts.link import StreamLink
from imud.contracts.status import KernelCounters
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.links import LINKS
from imud.links.memory import MemoryCanLink, MemoryLink, MemoryOptions
from imud.model.errors import LinkBusy, LinkError, LinkMissing
from tests.support.event_loops import in_loop


class Listener:
    def __init__(self) -> None:
        self.chunks: list[tuple[bytes, int]] = []
        self.ends: list[LinkError | None] = []

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        self.chunks.append((data, t_rx_ns))

    def on_end(self, error: LinkError | None) -> None:
        self.ends.append(error)


def opened() -> tuple[MemoryLink, Listener]:
    link, listener = MemoryLink(MemoryOptions()), Listener()
    link.open()
    link.start(listener.on_data, listener.on_end)
    return link, listener


def test_what_is_fed_arrives_with_its_time() -> None:
    link, listener = opened()
    assert link.feed(b"a", 5)
    assert listener.chunks == [(b"a", 5)]
    link.close()
    link.close()
    assert not link.feed(b"b", 6)
    assert (listener.chunks, listener.ends) == ([(b"a", 5)], [])
    link, listener = opened()
    link.pause()
    assert [link.feed(b"c", 7), link.feed(b"d", 8), link.take(), link.take()] == [True, True, b"cd", b""]
    assert listener.chunks == []
    link.write(b"LOG VERSION\r\n")
    link.set_baud(9600)
    assert (link.written, link.bauds, link.baud) == ([b"LOG VERSION\r\n"], [9600], 9600)
    link.counters = KernelCounters(overrun=3)
    assert link.kernel_counters().overrun == 3
    link.end(None)
    link.end(LinkError("late"))
    assert listener.ends == [None]
    assert not link.listening


def test_a_can_link_delivers_the_frames_that_pass_its_filters() -> None:
    link, passed, news = MemoryCanLink(MemoryOptions()), list[list[CanFrame]](), list[tuple[str, str]]()
    one, two = CanFrame(1, False, b"", 5), CanFrame(2, False, b"", 6)
    assert not link.feed([one])
    link.filters = [CanFilter(1, 0x7FF, False)]
    with pytest.raises(LinkError, match="and cannot send"):
        link.send_cyclic([])
    link.open()
    link.send_cyclic(cyclic := [CyclicFrame(1, False, b"", 1_000_000)])
    link.start(lambda frames: passed.append(list(frames)), lambda *told: news.append(told), lambda _error: None)
    assert link.feed([two, one])
    assert link.feed([two])
    link.news("bus off", "bus off")
    assert (passed, news, link.listening, link.cyclic) == ([[one]], [("bus off", "bus off")], True, cyclic)
    link.close()
    assert (link.is_open, link.listening, link.cyclic) == (False, False, ())


@in_loop
async def test_pulling_it_out_ends_it_until_it_appears() -> None:
    link, listener = opened()
    await link.wait_present()
    link.disappear()
    assert isinstance(listener.ends[0], LinkMissing)
    link.close()
    with pytest.raises(LinkMissing):
        link.open()
    waiting = asyncio.create_task(link.wait_present())
    await asyncio.sleep(0)
    assert not waiting.done()
    link.appear()
    await waiting
    link.open()


def test_misuse_is_an_error() -> None:
    link, _ = opened()
    with pytest.raises(LinkBusy):
        link.open()
    link.close()
    with pytest.raises(LinkError, match="and cannot send"):
        link.write(b"x")
    with pytest.raises(LinkError, match="cannot set its baud rate"):
        link.set_baud(9600)


def test_the_row() -> None:
    row = LINKS["memory"]
    link: StreamLink = row.make(msgspec.convert({"baud": "auto", "hold_ns": 7, "writable": False}, row.settings))
    assert (link.auto_baud, link.baud, link.hold_ns, link.writable) == (True, 0, 7, False)
