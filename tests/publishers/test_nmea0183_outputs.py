"""Ports: accepted sentences arrive complete, other sentences are dropped and counted, and no port waits."""

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from imud.contracts.status import OutputStatus
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S
from imud.publishers.nmea0183 import SerialOutput, TcpOutput, UdpOutput
from imud.publishers.nmea0183 import open_serial as open_real_port
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.socket_rig import in_context

CLIENTS_MAX, RETRY_FIRST_NS, STUCK_NS = 32, NS_PER_S, 30 * NS_PER_S

LIMIT_S = 60.0
ONE = b"$HEHDT,98.3,T*2F\r\n"
BUSY = b"$" + b"x" * 60_000 + b"\r\n"


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():
            await asyncio.sleep(0)


class Server(TcpOutput):
    def __init__(self) -> None:
        self.clock, self.clients = VirtualClock(), list[socket.socket]()
        super().__init__("127.0.0.1", 0, self.clock.now_ns)
        self.open()

    def connect(self) -> socket.socket:
        self.clients.append(socket.create_connection(("127.0.0.1", self.port), timeout=LIMIT_S))
        return self.clients[-1]

    async def connected(self) -> socket.socket:
        before, sock = self.status().readers, self.connect()
        await until(lambda: self.status().readers == before + 1)
        return sock


@asynccontextmanager
async def serving(_folder: Path) -> AsyncIterator[Server]:
    made = Server()
    yield made
    for client in made.clients:
        client.close()
    made.close()
    made.close()


@in_context("made", serving)
async def test_every_client_gets_every_sentence(made: Server) -> None:
    first, second = await made.connected(), await made.connected()
    made.put(ONE * 2)
    assert first.recv(100) == second.recv(100) == ONE * 2
    assert made.status().sent == 4
    assert made.status().dropped == 0
    first.shutdown(socket.SHUT_WR)  # kplex direction=in, ncat </dev/null
    second.close()

    def is_alone() -> bool:
        made.put(ONE)
        return made.status().readers == 1

    await until(is_alone)
    first.recv(10_000)
    for _ in range(5):
        made.put(ONE)
        assert first.recv(100) == ONE
    assert made.status().readers == 1


@in_context("made", serving)
async def test_data_from_a_client_is_ignored_and_an_idle_client_stays_connected(made: Server) -> None:
    client = await made.connected()
    client.sendall(b"?WATCH={}\r\n" * 1000)
    for _ in range(20):
        await asyncio.sleep(0)
    made.put(ONE)
    assert client.recv(100) == ONE
    made.clock.advance(100 * STUCK_NS)  # a missing device, or a sentence with 0.01 Hz
    made.tick(made.clock.now_ns())
    assert made.status().readers == 1
    made.put(ONE)
    assert client.recv(100) == ONE


@in_context("made", serving)
async def test_a_client_that_does_not_read_loses_complete_sentences_and_is_disconnected(made: Server) -> None:
    client = await made.connected()
    for _ in range(200):
        made.put(BUSY)
    status = made.status()
    assert status.dropped > 100
    assert status.sent + status.dropped == 200
    got = bytearray()
    client.settimeout(0)
    while len(got) < status.sent * len(BUSY):  # the rest of a partly sent sentence precedes the next sentence
        made.put(b"")
        try:
            got += client.recv(1 << 20)
        except BlockingIOError:
            await asyncio.sleep(0)
    assert bytes(got) == BUSY * status.sent
    for _ in range(200):
        made.put(BUSY)
    made.clock.advance(STUCK_NS)
    made.tick(made.clock.now_ns())
    assert made.status().readers == 1
    made.clock.advance(1)
    made.tick(made.clock.now_ns())
    assert made.status().readers == 0


@in_context("made", serving)
async def test_clients_above_the_limit_are_rejected(made: Server) -> None:
    for _ in range(CLIENTS_MAX):
        await made.connected()
    one_more = made.connect()
    one_more.setblocking(False)
    closed: list[bytes] = []

    def is_closed() -> bool:
        try:
            closed.append(one_more.recv(1))
        except BlockingIOError:
            return False
        return True

    await until(is_closed)
    assert closed == [b""]
    assert made.status().readers == CLIENTS_MAX
    made.clients[3].shutdown(socket.SHUT_WR)
    for _ in range(10):
        await asyncio.sleep(0)
    made.connect()  # in place of the client that can be closed
    made.clients[3].setblocking(False)
    one_more = made.clients[3]
    await until(is_closed)
    assert made.status().readers == CLIENTS_MAX


