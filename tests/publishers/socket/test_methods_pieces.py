"""imud makes replies about many devices in pieces, with samples in between. The replies are complete."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from imud.contracts.status import DeviceStatus
from imud.publishers.socket.methods import DEVICES_PER_PIECE
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.support.publisher_context import publisher_context
from tests.support.socket_rig import NOW_NS, Peer, batch, device_status, in_context, until

TURN_NS = 1_000_000

DEVICES = 100
DEVICE_NS = 30_000
"""Time to make the status of a running device, ns."""


class Fleet:
    """A server with many devices. Its clock advances with each device status."""

    def __init__(self, directory: Path) -> None:
        self.now_ns = NOW_NS
        self.taken = 0
        self.names = [f"imu{number}" for number in range(DEVICES)]
        known = publisher_context(now_ns=lambda: self.now_ns, each_status=self.each_status)
        self.server = SocketServer(SocketOptions(path=str(directory / "s")), known)

    def each_status(self) -> Iterator[DeviceStatus]:
        for number, name in enumerate(list(self.names)):
            self.now_ns += DEVICE_NS
            self.taken += 1
            yield device_status(name, number)

    async def most_in_a_turn(self, done: asyncio.Task[object]) -> int:
        most, before = 0, self.taken
        while not done.done():
            await asyncio.sleep(0)
            most, before = max(most, self.taken - before), self.taken
        return most


@asynccontextmanager
async def started(directory: Path) -> AsyncIterator[Fleet]:
    fleet = Fleet(directory)
    fleet.server.start()
    yield fleet
    fleet.server.close()


@pytest.mark.parametrize("method", ["devices", "status", "schema"])
@pytest.mark.parametrize("form", ["number", "string"])
@in_context("fleet", started)
async def test_the_state_of_many_devices_is_taken_in_many_turns(fleet: Fleet, method: str, form: str) -> None:
    peer = await Peer.greeted(fleet.server)
    await peer.result("options", big_numbers=form)
    asked = asyncio.ensure_future(peer.result(method))
    most = await fleet.most_in_a_turn(asked)
    assert 0 < most * DEVICE_NS < TURN_NS + DEVICES_PER_PIECE * DEVICE_NS
    result = await asked
    found = result if method == "devices" else result["devices"]
    names = list(found) if method == "schema" else [device["name"] for device in found]
    assert names == fleet.names
    if method == "status":
        numbers = (result["now_ns"], found[-1]["latency_sum_ns"])
        assert all(isinstance(number, str if form == "string" else int) for number in numbers)
        assert int(result["now_ns"]) == fleet.now_ns
        assert len(result["socket"]["clients"]) == 1


@in_context("fleet", started)
async def test_samples_and_other_clients_come_between_and_requests_keep_their_order(fleet: Fleet) -> None:
    asking, watching = await Peer.greeted(fleet.server), await Peer.greeted(fleet.server)
    await watching.result("watch")
    lines = [json.dumps({"jsonrpc": "2.0", "id": n, "method": m}) for n, m in ((1, "status"), (2, "poll"))]
    await asking.send("\n".join([*lines, ""]).encode())
    await until(lambda: 0 < fleet.taken < DEVICES)
    fleet.server.publish(batch("imu0", 1))
    connection, _ = fleet.server.hub.connections.values()
    assert fleet.server.hub.pool.held_bytes > 1000  # the unfinished reply counts
    assert (await watching.message())["params"]["seq"] == 1
    assert fleet.taken < DEVICES
    assert [(await asking.message())["id"] for _ in range(2)] == [1, 2]
    assert connection.unread_bytes == 0
    assert fleet.server.hub.pool.held_bytes == 0
    # if a client leaves, imud discards its unfinished reply
    fleet.taken = 0
    await asking.send(lines[0].encode() + b"\n")
    await until(lambda: fleet.taken > 0)
    asking.close()
    await until(lambda: len(fleet.server.hub.connections) == 1)
    assert fleet.server.hub.pool.held_bytes == 0
    assert fleet.server.hub.status().failed == 0
