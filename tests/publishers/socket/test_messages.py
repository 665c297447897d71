"""Types of messages: the JSON Schema in docs is up to date, and servers and examples are valid. Big numbers."""

import ast
import json
import socket
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import msgspec
import pytest

from docs.generate.socket_schema import socket_document, socket_schema
from imud.model.event import Event, EventKind
from imud.publishers.shm import ShmOptions, ShmPublisher
from imud.publishers.socket.messages import NOTIFICATIONS
from imud.publishers.socket.methods import METHODS
from imud.publishers.socket.server import SocketServer
from tests.support.daemon_process import LIMIT_S, sending_daemon
from tests.support.files import ROOT, hi91
from tests.support.socket_rig import CHECKER, EPOCH, NOW_NS, Peer, batch, in_server

needs_jsonschema = pytest.mark.skipif(not CHECKER.able, reason="the package jsonschema is not installed")
UTC_NS = 1_790_000_000_000_000_000 + 1_000_000


def test_the_file_in_docs_and_the_types_of_methods() -> None:
    current = (ROOT / "docs" / "socket.schema.json").read_text()
    assert current == socket_schema(), "run python -m docs.generate.references"
    free = {name for name, method in METHODS.items() if method.result is Any}
    assert free <= {"command"}  # the result of an action can have any type
    fields = [(name, one) for name, method in METHODS.items() for one in msgspec.structs.fields(method.params)]
    assert [(name, one.name) for name, one in fields if not one.required and NoneType not in get_args(one.type)] == []
    sent = set()
    for path in (ROOT / "imud" / "publishers" / "socket").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "encode_notification":
                assert isinstance(node.args[0], ast.Constant)
                sent.add(node.args[0].value)
    assert sent | {"sample"} == set(NOTIFICATIONS)


@needs_jsonschema
def test_the_schema_finds_invalid_messages_and_accepts_the_document() -> None:
    from jsonschema import Draft202012Validator

    whole = socket_document()
    Draft202012Validator.check_schema(whole)
    good = {"jsonrpc": "2.0", "method": "device", "params": {"device": "a", "device_id": 1}}
    CHECKER.check("notification.device", good)
    Draft202012Validator(whole).validate(good)
    for params in ({"device": "a"}, {"device": 1, "device_id": 1}, {"device": "a", "device_id": 1, "more": 2}):
        with pytest.raises(AssertionError, match=r"notification\.device"):
            CHECKER.check("notification.device", {**good, "params": params})
    lines = [line[2:] for line in (ROOT / "docs" / "socket.md").read_text().splitlines() if line.startswith("→ {")]
    requests = [json.loads(line) for line in lines]
    assert {request["method"] for request in requests} == set(METHODS)
    for request in requests:
        CHECKER.check(f"request.{request['method']}", request)


@in_server()
async def test_big_numbers_are_strings_on_request(server: SocketServer) -> None:
    plain, text = await Peer.greeted(server), await Peer.greeted(server)
    assert await text.result("options", big_numbers="string") == {"big_numbers": "string", "epoch": str(EPOCH)}
    assert (await plain.result("options"))["epoch"] == EPOCH
    for peer in (plain, text):
        await peer.result("watch")
        await peer.result("events")
    server.publish(batch("imu0", 1))
    server.event(Event(NOW_NS, "imu0", EventKind.MARK, "a pulse", {"t_ns": 5, "edge_seq": 3}))
    sample, event = (await plain.message())["params"], (await plain.message())["params"]
    assert (sample["utc_ns"], sample["seq"], event["t_ns"], event["detail"]["t_ns"]) == (UTC_NS, 1, NOW_NS, 5)
    sample, event = (await text.message())["params"], (await text.message())["params"]
    assert (sample["utc_ns"], sample["t_ns"], sample["seq"]) == (str(UTC_NS), "80000001000000", 1)
    assert sample["accel_m_s2"] == [0.125, -0.5, 9.75]
    assert (event["t_ns"], event["detail"]) == (str(NOW_NS), {"t_ns": "5", "edge_seq": 3})
    status = await text.result("status")
    assert (status["now_ns"], status["devices"][0]["clock"]["offset_ns"]) == (str(NOW_NS), "0")
    assert (await text.result("schema"))["slot"]["present_bits"]["t_dev_ns"] == 1
    assert (await text.result("poll", fields=["utc_ns"]))["samples"][0]["utc_ns"] == str(UTC_NS)
    assert (await plain.result("poll"))["samples"][0]["utc_ns"] == UTC_NS
    await text.result("options", big_numbers="number")
    assert (await text.result("poll"))["now_ns"] == NOW_NS


