"""Holds of a CAN link, on a socket of another family with the same reads, time stamps and event loop."""

import asyncio
import errno
import os
import socket
from collections.abc import Callable, Coroutine, Iterator, Sequence
from pathlib import Path

import pytest

from imud.formats.can import CanFrame, pack_frame
from imud.links import netlink
from imud.links.socketcan import BATCH_FRAMES, FrameReader, SocketCanLink, SocketCanOptions
from imud.model.errors import LinkError, LinkMissing
from tests.support.daemon_process import LIMIT_S

GATHER_MS = 10  # hold of frames

Ends = tuple[socket.socket, socket.socket, Path]


class Bus:
    """A link with a loopback socket, the delivered frames, and the times of its timers."""

    def __init__(self, ends: Ends, gather_ms: int) -> None:
        receiver, sender, sys = ends
        settings = SocketCanOptions(interface="lo")
        self.link = SocketCanLink(settings, sys=sys, open_socket=lambda _settings, _filters: receiver.dup())
        self.link.gather_ns = gather_ms * 1_000_000
        self.batches: list[list[CanFrame]] = []
        self.ends: list[LinkError | None] = []
        self.delays_s: list[float] = []
        """Delays of the started timers, s."""
        self.looks = 0
        """Number of ended timers of the link."""
        self.by_timer: list[bool] = []
        """True for each batch that a timer read."""
        self.then: Callable[[], None] = lambda: None
        """Function that runs once, directly after the next delivery."""
        self._sender = sender
        self._news = asyncio.Event()
        self._looking = False
        self._failures: list[dict[str, object]] = []

    def send(self, *can_ids: int) -> None:
        for can_id in can_ids:
            self._sender.send(pack_frame(can_id, False, b"\1"))

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait for deliveries until the condition is true."""

        async def wait() -> None:
            while not condition():
                self._news.clear()
                await self._news.wait()

        await asyncio.wait_for(wait(), LIMIT_S)

    def run(self, story: Callable[["Bus"], Coroutine[None, None, None]]) -> None:

        async def play() -> None:
            loop = asyncio.get_running_loop()
            call_later = loop.call_later

            def noted(delay_s: float, call: Callable[..., object], *arguments: object) -> asyncio.TimerHandle:
                if getattr(call, "__self__", None) is not self.link:
                    return call_later(delay_s, call, *arguments)
                self.delays_s.append(delay_s)
                return call_later(delay_s, self._run_timer, call)

            loop.set_exception_handler(lambda _loop, context: self._failures.append(context))
            loop.call_later = noted  # type: ignore[assignment]
            self.link.open()
            self.link.start(self._on_frames, lambda news, problem: None, self.ends.append)
            await story(self)
            self.link.close()

        asyncio.run(play())
        assert self._failures == []

    def _run_timer(self, call: Callable[[], object]) -> None:
        self._looking = True
        call()
        self._looking = False
        self.looks += 1
        self._news.set()

    def _on_frames(self, frames: Sequence[CanFrame]) -> None:
        self.batches.append(list(frames))
        self.by_timer.append(self._looking)
        then, self.then = self.then, lambda: None
        then()
        self._news.set()


@pytest.fixture
def ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ends]:
    monkeypatch.setattr(netlink, "can_details", lambda name: netlink.CanDetails(None, None))
    interface = tmp_path / "class/net/lo"
    interface.mkdir(parents=True)
    (interface / "type").write_text(f"{netlink.ARPHRD_CAN}\n")
    (interface / "flags").write_text(f"{netlink.IFF_UP:#x}\n")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        sender.connect(receiver.getsockname())
        yield receiver, sender, tmp_path


def test_a_link_waits_for_its_interface(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[bool] = []

    async def wait_until(holds: Callable[[], bool]) -> None:
        found.append(holds())

    monkeypatch.setattr(netlink, "wait_until", wait_until)
    for flags in (netlink.IFF_UP, 0):
        (ends[2] / "class/net/lo/flags").write_text(f"{flags:#x}\n")
        asyncio.run(Bus(ends, 0).link.wait_present())
    assert found == [True, False]


def test_frames_gather(ends: Ends) -> None:

    async def story(bus: Bus) -> None:
        bus.then = lambda: bus.send(2, 3, 4)
        bus.send(1)
        await bus.until(lambda: len(bus.batches) == 2)

    bus = Bus(ends, GATHER_MS)
    bus.run(story)
    assert [[frame.can_id for frame in batch] for batch in bus.batches] == [[1], [2, 3, 4]]
    assert (bus.delays_s, bus.by_timer) == ([GATHER_MS / 1000] * 2, [False, True])


def test_what_is_more_than_a_batch_is_read_at_once(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        bus.then = lambda: bus.send(*range(2 * BATCH_FRAMES + 5))
        bus.send(0x700)
        await bus.until(lambda: len(bus.batches) == 4)

    bus = Bus(ends, GATHER_MS)
    bus.run(story)
    assert [len(batch) for batch in bus.batches] == [1, BATCH_FRAMES, BATCH_FRAMES, 5]
    assert bus.delays_s == [GATHER_MS / 1000] * 2


def test_a_bus_that_fell_silent_is_watched_again(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        for number in range(1, 4):
            bus.then = lambda: bus.send(0x100)
            bus.send(number)
            await bus.until(lambda: bus.looks == 2 * number)  # noqa: B023 - called before the number changes
            assert len(bus.delays_s) == 2 * number  # no timer runs while no frame arrives

    bus = Bus(ends, 1)
    bus.run(story)
    assert [[frame.can_id for frame in batch] for batch in bus.batches] == [[1], [0x100], [2], [0x100], [3], [0x100]]
    assert bus.by_timer == [False, True] * 3


def test_without_it_every_frame_is_read_as_it_comes(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        for number in range(3):
            bus.send(number)
            await bus.until(lambda: len(bus.batches) == number + 1)  # noqa: B023 - as above

    bus = Bus(ends, 0)
    bus.run(story)
    assert [len(batch) for batch in bus.batches] == [1, 1, 1]
    assert bus.delays_s == []


@pytest.mark.parametrize("at", ["delivery", "pause"])
def test_closed_while_frames_gather(ends: Ends, at: str) -> None:

    async def story(bus: Bus) -> None:
        if at == "delivery":
            bus.then = bus.link.close
        bus.send(1)
        await bus.until(lambda: bus.batches)
        bus.send(2)
        bus.link.close()
        await asyncio.sleep(0.005)

    bus = Bus(ends, 1)
    bus.run(story)
    assert [frame.can_id for batch in bus.batches for frame in batch] == [1]
    assert bus.looks == 0
    assert len(bus.delays_s) == (at == "pause")


def test_a_bus_that_ends_in_the_pause_says_so_once(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    class Reader(FrameReader):
        down = False

        def read(self) -> list[CanFrame]:
            if Reader.down:
                raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
            return super().read()

    async def story(bus: Bus) -> None:
        bus.send(1)
        await bus.until(lambda: bus.batches)
        Reader.down = True
        bus.send(2)  # the link must not watch the socket any longer
        await bus.until(lambda: bus.ends)
        await asyncio.sleep(0.005)

    monkeypatch.setattr("imud.links.socketcan.FrameReader", Reader)
    bus = Bus(ends, 1)
    bus.run(story)
    (ended,) = bus.ends
    assert isinstance(ended, LinkMissing)
    assert bus.looks == 1
    assert len(bus.delays_s) == 1


def test_what_gathers_is_read_when_nothing_may_wait_any_more(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        bus.then = lambda: bus.send(2)
        bus.send(1)
        await bus.until(lambda: bus.batches)
        bus.link.gather_ns = 0
        assert [[frame.can_id for frame in batch] for batch in bus.batches] == [[1], [2]]
        bus.send(3)
        await bus.until(lambda: len(bus.batches) == 3)

    bus = Bus(ends, GATHER_MS)
    bus.run(story)
    assert bus.looks == 0
    assert len(bus.delays_s) == 1


def test_no_more_gathers_than_half_the_buffer_holds(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        room = ends[0].getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 960
        assert bus.link.gather_ns == room // 2 * 95_000  # frames of 95 bits at 1 Mbit/s

    Bus(ends, 60_000).run(story)
