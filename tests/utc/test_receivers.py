"""Sources with a receiver: gpsd on a server of the test and a real gpsd, and a serial port with a fake or real link."""

import asyncio
import json
import os
import select
import shutil
import socket
import subprocess
import time
import tracemalloc
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random
from unittest.mock import AsyncMock

import msgspec
import pytest

from imud.contracts.link import OnData, OnEnd
from imud.contracts.status import KernelCounters
from imud.formats.nmea0183 import Rmc, build, checksum, parse
from imud.host import peer_stream
from imud.model.errors import LinkError, LinkMissing
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.utc import RMC_SOURCES, receivers
from imud.utc.system_clock import SystemClockSource
from tests.support.daemon_process import running_daemon
from tests.support.documented import check_schema
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.pty_port import PtyPort
from tests.support.rmc_sources import LIMIT_S, Sentences, soon
from tests.support.surroundings import free_port

SENTENCES = [build((1_795_000_000 + n) * NS_PER_S) for n in range(5)]
VERSION = b'{"class":"VERSION","release":"3.22","rev":"3.22","proto_major":3,"proto_minor":14}\r\n'
CONTEXT = receivers.SourceContext(lambda *_: Port(), time.monotonic_ns, lambda: 0, lambda: 0)
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
Scene = Callable[[receivers.GpsdSource, Sentences], Awaitable[None]]


