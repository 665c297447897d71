"""The serial link on real pseudo-terminals."""

import asyncio
import errno
import fcntl
import os
import select
import termios
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from imud.contracts.link import StreamLink
from imud.contracts.status import KernelCounters
from imud.links import LINKS
from imud.links.serial_port import baud_of
from imud.links.uart import UartLink, UartOptions
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.model.units import NS_PER_MS
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.event_loops import in_loop
from tests.support.leaks import open_descriptors
from tests.support.pty_port import PtyPort, unprivileged, waiting_bytes


@pytest.fixture
def pty() -> Iterator[PtyPort]:
    port = PtyPort()
    yield port
    port.unplug()


@pytest.fixture
def link(pty: PtyPort) -> UartLink:
    return UartLink(UartOptions(port=pty.path))


class Receiver:
    def __init__(self) -> None:
        self.chunks: list[tuple[bytes, int]] = []
        self.ends: list[LinkError | None] = []
        self.called = asyncio.Event()

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.chunks)

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        self.chunks.append((data, t_rx_ns))
        self.called.set()

    def on_end(self, error: LinkError | None) -> None:
        self.ends.append(error)
        self.called.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(LIMIT_S):
            while not condition():
                self.called.clear()
                await self.called.wait()


def play(link: UartLink, scene: Callable[[Receiver], Awaitable[None]]) -> Receiver:

    async def whole() -> Receiver:
        receiver = Receiver()
        link.open()
        try:
            link.start(receiver.on_data, receiver.on_end)
            await scene(receiver)
        finally:
            link.close()
        return receiver

    return asyncio.run(whole())


def test_bytes_pass_as_they_are(pty: PtyPort, link: UartLink) -> None:
    everything = bytes(range(256))

    async def scene(receiver: Receiver) -> None:
        pty.send(everything)
        await receiver.until(lambda: len(receiver.data) == 256)

    before_ns, receiver = time.monotonic_ns(), play(UartLink(UartOptions(port=pty.path, baud=115200)), scene)
    assert receiver.data == everything
    assert all(before_ns < t_rx_ns <= time.monotonic_ns() for _, t_rx_ns in receiver.chunks)
    assert receiver.ends == []
    link.open()
    link.write(everything)
    assert pty.received() == everything
    link.close()


async def drained(pty: PtyPort, count: int, received: bytes = b"") -> bytes:
    """Receive until `count` bytes have arrived."""
    done = asyncio.Event()

    def on_readable() -> None:
        nonlocal received
        received += pty.received()
        if len(received) >= count:
            done.set()

    asyncio.get_running_loop().add_reader(pty.master, on_readable)
    await asyncio.wait_for(done.wait(), LIMIT_S)
    asyncio.get_running_loop().remove_reader(pty.master)
    return received


def test_what_the_port_does_not_take_is_queued_in_order_bounded_and_ends_with_the_link(
    pty: PtyPort, link: UartLink
) -> None:
    blocks = [bytes([number % 251]) * 1000 for number in range(200)]

    async def scene(_receiver: Receiver) -> None:
        accepted = 0
        with pytest.raises(LinkError, match="bytes wait"):  # noqa: PT012
            for block in blocks:
                link.write(block)
                accepted += 1
        assert accepted * 1000 > 4096
        assert await drained(pty, accepted * 1000) == b"".join(blocks[:accepted])

        sent = pty.fill()
        link.write(bytes(1000))  # all bytes are queued
        received = b""
        while not select.select([], [pty.slave], [], 0)[1]:  # until the port accepts data again
            received += pty.received()
        link.write(b"last")
        assert await drained(pty, sent + 1004, received) == bytes(sent + 1000) + b"last"
        numbers = [int(name) for name in os.listdir("/proc/self/fd")]
        assert not any(asyncio.get_running_loop().remove_writer(number) for number in numbers)

        with pytest.raises(LinkError, match="0 bytes wait"):
            link.write(bytes(4096 + 1))
        sent = pty.fill()
        link.write(bytes(4096))
        with pytest.raises(LinkError, match="4096 bytes wait"):  # noqa: PT012
            for _ in range(4096):  # on a slow host, the port accepts some bytes after `fill`
                link.write(b"x")
                sent += 1
        numbers = [int(name) for name in os.listdir("/proc/self/fd")]
        link.close()
        assert not any(asyncio.get_running_loop().remove_writer(number) for number in numbers)
        await drained(pty, sent)
        link.open()
        link.write(b"new")
        assert await drained(pty, 3) == b"new"

    play(link, scene)


