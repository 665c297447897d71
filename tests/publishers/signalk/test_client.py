"""Client of a hostile Signal K server: slow and endless replies, floods of frames, and its own certificate."""

import asyncio
import shutil
import ssl
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from unittest.mock import AsyncMock

import pytest

from imud.host import peer_stream
from imud.model.units import NS_PER_S
from imud.publishers.signalk import websocket
from imud.publishers.signalk.client import HandshakeRefused, SignalKClient
from imud.publishers.signalk.settings import address_of
from imud.publishers.signalk.websocket import ControlFrame, UnusableServer, accept_of
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.publisher_context import publisher_context

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter, bytes], Awaitable[None]]
Scene = Callable[[SignalKClient], Awaitable[None]]
HEAD_END = b"\r\n\r\n"


class Bench:
    """A server of the test, and a client in virtual time."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.cpu_ns = 0
        self.context = publisher_context(now_ns=self.clock.now_ns, cpu_ns=lambda: self.cpu_ns)

    def run(self, serve: Serve, scene: Scene) -> None:
        async def body() -> None:
            connections: set[asyncio.Task[None]] = set()

            async def serve_connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
                task = asyncio.current_task()
                assert task is not None
                connections.add(task)
                with suppress(OSError, asyncio.IncompleteReadError):
                    await serve(reader, writer, await reader.readuntil(HEAD_END))
                writer.transport.abort()

            server = await asyncio.start_server(serve_connection, "127.0.0.1", 0)
            address = address_of(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}")
            assert address is not None
            async with server:
                await scene(SignalKClient(address, None, self.context.clock))
                await asyncio.gather(*connections)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(peer_stream, "resolve", AsyncMock(return_value=["127.0.0.1"]))
            run_virtually(self.clock, body())


async def accept(writer: asyncio.StreamWriter, request: bytes) -> None:
    lines = request.decode().split("\r\n")
    key = next(line.partition(": ")[2] for line in lines if line.startswith("Sec-WebSocket-Key"))
    writer.write(b"HTTP/1.1 101 Switching Protocols\r\nSec-WebSocket-Accept: %b\r\n\r\n" % accept_of(key).encode())
    await writer.drain()


OK = b"HTTP/1.1 200 OK\r\n"
SLOW_REPLIES = {
    "status": (b"", b"H"),
    "headers": (OK, b"x"),
    "interim replies": (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "body": (OK + b"Content-Length: 100\r\n\r\n", b"x"),
    "chunks": (OK + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\nx\r\n"),
}


@pytest.mark.parametrize("name", SLOW_REPLIES)
@pytest.mark.parametrize("is_websocket", [False, True])
def test_one_deadline_for_a_reply(name: str, is_websocket: bool) -> None:
    """The server sends one piece each 4 s."""
    bench = Bench()
    start, piece = SLOW_REPLIES[name]

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _request: bytes) -> None:
        writer.write(start)
        while not writer.transport.is_closing():
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(4)

    async def scene(client: SignalKClient) -> None:
        start_ns = bench.clock.now_ns()
        with pytest.raises(TimeoutError):
            await (client.open_websocket("/", {}) if is_websocket else client.request("GET", "/", {}))
        assert (bench.clock.now_ns() - start_ns) / NS_PER_S == pytest.approx(10, abs=0.1)

    bench.run(serve, scene)


@pytest.mark.parametrize(
    "reply",
    [
        b"HTTP/1.1 100 Continue\r\n\r\n" * 100_000,
        OK + b"A: b\r\n" * 300_000,
        OK + b"Transfer-Encoding: chunked\r\n\r\n" + b"1\r\nx\r\n" * 300_000,
    ],
    ids=["interim replies", "headers", "chunks"],
)
def test_endless_replies_end_at_their_limit(reply: bytes) -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _request: bytes) -> None:
        writer.write(reply)
        await writer.drain()

    async def scene(client: SignalKClient) -> None:
        with pytest.raises(UnusableServer, match=r"expected .*at most .*, got more; set signalk\.url"):
            await client.request("GET", "/", {})

    Bench().run(serve, scene)


def test_redirect_and_wrong_key_are_not_a_websocket() -> None:
    replies = [
        b"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:1/\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 101 Switching Protocols\r\nSec-WebSocket-Accept: x\r\n\r\n",
    ]

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _request: bytes) -> None:
        writer.write(replies.pop(0))
        await writer.drain()

    async def scene(client: SignalKClient) -> None:
        with pytest.raises(HandshakeRefused, match="302"):
            await client.open_websocket("/", {})
        with pytest.raises(UnusableServer, match="expected the key of the WebSocket"):
            await client.open_websocket("/", {})

    Bench().run(serve, scene)


def test_flood_of_empty_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame costs 10 µs of virtual CPU time: 50 ms per second are 5,000 frames, of 14 million."""
    bench = Bench()
    frames = 0
    flood = b"\x81\x00" * 32_768
    sent_bytes = 0

    class CountedReader(websocket.WebSocketReader):
        def feed(self, data: bytes) -> list[ControlFrame]:
            nonlocal frames
            frames += len(data) // 2
            bench.cpu_ns += len(data) // 2 * 10_000
            return super().feed(data)

    monkeypatch.setattr(websocket, "WebSocketReader", CountedReader)

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes) -> None:
        nonlocal sent_bytes
        await accept(writer, request)
        for _ in range(430):
            writer.write(flood)
            await writer.drain()
            sent_bytes += len(flood)

    async def scene(client: SignalKClient) -> None:
        opened_websocket = await client.open_websocket("/", {})
        receiver = asyncio.create_task(opened_websocket.receive())
        while not frames:
            await asyncio.sleep(0)
        start_ns = bench.clock.now_ns()
        while bench.clock.now_ns() - start_ns < 10 * NS_PER_S:
            await asyncio.sleep(0.05)
        assert 53_000 <= frames <= 57_000, "50 ms at the start, 50 ms per second, and one read"
        assert "sends more than imud processes" in client.problem
        assert client.refused
        assert sent_bytes < 400 * len(flood), "the kernel stops the server"
        receiver.cancel()
        await opened_websocket.close()

    bench.run(serve, scene)


