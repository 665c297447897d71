"""Connections to servers: small pieces in different turns, addresses, and the end of a connection."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from unittest.mock import AsyncMock

import pytest

from imud.host import peer_stream
from imud.host.peer_stream import READ_BYTES, PeerStream, open_peer_stream
from imud.model.units import NS_PER_MS
from imud.model.work_budget import WorkBudget, WorkLimits
from tests.support.event_loops import in_loop

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Cpu:
    ns = 0

    def __call__(self) -> int:
        return self.ns


@asynccontextmanager
async def connected(serve: Serve, cpu: Cpu) -> AsyncIterator[tuple[PeerStream, WorkBudget]]:
    connection_end = asyncio.Event()

    async def serve_and_close(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await serve(reader, writer)
        writer.close()
        connection_end.set()

    budget = WorkBudget(WorkLimits(), cpu)
    server = await asyncio.start_server(serve_and_close, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server:
        stream = await open_peer_stream("127.0.0.1", port, "the server", budget, lambda: 0)
        yield stream, budget
        await stream.close()
        await connection_end.wait()


@in_loop
async def test_other_work_runs_between_two_pieces() -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(bytes(10 * READ_BYTES))

    turns = 0

    def count_turn() -> None:
        nonlocal turns
        turns += 1
        asyncio.get_running_loop().call_soon(count_turn)

    async with connected(serve, Cpu()) as (stream, _):
        count_turn()
        received_bytes = pieces = 0
        while data := await stream.read():
            assert len(data) <= READ_BYTES
            received_bytes += len(data)
            pieces += 1
        assert received_bytes == 10 * READ_BYTES
        assert turns >= pieces


@in_loop
async def test_only_the_work_after_a_read_is_charged(monkeypatch: pytest.MonkeyPatch) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(3):
            writer.write(b"x")
            await reader.read(1)

    cpu = Cpu()
    pauses: list[float] = []
    sleep = asyncio.sleep

    async def wait(seconds: float) -> None:
        if seconds:
            pauses.append(seconds)
            budget._uses.clear()  # the next second
        await sleep(0)

    async with connected(serve, cpu) as (stream, budget):
        monkeypatch.setattr(asyncio, "sleep", wait)
        await stream.read()
        stream.end_turn()
        cpu.ns += 1000 * NS_PER_MS  # work of others
        stream.write(b"1")
        await stream.read()
        assert not pauses
        cpu.ns += 60 * NS_PER_MS  # above the 50 ms of a second
        stream.write(b"1")
        await stream.read()
        assert pauses == [0.1]
        assert budget.problem(0).startswith("the server sends more than imud processes: 1 inputs")
        stream.write(b"1")


@in_loop
async def test_first_address_that_accepts(monkeypatch: pytest.MonkeyPatch) -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"hello")

    addresses = AsyncMock(return_value=["127.0.0.2", "127.0.0.1", "127.0.0.3"])
    monkeypatch.setattr(peer_stream, "resolve", addresses)
    async with connected(serve, Cpu()) as (stream, _):
        assert await stream.read() == b"hello"
        assert await stream.read() == b""
    addresses.return_value = ["127.0.0.2", "127.0.0.3"]
    with pytest.raises(ConnectionRefusedError):
        await open_peer_stream("name", 9, "the server", WorkBudget(WorkLimits(), Cpu()), lambda: 0)


@in_loop
async def test_close_sends_the_queued_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The transport closes itself after the last byte. A second call of `abort` does nothing."""
    received_bytes = 0

    async def serve(reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        nonlocal received_bytes
        while data := await reader.read(1 << 20):
            received_bytes += len(data)

    monkeypatch.setattr(peer_stream, "CLOSE_S", 60.0)
    async with connected(serve, Cpu()) as (stream, _):
        stream.write(bytes(30_000_000))
        await stream.close()
        stream.abort()
        stream.abort()
    assert received_bytes == 30_000_000
