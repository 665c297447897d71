"""`record.start`, `.stop`, `.snapshot`: descriptors, rights, and the end of a recording."""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from io import BytesIO
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud.formats.jsonrpc import Code, RpcError
from imud.formats.recording import RecordingReader
from imud.formats.records import EndRecord, Kind, Record, decode_object
from imud.host.threads import BusThread
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.publishers.socket.admission import Guard, Quota, Rights
from imud.publishers.socket.server import SocketServer
from tests.publishers.recorder.recording_bench import HandSource
from tests.support.socket_rig import NOW_NS, Peer, alone, in_context, in_server, serving, until

RECORDINGS_MAX = 4
Recorded = tuple[SocketServer, HandSource]


@asynccontextmanager
async def recording(folder: Path) -> AsyncIterator[Recorded]:
    source = HandSource()
    async with serving(folder, recording=source) as server:
        yield server, source


class RecordingPeer(Peer):
    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self.fds: list[int] = []

    async def body(self) -> bytes:
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
        super().close()
        while self.fds:
            os.close(self.fds.pop())


async def tick_until(server: SocketServer, condition: Callable[[], bool]) -> None:
    """Call `tick`, as the daemon does, until the condition is true. `run` limits the time."""
    while not condition():
        server.tick(NOW_NS)
        await asyncio.sleep(0.001)


async def recording_of(server: SocketServer, peer: RecordingPeer) -> list[Record]:
    """Return the records from the descriptor, to end of file. They must be complete."""
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
    reader = RecordingReader(BytesIO(data), "received")
    found = list(reader)
    assert reader.problems == []
    return found


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


@in_context("recorded", recording)
async def test_a_recording_comes_through_the_descriptor_to_its_regular_end(recorded: Recorded) -> None:
    server, source = recorded
    source.present = ["imu0", "imu1"]
    peer = await RecordingPeer.greeted(server)
    before = open_descriptors()
    assert await peer.result("record.start", devices=["imu1", "imu1"]) == {"devices": ["imu1"]}
    server.tick(NOW_NS)
    source.deliver()
    assert await peer.error("record.start") == (
        -32004, "record.start: this connection already records; stop it with record.stop",
    )  # fmt: skip
    for device in ("imu0", "imu1"):
        server.event(Event(NOW_NS, device, EventKind.UP, "found"))
    server.remove_device("imu1")
    server.add_device("imu1", 1)
    server.tick(NOW_NS)
    server.event(Event(NOW_NS, "imu1", EventKind.DOWN, "gone"))
    assert await peer.result("record.stop") == {"stopped": True, "records_dropped": 0}
    assert await peer.result("record.stop") == {"stopped": False, "records_dropped": 0}
    found = await recording_of(server, peer)
    kinds = [record.kind for record in found]
    assert kinds[:3] == [Kind.SESSION, Kind.CALL, Kind.DEVICE]
    assert Kind.DATA in kinds
    assert kinds.count(Kind.EVENT) == 2
    assert kinds.count(Kind.DEVICE) == 2  # described again when the device was added again
    assert {record.device for record in found if record.kind in (Kind.DEVICE, Kind.CHECK, Kind.EVENT)} == {1}
    assert (decode_object(found[-1], EndRecord).reason, source.listening) == ("it was stopped", [])
    await tick_until(server, lambda: open_descriptors() == before)
    assert await peer.result("record.start") == {"devices": None}


@in_context("recorded", recording)
async def test_it_ends_with_the_connection_and_with_the_descriptor(recorded: Recorded) -> None:
    server, source = recorded
    before = open_descriptors()
    peer = await RecordingPeer.greeted(server)
    await peer.result("record.start")
    assert source.listening
    peer.close()
    await tick_until(server, lambda: not source.listening)
    assert open_descriptors() == before
    peer = await RecordingPeer.greeted(server)
    await peer.result("record.start")
    os.close(peer.fds.pop())
    await tick_until(server, lambda: not source.listening)
    assert open_descriptors() == before + 2  # both ends of the connection
    await peer.result("record.start")
    peer.close()
    await until(lambda: not server.hub.connections)


