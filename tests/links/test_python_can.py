"""The link to python-can, on its virtual bus."""

import asyncio
import contextlib
import errno
import struct
import threading
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import Mock

import can
import msgspec
import pytest

from imud.contracts.link import CanLink
from imud.formats.can import CanFilter, CanFrame, CyclicFrame, pack_filters, pack_frame
from imud.links import LINKS
from imud.links.python_can import DAMAGED_MAX, PythonCanLink
from imud.links.socketcan import LINK, SocketCanOptions
from imud.model.errors import LinkError
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.event_loops import in_loop


def make(channel: str, **keys: object) -> CanLink:
    row = LINKS["socketcan"]
    return row.make_can(msgspec.convert({"interface": channel, "backend": "virtual", **keys}, row.settings))


@in_loop
async def test_frames_pass_the_filters_in_the_loops_thread_and_commands_go_out() -> None:
    link = make("pass")
    link.filters = [CanFilter(0x65, 0x7FF, False)]
    await link.wait_present()
    link.open()
    got: list[CanFrame] = []
    threads: set[threading.Thread] = set()
    done = asyncio.Event()

    def on_frames(frames: Sequence[CanFrame]) -> None:
        threads.add(threading.current_thread())
        got.extend(frames)
        if len(got) == 2:
            done.set()

    link.start(on_frames, lambda news, problem: None, lambda error: None)
    with can.Bus("pass", "virtual") as far:
        for can_id, extended, data in (
            (0x65, False, b"\1\2"),
            (0x66, False, b""),
            (0x65, True, b""),
            (0x65, False, bytes(64)),
        ):
            far.send(can.Message(arbitration_id=can_id, is_extended_id=extended, data=data, is_fd=len(data) > 8))
        await asyncio.wait_for(done.wait(), LIMIT_S)
        link.write(pack_frame(0x123, False, b"\7") + pack_frame(0x1234, True, b""))
        sent = [m for m in (far.recv(LIMIT_S), far.recv(LIMIT_S)) if m]
    found = [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in sent]
    assert found == [(0x123, False, b"\7"), (0x1234, True, b"")]
    assert threads == {threading.current_thread()}
    link.close()
    link.close()
    assert [frame[:3] for frame in got] == [(0x65, False, b"\1\2"), (0x65, False, bytes(64))]
    assert 0 < got[0].t_rx_ns <= got[1].t_rx_ns
    assert "can pass" not in [thread.name for thread in threading.enumerate()]
    with pytest.raises(LinkError, match="not open"):
        link.write(b"")


class FakeBus:
    """A bus of python-can with prepared messages. It notes its shutdown."""

    def __init__(self, *messages: can.Message) -> None:
        self.messages = list(messages)
        self.sent: list[can.Message] = []
        self.timeouts_s: set[float] = set()
        self.is_shut_down = False

    def recv(self, timeout_s: float) -> can.Message | None:
        self.timeouts_s.add(timeout_s)
        return self.messages.pop(0) if self.messages else None

    def send(self, message: can.Message, timeout: float) -> None:
        assert timeout == 0
        self.sent.append(message)

    def shutdown(self) -> None:
        self.is_shut_down = True