def test_unplugging_ends_the_link_once(pty: PtyPort, link: UartLink) -> None:
    async def scene(receiver: Receiver) -> None:
        pty.unplug()
        await receiver.until(lambda: bool(receiver.ends))
        for _ in range(20):
            await asyncio.sleep(0)

    receiver = play(link, scene)
    assert len(receiver.ends) == 1
    assert isinstance(receiver.ends[0], LinkMissing)
    assert pty.path in str(receiver.ends[0])


def test_a_spurious_wake_up_is_no_end(pty: PtyPort) -> None:
    async def scene(receiver: Receiver) -> None:
        stolen: list[bytes] = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _loop, context: failures.append(context))
        pty.send(b"x")
        wait_until(lambda: waiting_bytes(pty.slave) == 1, "the byte is there")  # the event loop does not run until then
        loop.call_soon(lambda: stolen.append(os.read(pty.slave, 1)))
        for _ in range(5):  # the descriptor was readable, but no data remains when the link reads it
            await asyncio.sleep(0)
        assert stolen == [b"x"]

    failures: list[dict[str, object]] = []
    receiver = play(UartLink(UartOptions(port=pty.path)), scene)
    assert (receiver.data, receiver.ends, failures) == (b"", [], [])


def test_closing_releases_everything_may_be_repeated_and_is_allowed_in_the_receiver(
    pty: PtyPort, link: UartLink
) -> None:
    before = open_descriptors()
    for _ in range(3):
        link.open()
        link.close()
        link.close()
    assert open_descriptors() == before
    with pytest.raises(LinkError, match="not open"):
        link.write(b"x")
    with pytest.raises(LinkError, match="not open"):
        link.set_baud(9600)

    async def scene(receiver: Receiver) -> None:
        got = asyncio.Event()

        def on_data(data: bytes, t_rx_ns: int) -> None:
            link.close()
            got.set()

        link.start(on_data, receiver.on_end)
        pty.send(b"x")
        await asyncio.wait_for(got.wait(), LIMIT_S)
        await asyncio.sleep(0.01)  # a remaining reader would read and end the link

    assert play(link, scene).ends == []


@pytest.mark.manual("A 1.1 characters", "B 3 characters")
def test_the_port_is_raw_8n1_at_the_rate(pty: PtyPort) -> None:
    tty_settings = termios.tcgetattr(pty.slave)
    tty_settings[0] |= termios.BRKINT | termios.IXON | termios.ICRNL | termios.ISTRIP
    tty_settings[2] |= termios.HUPCL
    tty_settings[3] |= termios.ICANON | termios.ECHO | termios.ISIG
    termios.tcsetattr(pty.slave, termios.TCSANOW, tty_settings)
    link = UartLink(UartOptions(port=pty.path, baud=921600))
    link.open()
    iflag, oflag, cflag, lflag, _, _, characters = termios.tcgetattr(pty.slave)
    link.close()
    assert not iflag & (termios.BRKINT | termios.IGNBRK | termios.IXON | termios.ICRNL | termios.ISTRIP | termios.INPCK)
    assert not oflag & termios.OPOST
    assert cflag & termios.CSIZE == termios.CS8
    assert not cflag & (termios.CSTOPB | termios.PARENB | termios.HUPCL | termios.CRTSCTS)
    assert not lflag & (termios.ICANON | termios.ECHO | termios.ISIG)
    assert characters[termios.VMIN] in (1, b"\x01")


