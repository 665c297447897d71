"""The client of gpsd against a server that the test plays."""

import asyncio
import json
import time
from collections.abc import Awaitable, Callable

from imud.formats.rmc import build
from imud.units import NS_PER_S
from imud.utc.gpsd import GpsdSource
from imud.utc.retry import FIRST_S, Retry
from imud.utc.source import RmcSettings
from tests.support.sentences import LIMIT_S, Sentences, soon

SENTENCES = [build((1_795_000_000 + n) * NS_PER_S) for n in range(5)]
VERSION = b'{"class":"VERSION","release":"3.22","rev":"3.22","proto_major":3,"proto_minor":14}\r\n'
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
Scene = Callable[[GpsdSource, Sentences], Awaitable[None]]


def play(serve: Serve, scene: Scene, gps: str = "", retry: Retry | None = None) -> Sentences:
    async def whole() -> Sentences:
        async def one(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                await serve(reader, writer)
            finally:
                writer.close()

        server = await asyncio.start_server(one, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        sentences = Sentences()
        source = GpsdSource(RmcSettings(source="gpsd", tcp_port=port, gps=gps), retry or Retry(soon))
        async with server:
            source.start(sentences)
            try:
                async with asyncio.timeout(LIMIT_S):
                    await scene(source, sentences)
            finally:
                await source.close()
                await source.close()
        return sentences

    return asyncio.run(whole())


def test_it_asks_for_nmea_and_gives_rmc_with_its_time() -> None:
    asked: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(VERSION)
        asked.append(await reader.readline())
        writer.write(b'{"class":"WATCH","enable":true,"nmea":true}\r\n' + SENTENCES[0] + b"$GPGGA,,,*00\r\n")
        writer.write(SENTENCES[1])
        await reader.read()

    async def scene(source: GpsdSource, sentences: Sentences) -> None:
        await sentences.until(lambda: len(sentences.got) == 2)
        assert source.problem == ""
        assert source.sentences == 2

    begin_ns = time.monotonic_ns()
    sentences = play(serve, scene, gps="/dev/ttyACM0")
    assert sentences.data == SENTENCES[:2]
    assert all(begin_ns <= t_rx_ns <= time.monotonic_ns() for _, t_rx_ns in sentences.got)
    command, _, rest = asked[0].partition(b"=")
    assert command == b"?WATCH"
    assert rest.endswith(b";\n")
    assert json.loads(rest[:-2]) == {"enable": True, "nmea": True, "device": "/dev/ttyACM0"}


def test_a_server_that_leaves_is_come_back_to() -> None:
    connections = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        await reader.readline()
        writer.write(SENTENCES[connections] + SENTENCES[0][:20])
        await writer.drain()

    async def scene(_source: GpsdSource, sentences: Sentences) -> None:
        await sentences.until(lambda: len(sentences.got) >= 3)

    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    assert play(serve, scene, retry=Retry(sleep)).data[:3] == SENTENCES[1:4]
    assert set(pauses) == {FIRST_S}  # after each success the next pause is short again


def test_nobody_there_is_a_problem_and_not_the_end() -> None:
    async def scene() -> None:
        server = await asyncio.start_server(lambda _r, w: w.close(), "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        server.close()
        await server.wait_closed()
        paused = asyncio.Event()

        async def sleep(_seconds: float) -> None:
            paused.set()
            await asyncio.sleep(0)

        source = GpsdSource(RmcSettings(source="gpsd", tcp_port=port), Retry(sleep))
        source.start(Sentences())
        async with asyncio.timeout(LIMIT_S):
            await paused.wait()
        assert "cannot be reached" in source.problem
        assert "is gpsd running?" in source.problem
        await source.close()

    asyncio.run(scene())


def test_a_silent_server_is_a_problem() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(b"x" * 100_000 + b"\n" + SENTENCES[0])
        await reader.read()

    problems: list[str] = []

    async def scene(source: GpsdSource, sentences: Sentences) -> None:
        await sentences.until(lambda: bool(sentences.got))
        problems.append(source.problem)

    assert play(serve, scene).data == SENTENCES[:1]
    assert problems == [""]
