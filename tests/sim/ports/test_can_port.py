"""Several datagrams in one system call, like the frames of a simulated device."""

import errno
import socket
from collections.abc import Iterator

import pytest

from imud.links.socketcan import libc
from imud.sim.ports import can_port


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
