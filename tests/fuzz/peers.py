"""Servers that imud connects to: gpsd and Signal K. The complete client reads the input in virtual time, in any pieces.

For any bytes, the client continues, reports a printable problem, and keeps its limits.
"""

import asyncio
import zlib
from collections.abc import Coroutine, Sequence
from random import Random
from typing import Any, Final, cast
from unittest.mock import patch

from imud.contracts.lines import UtcReference
from imud.contracts.link import StreamLink
from imud.device.utc import UtcFeed
from imud.formats.nmea0183 import Rmc, build, parse
from imud.host.http_reply import SWITCHING_PROTOCOLS, HttpReply, InvalidReply
from imud.host.peer_stream import PeerStream
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.model.work_budget import WorkBudget
from imud.publishers.signalk import client as signalk_client
from imud.publishers.signalk.client import CONTENT_BYTES_MAX
from imud.publishers.signalk.server import DENIED, QUEUE_MAX, SignalKServer
from imud.publishers.signalk.settings import SignalKOptions
from imud.publishers.signalk.websocket import CONTROL_BYTES_MAX, InvalidFrame, WebSocketReader, accept_of
from imud.testing.invariants import cut
from imud.utc import receivers
from imud.utc.receivers import GpsdSource, RmcOptions, SourceContext
from imud.utc.rmc_feed import RmcFeed
from tests.fuzz.target import Target, check_printable
from tests.fuzz.utc import mend, stream_seeds, words
from tests.support.event_loops import UTC_AHEAD_NS, VirtualClock, VirtualLoop
from tests.support.publisher_context import publisher_context

GPSD_BYTES_MAX: Final = 2048
SIGNALK_BYTES_MAX: Final = 2048
WAITS_MS: Final = ((0,), (0,), (0, 1, 100), (0, 700, 1000, 4000))  # times between two pieces of a connection
NEXT: Final = b"\n--next--\n"  # separates the replies to successive connections
HEAD_END: Final = b"\r\n\r\n"  # separates the headers and the content of a reply
CPU_PER_READ_NS: Final = 700_000  # virtual CPU time of a piece: some inputs exceed the budget
GPSD_S: Final = 30  # virtual time of a gpsd session, s
SESSION_S: Final = 90  # virtual time of a Signal K session, s. imud sends one delta each second.
KEY: Final = "dGhlIHNhbXBsZSBub25jZQ=="  # key of each WebSocket, so that a seed can accept it
SOURCE: Final = "imud.bow"


def names() -> Sequence[str]:
    return ["gpsd", "signalk", "http-reply", "websocket"]


def make(name: str) -> Target:
    if name == "gpsd":
        return Target(run_gpsd, stream_seeds_of_gpsd, mend, words=words, bytes_max=GPSD_BYTES_MAX)
    if name == "signalk":
        return Target(run_signalk, signalk_seeds, words=signalk_words, bytes_max=SIGNALK_BYTES_MAX)
    run = run_http_reply if name == "http-reply" else run_websocket
    return Target(run, reply_seeds, words=signalk_words, bytes_max=SIGNALK_BYTES_MAX)


class Network:
    """Servers in memory. Each connection receives the next part of the input in random pieces."""

    def __init__(self, parts: Sequence[bytes], seed: int) -> None:
        self.clock = VirtualClock()
        self._cpu_ns = 0
        self._parts = list(parts)
        self._random = Random(seed)
        self._tasks: set[asyncio.Task[None]] = set()

    def cpu_ns(self) -> int:
        self._cpu_ns += CPU_PER_READ_NS
        return self._cpu_ns

    async def connect(self, *arguments: Any) -> PeerStream:
        """Replace `open_peer_stream`."""
        _host, _port, peer, budget, now_ns, *_ = arguments
        assert isinstance(budget, WorkBudget)
        if not self._parts:
            raise ConnectionRefusedError(111, "Connection refused")
        reader = asyncio.StreamReader()
        task = asyncio.create_task(self._send(reader, self._parts.pop(0)))
        self._tasks.add(task)
        return PeerStream(reader, cast(asyncio.StreamWriter, FakeWriter()), peer, budget, now_ns)

    async def _send(self, reader: asyncio.StreamReader, data: bytes) -> None:
        waits_ms = self._random.choice(WAITS_MS)
        for piece in cut(data, self._random):
            reader.feed_data(piece)
            await asyncio.sleep(self._random.choice(waits_ms) / 1000)
        if self._random.random() < 0.5:  # otherwise, the server is silent
            reader.feed_eof()

    def run(self, body: Coroutine[Any, Any, None]) -> None:
        """Run the client. An exception of a task or callback is a finding."""
        failures: list[object] = []

        async def run_and_end() -> None:
            asyncio.get_running_loop().set_exception_handler(lambda _loop, context: failures.append(context))
            await body
            for task in self._tasks:
                task.cancel()

        with asyncio.Runner(loop_factory=lambda: VirtualLoop(self.clock)) as runner:
            runner.run(run_and_end())
        assert not failures, failures


