"""Work that clients of the TCP server cause, and a serial port that accepts no data."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget
from imud.publishers import sentence_ports
from tests.publishers.test_nmea0183 import BUSY, ONE, Server
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.socket_rig import in_context, until


class BudgetedServer(Server):
    """Server on which each read and each connection costs 1 ms of CPU time."""

    def __init__(self) -> None:
        self.cpu_ns = 0
        super().__init__()
        self._budget = WorkBudget(sentence_ports.PEER_LIMITS, self.take_cpu_ns)

    def take_cpu_ns(self) -> int:
        self.cpu_ns += 1_000_000
        return self.cpu_ns


@asynccontextmanager
async def budgeted(_folder: Path) -> AsyncIterator[BudgetedServer]:
    made = BudgetedServer()
    yield made
    for client in made.clients:
        client.close()
    made.close()


@in_context("made", budgeted)
async def test_data_of_clients_stay_within_the_budget(made: BudgetedServer) -> None:
    """A client sends data without end: imud reads at most 20 ms per second, and then leaves the data in the kernel."""
    flooding = await made.connected()
    flooding.setblocking(False)
    for _ in range(2000):
        with suppress(BlockingIOError):
            flooding.send(bytes(65_536))
        await asyncio.sleep(0)
    assert made.cpu_ns <= (20 + 20) * 3 * 1_000_000, "three readings of the clock for each read"
    assert "127.0.0.1 sends more than imud processes" in made.status().problem
    assert made.status().discarded >= 1
    made.put(ONE)
    assert flooding.recv(100) == ONE, "the client still gets sentences"
    used_ns = made.cpu_ns
    made.clock.advance(NS_PER_S)
    made.tick(made.clock.now_ns())
    await until(lambda: made.cpu_ns > used_ns)


@in_context("made", budgeted)
async def test_connections_stay_within_the_budget(made: BudgetedServer) -> None:
    for _ in range(100):
        made.connect().close()
        await asyncio.sleep(0)
    assert made.cpu_ns <= (20 + 2 * 20) * 3 * 1_000_000
    made.clock.advance(NS_PER_S)
    made.tick(made.clock.now_ns())
    for _ in range(20):
        await asyncio.sleep(0)
    assert made.status().discarded >= 1


@in_loop
async def test_serial_port_without_progress_is_a_problem() -> None:
    clock = VirtualClock()
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    made = sentence_ports.SerialOutput("/dev/ttyUSB9", 38400, clock.now_ns, lambda _port, _baud: slave)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    for _ in range(2000):
        made.put(BUSY)
    assert (made.status().readers, made.status().problem) == (1, "")
    clock.advance(10 * NS_PER_S)
    status = made.status()
    assert status.readers == 0
    assert status.problem == "the port has accepted no data for 10 s; check its flow control"
    made.close()
    os.close(master)