def test_pongs_and_a_silent_server() -> None:
    received = bytearray()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes) -> None:
        await accept(writer, request)
        writer.write(b"\x89\x01a\x89\x01b")
        while data := await reader.read(1000):
            received.extend(data)

    async def scene(client: SignalKClient) -> None:
        opened_websocket = await client.open_websocket("/", {})
        receiver = asyncio.create_task(opened_websocket.receive())
        with pytest.raises(UnusableServer, match="has not replied to a ping for 5 s"):
            await opened_websocket.ping(5.0)
        opcodes = sorted((received[0], received[6 if received[0] == 0x89 else 7]))
        assert opcodes == [0x89, 0x8A], "a ping, and one pong for two pings"
        assert len(received) == 6 + 7
        receiver.cancel()
        await opened_websocket.close()

    Bench().run(serve, scene)


def test_a_server_that_does_not_read() -> None:
    bench = Bench()
    connection_end = asyncio.Event()

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes) -> None:
        await accept(writer, request)
        await connection_end.wait()

    async def scene(client: SignalKClient) -> None:
        opened_websocket = await client.open_websocket("/", {})
        start_ns = bench.clock.now_ns()

        async def send_until_error() -> None:
            while True:
                await opened_websocket.send("x" * 100_000)

        with pytest.raises(UnusableServer, match="has not read the values of imud for 10 s"):
            await send_until_error()
        assert bench.clock.now_ns() - start_ns < 11 * NS_PER_S
        await opened_websocket.close()
        assert bench.clock.now_ns() - start_ns < 12 * NS_PER_S, "close waits 1 s"
        connection_end.set()

    bench.run(serve, scene)


NO_OPENSSL = "" if shutil.which("openssl") else "openssl is not installed (make mqtt-deps)"


def make_certificate(folder: Path, bits: int) -> Path:
    """Make a certificate as signalk-server does: only for localhost."""
    folder.mkdir()
    command = [
        "openssl", "req", "-x509", "-newkey", f"rsa:{bits}", "-nodes", "-keyout", "key.pem", "-out", "own.pem", "-days",
        "365", "-subj", "/CN=localhost", "-sha1", "-addext", "subjectAltName=URI:http://example.org/webid#me",
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return folder / "own.pem"


@asynccontextmanager
async def tls_server(folder: Path) -> AsyncIterator[int]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.set_ciphers("DEFAULT:@SECLEVEL=0")
    context.load_cert_chain(folder / "own.pem", folder / "key.pem")
    connections: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        connections.add(task)
        with suppress(asyncio.IncompleteReadError, OSError):
            await reader.readuntil(HEAD_END)
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok")
            await writer.drain()
        writer.transport.abort()

    server = await asyncio.start_server(serve, "127.0.0.1", 0, ssl=context)
    async with server:
        yield server.sockets[0].getsockname()[1]
        await asyncio.gather(*connections)


async def get(port: int, ca_file: Path) -> tuple[int, bytes]:
    address = address_of(f"https://127.0.0.1:{port}")
    assert address is not None
    client = SignalKClient(address, str(ca_file), publisher_context().clock)
    await client.load_certificates()
    return await client.request("GET", "/", {})


@pytest.mark.skipif(bool(NO_OPENSSL), reason=NO_OPENSSL)
@pytest.mark.parametrize("bits", [1024, 2048])
@in_loop
async def test_the_own_certificate_of_a_server(tmp_path: Path, bits: int) -> None:
    own_certificate = make_certificate(tmp_path / "own", bits)
    other_certificate = make_certificate(tmp_path / "other", 2048)
    bundle = tmp_path / "bundle.pem"
    bundle.write_bytes(other_certificate.read_bytes() + own_certificate.read_bytes())
    async with tls_server(tmp_path / "own") as port:
        assert await get(port, own_certificate) == (200, b"ok")
        assert await get(port, bundle) == (200, b"ok")
        with pytest.raises(ssl.SSLCertVerificationError):
            await get(port, other_certificate)