@pytest.mark.parametrize("baud", [9600, 115200, 256000, 460800, 921600, 250_001])
@pytest.mark.manual("A 1.1 rates")
def test_every_rate_is_set_when_opening_and_later_and_old_bytes_are_discarded(pty: PtyPort, baud: int) -> None:
    link = UartLink(UartOptions(port=pty.path, baud=baud))
    link.open()
    assert baud_of(pty.slave) == baud
    link.set_baud(57600)
    assert baud_of(pty.slave) == link.baud == 57600
    link.set_baud(baud)
    assert baud_of(pty.slave) == link.baud == baud
    pty.send(b"old bytes")
    wait_until(lambda: waiting_bytes(pty.slave) == 9, "the pty handed the bytes over")
    link.set_baud(9600)
    assert waiting_bytes(pty.slave) == 0
    link.close()


def test_a_rate_that_the_driver_changes_is_refused(pty: PtyPort, monkeypatch: pytest.MonkeyPatch) -> None:
    link = UartLink(UartOptions(port=pty.path, baud=115200))
    link.open()
    monkeypatch.setattr("imud.links.serial_port.baud_of", lambda fd: 115200)
    with pytest.raises(LinkError, match="does not support 256000 baud: its driver set 115200 baud"):
        link.set_baud(256000)
    assert link.baud == 115200
    link.set_baud(round(115200 / 1.03) + 1)  # 3 % is the tolerance
    with pytest.raises(LinkError, match="does not support 111000 baud"):
        link.set_baud(111_000)
    link.close()
    before = open_descriptors()
    with pytest.raises(LinkError, match="does not support 230400 baud") as caught:
        UartLink(UartOptions(port=pty.path, baud=230400)).open()
    assert open_descriptors() == before
    assert caught.value.__cause__ is None


@pytest.mark.manual("A 1.8 one program")
def test_a_second_open_is_refused_and_names_the_holder(pty: PtyPort, link: UartLink) -> None:
    first, second = (UartLink(UartOptions(port=pty.path)) for _ in range(2))
    first.open()
    with pytest.raises(LinkBusy, match=rf"\(pid {os.getpid()}\)"):
        second.open()
    first.close()
    second.open()
    second.close()
    os.chmod(pty.path, 0o666)
    link.open()
    with unprivileged(), pytest.raises(OSError, match="busy"):
        os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    link.close()


@pytest.mark.parametrize("step", ["fcntl.ioctl", "_finish_raw", "_check_rate", "baud_of"])
@pytest.mark.parametrize("kind", [OSError, termios.error])
def test_a_step_after_open_that_fails_releases_the_port(
    pty: PtyPort, link: UartLink, monkeypatch: pytest.MonkeyPatch, step: str, kind: type[Exception]
) -> None:
    def refuse(*_arguments: object) -> None:
        raise kind(errno.EIO, "by the test")

    before = open_descriptors()
    with monkeypatch.context() as patch:
        if step == "fcntl.ioctl":  # TIOCEXCL fails; the library needs the other calls
            real = fcntl.ioctl
            patch.setattr(fcntl, "ioctl", lambda *a: refuse() if a[1] == termios.TIOCEXCL else real(*a))
        else:
            patch.setattr(f"imud.links.serial_port.{step}", refuse)
        with pytest.raises(LinkError) as caught:
            link.open()
    assert open_descriptors() == before, (
        "the traceback keeps the port object alive: only close() releases the descriptor"
    )
    assert "exists without hardware" in str(caught.value)
    link.open()
    link.close()


def test_ports_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(LinkMissing, match="/dev/no-such-port does not exist"):
        UartLink(UartOptions(port="/dev/no-such-port")).open()
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(LinkError, match="is not a serial port"):
        UartLink(UartOptions(port=str(path))).open()


@in_loop
async def test_a_port_that_is_unplugged_and_comes_back_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "by-id" / "usb-imu"
    path.parent.mkdir()
    first, second = PtyPort(), PtyPort()
    path.symlink_to(first.path)
    link = UartLink(UartOptions(port=str(path)))

    async def life(port: PtyPort) -> None:
        receiver = Receiver()
        await asyncio.wait_for(link.wait_present(), LIMIT_S)
        link.open()
        link.start(receiver.on_data, receiver.on_end)
        port.send(b"hello")
        await receiver.until(lambda: receiver.data == b"hello")
        path.unlink()
        port.unplug()
        await receiver.until(lambda: bool(receiver.ends))
        link.close()

    await life(first)
    waiting = asyncio.create_task(life(second))
    for _ in range(20):
        await asyncio.sleep(0)
    assert not waiting.done()
    path.symlink_to(second.path)
    await waiting