class FakeWriter:
    """Writer and transport of a connection. The server ignores the bytes."""

    @property
    def transport(self) -> "FakeWriter":
        return self

    def write(self, data: bytes) -> None: ...
    def abort(self) -> None: ...
    def close(self) -> None: ...
    async def drain(self) -> None: ...
    async def wait_closed(self) -> None: ...

    def get_extra_info(self, _name: str) -> "FakeWriter":
        return self

    def setsockopt(self, *_arguments: int) -> None: ...


class Port:
    """Port of a device."""

    bit_rate = 115_200
    is_free = True

    def __init__(self, clock: VirtualClock) -> None:
        self.sentences: list[tuple[int, bytes]] = []
        self._clock = clock

    def write(self, data: bytes) -> None:
        self.sentences.append((self._clock.now_ns(), data))

    def on_reset(self) -> None: ...


def _no_port(_path: str, _baud: int) -> StreamLink:
    raise AssertionError


def run_gpsd(data: bytes) -> None:
    """The device gets valid sentences of plausible times, at most at the configured rate in real time."""
    seed = zlib.crc32(data)
    rate_hz = 1 + seed % 10
    reference = UtcReference(UTC_AHEAD_NS, NS_PER_MS) if seed & 16 else None
    network = Network(data.split(NEXT), seed)
    clock = network.clock
    port = Port(clock)
    context = SourceContext(_no_port, clock.now_ns, lambda: UTC_AHEAD_NS, network.cpu_ns)
    source = GpsdSource(RmcOptions(source="gpsd", rate_hz=rate_hz), context)
    feed = RmcFeed(port, clock.now_ns, rate_hz)
    keeper = UtcFeed(source, feed, lambda: reference, clock.host)

    async def body() -> None:
        for _ in range(GPSD_S):
            keeper.tick(clock.now_ns(), None)
            check_printable(keeper.problem)
            await asyncio.sleep(1)
        keeper.close()

    with patch.object(receivers, "open_peer_stream", network.connect):
        network.run(body())
    assert feed.sent + sum(feed.refused.values()) == source.sentences
    for _, sentence in port.sentences:
        rmc = parse(sentence)
        assert isinstance(rmc, Rmc)
        assert rmc.valid
    for index, (first_ns, _) in enumerate(port.sentences):
        count = sum(first_ns <= t_ns < first_ns + NS_PER_S for t_ns, _ in port.sentences[index:])
        assert count <= rate_hz + 2


def run_signalk(data: bytes) -> None:
    """The counters balance, the queue keeps its limit, and only a denied request ends the output."""
    network = Network(data.split(NEXT), zlib.crc32(data))
    context = publisher_context(now_ns=network.clock.now_ns, cpu_ns=network.cpu_ns)
    put_count = 0

    async def body() -> None:
        nonlocal put_count
        server = SignalKServer(SignalKOptions(), None, context.clock)
        server.start()
        task = server._task
        assert task is not None
        for _ in range(SESSION_S):
            server.put("navigation.attitude", SOURCE, "{}")
            put_count += 1
            status = server.status()
            check_printable(status.problem)
            assert status.sent + status.dropped + len(server._queue) in (put_count, put_count - 1)
            assert len(server._queue) <= QUEUE_MAX
            assert task.done() == (status.problem == DENIED)
            await asyncio.sleep(1)
        server.close()
        await asyncio.gather(task, return_exceptions=True)

    with (
        patch.object(signalk_client, "open_peer_stream", network.connect),
        patch.object(signalk_client, "new_key", lambda: KEY),
    ):
        network.run(body())


def run_http_reply(data: bytes) -> None:
    """The result does not depend on the pieces. A reply is at most as long as its limit."""
    assert _parse_reply([data]) == _parse_reply(cut(data, Random(zlib.crc32(data))))


