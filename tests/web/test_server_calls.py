"""Requests to the daemon. Each uses its own connection."""

import asyncio
from pathlib import Path

import pytest

from imud.formats.jsonrpc import Code, RpcError
from imud.model.errors import ImudError, LinkMissing
from imud.web.server import AT_A_TIME_MAX, Busy, Calls
from tests.support import socket_rig
from tests.support.socket_rig import serving


async def test_a_request_uses_a_connection_that_ends_after_the_reply(tmp_path: Path) -> None:
    async with serving(tmp_path) as server:
        calls = Calls(server.hub.path)
        report = await calls.call("settings.get", {"device": "imu0"})
        assert report["settings"][0]["actual"] == "6-axis"
        request = {"device": "imu0", "name": "yaw", "arguments": {"angle_deg": 5}}
        assert await calls.call("command", request) is None
        await socket_rig.until(lambda: not server.hub.connections)
        with pytest.raises(RpcError, match="no device named 'none'") as caught:
            await Calls(server.hub.path).call("actions", {"device": "none"})
        assert caught.value.code == Code.INVALID_PARAMS


async def test_long_orders_hold_up_no_others_and_are_bounded(tmp_path: Path) -> None:
    socket_rig.done_late = asyncio.Event()
    async with serving(tmp_path) as server:
        calls = Calls(server.hub.path)
        request = {"device": "imu0", "name": "wait", "arguments": {}}
        waiting = [asyncio.create_task(calls.call("command", request)) for _ in range(AT_A_TIME_MAX - 1)]
        assert await calls.call("actions", {"device": "imu1"})
        await socket_rig.until(lambda: len(server.hub.connections) == AT_A_TIME_MAX - 1)
        waiting.append(asyncio.create_task(calls.call("command", request)))
        await socket_rig.until(lambda: len(server.hub.connections) == AT_A_TIME_MAX)
        with pytest.raises(Busy, match="try again"):
            await calls.call("actions", {"device": "imu1"})
        socket_rig.done_late.set()
        assert await asyncio.gather(*waiting) == [{"waited": "imu0"}] * AT_A_TIME_MAX


async def test_without_a_daemon_the_error_names_the_path(tmp_path: Path) -> None:
    with pytest.raises(LinkMissing, match=r"no daemon at .*/none: No such file"):
        await Calls(str(tmp_path / "none")).call("schema", {})


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (b"", "closed the connection"),
        (b"GET / HTTP/1.1\n", "not JSON"),
        (b'{"jsonrpc":"2.0","method":"hello","params":{"protocol":9}}\n', "protocol 1"),
        (b'{"jsonrpc":"2.0","method":"hello","params":{"protocol":1}}\nhalf', "closed the connection|is lost"),
        (b'{"jsonrpc":"2.0","id":null,"error":{"code":-32002,"message":"too many clients"}}\n', "too many clients"),
    ],
)
async def test_invalid_replies_raise_errors(sent: bytes, problem: str, tmp_path: Path) -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(sent)
        writer.close()

    path = str(tmp_path / "fake")
    async with await asyncio.start_unix_server(serve, path):
        with pytest.raises(ImudError, match=problem):
            await Calls(path).call("schema", {})
