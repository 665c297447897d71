"""Holds of a CAN link, on a socket of another family with the same reads, time stamps and event loop. Network
interfaces: a file tree and prepared netlink replies. Cyclic sending by the kernel, and by a timer of the event loop."""

import asyncio
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from imud.contracts.status import KernelCounters
from imud.formats import kernel
from imud.formats.can import FD_LENGTHS, RAW_FD_FRAME, RAW_FRAME, CanFrame, CyclicFrame, pack_frame
from imud.host import netlink
from imud.host.netlink import CanDetails, absence, can_details, can_interfaces, parse_details, wait_until
from imud.links import socketcan
from imud.links.cyclic_sender import LoopSender, setup
from imud.links.socketcan import BusState, ControllerState, FrameReader, SocketCanLink, SocketCanOptions
from imud.model.errors import LinkError, LinkMissing
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import in_loop

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
        self.news: list[tuple[str, str]] = []
        self.delays_s: list[float] = []  # delays of the started timers, s
        self.looks = 0  # number of ended timers of the link
        self.by_timer: list[bool] = []  # True for each batch that a timer read
        self.then: Callable[[], None] = lambda: None  # runs once, directly after the next delivery
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
            self.link.start(self._on_frames, lambda *news: self.news.append(news), self.ends.append)
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
    with pytest.raises(LinkMissing, match="lo is down"):
        Bus(ends, 0).link.open()
    assert found == [True, False]


@pytest.mark.parametrize("sizes", [[1, 3], [1, 64, 64, 5]])
def test_frames_gather_and_more_than_a_batch_is_read_at_once(ends: Ends, sizes: list[int]) -> None:
    async def story(bus: Bus) -> None:
        bus.then = lambda: bus.send(*range(1, sum(sizes)))
        bus.send(0)
        await bus.until(lambda: len(bus.batches) == len(sizes))

    bus = Bus(ends, GATHER_MS)
    bus.run(story)
    assert [frame.can_id for batch in bus.batches for frame in batch] == [*range(sum(sizes))]
    assert [len(batch) for batch in bus.batches] == sizes
    assert (bus.delays_s, bus.by_timer[:2], bus.news) == ([GATHER_MS / 1000] * 2, [False, True], [])