def _parse_reply(pieces: Sequence[bytes]) -> tuple[object, ...]:
    reply = HttpReply(CONTENT_BYTES_MAX)
    rest = bytearray()
    try:
        for piece in pieces:
            if reply.is_complete:
                rest += piece
            else:
                reply.feed(piece)
        if not reply.is_complete:
            reply.end()
    except InvalidReply as error:
        check_printable(str(error))
        return (str(error),)
    assert 101 <= reply.status <= 599
    is_switch = reply.status == SWITCHING_PROTOCOLS
    return reply.status, reply.headers, bytes(reply.content), reply.rest + bytes(rest) if is_switch else b""


def run_websocket(data: bytes) -> None:
    """The control frames do not depend on the pieces. The reader stores at most one head or control frame."""
    assert _read_frames([data]) == _read_frames(cut(data, Random(zlib.crc32(data))))


def _read_frames(pieces: Sequence[bytes]) -> list[object]:
    reader = WebSocketReader()
    results: list[object] = []
    try:
        for piece in pieces:
            results += reader.feed(piece)
            assert len(reader._rest) < 2 + CONTROL_BYTES_MAX
    except InvalidFrame as error:
        check_printable(str(error))
        return [str(error)]
    return results


def stream_seeds_of_gpsd() -> list[bytes]:
    utc_ns = VirtualClock().realtime_ns()
    seconds = [build(utc_ns + second * NS_PER_S) for second in range(20)]
    flood = build(utc_ns) * 25
    return [*stream_seeds()[:12], b"".join(seconds), flood, NEXT.join(seconds[:5]), b"".join(reversed(seconds))]


def _reply(status: int, body: bytes, head: bytes = b"") -> bytes:
    return b"HTTP/1.1 %d x\r\nContent-Length: %d\r\n%b\r\n%b" % (status, len(body), head, body)


def signalk_seeds() -> list[bytes]:
    websocket = b"HTTP/1.1 101 x\r\nSec-WebSocket-Accept: %b\r\n\r\n" % accept_of(KEY).encode()
    hello = b'\x81\x20{"name":"x","self":"vessels.urn"}'
    frames = hello + b"\x89\x01a\x8a\x00\x81\x00\x01\x01a\x80\x01b\x82\x7e\x00\x80" + bytes(128)
    stream = websocket + frames
    pongs = websocket + hello + b"\x8a\x00" * 50
    values = [_reply(200, b'{"$source":"imud.bow","timestamp":"%d"}' % number) for number in range(3)]
    request = _reply(202, b'{"state":"PENDING","statusCode":202,"href":"/signalk/v1/requests/1"}')
    pending = _reply(200, b'{"state":"PENDING"}')
    done = b'{"state":"COMPLETED","statusCode":200,"accessRequest":{"permission":"%b","token":"t.o.k"}}'
    approved = _reply(200, done % b"APPROVED")
    denied = _reply(200, done % b"DENIED")
    open_server = _reply(404, b'{"message":"no security"}')
    redirect = _reply(302, b"", b"Location: /\r\n")
    interim = b"HTTP/1.1 100 Continue\r\n\r\n"
    chunked = b'HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n13\r\n{"state":"PENDING"}\r\n0\r\n\r\n'
    sessions = [
        [open_server, pongs, *values], [open_server, stream], [request, pending, approved, pongs, *values],
        [request, denied], [request, chunked, interim + approved, websocket + b"\x88\x02\x03\xe8"],
        [request, approved, *[_reply(401, b"")] * 10, request, pending], [open_server, redirect],
        [open_server, b"HTTP/1.1 200 OK\r\n\r\n"], [b"SSH-2.0\r\n\r\n"], [open_server, websocket + b"\x81\x00" * 300],
    ]  # fmt: skip
    return [NEXT.join(session) for session in sessions]


def reply_seeds() -> list[bytes]:
    return sorted({part for seed in signalk_seeds() for part in [*seed.split(NEXT), *seed.split(HEAD_END)]})


def signalk_words() -> list[bytes]:
    return [
        NEXT, b"HTTP/1.1 101 x\r\n", b"HTTP/1.1 100 x\r\n\r\n", b"Content-Length: ", b"Transfer-Encoding: chunked\r\n",
        b"\r\n\r\n", b"\x89\x00", b"\x8a\x00", b"\x88\x00", b"\x81\x7e", b"\x81\x7f", b'"state":"PENDING"',
        b'"permission":"APPROVED"', b'"href":"/', b'"values":{"imud.bow":{"timestamp":"1"}}', b"\n0\r\n\r\n",
    ]  # fmt: skip