@in_server()
async def test_clients_that_watch_a_removed_device_get_device_removed(server: SocketServer) -> None:
    everything, one, other = [await Peer.greeted(server) for _ in range(3)]
    await everything.result("watch")
    await one.result("watch", devices=["imu0"])
    await other.result("watch", devices=["imu1"])
    server.remove_device("imu0")
    server.remove_device("imu0")
    left = {"jsonrpc": "2.0", "method": "device_removed", "params": {"device": "imu0", "device_id": 0}}
    assert await everything.message() == await one.message() == left
    assert len(await other.result("devices")) == 2
    server.add_device("imu0", 4)
    assert (await everything.message())["params"] == {"device": "imu0", "device_id": 4}
    server.publish(batch("imu0", 1))
    assert (await one.message())["method"] == "sample"


@in_server()
async def test_rings_of_devices_and_optional_parameters(server: SocketServer, tmp_path: Path) -> None:
    shm = ShmPublisher(ShmOptions(directory=str(tmp_path), slots=64), server.hub.context)
    shm.start()
    shm.add_device("imu0", 0)
    peer = await Peer.greeted(server)
    assert [one["ring"] for one in await peer.result("devices")] == [f"{tmp_path}/imud.imu0", None]
    shm.close()
    assert [one["ring"] for one in await peer.result("devices")] == [None, None]
    nothing: dict[str, Any] = {"devices": None, "fields": None, "convention": None}
    assert (await peer.result("watch", **nothing, rate_hz=None, encoding=None))["encoding"] == "json"
    assert (await peer.result("poll", **nothing))["samples"] == []
    assert await peer.result("events", devices=None, enable=None) == {"enable": True}
    assert (await peer.result("options", big_numbers=None))["big_numbers"] == "number"


@in_server()
async def test_a_last_line_without_newline_is_dropped(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.send(b'{"jsonrpc":"2.0","id":1,"method":"unwatch"}\n{"jsonrpc":"2.0","id":2,"method":"unwatch"}')
    peer.sock.shutdown(socket.SHUT_WR)
    assert (await peer.message())["id"] == 1
    assert await peer.ended()


@needs_jsonschema
@pytest.mark.live
def test_every_message_of_a_real_daemon_is_of_these_types(tmp_path: Path) -> None:
    with (
        sending_daemon(tmp_path, lambda number: hi91(10 * number)) as daemon,
        socket.socket(socket.AF_UNIX) as sock,
        sock.makefile("rwb") as lines,
    ):
        sock.settimeout(LIMIT_S)
        sock.connect(str(daemon.socket))
        asked: dict[int, tuple[str, dict[str, Any]]] = {1: ("events", {}), 2: ("watch", {"rate_hz": None})}
        plain = ["devices", "status", "schema", "poll"]
        asked |= {number: (name, {}) for number, name in enumerate([*plain, "unwatch"], start=3)}
        asked |= {10: ("actions", {"device": "bow"}), 11: ("calibrations", {"device": "bow"})}
        asked |= {12: ("options", {"big_numbers": "string"})}
        asked |= {number: (name, {}) for number, name in enumerate(plain, start=13)}
        asked |= {20: ("notify", {"device": "no such device"})}
        for number, (method, params) in asked.items():
            request = {"jsonrpc": "2.0", "id": number, "method": method, "params": params}
            lines.write(json.dumps(request).encode() + b"\n")
        lines.flush()
        seen = set()
        while 20 not in seen:
            message = json.loads(lines.readline())
            number = message.get("id")
            CHECKER.check_sent(message, asked[number][0] if number in asked else None)
            seen.add(number)
        assert set(asked) <= seen