def test_a_controller_that_is_off_at_the_start_is_news(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(bus: Bus) -> None:
        assert [news == problem and news.startswith("lo is bus-off: ") for news, problem in bus.news] == [True]
        bus.news.clear()
        bus._sender.send(RAW_FRAME.pack(0x2000_0100, 8, bytes(8)))
        bus.send(1)
        await bus.until(lambda: bus.batches)
        assert bus.news == [("lo is error-active again", "")]
        bus.link.sender_failed(failure := LinkError("full"))
        assert bus.ends == [failure]
        state, bus.link._reader.dropped = bus.link._state, 4  # type: ignore[union-attr]
        state.overflows, state.passive_count, state.bus_off_count = 1, 2, 3
        assert bus.link.kernel_counters() == KernelCounters(overrun=5, error_passive=2, bus_off=3)
        bus.link.close()
        assert bus.link.kernel_counters() == KernelCounters(overrun=1, error_passive=2, bus_off=3)

    monkeypatch.setattr(netlink, "can_details", lambda name: netlink.CanDetails(None, 3))
    Bus(ends, 0).run(story)


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
    assert ([len(batch) for batch in bus.batches], bus.delays_s) == ([1, 1, 1], [])


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
    assert (bus.looks, len(bus.delays_s)) == (0, at == "pause")


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
    assert (bus.looks, len(bus.delays_s)) == (1, 1)


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
    assert (bus.looks, len(bus.delays_s)) == (0, 1)


def test_a_full_bus_leaves_the_loop_time_for_others(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    class FullBus(FrameReader):
        def read(self) -> list[CanFrame]:
            return [CanFrame(1, False, b"", 0)] * 64

    async def story(bus: Bus) -> None:
        bus.send(1)
        await bus.until(lambda: bus.looks)
        assert len(bus.batches) == 1 + bus.looks * 1024 // 64

    monkeypatch.setattr("imud.links.socketcan.FrameReader", FullBus)
    Bus(ends, GATHER_MS).run(story)


def test_no_more_gathers_than_half_the_buffer_holds(ends: Ends) -> None:
    async def story(bus: Bus) -> None:
        room = ends[0].getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 960
        assert bus.link.gather_ns == room // 2 * 95_000  # frames of 95 bits at 1 Mbit/s

    Bus(ends, 60_000).run(story)


def frame(status: int) -> bytes:
    return bytes([0, status, 0, 0, 0, 0, 0, 0])


def news_of(bus: BusState, classes: int, status: int = 0) -> str:
    """Return the change of state that an error frame causes."""
    bus.news.clear()
    assert bus.add_error_frame(classes, frame(status)) is bool(status & 0x01 and classes == 0x4)
    assert all(problem == bus.problem for _, problem in bus.news)
    return "".join(news for news, _ in bus.news)


def test_life_of_a_controller_from_its_state_at_the_start() -> None:
    bus = BusState("can0", 0)
    assert bus.problem == ""
    assert news_of(bus, 0x4, 0x08) == "can0 is near its error limit (warning)"
    assert bus.problem == ""
    assert news_of(bus, 0x4, 0x20).startswith("can0 is error-passive: ")
    assert news_of(bus, 0x4, 0x10) == ""  # the state has not changed
    assert "terminated" in bus.problem
    assert news_of(bus, 0x40).startswith("can0 is bus-off: ")
    assert "`ip link set can0 down`, then `ip link set can0 up type can restart-ms 100`" in bus.problem
    assert news_of(bus, 0x100) == "can0 is error-active again"
    assert (bus.problem, (bus.passive_count, bus.bus_off_count)) == ("", (1, 1))
    bus = BusState("can0", 0)
    assert news_of(bus, 0x4, 0x01) == ""
    assert (bus.overflows, bus.state) == (1, ControllerState.ACTIVE)
    bus = BusState("can0", 2)
    assert news_of(bus, 0x80, 0x20 | 0x01) == ""
    assert (bus.overflows, bus.state) == (0, ControllerState.PASSIVE)
    for number, state in ((3, ControllerState.BUS_OFF), (None, ControllerState.ACTIVE), (5, 0)):
        assert BusState("can0", number).state == state


HOUR_NS = 3600 * 10**9
QUARTER_NS = 10**9 // 4
OFFSET_NS = 1_700_000_000 * 10**9
ERROR_FRAME = RAW_FRAME.pack(0x2000_0004, 8, bytes([0, 1, 0, 0, 0, 0, 0, 0]))


def real_ns() -> int:
    """Return the time of a clock that is OFFSET_NS behind the clock of the kernel's time stamps."""
    return time.time_ns() - OFFSET_NS


class Wire:
    """A reader on a loopback UDP socket. Datagrams replace the frames.

    The clocks of the reader stop during a read. Two readings are thus equal, and each time stamp is exact.
    """

    def __init__(self) -> None:
        self.receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.receiver.bind(("127.0.0.1", 0))
        self.receiver.setblocking(False)
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.connect(self.receiver.getsockname())
        self.state = BusState("can0")
        self.wall_ahead_ns = 0
        self.now_ns = real_ns()
        self.reader = FrameReader(
            self.receiver, self.state, lambda: self.now_ns, lambda: self.now_ns + OFFSET_NS + self.wall_ahead_ns
        )
        self._wait_for_stamps()

    def send(self, *can_ids: int) -> tuple[int, int]:
        """Send frames. Return the time before and after sending."""
        before_ns = real_ns()
        for can_id in can_ids:
            self.sender.send(pack_frame(can_id, False, bytes([can_id & 0xFF])))
        return before_ns, real_ns()

    def read(self) -> list[CanFrame]:
        assert select.select([self.receiver], [], [], LIMIT_S)[0]
        self.now_ns = real_ns()
        return self.reader.read()

    def ids(self) -> list[tuple[int, bool]]:
        """Read. Return the identifiers, and whether frames were lost before each."""
        return [(frame.can_id, frame.after_loss) for frame in self.read()]

    def close(self) -> None:
        self.receiver.close()
        self.sender.close()

    def _wait_for_stamps(self) -> None:
        """Wait until the kernel time-stamps datagrams, some ms after the first socket has requested time stamps."""
        end_s, is_stamped = time.monotonic() + LIMIT_S, False
        while not is_stamped:
            assert time.monotonic() < end_s, "no kernel stamps"
            _, sent_ns = self.send(0)
            time.sleep(0.002)
            is_stamped = any(frame.t_rx_ns < sent_ns for frame in self.read())


@pytest.fixture(params=["kernel", "python"])
def wire(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    monkeypatch.setattr(kernel, "present", kernel.present if request.param == "kernel" else kernel.Kernel(None))
    with closing(Wire()) as made:
        yield made


def test_a_read_is_bounded_and_frames_come_with_the_time_of_their_arrival(wire: Wire) -> None:
    wire.send(*range(64 + 5))
    first, second = wire.read(), wire.read()
    assert ([f.can_id for f in first + second], (len(first), len(second))) == (list(range(64 + 5)), (64, 5))
    assert second[0].t_rx_ns >= first[-1].t_rx_ns
    assert wire.reader.read() == []
    before_ns, after_ns = wire.send(1, 2, 0x7FF)
    frames = wire.read()
    assert [f[:3] for f in frames] == [(1, False, b"\x01"), (2, False, b"\x02"), (0x7FF, False, b"\xff")]
    assert not any(f.after_loss for f in frames)
    times = [f.t_rx_ns for f in frames]
    assert before_ns <= times[0] < times[1] < times[2] <= after_ns
    wire.sender.send(pack_frame(0x1234, True, b""))
    wire.sender.send(pack_frame(0x1FFFFFFF, True, bytes(8)))
    assert [f[:3] for f in wire.read()] == [(0x1234, True, b""), (0x1FFFFFFF, True, bytes(8))]
    # frames of every length in the same buffers: no frame contains bytes of an older frame
    for lengths in (FD_LENGTHS, FD_LENGTHS[::-1]):
        sent = [(0x18FF5B08, True, bytes(range(100 + size, 100 + 2 * size))) for size in lengths]
        for frame in sent:
            wire.sender.send(pack_frame(*frame))
        assert [f[:3] for f in wire.read()] == sent
    wire.receiver.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        wire.reader.read()


def test_drops_are_counted_and_marked_where_they_were(wire: Wire) -> None:
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    wire.send(*range(100))
    taken = wire.ids()
    assert len(taken) < 100
    assert not any(after_loss for _, after_loss in taken)
    wire.send(200, 201)
    assert wire.ids() == [(200, True), (201, False)]
    assert len(taken) + wire.reader.dropped == 100
    wire.send(202)
    assert wire.ids() == [(202, False)]


def test_a_drop_is_seen_after_reads_of_single_frames(wire: Wire) -> None:
    """A read without drops needs less space for control messages. The next read has the full space again."""
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
    wire.send(1)
    assert wire.ids() == [(1, False)]
    # fills the buffer, and the reader truncates it to a frame
    wire.sender.send(pack_frame(2, False, b"") + bytes(4000))
    wire.send(3)
    assert wire.ids() == [(2, False)]
    wire.send(4)
    assert wire.ids() == [(4, True)]
    assert wire.reader.dropped == 1


def test_error_frames_go_their_own_way_and_can_mean_a_loss(wire: Wire) -> None:
    wire.sender.send(ERROR_FRAME)
    wire.sender.send(RAW_FRAME.pack(0x4000_0123, 0, b""))  # a remote frame
    wire.send(5, 6)
    assert wire.ids() == [(5, True), (6, False)]
    assert (wire.state.overflows, wire.state.news) == (1, [])
    wire.sender.send(ERROR_FRAME)
    assert wire.ids() == []
    wire.send(7)
    assert wire.ids() == [(7, True)], "a loss that is read alone marks the next frame"
    wire.send(8)
    assert wire.ids() == [(8, False)]


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, 0])
def test_a_wall_clock_set_between_arrival_and_read_moves_no_stamp(wire: Wire, step_ns: int) -> None:
    wire.reader.read()
    spans = [wire.send(can_id) for can_id in range(1, 4)]
    wire.wall_ahead_ns += step_ns
    for frame, (before_ns, after_ns) in zip(wire.read(), spans, strict=True):
        assert before_ns <= frame.t_rx_ns <= after_ns


def test_frames_of_before_and_after_a_step_of_the_wall_clock_keep_their_order_and_bounds(wire: Wire) -> None:
    wire.wall_ahead_ns += HOUR_NS
    before_ns, after_ns = wire.send(1)
    (first,) = wire.read()
    assert before_ns <= first.t_rx_ns <= after_ns
    wire.wall_ahead_ns += HOUR_NS
    wire.send(2)
    (second,) = wire.read()
    assert first.t_rx_ns < second.t_rx_ns <= wire.now_ns


@pytest.mark.parametrize("step_ns", [QUARTER_NS, -QUARTER_NS])
def test_a_frame_of_a_time_between_two_steps_of_the_wall_clock_is_not_dated_before_it_came(
    wire: Wire, step_ns: int
) -> None:
    """The wall clock is set and set back between two reads, like on a host under SIGSTOP."""
    wire.wall_ahead_ns += step_ns  # the offset of both reads; the kernel's time stamps do not contain it
    wire.send(1)
    wire.read()
    sent_ns, _ = wire.send(2, 3)
    for frame in wire.read():
        assert sent_ns <= frame.t_rx_ns <= wire.now_ns


def test_a_frame_is_no_older_than_the_read_that_emptied_the_queue(wire: Wire) -> None:
    wire.send(1)
    begun_ns = real_ns()
    wire.read()
    wire.send(2)
    wire.wall_ahead_ns += HOUR_NS
    (frame,) = wire.read()
    assert begun_ns <= frame.t_rx_ns <= wire.now_ns


def test_limits_of_a_step_and_of_a_backlog(wire: Wire) -> None:
    """An offset changes by a step from 100 us. A frame waited in a queue if its stamp is over 5 ms too old."""

    def stamps(offset_ns: int, now_ns: int, *times_ns: int) -> list[int]:
        reader = FrameReader(wire.receiver, BusState("can0"), lambda: 0, lambda: 0)
        rows = [
            ((1, 0, 0, bytes(64)), (socketcan.SO_TIMESTAMPNS_NEW, 0, t_ns, 0, 0))
            for t_ns in (20_000_000 + offset_ns, *times_ns)
        ]
        for i, (frame, control) in enumerate(rows):
            RAW_FD_FRAME.pack_into(reader._frames, 72 * i, *frame)
            socketcan._CONTROL.pack_into(reader._control, 64 * i, *control)
        module = kernel.present.module
        usual = None if module is None else reader._usual(module, len(rows), offset_ns, now_ns)
        reader = FrameReader(wire.receiver, BusState("can0"), lambda: 0, lambda: 0)
        frames = reader._decoded(rows, offset_ns, now_ns)
        assert usual == (None if module is None else frames)
        return [frame.t_rx_ns for frame in frames][1:]

    assert stamps(99_999, 21_000_000, 20_050_000) == [20_000_000]
    assert stamps(100_000, 21_000_000, 20_050_000) == [20_050_000]
    assert stamps(0, 21_000_000, 15_000_000, 14_999_999) == [20_000_000, 21_000_000]


@pytest.mark.parametrize("closest", [2, 4])
def test_clocks_that_are_always_read_apart_give_the_closest_of_some_readings(wire: Wire, closest: int) -> None:
    """Each time, the thread stops between the readings of both clocks: once for 30 us, else for 20 ms."""
    away_ns, calls = [0, 0, 20_000_000, 0, 20_000_000, 0, 20_000_000], iter(range(7))
    away_ns[closest] = 30_000
    gone_ns, base_ns, begun = 0, real_ns(), False

    def now_ns() -> int:
        nonlocal gone_ns
        gone_ns += away_ns[next(calls)] if begun else 0
        return base_ns + gone_ns

    reader = FrameReader(wire.receiver, BusState("can0"), now_ns, lambda: base_ns + gone_ns + OFFSET_NS)
    before_ns, after_ns = wire.send(1)
    base_ns, begun = after_ns, True
    (frame,) = reader.read()
    assert before_ns - 15_000 <= frame.t_rx_ns <= after_ns + 15_000
    assert not list(calls), "three readings, because each needs more than 20 us"


def interface(sys: Path, name: str, kind: int, flags: int) -> None:
    folder = sys / "class/net" / name
    folder.mkdir(parents=True)
    (folder / "type").write_text(f"{kind}\n")
    (folder / "flags").write_text(f"{flags:#x}\n")


def test_absence_says_what_to_do(tmp_path: Path) -> None:
    interface(tmp_path, "can0", 280, 0x40081)
    interface(tmp_path, "can1", 280, 0x40080)
    interface(tmp_path, "eth0", 1, 0x1003)
    assert absence("can0", tmp_path) == ""
    assert "can1 is down" in absence("can1", tmp_path)
    assert "can9 does not exist" in absence("can9", tmp_path)
    with pytest.raises(LinkError, match="eth0 is not a CAN interface"):
        absence("eth0", tmp_path)
    assert can_interfaces(tmp_path) == ["can0"]
    assert can_interfaces(tmp_path / "none") == []


def attribute(kind: int, data: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def answer(info: bytes) -> bytes:
    body = bytes(16) + attribute(3, b"can0\0") + (attribute(18, info) if info else b"")
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def test_details_of_an_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    limits_s: list[float] = []
    monkeypatch.setattr(socket.socket, "settimeout", lambda _socket, limit_s: limits_s.append(limit_s))
    timing = struct.pack("=8I", 250_000, 875, 0, 0, 0, 0, 0, 0)
    data = attribute(1, timing) + attribute(4, struct.pack("=I", 3))
    info = attribute(1, b"can\0") + attribute(2, data)
    assert parse_details(answer(info)) == CanDetails(250_000, 3)
    assert parse_details(answer(attribute(1, b"vcan\0"))) == CanDetails(None, None)
    assert parse_details(answer(b"")) == CanDetails(None, None)
    assert parse_details(struct.pack("=IHHIIi", 20, 2, 0, 1, 0, -19)) == CanDetails(None, None)
    assert parse_details(answer(attribute(2, b"\1\0\1\0"))[:-1]) == CanDetails(None, None)
    assert parse_details(answer(b"\3\0\7\0" + info)) == CanDetails(None, None), "an attribute has at least 4 bytes"
    assert parse_details(answer(attribute(7, b"") + info)) == CanDetails(250_000, 3)
    assert (can_details("lo"), limits_s) == (CanDetails(None, None), [1])
    with pytest.raises(LinkError, match="nosuch0"):
        can_details("nosuch0")


@in_loop
async def test_a_wait_ends_without_a_reader() -> None:
    held = iter([False, True])
    waiting = asyncio.create_task(wait_until(lambda: next(held)))
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    await wait_until(lambda: next(held))


@in_loop
async def test_each_change_of_an_interface_is_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    class News(socket.socket):
        def bind(self, address: object) -> None:
            groups.append(address)

    theirs, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    news, looks, groups = News(fileno=theirs.detach()), list[bool](), list[object]()
    news.setblocking(False)
    monkeypatch.setattr(socket, "socket", lambda *_: news)
    waiting = asyncio.create_task(wait_until(lambda: looks.append(len(looks) == 2) or looks[-1]))  # type: ignore[func-returns-value]
    for count in (1, 2, 3):
        for _ in range(5):
            await asyncio.sleep(0)
        assert (len(looks), waiting.done(), groups) == (count, count == 3, [(0, 1)])
        if count < 3:
            ours.send(b"changed")
    ours.close()


MS = 1_000_000
SYNC = CyclicFrame(0x80, False, b"\7", 10 * MS)


def test_the_message_to_the_broadcast_manager() -> None:
    """`struct bcm_msg_head` of linux/can/bcm.h on a 64-bit system has 56 bytes. The frame follows."""
    if struct.calcsize("P") != 8:
        pytest.skip("laid out otherwise")
    message = setup(CyclicFrame(0x18FEE9AA, True, b"\1\2", 1_002_500_000))
    assert len(message) == 56 + RAW_FRAME.size
    head = struct.unpack("=IIIIqqqqII", message[:56])
    assert head == (1, 3, 0, 0, 0, 0, 1, 2500, 0x98FEE9AA, 1)
    assert message[56:] == pack_frame(0x18FEE9AA, True, b"\1\2")


def run(late_ns: list[int], *, fail_after: int = 1 << 30) -> tuple[list[int], list[str]]:
    """Send; each timer fires late by the next of `late_ns`. Return the times of the frames and the reported errors."""
    now_ns, sent_at, errors = 0, list[int](), list[str]()

    async def story() -> None:
        loop, done = asyncio.get_running_loop(), asyncio.Event()

        class Link:
            def write(self, data: bytes) -> None:
                if len(sent_at) >= fail_after:
                    raise LinkError("full")
                assert data == pack_frame(0x80, False, b"\7")
                sent_at.append(now_ns)

            def sender_failed(self, error: LinkError) -> None:
                errors.append(str(error))
                done.set()

        def call_later(delay_s: float, callback: object, *arguments: object) -> asyncio.TimerHandle:
            nonlocal now_ns
            if not late_ns:
                done.set()
                return loop_call_later(0, lambda: None)
            now_ns += round(delay_s * 1e9) + late_ns.pop(0)
            return loop_call_later(0, callback, *arguments)  # type: ignore[arg-type]  # as it was given

        loop_call_later = loop.call_later
        loop.call_later = call_later  # type: ignore[assignment]  # the test's own time
        sender = LoopSender(Link(), [SYNC], lambda: now_ns)
        await done.wait()
        sender.close()
        sender.close()

    asyncio.run(story())
    return [sent_ns // MS for sent_ns in sent_at], errors


def test_deadlines_are_absolute_and_a_failed_link_ends_them() -> None:
    assert run([3 * MS, 0, 9 * MS, 0]) == ([0, 13, 20, 39, 40], [])
    assert run([35 * MS, 0]) == ([0, 45, 50], [])
    assert run([-MS, 0, 0]) == ([0, 10, 20], []), "a timer that fires early waits on"
    assert run([0] * 5, fail_after=2) == ([0, 10], ["full"])