@in_context("made", serving)
async def test_a_port_in_use_is_reported(made: Server) -> None:
    with pytest.raises(ServerError, match=r"nmea0183\.tcp_port"):
        TcpOutput("127.0.0.1", made.port, VirtualClock().now_ns).open()


@pytest.mark.parametrize("address", ["127.0.0.1", "127.255.255.255"])
def test_datagrams_to_a_host_and_to_all(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((address, 0))
        receiver.settimeout(LIMIT_S)
        made = UdpOutput(address, receiver.getsockname()[1])
        made.put(ONE * 3)
        assert receiver.recv(1000) == ONE * 3
        assert (made.status().sent, made.status().dropped, made.status().readers) == (3, 0, 1)
        made.close()


def test_datagrams_without_a_route_are_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    made = UdpOutput("127.0.0.1", 9)
    made.put(ONE + b"x" * 70_000)  # longer than the maximum of a datagram
    made.put(ONE + b"x" * 70_000)
    assert (made.status().dropped, made.status().readers) == (2, 0)
    assert "too long" in made.status().problem
    assert len(caplog.records) == 1
    made.close()


class Port:
    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def close(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@in_loop
async def test_a_lost_serial_port_is_opened_again() -> None:
    clock, ports = VirtualClock(), [Port(), Port()]
    tried: list[int] = []

    def open_port(_port: str, baud: int) -> int:
        tried.append(baud)
        if len(tried) == 1:
            raise FileNotFoundError(2, "No such file or directory")
        return open_real_port(ports[0].path, baud)

    made = SerialOutput("/dev/ttyUSB9", 38400, clock.now_ns, open_port)
    made.put(ONE)
    made.tick(clock.now_ns())
    await until(lambda: made.status().problem == "No such file or directory")
    made.tick(clock.now_ns())
    assert len(tried) == 1  # the attempt is not due
    clock.advance(RETRY_FIRST_NS)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(ONE)
    assert os.read(ports[0].master, 100) == ONE
    ports[0].close()
    made.put(ONE)
    assert made.status().readers == 0
    ports.pop(0)
    clock.advance(2 * RETRY_FIRST_NS)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(ONE)
    assert os.read(ports[0].master, 100) == ONE
    assert made.status() == OutputStatus("serial /dev/ttyUSB9", 2, 2, 1, "")
    assert tried == [38400] * 3
    made.close()
    made.close()
    ports[0].close()


@in_loop
async def test_a_serial_port_finishes_a_sentence_before_the_next() -> None:
    clock, (reader, writer) = VirtualClock(), os.pipe2(os.O_NONBLOCK)
    made = SerialOutput("/dev/ttyUSB9", 4800, clock.now_ns, lambda *_: writer)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(2 * BUSY)  # a pipe has room for 65,536 bytes
    data, written, puts = b"", 2, 0
    while len(data) < len(2 * BUSY):
        data += os.read(reader, 4096)
        made.put(ONE)
        puts += 1
    with suppress(BlockingIOError):
        data += os.read(reader, 65_536)
    written += data.count(ONE)
    assert data == 2 * BUSY + data.count(ONE) * ONE
    assert (made.status().sent, made.status().dropped) == (written, puts - data.count(ONE))
    made.close()
    os.close(reader)


@in_loop
async def test_a_full_serial_port_drops_complete_sentences() -> None:
    clock, port = VirtualClock(), Port()
    made = SerialOutput(port.path, 4800, clock.now_ns)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    sentence = b"$" + b"y" * 60 + b"\r\n"
    for _ in range(5000):
        made.put(sentence)
    status = made.status()
    assert status.dropped > 0
    got = bytearray()
    while len(got) < status.sent * len(sentence):
        got += os.read(port.master, 1 << 16)
        made.put(b"")
    assert bytes(got) == sentence * status.sent
    made.close()
    port.close()


@in_loop
async def test_a_port_opened_after_the_end_is_closed() -> None:
    clock, port = VirtualClock(), Port()
    fds: list[int] = []

    def open_port(path: str, baud: int) -> int:
        fds.append(open_real_port(path, baud))
        return fds[0]

    made = SerialOutput(port.path, 4800, clock.now_ns, open_port)
    made.tick(clock.now_ns())
    made.close()

    def is_closed() -> bool:
        if not fds:
            return False
        try:
            os.fstat(fds[0])
        except OSError:
            return True
        return False

    await until(is_closed)
    port.close()
