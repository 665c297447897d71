"""Images of clients for firmware updates, and one update at a time."""

import asyncio
import os
import socket
from typing import Any
from zlib import crc32

import pytest

from imud.contracts.firmware import IMAGE_BYTES_MAX
from imud.publishers.socket.admission import Rights
from imud.publishers.socket.server import SocketServer
from tests.support import socket_rig
from tests.support.socket_rig import Peer, in_server, until

IMAGE = bytes(range(256)) * 8


async def opened(peer: Peer, size: int = len(IMAGE)) -> int:
    """Return the descriptor of `firmware.open`."""
    await peer.send(b'{"jsonrpc":"2.0","id":1,"method":"firmware.open","params":{"size_bytes":%d}}\n' % size)
    fds: list[int] = []
    data = b""
    while not data:
        await asyncio.sleep(0)
        try:
            data, fds, _flags, _address = socket.recv_fds(peer.sock, 4096, 4)
        except BlockingIOError:
            continue
    assert data == b'{"jsonrpc":"2.0","id":1,"result":{"size_bytes":%d}}\n' % size
    (fd,) = fds
    return fd


def write(fd: int, data: bytes = IMAGE) -> None:
    os.pwrite(fd, data, 0)
    os.close(fd)


def params(**more: object) -> dict[str, Any]:
    return {"device": "imu0", "address": 0x0801_0000, "crc32": crc32(IMAGE), **more}


@in_server()
async def test_image_reaches_the_device(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    before = len(os.listdir("/proc/self/fd"))
    for version in (None, "1.7.0"):
        write(await opened(peer))
        result = await peer.result("firmware.update", **params(product="HI13", version=version))
        assert (result["size_bytes"], result["product"], result["after"]) == (2048, "HI13", version or "")
    assert len(os.listdir("/proc/self/fd")) == before


@in_server()
async def test_size_of_the_file_is_fixed_and_the_content_is_checked(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    fd = await opened(peer)
    for change in (lambda: os.ftruncate(fd, 1), lambda: os.pwrite(fd, b"x", len(IMAGE))):
        with pytest.raises(PermissionError):
            change()
    write(fd, IMAGE[::-1])
    code, message = await peer.error("firmware.update", **params())
    assert (code, "expected an image with the CRC-32" in message) == (-32602, True)
    code, message = await peer.error("firmware.update", **params())
    assert (code, message) == (-32602, "firmware.update: expected firmware.open on this connection before")


@in_server()
async def test_wrong_parameters_are_explained(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    for size in (0, IMAGE_BYTES_MAX + 1):
        code, message = await peer.error("firmware.open", size_bytes=size)
        assert (code, str(size) in message) == (-32602, True)
    for wrong in ({"device": "imu7"}, {"address": -1}, {"address": 1 << 32}, {"crc32": "1"}, {"product": "x" * 65}):
        assert (await peer.error("firmware.update", **params(**wrong)))[0] == -32602
    with_rights = await opened(peer)
    os.close(with_rights)
    code, message = await peer.error("firmware.update", **params(crc32=crc32(bytes(len(IMAGE))), product="refused"))
    assert (code, "refuses" in message) == (-32005, True)


@in_server()
async def test_clients_without_the_right_to_control_are_refused(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    connection.rights = Rights.READ
    requests: dict[str, dict[str, Any]] = {"firmware.open": {"size_bytes": 1}, "firmware.update": params()}
    for method, given in requests.items():
        code, message = await peer.error(method, **given)
        assert code == -32001
        assert message.startswith(f"{method}: expected root or a member of group 'imud-control'")


@in_server()
async def test_one_update_runs_at_a_time(server: SocketServer) -> None:
    first, second = await Peer.greeted(server), await Peer.greeted(server)
    for peer in (first, second):
        write(await opened(peer))
    socket_rig.done_late = asyncio.Event()
    waiting = asyncio.create_task(first.result("firmware.update", **params(product="wait")))
    await until(lambda: bool(server.hub.running))
    await asyncio.sleep(0)
    code, message = await second.error("firmware.update", **params(device="imu1"))
    assert code == -32005
    assert f"imu1: the firmware update of imu0 is running, started 0 s ago by uid {os.getuid()}" in message
    socket_rig.done_late.set()
    await waiting
    write(await opened(second))
    assert (await second.result("firmware.update", **params(device="imu1")))["verified"]


@in_server()
async def test_file_ends_with_its_connection(server: SocketServer) -> None:
    before = len(os.listdir("/proc/self/fd"))
    peer = await Peer.greeted(server)
    fds = [await opened(peer) for _ in range(3)]  # a new file replaces the previous file
    for fd in fds:
        os.close(fd)
    assert len(os.listdir("/proc/self/fd")) == before + 2 + 1  # both ends of the connection, one file
    peer.close()
    await until(lambda: not server.hub.connections)
    assert len(os.listdir("/proc/self/fd")) == before