def play(serve: Serve, scene: Scene, gps: str = "", retry: receivers.Retry | None = None) -> Sentences:
    async def whole() -> Sentences:
        async def one(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                await serve(reader, writer)
            finally:
                writer.close()

        server = await asyncio.start_server(one, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        sentences = Sentences()
        source = receivers.GpsdSource(
            receivers.RmcOptions(source="gpsd", tcp_port=port, gps=gps),
            CONTEXT,
            retry or receivers.Retry(soon),
        )
        async with server:
            source.start(sentences)
            try:
                async with asyncio.timeout(LIMIT_S):
                    await scene(source, sentences)
            finally:
                source.close()
                source.close()
        return sentences

    return asyncio.run(whole())


def test_it_asks_for_nmea_and_gives_rmc_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second address of the host accepts the connection."""
    addresses = AsyncMock(return_value=["127.0.0.2", "127.0.0.1", "127.0.0.3"])
    monkeypatch.setattr(peer_stream, "resolve", addresses)
    asked: list[bytes] = []
    ended = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(VERSION)
        asked.append(await reader.readline())
        writer.write(b'{"class":"WATCH","enable":true,"nmea":true}\r\n' + SENTENCES[0] + b"$GPGGA,,,*00\r\n")
        writer.write(b"x" * 100_000 + b"\n" + SENTENCES[1])  # it skips a line that is too long
        assert await reader.read() == b""
        ended.set()

    async def scene(source: receivers.GpsdSource, sentences: Sentences) -> None:
        await sentences.until(lambda: len(sentences.got) == 2)
        assert (source.problem, source.sentences) == ("", 2)
        assert source._stream is not None
        sock = source._stream.get_extra_info("socket")
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        probes = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        assert [sock.getsockopt(socket.IPPROTO_TCP, option) for option in probes] == [10, 5, 3]  # a loss shows in 25 s
        source.close()
        await ended.wait()

    begin_ns = time.monotonic_ns()
    sentences = play(serve, scene, gps="/dev/ttyACM0")
    assert sentences.data == SENTENCES[:2]
    assert all(begin_ns <= t_rx_ns <= time.monotonic_ns() for _, t_rx_ns in sentences.got)
    command, _, rest = asked[0].partition(b"=")
    assert command == b"?WATCH"
    assert rest.endswith(b";\n")
    assert json.loads(rest[:-2]) == {"enable": True, "nmea": True, "device": "/dev/ttyACM0"}


def test_a_server_that_closes_is_connected_to_again() -> None:
    connections = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        await reader.readline()
        writer.write(SENTENCES[connections] + SENTENCES[0][:20])
        await writer.drain()

    async def scene(_source: receivers.GpsdSource, sentences: Sentences) -> None:
        await sentences.until(lambda: len(sentences.got) >= 3)

    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    assert play(serve, scene, retry=receivers.Retry(sleep)).data[:3] == SENTENCES[1:4]
    assert set(pauses) == {0.5}  # after a success, the next pause is short again


@in_loop
async def test_an_unreachable_server_is_reported_and_retried() -> None:
    server = await asyncio.start_server(lambda _r, w: w.close(), "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    server.close()
    await server.wait_closed()
    paused = asyncio.Event()

    async def sleep(_seconds: float) -> None:
        paused.set()
        await asyncio.sleep(0)

    options = receivers.RmcOptions(source="gpsd", tcp_port=port)
    source = receivers.GpsdSource(options, CONTEXT, receivers.Retry(sleep))
    source.start(Sentences())
    async with asyncio.timeout(LIMIT_S):
        await paused.wait()
    assert "cannot connect to gpsd" in source.problem
    assert "is gpsd running?" in source.problem
    source.close()


def test_a_server_that_does_not_answer_is_retried_after_5_s(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, paused_s = VirtualClock(), list[float]()

    async def connect(*_address: object, **_options: object) -> None:
        await asyncio.sleep(60)

    async def sleep(_seconds: float) -> None:
        paused_s.append((clock.now_ns() - begin_ns) / NS_PER_S)
        await asyncio.sleep(60)

    async def scene() -> None:
        source.start(Sentences())
        await asyncio.sleep(20)
        source.close()

    monkeypatch.setattr(asyncio, "open_connection", connect)
    begin_ns = clock.now_ns()
    source = receivers.GpsdSource(
        receivers.RmcOptions(source="gpsd"), CONTEXT._replace(now_ns=clock.now_ns), receivers.Retry(sleep)
    )
    run_virtually(clock, scene())
    assert paused_s == [pytest.approx(5, abs=0.1)]
    assert source.problem == "cannot connect to gpsd at 127.0.0.1:2947: no answer; is gpsd running?"


class Port:
    title = "/dev/ttyGNSS"
    writable = True
    baud = 9600
    auto_baud = False
    hold_ns = 0
    waiting_bytes = 0

    def __init__(self, refusals: int = 0) -> None:
        self.opened = self.closed = 0
        self.pauses = self.resumes = 0
        self.on_data: OnData | None = None
        self.on_end: OnEnd | None = None
        self.started = asyncio.Event()
        self._refusals = refusals

    def absence(self) -> str:
        return ""

    async def wait_present(self) -> None:
        await asyncio.sleep(0)

    def open(self) -> None:
        if self._refusals:
            self._refusals -= 1
            raise LinkError("/dev/ttyGNSS is in use")
        self.opened += 1

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        self.on_data, self.on_end = on_data, on_end
        self.started.set()

    def deliver_to(self, on_data: OnData) -> None: ...

    def pause(self) -> None:
        self.pauses += 1

    def resume(self) -> None:
        self.resumes += 1

    def take(self) -> bytes:
        return b""

    def write(self, data: bytes) -> None:
        raise AssertionError(data)

    def set_baud(self, baud: int) -> None:
        raise AssertionError(baud)

    def kernel_counters(self) -> KernelCounters:
        return KernelCounters()

    def close(self) -> None:
        self.closed += 1
        self.started.clear()


@in_loop
async def test_sentences_come_with_the_time_of_their_last_byte() -> None:
    port, sentences = Port(), Sentences()
    source = receivers.NmeaPortSource(port, CONTEXT, receivers.Retry(soon))
    source.start(sentences)
    async with asyncio.timeout(LIMIT_S):
        await port.started.wait()
        assert "9600 bit/s" in source.problem
        assert port.on_data
        port.on_data(SENTENCES[0][:30], 1000)
        port.on_data(SENTENCES[0][30:] + b"$GPGSV,*00\r\n" + SENTENCES[1], 2000)
    assert sentences.got == [(SENTENCES[0], 2000), (SENTENCES[1], 2000)]
    assert (source.problem, source.sentences) == ("", 2)
    source.close()
    source.close()
    assert port.closed >= 1


@in_loop
async def test_a_port_that_goes_away_or_is_held_is_opened_again() -> None:
    port, sentences = Port(refusals=3), Sentences()
    source = receivers.NmeaPortSource(port, CONTEXT, receivers.Retry(soon))
    source.start(sentences)
    async with asyncio.timeout(LIMIT_S):
        await port.started.wait()
        assert port.on_data
        assert port.on_end
        port.on_data(SENTENCES[0] + SENTENCES[1][:20], 1)
        port.on_end(LinkMissing("/dev/ttyGNSS is gone"))
        assert source.problem == "/dev/ttyGNSS is gone"
        port.started.clear()
        await port.started.wait()
        port.on_data(SENTENCES[1][20:] + SENTENCES[2], 2)
    assert sentences.data == [SENTENCES[0], SENTENCES[2]]
    for _ in range(50):
        await asyncio.sleep(0)
    assert port.opened == 2, "it is not opened once more for the first end"
    source.close()


def test_sources_by_their_name_and_documented_values() -> None:
    """`nmea` needs a port, the others read gpsd or the clock of the host."""
    asked: list[tuple[str, int]] = []

    def make_port(path: str, baud: int) -> Port:
        asked.append((path, baud))
        return Port()

    context = receivers.SourceContext(make_port, time.monotonic_ns, lambda: 0)
    options = {"port": "/dev/ttyGNSS", "baud": 38400}
    made = [
        make(msgspec.convert({"source": name, **options}, receivers.RmcOptions), context)
        for name, make in RMC_SOURCES.items()
    ]
    kinds = {"gpsd": receivers.GpsdSource, "nmea": receivers.NmeaPortSource, "system": SystemClockSource}
    assert dict(zip(RMC_SOURCES, map(type, made), strict=True)) == kinds
    assert asked == [("/dev/ttyGNSS", 38400)]
    assert "NMEA receiver on /dev/ttyGNSS" in [one.title for one in made]
    assert check_schema("RMC sentences", receivers.RmcOptions) == 8
    with pytest.raises(ValueError, match=r'^host: expected an IP address or a host name, got "a b"$'):
        receivers.RmcOptions(source="gpsd", host="a b")
    with pytest.raises(ValueError, match=r"^expected the key port for source nmea, "):
        receivers.RmcOptions(source="nmea")


SENTENCES_PER_READ = peer_stream.READ_BYTES // len(SENTENCES[0]) + 1


class CountedCpu:
    """CPU time that advances by 1 ms for each sentence."""

    def __init__(self) -> None:
        self.sentences = 0

    def __call__(self) -> int:
        return self.sentences * NS_PER_MS

    def take(self, _sentence: bytes, _t_rx_ns: int) -> None:
        self.sentences += 1


def test_gpsd_that_floods_waits_for_the_next_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time and CPU time are virtual: 50 ms of CPU time at the start, and 50 ms per second."""
    monkeypatch.setattr(peer_stream, "resolve", AsyncMock(return_value=["127.0.0.1"]))
    clock, cpu = VirtualClock(), CountedCpu()
    flood = b"".join(SENTENCES) * 20_000  # 7 MB
    sent_bytes = 0
    connection_end = asyncio.Event()

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal sent_bytes
        with suppress(OSError):
            for start in range(0, len(flood), 65536):
                writer.write(flood[start : start + 65536])
                await writer.drain()
                sent_bytes += 65536
        writer.transport.abort()
        connection_end.set()

    async def scene() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        options = receivers.RmcOptions(source="gpsd", tcp_port=server.sockets[0].getsockname()[1])
        context = CONTEXT._replace(now_ns=clock.now_ns, cpu_ns=cpu)
        source = receivers.GpsdSource(options, context, receivers.Retry(soon))
        async with server:
            source.start(cpu.take)
            while not cpu.sentences:
                await asyncio.sleep(0)
            start_ns = clock.now_ns()
            while clock.now_ns() - start_ns < 10 * NS_PER_S:
                await asyncio.sleep(0.05)
            budget = 50 + 10 * 50  # sentences
            assert budget - SENTENCES_PER_READ <= cpu.sentences <= budget + SENTENCES_PER_READ
            assert "gpsd at 127.0.0.1" in source.problem
            assert "sends more than imud processes" in source.problem
            assert sent_bytes < len(flood) - 65536, "the kernel stops the server"
            source.close()
            await connection_end.wait()

    run_virtually(clock, scene())


@in_loop
async def test_port_that_floods_is_paused() -> None:
    port, cpu = Port(), CountedCpu()
    now_ns = 0
    source = receivers.NmeaPortSource(port, CONTEXT._replace(now_ns=lambda: now_ns, cpu_ns=cpu))
    source.start(cpu.take)
    async with asyncio.timeout(LIMIT_S):
        await port.started.wait()
        assert port.on_data
        for _ in range(50):
            port.on_data(SENTENCES[0], now_ns)
        assert (cpu.sentences, port.pauses, source.problem) == (50, 0, "")
        port.on_data(SENTENCES[0], now_ns)
        assert (cpu.sentences, port.pauses) == (50, 1)
        assert source.problem.startswith("NMEA receiver on /dev/ttyGNSS sends more than imud processes: 1 inputs")
        while not port.resumes:
            await asyncio.sleep(0.01)
        now_ns = NS_PER_S // 10
        port.on_data(SENTENCES[0], now_ns)
        assert cpu.sentences == 51
    for _ in range(5):
        port.on_data(SENTENCES[0], now_ns)
    source.close()  # also cancels the end of the pause
    assert port.pauses == 2


GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
JSON = b'{"class":"TPV","device":"/dev/ttyS0","mode":3}\r\n'


@pytest.mark.parametrize("size", [1, 2, 7, 64, 10_000])
def test_any_split_gives_the_same(size: int) -> None:
    data = JSON + b"".join(sentence + GGA for sentence in SENTENCES)
    splitter = receivers.SentenceSplitter()
    assert [s for at in range(0, len(data), size) for s in splitter.feed(data[at : at + size])] == SENTENCES


def test_broken_and_too_long_sentences_and_lines_are_skipped() -> None:
    broken = SENTENCES[0][:30] + SENTENCES[1]
    assert receivers.SentenceSplitter().feed(broken + b"noise\xff$" + SENTENCES[2]) == SENTENCES[1:3]
    splitter = receivers.SentenceSplitter()
    splitter.feed(SENTENCES[0][:20])
    splitter.clear()
    assert splitter.feed(SENTENCES[0][20:] + SENTENCES[1]) == [SENTENCES[1]]
    random = Random(1)
    assert splitter.feed(b"$GPRMC," + b"1" * 120 + b"\r\n") == []
    for _ in range(100):
        splitter.feed(random.randbytes(random.randrange(200)))
    splitter = receivers.SentenceSplitter()
    tracemalloc.start()
    try:
        for _ in range(100):
            assert splitter.feed(b"$" + b"x" * 1000) == []
            assert tracemalloc.get_traced_memory()[0] <= 16_384 + 4000
    finally:
        tracemalloc.stop()
    assert splitter.feed(SENTENCES[0] + SENTENCES[1]) == [SENTENCES[1]]  # the first sentence ends the skipped line


@in_loop
async def test_pauses() -> None:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    retry = receivers.Retry(sleep)
    for _ in range(10):
        await retry.pause()
    retry.reset()
    await retry.pause()
    assert pauses == [0.5, 1, 2, 4, 8, 16, 30, 30, 30, 30, 0.5]


WANTED = 3
UTC_S = 1_795_000_000
NO_GPSD = "" if shutil.which("gpsd") else "gpsd is not installed (Debian package gpsd)"


class Receiver(PtyPort):
    """A GNSS receiver with a fix, on a pty. It sends one cycle of sentences after the other."""

    def __init__(self) -> None:
        super().__init__()
        os.chmod(self.path, 0o666)  # gpsd drops its privileges
        self.second = UTC_S

    def cycle(self) -> None:
        rmc = build(self.second * NS_PER_S)
        time = rmc.split(b",")[1].decode()
        gga = f"GPGGA,{time},0000.000,N,00000.000,E,1,08,0.9,12.0,M,0.0,M,,"
        gsa = "GPGSA,A,3,01,02,03,04,05,06,07,08,,,,,1.6,0.9,1.3"
        rest = "".join(f"${body}*{checksum(body.encode()):02X}\r\n" for body in (gga, gsa))
        self.received()  # no reply to the requests of gpsd
        self.send(rmc + rest.encode())
        self.second += 1


@contextmanager
def gpsd(port: int, device: str, folder: Path) -> Iterator[None]:
    with (folder / "gpsd.log").open("w") as log:
        command = ["gpsd", "-N", "-n", "-b", "-D", "2", "-S", str(port), device]
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            process.wait(timeout=LIMIT_S)
            print((folder / "gpsd.log").read_text())


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.unplug()


class FarEnd(PtyPort):
    """The far end of a serial port, with a device that only receives."""

    text = b""

    def lines(self, wait_s: float) -> list[bytes]:
        select.select([self.master], [], [], wait_s)
        *whole, self.text = (self.text + self.received()).split(b"\n")
        return [line + b"\n" for line in whole]


@pytest.fixture
def port() -> Iterator[FarEnd]:
    made = FarEnd()
    yield made
    made.unplug()


@pytest.mark.live
@pytest.mark.skipif(bool(NO_GPSD), reason=NO_GPSD)
def test_a_device_gets_the_sentences_of_gpsd(receiver: Receiver, port: FarEnd, tmp_path: Path) -> None:
    tcp_port = free_port()
    device = {
        "driver": "hipnuc-uart", "identify": False, "uart": {"port": port.path, "baud": 115200},
        "rmc": {"source": "gpsd", "tcp_port": tcp_port},
    }  # fmt: skip
    fed: list[Rmc] = []
    with gpsd(tcp_port, receiver.path, tmp_path), running_daemon(tmp_path, {"bow": device}) as daemon:
        receiver.second = 0
        end = time.monotonic() + LIMIT_S
        while len(fed) < WANTED:
            assert time.monotonic() < end, daemon.statuses()["bow"].utc
            now_s = time.time()
            if int(now_s) > receiver.second and now_s % 1 < 0.5:  # a receiver sends each sentence early in its second
                receiver.second = int(now_s)
                receiver.cycle()
                receiver.second -= 1
            for line in port.lines(0.1):
                assert line.startswith(b"$GPRMC,")
                rmc = parse(line)
                assert isinstance(rmc, Rmc)
                assert rmc.unix_s <= time.time()
                fed.append(rmc)
        utc = daemon.statuses()["bow"].utc
    assert all(rmc.valid and rmc.fraction_ns == 0 for rmc in fed)
    assert utc is not None
    assert (utc.source, utc.problem) == (f"gpsd at 127.0.0.1:{tcp_port}", "")
    assert utc.sentences >= utc.sent >= WANTED