@pytest.mark.parametrize("stopped", [False, True])
@alone()
async def test_a_stop_of_imud_ends_a_recording_regularly(tmp_path: Path, stopped: bool) -> None:
    async with recording(tmp_path) as (server, source):
        peer = await RecordingPeer.greeted(server)
        await peer.result("record.start")
        source.deliver()
        if stopped:
            await peer.result("record.stop")
    assert source.listening == []
    found = records_of(os.read(peer.fds[0], 1 << 16))
    assert decode_object(found[-1], EndRecord).reason == ("it was stopped" if stopped else "imud stopped")


@in_context("recorded", recording)
async def test_the_maximum_counts_recordings_that_run_and_those_that_still_send(recorded: Recorded) -> None:
    server, _source = recorded
    peers = [await RecordingPeer.greeted(server) for _ in range(RECORDINGS_MAX + 1)]
    for peer in peers[:-1]:
        await peer.result("record.start")
    full = (-32004, f"record.start: {RECORDINGS_MAX} recordings are running, the maximum")
    assert await peers[-1].error("record.start") == full
    peers[0].close()  # this ends its recording immediately
    await until(lambda: len(server.hub.connections) == RECORDINGS_MAX)
    await peers[-1].result("record.start")
    for peer in peers[1:3]:  # these recordings end with the next tick
        await peer.result("record.stop")
    assert await peers[1].error("record.start") == full
    await recording_of(server, peers[1])
    await recording_of(server, peers[2])
    await peers[1].result("record.start")
    await peers[2].result("record.start")


@in_server()
async def test_reading_is_not_enough(server: SocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    peer = await Peer.greeted(server)
    code, message = await peer.error("record.start", devices=["imu7"])
    words = 'expected a device that imud knows, got "imu7"; did you mean imu1? known: imu0, imu1'
    assert (code, message) == (-32602, words)
    monkeypatch.setattr(Guard, "rights_of", lambda _guard, _peer: Rights.READ)
    peer = await Peer.greeted(server)
    for method in ("record.start", "record.stop", "record.snapshot"):
        code, message = await peer.error(method)
        assert code == -32001
        assert message.startswith(f"{method}: expected root or a member of")


@pytest.mark.parametrize("method", ["record.start", "record.snapshot"])
@alone()
async def test_a_failed_request_leaves_no_fd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    fail = Mock(side_effect=RuntimeError("can't start new thread"))
    refuse = Mock(side_effect=ServerError("nothing is kept: it has just begun"))
    no_socket = Mock(side_effect=OSError(24, "Too many open files"))
    checked: list[int] = []
    refusing: list[bool] = []

    def check_fds(_quota: Quota, fds: Sequence[int]) -> None:
        checked.extend(fds)
        if refusing:
            raise RpcError(Code.UNAVAILABLE, "none to spare")

    monkeypatch.setattr(Quota, "check_fds", check_fds)
    async with serving(tmp_path) as server:
        peer = await Peer.greeted(server)
        if method == "record.snapshot":
            code, message = await peer.error(method)
            assert code == -32004
            assert "`recorder: {flight: {enabled: true}}`" in message
            server.hub.context.outputs.snapshots.append(refuse)
            why = "nothing is kept: it has just begun"
        else:
            monkeypatch.setattr(BusThread, "__init__", fail)
            why = "the daemon cannot record: can't start new thread"
        before = open_descriptors()
        for _ in range(2):  # the second call succeeds only if the first closed its descriptor
            assert await peer.error(method) == (-32004, f"{method}: {why}")
        assert (open_descriptors(), len(checked), len(set(checked))) == (before, 4, 2)
        refusing.append(True)
        assert await peer.error(method) == (-32004, "none to spare")
        assert open_descriptors() == before
        monkeypatch.setattr(socket, "socketpair", no_socket)
        why = "the daemon cannot make a descriptor: Too many open files"
        assert await peer.error(method) == (-32004, f"{method}: {why}")


@in_server()
async def test_a_snapshot_contains_the_data_of_the_flight_recorder(server: SocketServer) -> None:
    def take(sock: socket.socket) -> float:
        with sock:
            sock.send(b"a snapshot")
        return 299.5

    peer = await RecordingPeer.greeted(server)
    server.hub.context.outputs.snapshots.append(take)
    assert await peer.result("record.snapshot") == {"seconds": 299.5}
    assert (os.read(peer.fds[0], 100), os.read(peer.fds[0], 100)) == (b"a snapshot", b"")
