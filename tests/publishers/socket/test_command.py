"""`actions` and `command`: late replies, errors, the necessary right, and clients that leave."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from imud.client.connection import rpc_error
from imud.publishers.socket.admission import Guard, Rights
from imud.publishers.socket.server import SocketServer
from tests.support import socket_rig
from tests.support.socket_rig import Peer, in_server, run, serving, until


@pytest.fixture(autouse=True)
def not_done_yet() -> None:
    socket_rig.done_late = asyncio.Event()


def request(number: int, name: str, **arguments: Any) -> bytes:
    params = {"device": "imu0", "name": name, "arguments": arguments}
    return json.dumps({"jsonrpc": "2.0", "id": number, "method": "command", "params": params}).encode() + b"\n"


@in_server()
async def test_late_replies_and_the_error_of_a_removed_command(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.send(request(70, "wait"))
    assert len(await peer.result("devices")) == 2
    await peer.send(request(71, "wait"))
    refused = await peer.message()
    assert (refused["id"], refused["error"]["code"]) == (71, -32004)
    socket_rig.done_late.set()
    assert await peer.message() == {"jsonrpc": "2.0", "id": 70, "result": {"waited": "imu0"}}
    await peer.send(request(72, "yaw", angle_deg=5))
    assert (await peer.message())["result"] is None
    words = "mode is a setting: imud settings imu0 --set mode=9-axis"
    error = {"code": -32005, "message": words, "data": {"settings": {"mode": "9-axis"}, "save": False}}
    await peer.send(request(73, "mode", axes=9))
    assert (await peer.message())["error"] == error
    assert rpc_error(error).data == error["data"]
    assert (await peer.ask("command", device="imu0", name="explode"))["error"].keys() == {"code", "message"}


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("explode", {}, "imu0 refuses explode"),
        ("yaw", {}, "expected the argument angle_deg (a number), got none; arguments: angle_deg"),
        ("yaw", {"angle_deg": "x"}, 'angle_deg: expected a number, got "x"'),
        ("yaw", {"angle_deg": 1, "speed": 2}, 'expected an argument that imud knows, got "speed"'),
    ],
)
@in_server()
async def test_a_failure_has_a_reason(server: SocketServer, name: str, arguments: dict[str, Any], words: str) -> None:
    peer = await Peer.greeted(server)
    await peer.send(request(1, name, **arguments))
    error = (await peer.message())["error"]
    assert error["code"] == -32005
    assert words in error["message"]
    assert not server.hub.running


@in_server(control_group="imud-test-control")
async def test_reading_is_not_enough(server: SocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Guard, "rights_of", lambda _guard, _peer: Rights.READ)
    peer = await Peer.greeted(server)
    assert (await peer.result("actions", device="imu0"))[0]["name"] == "yaw"
    code, message = await peer.error("command", device="imu0", name="yaw")
    assert code == -32001
    assert message.startswith("command: expected root or a member of group 'imud-test-control', which does not")
    assert "make it with `sudo groupadd --system imud-test-control`" in message
    # readers may read the last known settings; all other requests need the right to control
    assert (await peer.result("settings.get", device="imu0"))["settings"][0]["actual"] == "6-axis"
    for method, more in (("settings.get", {"fresh": True}), ("settings.plan", {}), ("settings.apply", {})):
        code, message = await peer.error(method, device="imu0", **more)
        assert code == -32001
        assert message.startswith(f"{method}: ")
        assert "expected root or a member of group 'imud-test-control'" in message


@in_server(control_group="root")
async def test_a_group_that_exists_is_named(server: SocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Guard, "rights_of", lambda _guard, _peer: Rights.READ)
    error = (-32001, "command: expected root or a member of group 'root'")
    assert await (await Peer.greeted(server)).error("command", device="imu0", name="yaw") == error


def test_a_command_continues_without_its_client_and_ends_with_the_server(tmp_path: Path) -> None:
    async def body() -> None:
        async with serving(tmp_path) as server:
            peer = await Peer.greeted(server)
            await peer.send(request(1, "wait"))
            await until(lambda: bool(server.hub.running))
            (connection,) = server.hub.connections.values()
            peer.close()
            await until(lambda: not server.hub.connections)
            assert connection.number in server.hub.running
        await until(lambda: connection.number not in server.hub.running)

    run(body)


@in_server()
async def test_settings_are_planned_and_applied_one_change_at_a_time(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    assert (await peer.result("settings.get", device="imu0", fresh=True))["status"]["read_ns"] > 80 * 10**12
    plan = await peer.result("settings.plan", device="imu0", settings={"output": {"hi91": 5}}, save=True)
    assert plan["steps"][0]["value"] == {"hi91": 5}
    assert plan["save"] is True
    done = await peer.result("settings.apply", device="imu0", settings=None)
    assert (done["steps"][0]["name"], done["saved"]) == ("mode", False)
    code, message = await peer.error("settings.apply", device="imu0", settings=[1])
    assert code == -32602
    assert "settings: expected keys" in message
    code, _message = await peer.error("settings.apply", device="imu7")
    assert code == -32602
    params = {"device": "imu0", "settings": {"wait": 1}}
    line = {"jsonrpc": "2.0", "id": 90, "method": "settings.apply", "params": params}
    await peer.send(json.dumps(line).encode() + b"\n")
    for method, more in (
        ("settings.plan", {}), ("settings.apply", {}), ("settings.get", {"fresh": True}),
        ("command", {"name": "yaw"}), ("calibrate", {"kind": "heading"}),
    ):  # fmt: skip
        code, message = await peer.error(method, device="imu0", **more)
        assert (code, "is not finished; wait for its reply" in message) == (-32004, True)
    socket_rig.done_late.set()
    assert (await peer.message())["id"] == 90
