"""Descriptors that wake clients. No client can block the daemon with its descriptor."""

import asyncio
import os
import select
import socket
from pathlib import Path
from unittest.mock import patch

import pytest

from imud.formats.jsonrpc import encode_notification
from imud.publishers.socket.client import BYTE, ClientConnection, Waker
from imud.publishers.socket.outbox import NO_FD
from imud.publishers.socket.server import SocketServer
from tests.support.socket_rig import Peer, SteppingClock, alone, batch, in_server, serving, until


async def notified(peer: Peer, device: str = "imu0") -> int:
    await peer.send(b'{"jsonrpc":"2.0","id":1,"method":"notify","params":{"device":"%s"}}\n' % device.encode())
    await until(lambda: bool(select.select([peer.sock], [], [], 0)[0]))
    data, fds, _flags, _address = socket.recv_fds(peer.sock, 4096, 4)
    assert data == b'{"jsonrpc":"2.0","id":1,"result":{"device":"%s","latency_ms":0.0}}\n' % device.encode()
    (fd,) = fds
    return fd


def copies_held(connection: ClientConnection) -> list[Waker]:
    """Return the wakers with a copy of the client's end in the daemon."""
    return [waker for waker in connection.wakers.values() if waker.client_end != NO_FD]


async def wakened() -> None:
    """Wait until imud has woken the clients of the published batches."""
    done = asyncio.Event()
    asyncio.get_running_loop().call_soon(done.set)
    await done.wait()


def read_all(fd: int) -> bytes | None:
    try:
        return os.read(fd, 4096)
    except BlockingIOError:
        return None


@in_server()
async def test_notify_wakes_for_one_device_and_ends_the_old_descriptor(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    fd = await notified(peer)
    (connection,) = server.hub.connections.values()
    assert not copies_held(connection)  # the daemon keeps no copy
    server.publish(batch("imu1"))
    await wakened()
    assert read_all(fd) is None
    for first in (1, 3):
        server.publish(batch("imu0", first, 2))
        assert read_all(fd) is None  # not yet: the output shm may run later
        await wakened()
        assert read_all(fd) == BYTE
    other = await notified(peer, "imu1")
    server.publish(batch("imu1", 2))
    await wakened()
    assert (read_all(fd), read_all(other)) == (None, BYTE)
    peer.close()
    await until(lambda: not server.hub.connections)
    assert (read_all(fd), read_all(other)) == (b"", b"")
    os.close(fd)
    os.close(other)
    peer = await Peer.greeted(server)
    before = len(os.listdir("/proc/self/fd"))
    fds = [await notified(peer) for _ in range(5)]
    assert len(os.listdir("/proc/self/fd")) == before + 5 + 1  # five of the client, one of the daemon
    server.publish(batch())
    await wakened()
    assert [read_all(fd) for fd in fds] == [b"", b"", b"", b"", BYTE]
    for fd in fds:
        os.close(fd)


@alone()
async def test_many_clients_are_woken_in_several_turns(tmp_path: Path) -> None:
    """imud wakes clients for 0.3 ms per turn, first the clients that the last batch did not wake."""
    clock = SteppingClock()
    async with serving(tmp_path, clock) as server:
        fds = [await notified(await Peer.greeted(server)) for _ in range(40)]
        clock.step_ns = 200_000
        for batches, expected in ((1, [32, 8]), (2, [32, 32, 8])):
            for _ in range(batches):
                server.publish(batch("imu0"))
            woken = []
            for _ in expected:
                await asyncio.sleep(0)
                woken.append([fd for fd in fds if read_all(fd) == BYTE])
            assert ([len(turn) for turn in woken], {*woken[0], *woken[1]}) == (expected, {*fds})
        for fd in fds:
            os.close(fd)


@pytest.mark.timeout(60)  # a blocked daemon never returns
@in_server()
async def test_no_client_makes_the_daemon_wait(server: SocketServer) -> None:
    """A client clears O_NONBLOCK of its descriptor and never reads. imud still wakes the other client."""
    hostile, other = await Peer.greeted(server), await Peer.greeted(server)
    held, fd = await notified(hostile), await notified(other)
    os.set_blocking(held, True)
    with pytest.raises(BrokenPipeError), socket.socket(fileno=os.dup(held)) as sock:
        sock.send(b"this is never read")
    for seq in range(1, 101):
        server.publish(batch("imu0", seq))
        await wakened()
        assert read_all(fd) == BYTE
    assert 1 <= len(os.read(held, 4096)) <= 64  # the buffer was full; docs/socket.md: 64 bytes are enough
    server.publish(batch("imu0", 301))
    await wakened()
    assert read_all(held) == BYTE
    for end in (held, fd):
        os.close(end)
    for peer in (hostile, other):
        assert len(await peer.result("devices")) == 2


@in_server()
async def test_a_client_that_closes_its_descriptor_is_not_woken_any_more(server: SocketServer) -> None:
    closing, other = await Peer.greeted(server), await Peer.greeted(server)
    os.close(await notified(closing))
    fd = await notified(other)
    first, second = server.hub.connections.values()
    for seq in (1, 2):
        server.publish(batch("imu0", seq))
        await wakened()
        assert read_all(fd) == BYTE
        assert not first.wakers
    os.close(fd)
    server.publish(batch("imu0", 3))
    await wakened()
    assert not second.wakers
    server.publish(batch("imu0", 4))
    assert not server.hub.wakes("imu0")  # no waker is left
    for peer in (closing, other):
        assert len(await peer.result("devices")) == 2


@in_server()
async def test_unread_replies_do_not_gather_descriptors(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    connection.post(encode_notification("big", "x" * 500_000))  # the socket is full
    before = len(os.listdir("/proc/self/fd"))
    requests = [(number, "imu0" if number < 5 else "imu1") for number in range(6)]
    for number, device in requests:
        line = b'{"jsonrpc":"2.0","id":%d,"method":"notify","params":{"device":"%s"}}\n'
        await peer.send(line % (number, device.encode()))
    await until(lambda: len(connection.wakers) == 2)
    assert len(os.listdir("/proc/self/fd")) == before + 4  # both ends of two wakers
    replies = (await peer.messages(7))[1:]
    assert ["error" in reply for reply in replies] == [False, True, True, True, True, False]
    assert "ask again" in replies[1]["error"]["message"]
    assert (replies[1]["error"]["code"], len(os.listdir("/proc/self/fd"))) == (-32004, before + 2)
    os.close(await notified(peer))
    connection.post(encode_notification("big", "x" * 500_000))
    assert not server.hub.tick(0)
    connection.finish()
    assert server.hub.tick(0)


@in_server()
async def test_notify_without_a_free_descriptor(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    fd = await notified(peer)
    with patch.object(socket, "socketpair", side_effect=OSError(24, "Too many open files")):
        code, message = await peer.error("notify", device="imu0")
    assert code == -32004
    assert "Too many open files" in message
    server.publish(batch())
    await wakened()
    assert read_all(fd) == BYTE  # the old waker still works
    os.close(fd)