@in_loop
async def test_a_slow_bus_opens_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The event loop runs while slcan waits for its adapter. imud shuts the bus of a cancelled task down."""
    may_open, buses = threading.Event(), list[FakeBus]()

    def slow(*_where: object, **_keys: object) -> FakeBus:
        assert may_open.wait(LIMIT_S if threading.current_thread() is not threading.main_thread() else 0)
        buses.append(FakeBus())
        return buses[-1]

    monkeypatch.setattr(can, "Bus", slow)
    link = make("slow")
    for is_cancelled in (False, True):
        may_open.clear()
        opening = asyncio.create_task(link.wait_present())
        await asyncio.sleep(0)
        assert not opening.done()
        if is_cancelled:
            opening.cancel()
        may_open.set()
        await asyncio.gather(opening, return_exceptions=True)
        if not is_cancelled:
            link.open()
            link.close()
        async with asyncio.timeout(LIMIT_S):
            while not (len(buses) > is_cancelled and buses[-1].is_shut_down):
                await asyncio.sleep(0.001)
        assert (opening.cancelled(), len(buses)) == (is_cancelled, 1 + is_cancelled)


@in_loop
async def test_only_data_frames_are_delivered_and_nothing_after_close(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = [{}, {"is_error_frame": True}, {"is_remote_frame": True}, {"is_fd": True}, *[dict[str, bool]()] * 63]
    bus = FakeBus(*(can.Message(arbitration_id=n, is_extended_id=False, **kind) for n, kind in enumerate(kinds)))
    monkeypatch.setattr(can, "Bus", lambda *_, **__: bus)
    got: list[list[int]] = []
    link = make("fake")
    link.open()
    first = asyncio.Event()

    def on_frames(frames: Sequence[CanFrame]) -> None:
        got.append([frame.can_id for frame in frames])
        if len(got) == 2:
            first.set()

    link.start(on_frames, lambda news, problem: None, lambda error: None)
    await asyncio.wait_for(first.wait(), LIMIT_S)
    bus.messages += [can.Message(arbitration_id=9, is_extended_id=False)]
    wait_until(lambda: not bus.messages, "the thread has read the frame")
    link.close()
    await asyncio.sleep(0.01)  # the loop would deliver the frame now
    assert (got, (bus.is_shut_down, bus.timeouts_s)) == ([[0, *range(3, 64)], [64, 65, 66]], (True, {0, 0.05}))


@in_loop
@pytest.mark.parametrize(("closed", "kind"), [(False, can.CanOperationError), (True, OSError), (False, ValueError)])
async def test_a_failed_bus_ends_a_link(monkeypatch: pytest.MonkeyPatch, closed: bool, kind: type[Exception]) -> None:
    bus, ends = FakeBus(), list[str]()
    monkeypatch.setattr(bus, "recv", Mock(side_effect=kind("gone")))
    monkeypatch.setattr(can, "Bus", lambda *_, **__: bus)
    link = make("fake")
    assert isinstance(link, PythonCanLink)
    link.sender_failed(LinkError("a link that is not started"))
    link.open()
    link.start(lambda frames: None, lambda news, problem: None, lambda error: ends.append(str(error)))
    for thread in [one for one in threading.enumerate() if one.name == "can fake"]:
        thread.join()
    if closed:
        link.close()
    await asyncio.sleep(0)
    assert ends == ([] if closed else [f"cannot receive on {link.title}: gone"])
    link.sender_failed(LinkError("full"))
    assert len(ends) == (not closed)  # the link reports its end once
    assert link.kernel_counters().framing == (DAMAGED_MAX if kind is ValueError else 0)
    link.close()


@in_loop
async def test_failed_cyclic_frame_ends_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", lambda *_, **__: FakeBus())
    link, ends = make("fake"), list[str]()
    assert isinstance(link, PythonCanLink)
    link.open()
    link.start(lambda frames: None, lambda news, problem: None, lambda error: ends.append(str(error)))
    for _ in range(2):
        link.sender_failed(LinkError("full"))
    assert ends == ["full"]
    link.close()


# Exceptions of python-can, of Python without the library of a vendor, and classes that usually end a program
ERRORS: Sequence[BaseException] = (
    can.CanOperationError("gone"),
    can.CanInterfaceNotImplementedError("no library"),
    OSError(errno.ENODEV, "No such device"),
    NameError("name 'canGetNumberOfChannels' is not defined"),
    AttributeError("module 'ctypes' has no attribute 'WinDLL'"),
    struct.error("bad size"),
    SystemExit(0),
    KeyboardInterrupt(),
    GeneratorExit(),
    asyncio.CancelledError(),
    StopIteration(),
)


class FailingBus(FakeBus):
    """A bus that raises an exception at one place."""

    def __init__(self, place: str, error: BaseException) -> None:
        super().__init__()
        setattr(self, place, Mock(side_effect=error))

    def set_filters(self, _filters: object) -> None: ...


FAILURES = [(backend, ERRORS[0]) for backend in can.interfaces.BACKENDS if backend not in ("socketcan", "socketcand")]
FAILURES += [("slcan", error) for error in ERRORS]


@pytest.mark.parametrize(("backend", "error"), FAILURES)
@pytest.mark.parametrize("place", ["open", "recv", "send", "set_filters", "shutdown"])
def test_exceptions_of_backends_become_link_errors(
    monkeypatch: pytest.MonkeyPatch, place: str, backend: str, error: BaseException
) -> None:
    """At every place, an exception of any class ends only the link, and close always succeeds."""
    bus = FailingBus(place, error)
    bus_class = Mock(side_effect=error) if place == "open" else Mock(return_value=bus)
    monkeypatch.setattr(can, "Bus", bus_class)
    link, ends = make("fake", backend=backend), list[object]()

    @in_loop
    async def run() -> None:
        if place == "open":
            for wait in (True, False):
                with pytest.raises(LinkError, match="cannot open fake"):
                    await link.wait_present() if wait else link.open()
            return
        await link.wait_present()
        link.open()
        link.start(lambda frames: None, lambda news, problem: None, ends.append)
        if place == "send":
            with pytest.raises(LinkError, match="cannot send on fake"):
                link.write(pack_frame(1, False, b""))
            with pytest.raises(LinkError, match="cannot send on fake"):
                link.send_cyclic([CyclicFrame(1, False, b"", 10**9)])
        link.filters = [CanFilter(1, 1, False)]
        for thread in [thread for thread in threading.enumerate() if place == "recv" and thread.name == "can fake"]:
            thread.join()
        await asyncio.sleep(0)
        link.close()
        link.close()
        await asyncio.sleep(0)

    run()
    assert len(ends) == (place in ("recv", "set_filters"))
    assert all(isinstance(end, LinkError) for end in ends)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("backend", list(can.interfaces.BACKENDS))
def test_installed_backends_without_adapter(backend: str, tmp_path: Path) -> None:
    """python-can without adapters and without libraries of vendors: LinkError, or a bus that needs no adapter."""
    link = PythonCanLink(backend, str(tmp_path / "nosuch"), 500_000)
    with contextlib.suppress(LinkError):
        link.open()
        assert backend in ("virtual", "udp_multicast")
    link.close()


class DamagedBus(FakeBus):
    """A bus whose messages include exceptions, which `recv` raises."""

    def __init__(self, *events: can.Message | Exception) -> None:
        super().__init__()
        self.events = list(events)
        self._buffer = bytearray(b"\xff")

    def recv(self, timeout_s: float) -> can.Message | None:
        event = self.events.pop(0) if self.events else None
        if isinstance(event, Exception):
            raise event
        return event


@in_loop
async def test_damaged_frames_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    undecodable = can.CanOperationError("Could not read from serial device")
    undecodable.__cause__ = UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")
    frame = can.Message(arbitration_id=5, is_extended_id=False, data=b"12")
    short = can.Message(arbitration_id=5, is_extended_id=False, data=b"1", dlc=2)
    bus = DamagedBus(ValueError("invalid literal"), frame, undecodable, short, IndexError("range"), frame)
    monkeypatch.setattr(can, "Bus", lambda *_, **__: bus)
    link, ends, frames = make("fake", backend="slcan"), list[object](), list[CanFrame]()
    link.open()
    received = asyncio.Event()

    def on_frames(batch: Sequence[CanFrame]) -> None:
        frames.extend(batch)
        received.set()

    link.start(on_frames, lambda news, problem: None, ends.append)
    await asyncio.wait_for(received.wait(), LIMIT_S)
    assert ([frame.data for frame in frames], ends) == ([b"12", b"12"], [])
    assert link.kernel_counters().framing == 4
    assert bus._buffer == b""
    link.close()


@in_loop
async def test_cyclic_frames_are_replaced_and_end_with_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus()
    monkeypatch.setattr(can, "Bus", lambda *_, **__: bus)
    link = make("fake")
    link.open()
    link.send_cyclic([CyclicFrame(1, False, b"", 10**12)])
    link.send_cyclic([CyclicFrame(2, False, b"", 10**12)])
    running = [timer for timer in asyncio.get_running_loop()._scheduled if not timer.cancelled()]  # type: ignore[attr-defined]
    assert len(running) == 1
    link.close()
    assert all(timer.cancelled() for timer in asyncio.get_running_loop()._scheduled)  # type: ignore[attr-defined]
    assert [message.arbitration_id for message in bus.sent] == [1, 2]


def test_settings_of_other_backends_and_filters_and_the_bit_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(msgspec.ValidationError, match="the system sets it"):
        msgspec.convert({"interface": "can0", "bitrate": 500000}, SocketCanOptions)
    assert make("rate", bitrate=250000).bitrate == 250000
    assert LINK.make_can(SocketCanOptions(interface="can0")).title == "can0"
    with pytest.raises(LinkError, match="cannot open"):
        PythonCanLink("nosuch", "x").open()
    packed = pack_filters([CanFilter(0x65, 0x7FF, False), CanFilter(0x18FEE900, 0x03FFFF00, True)])
    assert packed.hex() == "65000000ff0700c0" + "00e9fe9800ffffc3"
    opened, bus = list[dict[str, object]](), Mock()
    monkeypatch.setattr(can, "Bus", lambda *_where, **keys: opened.append(keys) or bus)  # type: ignore[func-returns-value]
    for bitrate, data_bitrate in ((0, 0), (250_000, 0), (0, 2_000_000)):
        link = PythonCanLink("virtual", "x", bitrate, data_bitrate)
        link.filters = wanted = [CanFilter(0x65, 0x7FF, False)]
        assert link.filters == wanted
        link.open()
    shared = {"can_filters": [{"can_id": 0x65, "can_mask": 0x7FF, "extended": False}], "ignore_config": True}
    assert opened == [shared, shared | {"bitrate": 250_000}, shared | {"fd": True, "data_bitrate": 2_000_000}]
    link.filters = [CanFilter(0x66, 0x7FE, True)]
    bus.set_filters.assert_called_once_with([{"can_id": 0x66, "can_mask": 0x7FE, "extended": True}])
