"""Several datagrams in one system call, like the frames of a simulated device."""

import errno
import socket
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import pytest

from imud.drivers.hipnuc.canfd import HipnucCanfdCodec, HipnucCanfdOptions
from imud.formats.can import ERROR_FLAG, RAW_FRAME, REMOTE_FLAG, pack_frame
from imud.links.socketcan import BusState, FrameReader, libc
from imud.model.errors import LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.can_module import SentFrame
from imud.sim.hipnuc.j1939 import CANFD_SIMULATOR
from imud.sim.ports import can_port
from imud.sim.ports.can_port import CanPort, default_interface, open_can_socket
from imud.sim.sensor import SimulatorOptions


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    far.setblocking(False)
    with near, far:
        yield near, far


def test_datagrams_come_whole_and_in_order(
    pair: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = pair
    calls: list[int] = []
    real = libc.sendmmsg

    class Counting:
        @staticmethod
        def sendmmsg(*arguments: object) -> int:
            calls.append(1)
            return int(real(*arguments))

    monkeypatch.setattr(can_port, "libc", Counting)
    assert can_port.send_all(near.fileno(), [b"one", b"", b"\0three\0"]) == []
    assert [far.recv(64) for _ in range(3)] == [b"one", b"", b"\0three\0"]
    assert len(calls) == 1
    assert can_port.send_all(near.fileno(), []) == []
    assert len(calls) == 1
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    fd = near.fileno()
    near.close()
    far.close()
    assert [error.errno for error in can_port.send_all(fd, [b"a", b"b"])] == [errno.EBADF, errno.EBADF]


def test_those_that_are_refused_are_reported_one_by_one(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    far.setblocking(True)
    datagrams = [bytes([number]) * 8 for number in range(250)] * 8
    refused = can_port.send_all(near.fileno(), datagrams)
    assert refused
    assert {error.errno for error in refused} == {errno.EAGAIN}
    got = [far.recv(64) for _ in range(len(datagrams) - len(refused))]
    assert got == datagrams[: len(got)]


def test_a_port_passes_frames_in_both_directions(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    due, received, reboots = list[SentFrame](), list[tuple[object, ...]](), list[int]()
    module: Any = SimpleNamespace(
        advance=lambda _now_ns: [due.pop() for _ in due[:]], receive=lambda *frame: received.append(frame),
        next_ns=lambda: None, counters=lambda: {"frames_sent": 3}, reboot=reboots.append, epoch_ns=7,
    )  # fmt: skip
    port = CanPort(module, "vcan9", open_socket=lambda name: near if name == "vcan9" else far)
    assert (port.fileno(), port.node, port.is_open) == (near.fileno(), port, True)
    far.send(pack_frame(0x7FF, False, b"abc"))
    far.send(pack_frame(0, True, b""))
    far.send(pack_frame(1, True, bytes(range(64))))
    for flag in (ERROR_FLAG, REMOTE_FLAG):
        far.send(RAW_FRAME.pack(0x123 | flag, 8, bytes(8)))
    port.step(5, readable=False)
    assert received == []
    port.step(6, readable=True)
    assert received == [(0x7FF, False, b"abc", 6), (0, True, b"", 6), (1, True, bytes(range(64)), 6)]
    frame = SentFrame(10, 0x188, False, b"x")
    due += [frame, SentFrame(10, 0x188, False, bytes(48))]
    port.step(10, readable=False)
    assert [far.recv(80) for _ in range(2)] == [pack_frame(0x188, False, data) for data in (bytes(48), b"x")]
    assert port.next_ns(10) == 10
    module.next_ns = lambda: 30
    assert port.next_ns(10) == 30
    port.unplug(10, 90)  # no power until 100
    assert reboots == [100]
    assert port.next_ns(10) == 100
    due.append(frame)
    port.step(99, readable=False)
    assert due == [frame]
    port.step(100, readable=False)
    assert far.recv(64) == pack_frame(0x188, False, b"x")
    assert port.summary() == {"frames_sent": 3, "frames_refused": 0, "epoch_ns": 7}
    port.close()
    assert near.fileno() == -1
    due.extend([frame, frame])
    port.step(101, readable=False)
    assert port.summary()["frames_refused"] == 2
    port.step(102, readable=True)  # a failed read is ignored: an interface can return
    assert len(received) == 3


@pytest.mark.parametrize("message", ["canfd", "canfd_old"])
def test_can_fd_samples_cross_a_socket(pair: tuple[socket.socket, socket.socket], message: str) -> None:
    near, far = pair
    begin_ns = time.monotonic_ns()
    module = CANFD_SIMULATOR.make(SimulatorOptions(message=message, boot_ms=0, rate_hz=100.0, noise="none"), begin_ns)
    port = CanPort(module, "vcan9", open_socket=lambda _name: near)
    reader, codec = FrameReader(far, BusState("vcan9")), HipnucCanfdCodec(Ledger(), HipnucCanfdOptions())
    events: list[Any] = []
    for ms in range(0, 3000, 5):
        port.step(begin_ns + ms * 1_000_000, readable=False)
        for frame in reader.read():
            if len(frame.data) == 64:  # not the claim of the address
                events += codec.feed_frame(frame.can_id, frame.extended, frame.data, begin_ns + ms * 1_000_000)
    assert all(isinstance(event, Measurement) for event in events)
    assert [event.dev_ticks for event in events] == list(range(0, 2991, 10))
    assert (len(events), codec.ledger.lost(), codec.ledger.frames_bad(), port.frames_refused) == (300, 0, 0, 0)


def test_an_interface_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LinkError, match="CAN"):
        open_can_socket("no-such-can")
    monkeypatch.setattr(can_port, "can_interfaces", lambda: ["can7", "can8"])
    assert default_interface() == "can7"
    monkeypatch.setattr(can_port, "can_interfaces", list)
    with pytest.raises(LinkError, match="got none"):
        default_interface()


def test_a_socket_is_bound_to_an_interface_that_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Mock()
    monkeypatch.setattr(socket, "socket", lambda *_: made)
    assert open_can_socket("can0") is made
    made.getsockopt.side_effect = OSError(errno.ENETDOWN, "Network is down")
    with pytest.raises(LinkError, match="can0: Network is down: expected a CAN interface that is up"):
        open_can_socket("can0")
    assert (made.bind.call_args_list, made.close.call_count) == ([call(("can0",))] * 2, 1)
