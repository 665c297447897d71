"""The Foxglove server with a WebSocket client of aiohttp, the command as a process, and origins."""

import asyncio
import json
import re
import signal
import sys
from collections.abc import Callable
from contextlib import closing
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from foxglove import start_server

from imud.bridges.channel import MessageFrames, StampedEvent
from imud.bridges.json import JsonDialect
from imud.model.errors import BadArgument, ServerError
from imud.web.foxglove import FoxgloveServer, ViewerOrigins, hidden_address
from tests.bridges.samples import EVENT, FULL, UTC_NS
from tests.cli.conftest import Cli, imud_process
from tests.cli.protocol_client import connected
from tests.support.daemon_process import running_daemon
from tests.test_daemon import cable, device

DIALECT = JsonDialect()


def serve(notes: list[str]) -> FoxgloveServer:
    return FoxgloveServer("127.0.0.1", 0, ViewerOrigins(), note=notes.append)


def test_messages_reach_a_client_that_subscribed() -> None:
    async def talk(server: FoxgloveServer) -> None:
        channels = {channel.topic: channel for channel in DIALECT.samples(MessageFrames("bow"))}
        events = DIALECT.events()
        for channel in channels.values():
            server.open(channel)
        server.open(events)
        server.open(events)
        assert not server.is_subscribed
        async with connected(server.url) as client:
            await client.subscribe("/bow/attitude")
            await client.subscribe("/events")
            imu = client.channels["/bow/imu/data"]
            assert (imu["encoding"], imu["schemaName"], imu["schemaEncoding"]) == ("json", "imud.Imu", "jsonschema")
            assert json.loads(imu["schema"])["title"] == "imud.Imu"
            while not server.is_subscribed:
                await asyncio.sleep(0)
            got: dict[str, Any] = {}
            while len(got) < 2:
                server.send(channels["/bow/attitude"], FULL, FULL.utc_ns)
                server.send(channels["/bow/imu/data"], FULL, FULL.utc_ns)
                server.send(events, StampedEvent(EVENT, UTC_NS), UTC_NS)
                topic, t_ns, message = await client.receive(lambda *_: True)
                if message is not None:
                    assert t_ns == UTC_NS
                    got[topic] = message
            assert got["/bow/attitude"]["rotation"] == {"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5}
            assert client.channels["/bow/attitude"]["schemaName"] == "foxglove.FrameTransform"
            assert got["/events"]["message"] == 'loss: lost 3, "damaged"'
            server.problem("no daemon")
            await client.receive(lambda *_: client.statuses)
            assert client.statuses == ["no daemon"]

    notes: list[str] = []
    with closing(serve(notes)) as server:
        asyncio.run(talk(server))
        server.problem("no daemon")
        server.problem("")
    assert notes == ["no daemon", "connected to the daemon again"]


def test_the_server_behind_the_gate_is_hidden_and_ends_if_a_port_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    servers: list[Mock] = []

    def start(**options: Any) -> Mock:
        server = start_server(**options)
        servers.append(Mock(wraps=server, port=server.port))
        return servers[-1]

    monkeypatch.setattr("foxglove.start_server", start)
    with closing(serve([])) as server:
        port = int(server.url.rpartition(":")[2])
        with pytest.raises(ServerError, match=f"cannot listen on 127.0.0.1 port {port}"):
            FoxgloveServer("127.0.0.1", port, ViewerOrigins(), note=print)
        server.problem("no daemon")
        server.problem("")
        servers[0].remove_status.assert_called_once_with(["daemon"])
    assert [one.stop.call_count for one in servers] == [1, 1]
    addresses = {hidden_address() for _ in range(100)}
    assert len(addresses) >= 99, "of 16 million"
    assert all(ip_address(one).is_loopback for one in addresses)
    assert not addresses & {"127.0.0.0", "127.255.255.255"}


@pytest.mark.live
def test_the_command_shows_what_the_device_sent(tmp_path: Path) -> None:
    """A device at a serial port, the daemon, `imud foxglove`, and a client of the protocol."""

    async def look(url: str, send: Callable[[], None]) -> tuple[int, Any]:
        async with connected(url) as client:
            await client.subscribe("/bow/imu/data")
            while True:
                send()
                try:
                    _, t_ns, message = await asyncio.wait_for(client.receive(lambda topic, *_: topic), 0.3)
                except TimeoutError:
                    continue
                return t_ns, message

    with cable(tmp_path) as port, running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
        daemon.wait_for("bow", "searching")
        port.send(1)
        daemon.wait_for("bow", "running")
        words = ("foxglove", "--port", 0, "--rate", 0, "--schema", "json", "--socket", daemon.socket)
        with imud_process(*words) as process:
            while (found := re.search(r"ws://\S+", process.err.readline())) is None:
                pass
            t_ns, imu = asyncio.run(look(found[0], lambda: port.send(1)))
            process.end(signal.SIGTERM)
    assert imu["linear_acceleration"]["z"] == pytest.approx(9.8, abs=1e-6)
    assert (imu["frame_id"], t_ns) == ("bow", imu["timestamp"]["sec"] * 10**9 + imu["timestamp"]["nsec"])


def test_refused_arguments_and_the_warning(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    tunnel = "add --open, or omit --address and use a tunnel: ssh -L 8765:"
    for address in ("0.0.0.0", "::", "192.168.1.2", "gateway"):
        cli.refuses(tunnel, "foxglove", "--address", address, "--port", "0")
    for option, value in {"--port": "70000", "--rate": "-1", "--allow-origin": "viewer.example"}.items():
        cli.refuses(f"{option}: expected", "foxglove", option, value)
    cli.refuses("--rate: expected", "foxglove", "--rate", "nan")
    monkeypatch.setattr("imud.web.foxglove.Relay.run", lambda _relay: None)
    handler = signal.getsignal(signal.SIGTERM)
    try:
        err = cli("foxglove", "--address", "0.0.0.0", "--open", "--port", "0").err
        assert "WARNING: 0.0.0.0 is not a loopback address" in err
        assert "WARNING" not in cli("foxglove", "--port", "0").err
    finally:
        signal.signal(signal.SIGTERM, handler)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, "imud.web.foxglove", raising=False)
    cli.refuses(" install 'imud[foxglove]'", "foxglove")


HOST = "127.0.0.1:8765"
RULE = ViewerOrigins(names=["Gateway.example"], origins=["https://Viewer.example:8443"])
VIEWERS = (
    "", "file://", "https://app.foxglove.dev", "http://localhost:8080", "http://127.0.0.1", "https://[::1]:8080",
    "https://viewer.example:8443",
)  # fmt: skip
OTHERS = (
    "null", "https://attacker.example", "http://app.foxglove.dev", "https://app.foxglove.dev.attacker.example",
    "https://viewer.example", "https://localhost.attacker.example", "https://localhost@attacker.example",
    "http://localhost/path", "http://localhost:port", "chrome-extension://localhost", "http://[::1",
)  # fmt: skip


def test_hosts_and_origins_that_may_read() -> None:
    assert [origin for origin in VIEWERS if RULE.problem(HOST, origin)] == []
    for origin in OTHERS:
        problem = RULE.problem(HOST, origin)
        assert "may not read" in problem, origin
        assert f"--allow-origin {origin}" in problem
    for host in ("localhost:8765", "[::1]:8765", "192.168.1.7:8765", "gateway.example:8765"):
        assert RULE.problem(host, "file://") == "", host
    for host in ("attacker.example:8765", "127.0.0.1.attacker.example", ""):
        assert "--host NAME" in RULE.problem(host, "")
        assert "expected an IP address or one of gateway.example, localhost" in RULE.problem(host, "file://")
    for words in ("viewer.example", "*", "null", "https://", "https://viewer.example/page", "ftp://a"):
        with pytest.raises(BadArgument, match=r"--allow-origin: expected a site as https://viewer\.example:8080"):
            ViewerOrigins(origins=[words])
