"""Invalid input: the client gets the specified error, and the server continues to serve other clients."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from msgspec.structs import replace

from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.publishers.socket.admission import Rights
from imud.publishers.socket.methods import METHODS
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.support.publisher_context import publisher_context
from tests.support.socket_rig import NOW_NS, Peer, batch, device_status, in_context, in_server, until

LINE_MAX_BYTES, DEVICES_PER_PIECE, BYTES_BURST = 65_536, 8, 1 << 20


@pytest.mark.parametrize(
    ("line", "code", "request_id", "words"),
    [
        (b"{", -32700, None, "not JSON"), (b"\xff\xfe", -32700, None, "not JSON"),
        (b"[" * 60_000, -32700, None, "nested too deeply"),
        (b'{"jsonrpc":"2.0","id":1,"method":"watch","params":{"rate_hz":1e999}}', -32700, None, "not JSON"),
        (b"[" + b"1," * 3000 + b"1]", -32700, None, "too many values: expected at most 2048"),
        (b"{}", -32600, None, '"2.0"'), (b'{"jsonrpc":2.0,"id":1,"method":"devices"}', -32600, 1, '"2.0"'),
        (b'{"jsonrpc":"2.0","id":1,"method":"devices","params":[1]}', -32602, 1, "the parameters by name"),
        (b'{"jsonrpc":"2.0","id":1,"method":"config.get"}', -32601, 1, 'a method that imud knows, got "config.get"'),
        (b'{"jsonrpc":"2.0","id":null,"method":"x"}', -32601, None, 'a method that imud knows, got "x"'),
    ],
)  # fmt: skip
@in_server()
async def test_bad_lines(server: SocketServer, line: bytes, code: int, request_id: object, words: str) -> None:
    peer = await Peer.greeted(server)
    await peer.send(line + b"\n")
    reply = await peer.message()
    assert (reply["jsonrpc"], reply["id"], reply["error"]["code"]) == ("2.0", request_id, code)
    assert words in reply["error"]["message"]
    assert len(await peer.result("devices")) == 2


@pytest.mark.parametrize(
    ("method", "params", "words"),
    [
        ("watch", {"rate_hz": -1}, "0.001 … 1000000, got -1"),
        ("watch", {"rate_hz": 0.00099}, "expected 0 (every sample) or 0.001"),
        ("watch", {"rate_hz": 1_000_001}, "expected 0 (every sample) or 0.001"),
        ("watch", {"rate_hz": True}, "rate_hz: expected a number, or null, got true"),
        ("watch", {"rate_hz": "fast"}, 'got "fast"'),
        ("watch", {"devices": ["imu7"]}, 'a device that imud knows, got "imu7"'),
        ("watch", {"devices": []}, "devices: expected at least one name"),
        ("watch", {"devices": "imu0"}, 'expected a list, each item text, or null, got "imu0"'),
        ("watch", {"devices": [1]}, "got a list with 1 at [0]"),
        ("watch", {"fields": ["accel"]}, 'got "accel"; did you mean accel_m_s2? known: accel_m_s2'),
        ("watch", {"encoding": "xml"}, "xml"),
        ("poll", {"devices": ["imu7"]}, "known: imu0, imu1"),
        ("events", {"limit": 1001}, "limit: expected 1 to 1000, got 1001"),
        ("events", {"enable": "yes"}, 'enable: expected true or false, or null, got "yes"'),
        ("history", {}, "history: expected the parameter devices"),
        ("history", {"devices": ["imu0"], "points": 1001}, "points: expected 1 to 1000, got 1001"),
        ("history", {"devices": ["imu0"], "from_ns": 2, "to_ns": 1}, "from_ns: expected at most to_ns (1), got 2"),
        ("history", {"devices": ["imu0"], "convention": "up"}, "up"),
        ("notify", {}, "notify: expected the parameter device (text), got none"),
        ("notify", {"device": "imu7"}, "known: imu0, imu1"),
    ],
)
@in_server()
async def test_bad_parameters(server: SocketServer, method: str, params: dict[str, Any], words: str) -> None:
    peer = await Peer.greeted(server)
    code, message = await peer.error(method, **params)
    assert code == -32602
    assert words in message
    (connection,) = server.hub.connections.values()
    assert connection.number not in watching(server)
    assert not connection.wakers


def watching(server: SocketServer) -> set[int]:
    return {client.number for client in server.hub.clients() if client.encoding}


@in_server()
async def test_limits_are_allowed_unknown_members_ignored_and_nan_is_null(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    for rate_hz in (0.001, 1_000_000):
        assert (await peer.result("watch", rate_hz=rate_hz))["rate_hz"] == rate_hz
    line = b'{"later":1,"jsonrpc":"2.0","id":1,"method":"watch","params":{"later":[],"rate_hz":null}}\r\n'
    await peer.send(line)
    assert (await peer.message())["result"]["rate_hz"] == 0
    nan = batch()
    values = (float("nan"), float("inf"), -float("inf"))
    server.publish(Batch("imu0", 0, [replace(nan.samples[0], gyro_rad_s=values)]))
    assert (await peer.message())["params"]["gyro_rad_s"] == [None, None, None]


def test_rights_and_effects_of_the_methods() -> None:
    changing = {
        "command",
        "calibrate",
        "firmware.open",
        "firmware.update",
        "settings.plan",
        "settings.apply",
        "stop_calibration",
    }
    recording = {"record.start", "record.stop", "record.snapshot"}
    assert {name for name, method in METHODS.items() if method.right is not Rights.READ} == changing | recording
    assert {name for name, method in METHODS.items() if method.acts} == {
        "options", "watch", "unwatch", "events", "command", "calibrate", "firmware.update", "settings.apply",
        "stop_calibration", "record.stop",
    }  # fmt: skip


@in_server()
async def test_notifications_several_requests_half_and_blank_lines(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.send(b'{"jsonrpc":"2.0","method":"status"}\n')
    await peer.send(b'{"jsonrpc":"2.0","method":"nonsense"}\n')
    await peer.send(b'{"jsonrpc":"2.0","method":"notify","params":{"device":"imu0"}}\n')
    await peer.send(b'{"jsonrpc":"2.0","method":"watch","params":{"devices":["imu1"]}}\n')
    await peer.send(b'{"jsonrpc":"2.0","id":9,"method":"devices"}\n')
    assert (await peer.message())["id"] == 9
    (connection,) = server.hub.connections.values()
    assert connection.number in watching(server)
    assert not connection.wakers
    lines = b"".join(b'{"jsonrpc":"2.0","id":%d,"method":"poll"}\n\r\n\n' % number for number in range(25))
    await peer.send(lines)  # more requests than one turn serves
    assert [reply["id"] for reply in await peer.messages(25)] == list(range(25))
    line = b'{"jsonrpc":"2.0","id":"cut","method":"poll"}\n'
    for cut in range(1, len(line), 7):
        await peer.send(line[:cut])
        await asyncio.sleep(0)
        await peer.send(line[cut:])
        assert (await peer.message())["id"] == "cut"


@in_server()
async def test_a_client_that_leaves_in_the_middle_of_a_line(server: SocketServer) -> None:
    peer, other = await Peer.greeted(server), await Peer.greeted(server)
    await peer.send(b'{"jsonrpc":"2.0","id":1,"meth')
    peer.close()
    while len(server.hub.connections) > 1:
        await asyncio.sleep(0)
    assert len(await other.result("devices")) == 2


@pytest.mark.parametrize("newline", [b"", b"\n"])
@in_server()
async def test_a_line_over_the_limit_ends_the_connection(server: SocketServer, newline: bytes) -> None:
    peer, other = await Peer.greeted(server), await Peer.greeted(server)
    start = b'{"jsonrpc":"2.0","id":1,"method":"poll","x":"'
    longest = start + b"x" * (LINE_MAX_BYTES - len(start) - 2) + b'"}'
    await peer.send(longest + b"\n")
    assert (await peer.message())["id"] == 1
    await peer.send(b"x" * (LINE_MAX_BYTES + 1) + newline)
    assert (await peer.message())["error"]["code"] == -32003
    assert await peer.ended()
    assert server.hub.status().evicted == 1
    assert len(await other.result("devices")) == 2


@in_server()
async def test_many_requests_of_one_client_leave_turns_to_other_clients(server: SocketServer) -> None:
    flood, other = await Peer.greeted(server), await Peer.greeted(server)
    await flood.send(b'{"jsonrpc":"2.0","id":1,"method":"poll"}\n' * 1000)
    await other.result("poll")
    while b"\n" not in flood.buffer:
        flood.buffer += await asyncio.get_running_loop().sock_recv(flood.sock, 1 << 20)
    assert flood.buffer.count(b"\n") < 200  # of 1000, at the reply to the other client


@in_server()
async def test_a_name_with_control_characters_is_refused(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    for name, expected in (("x\nERROR forged", -32602), ("x" * 65, -32602), ("x" * 64, -32005)):
        code, _ = await peer.error("command", device="imu0", name=name)
        assert code == expected
        assert (await peer.error("calibrate", device="imu0", kind=name))[0] == expected


@in_server()
async def test_an_internal_error_ends_only_its_client(server: SocketServer, caplog: pytest.LogCaptureFixture) -> None:
    """A second error, in a step of the end of the client, does not keep its place."""
    other = await Peer.greeted(server)
    steps = ("client.ClientConnection.post", "outbox.Outbox.discard", "hub.Hub.unsubscribe")
    for failed, broken in enumerate(("", "", "", "methods.encode_result", *steps), 1):
        peer = await Peer.greeted(server)
        await peer.result("watch")
        request = '"devices"' if failed == 4 else '"command","params":{"device":"imu0","name":"break"}'
        with patch(f"imud.publishers.socket.{broken}", side_effect=ZeroDivisionError) if broken else nullcontext():
            await peer.send(b'{"jsonrpc":"2.0","id":1,"method":%b}\n' % request.encode())
            if broken != steps[0]:
                assert (await peer.message())["error"]["code"] == -32603
            assert await peer.ended()
        assert server.hub.status().failed >= failed
        assert len(await other.result("devices")) == 2
        assert len(server.hub.clients()) == 1
    assert caplog.text.count("internal error while serving a client") == 1


@in_server()
async def test_empty_lines_use_up_the_allowance_of_their_client(server: SocketServer) -> None:
    """Before the limit, 30 clients with 7 MB of empty lines each kept the daemon busy for minutes."""
    peer, other = await Peer.greeted(server), await Peer.greeted(server)
    peer.sock.setblocking(False)
    written, full = 0, 0
    while full < 200:  # the server no longer reads
        try:
            written += peer.sock.send(b"\n" * 65_536)
            full = 0
        except BlockingIOError:
            full += 1
        await asyncio.sleep(0)
    assert written < 2 * BYTES_BURST
    assert len(await other.result("devices")) == 2


TURN_NS, DEVICES, DEVICE_NS = 1_000_000, 100, 30_000
"""`DEVICE_NS`: time to make the status of a running device, ns."""


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
        assert (int(result["now_ns"]), len(result["socket"]["clients"])) == (fleet.now_ns, 1)


@in_context("fleet", started)
async def test_samples_and_other_clients_come_between_and_requests_keep_their_order(fleet: Fleet) -> None:
    asking, watching = await Peer.greeted(fleet.server), await Peer.greeted(fleet.server)
    await watching.result("watch")
    lines = [json.dumps({"jsonrpc": "2.0", "id": n, "method": m}) for n, m in ((1, "status"), (2, "poll"))]
    await asking.send("\n".join([*lines, ""]).encode())
    await until(lambda: 0 < fleet.taken < DEVICES)
    fleet.server.publish(batch("imu0", 1))
    assert fleet.server.hub.pool.held_bytes > 1000  # the unfinished reply counts
    assert (await watching.message())["params"]["seq"] == 1
    assert fleet.taken < DEVICES
    assert [(await asking.message())["id"] for _ in range(2)] == [1, 2]
    assert fleet.server.hub.pool.held_bytes == 0
    # if a client leaves, imud discards its unfinished reply
    fleet.taken = 0
    await asking.send(lines[0].encode() + b"\n")
    await until(lambda: fleet.taken > 0)
    asking.close()
    await until(lambda: len(fleet.server.hub.connections) == 1)
    assert (fleet.server.hub.pool.held_bytes, fleet.server.hub.status().failed) == (0, 0)