@in_loop
async def test_after_a_refusal_access_is_waited_for(pty: PtyPort, link: UartLink) -> None:
    os.chmod(pty.path, 0)
    with unprivileged():
        with pytest.raises(LinkDenied, match=r"user \w+ lacks .*; no group may open it \(mode 0000, group \w+\); "):
            link.open()
        waiting = asyncio.create_task(link.wait_present())
        for _ in range(20):
            await asyncio.sleep(0)
        assert not waiting.done()
        if os.getuid() == 0:
            os.seteuid(0)
        os.chmod(pty.path, 0o666)
        if os.getuid() == 0:
            os.seteuid(65534)
        await asyncio.wait_for(waiting, LIMIT_S)
        link.open()
        link.close()


def test_a_paused_port_keeps_what_comes_until_it_is_taken(
    pty: PtyPort, link: UartLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scene(receiver: Receiver) -> None:
        link.pause()
        pty.send(b"abc")
        wait_until(lambda: waiting_bytes(pty.slave) == 3, "the bytes are there")
        await asyncio.sleep(0)
        assert receiver.data == b""
        assert link.take() == b"abc"
        assert link.take() == b""
        link.resume()
        pty.send(b"d")
        await receiver.until(lambda: receiver.data == b"d")
        link.pause()
        sent = bytes(range(256)) * 32  # more than the limit of one read
        taken = b""
        for at in range(0, len(sent), 2048):
            pty.send(sent[at : at + 2048])
        while len(taken) < len(sent):
            taken += link.take()
        assert taken == sent
        pieces = iter([bytes(2048), b"last"])  # a full read is followed by another read
        with monkeypatch.context() as patch:
            patch.setattr(os, "read", lambda _fd, _size: next(pieces))
            assert link.take() == bytes(2048) + b"last"

    assert play(link, scene).ends == []


@pytest.mark.parametrize("resumed", [False, True])
def test_the_end_of_a_paused_port_is_reported_once(pty: PtyPort, link: UartLink, resumed: bool) -> None:
    async def scene(receiver: Receiver) -> None:
        link.pause()
        pty.unplug()
        await asyncio.sleep(0.01)
        assert receiver.ends == []
        assert link.take() == b""
        assert len(receiver.ends) == 1
        if resumed:
            link.resume()
        assert link.take() == b""

    assert len(play(link, scene).ends) == 1


def test_adapters_hold_bytes_back(pty: PtyPort, tmp_path: Path) -> None:
    timer = tmp_path / "class" / "tty" / os.path.basename(pty.path) / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    for low_latency, left_ms in ((False, 16), (True, 1)):
        timer.write_text("16\n")
        link = UartLink(UartOptions(port=pty.path, low_latency=low_latency), sys=tmp_path)
        link.open()
        link.close()
        assert (link.hold_ns, int(timer.read_text())) == (left_ms * NS_PER_MS, left_ms)
    link = UartLink(UartOptions(port=pty.path))
    assert link.kernel_counters() == KernelCounters()
    link.open()
    assert link.hold_ns == 0
    assert link.kernel_counters() == KernelCounters()
    link.close()


def test_the_row_and_its_settings() -> None:
    row = LINKS["uart"]
    settings = msgspec.convert({"port": "/dev/ttyUSB0", "baud": "auto"}, row.settings)
    link: StreamLink = row.make(settings)
    assert (link.title, link.auto_baud, link.baud, link.writable) == ("/dev/ttyUSB0", True, 115200, True)
    assert link.waiting_bytes == 2048, "half of the buffer of n_tty"
    assert not row.make(msgspec.convert({"port": "a", "baud": 9600}, row.settings)).auto_baud
    for wrong in ({}, {"port": ""}, {"baud": 0}, {"baud": "fast"}, {"speed": 9600}):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert({"port": "a", **wrong} if wrong else {}, UartOptions)
