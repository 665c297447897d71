"""`record.start`, `.stop`, `.snapshot`: descriptors with recordings, who may have them, and when they end."""

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import pytest

from imud.errors import ServerError
from imud.formats.jsonrpc import Code, RpcError
from imud.formats.recording.file import RecordingReader
from imud.formats.recording.records import EndRecord, Kind, Record, decode_object
from imud.publishers.socket.publisher import SocketServer
from imud.publishers.socket.quota import Quota
from imud.publishers.socket.recordings import RECORDINGS_MAX
from imud.publishers.socket.rights import Guard, Rights
from imud.worker import BusThread
from tests.publishers.recorder.recording_bench import HandSource
from tests.support.socket_rig import NOW_NS, Peer, run, serving, until


class RecordingPeer(Peer):
    """A client that keeps the descriptors that come."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self.fds: list[int] = []

    async def body(self) -> bytes:
        """The next line."""
        while (body := self._take()) is None:
            try:
                data, fds, _flags, _address = socket.recv_fds(self.sock, 1 << 16, 4)
            except BlockingIOError:
                await asyncio.sleep(0)
                continue
            self.fds += fds
            if not data:
                raise EOFError
            self.buffer += data
        return body

    def close(self) -> None:
        """Disconnect, and close what came."""
        super().close()
        while self.fds:
            os.close(self.fds.pop())


async def tick_until(server: SocketServer, condition: Callable[[], bool]) -> None:
    """Tick as the daemon does until something is so; `run` limits the time."""
    while not condition():
        server.tick(NOW_NS)
        await asyncio.sleep(0.001)


async def recording_of(server: SocketServer, peer: RecordingPeer) -> list[Record]:
    """The records that come through the descriptor, to end of file; they must be whole."""
    fd = peer.fds.pop()
    os.set_blocking(fd, False)

    chunks: list[bytes] = []

    def is_read() -> bool:
        with suppress(BlockingIOError):
            chunks.append(os.read(fd, 1 << 16))
        return bool(chunks) and not chunks[-1]

    await tick_until(server, is_read)
    os.close(fd)
    return records_of(b"".join(chunks))


def records_of(data: bytes) -> list[Record]:
    """The records of a whole recording."""
    reader = RecordingReader(BytesIO(data), "received")
    found = list(reader)
    assert reader.problems == []
    return found


def test_a_recording_comes_through_the_descriptor_to_its_regular_end(tmp_path: Path) -> None:
    async def body() -> None:
        source = HandSource()
        source.present = ["imu0", "imu1"]
        async with serving(tmp_path, recording=source) as server:
            peer = await RecordingPeer.greeted(server)
            assert await peer.result("record.start", devices=["imu1", "imu1"]) == {"devices": ["imu1"]}
            server.tick(NOW_NS)
            source.deliver()
            assert await peer.error("record.start") == (
                -32004, "record.start: this connection records already; record.stop ends that",
            )  # fmt: skip
            assert await peer.result("record.stop") == {"stopped": True, "records_dropped": 0}
            assert await peer.result("record.stop") == {"stopped": False, "records_dropped": 0}
            found = await recording_of(server, peer)
            kinds = [record.kind for record in found]
            assert kinds[:3] == [Kind.SESSION, Kind.CALL, Kind.DEVICE]
            assert Kind.DATA in kinds
            assert {record.device for record in found if record.kind in (Kind.DEVICE, Kind.CHECK)} == {1}
            assert decode_object(found[-1], EndRecord).reason == "it was stopped"
            assert source.listening == []
            assert await peer.result("record.start") == {"devices": None}
            peer.close()

    run(body)


def test_it_ends_with_the_connection_and_with_the_descriptor(tmp_path: Path) -> None:
    async def body() -> None:
        source = HandSource()
        async with serving(tmp_path, recording=source) as server:
            peer = await RecordingPeer.greeted(server)
            await peer.result("record.start")
            assert source.listening
            peer.close()
            await tick_until(server, lambda: not source.listening)
            peer = await RecordingPeer.greeted(server)
            await peer.result("record.start")
            os.close(peer.fds.pop())
            await tick_until(server, lambda: not source.listening)
            await peer.result("record.start")
            peer.close()
            await until(lambda: not server.hub.connections)

    run(body)


def test_imud_that_stops_ends_it_regularly(tmp_path: Path) -> None:
    async def body() -> tuple[int, RecordingPeer]:
        source = HandSource()
        async with serving(tmp_path, recording=source) as server:
            peer = await RecordingPeer.greeted(server)
            await peer.result("record.start")
            source.deliver()
        assert source.listening == []
        return peer.fds.pop(), peer

    fd, peer = run(body)
    with open(fd, "rb") as file:
        found = records_of(file.read())
    assert decode_object(found[-1], EndRecord).reason == "imud stopped"
    peer.close()


def test_there_are_only_so_many_at_a_time(tmp_path: Path) -> None:
    async def body() -> None:
        async with serving(tmp_path, recording=HandSource()) as server:
            peers = [await RecordingPeer.greeted(server) for _ in range(RECORDINGS_MAX + 1)]
            for peer in peers[:-1]:
                await peer.result("record.start")
            code, message = await peers[-1].error("record.start")
            assert code == -32004
            assert f"{RECORDINGS_MAX} recordings run already" in message
            peers[0].close()
            await until(lambda: len(server.hub.connections) == RECORDINGS_MAX)
            await peers[-1].result("record.start")
            for peer in peers:
                peer.close()

    run(body)


def test_reading_is_not_enough_and_devices_must_be_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def body() -> None:
        async with serving(tmp_path) as server:
            peer = await Peer.greeted(server)
            code, message = await peer.error("record.start", devices=["imu7"])
            assert (code, message) == (-32602, "no device named 'imu7'; there are: imu0, imu1")
            peer.close()
            monkeypatch.setattr(Guard, "rights_of", lambda _guard, _peer: Rights.READ)
            peer = await Peer.greeted(server)
            for method in ("record.start", "record.stop", "record.snapshot"):
                code, message = await peer.error(method)
                assert code == -32001
                assert message.startswith(f"{method}: expected root or a member of")
            peer.close()

    run(body)


def test_a_daemon_without_descriptors_or_threads_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    refusing: list[bool] = []

    def check_fds(*_: object) -> None:
        if refusing:
            raise RpcError(Code.UNAVAILABLE, "none to spare")

    monkeypatch.setattr(Quota, "check_fds", check_fds)

    async def body() -> None:
        async with serving(tmp_path) as server:
            peer = await Peer.greeted(server)
            monkeypatch.setattr(BusThread, "__init__", no_thread)
            code, message = await peer.error("record.start")
            assert (code, message) == (-32004, "record.start: the daemon cannot record: can't start new thread")
            refusing.append(True)
            assert await peer.error("record.start") == (-32004, "none to spare")
            peer.close()

    run(body)


def test_a_snapshot_is_what_the_flight_recorder_sends(tmp_path: Path) -> None:
    def take(sock: socket.socket) -> float:
        with sock:
            sock.send(b"a snapshot")
        return 299.5

    def refuse(_sock: socket.socket) -> float:
        raise ServerError("nothing is kept: it has just begun")

    async def body() -> None:
        async with serving(tmp_path) as server:
            peer = await RecordingPeer.greeted(server)
            code, message = await peer.error("record.snapshot")
            assert code == -32004
            assert "`recorder: {flight: {enabled: true}}`" in message
            server.hub.context.snapshots.append(take)
            assert await peer.result("record.snapshot") == {"seconds": 299.5}
            assert os.read(peer.fds[0], 100) == b"a snapshot"
            assert os.read(peer.fds[0], 100) == b""
            server.hub.context.snapshots[0] = refuse
            assert await peer.error("record.snapshot") == (
                -32004,
                "record.snapshot: nothing is kept: it has just begun",
            )
            peer.close()

    run(body)
