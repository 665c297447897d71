"""The HTTP server: permissions, replies, the WebSocket, requests to the daemon."""

import asyncio
import base64
import json
import re
import shutil
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from time import monotonic_ns, thread_time_ns
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import pytest
from aiohttp import ClientWebSocketResponse, WSMsgType, WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer, get_port_socket
from aiohttp.web import AppRunner, HTTPRequestTimeout

from imud.formats.jsonrpc import Code, RpcError
from imud.model.errors import ImudError, LinkMissing
from imud.model.event import Event, EventKind
from imud.publishers.socket.server import SocketServer
from imud.web import connections as web_connections
from imud.web import hub as mailbox
from imud.web import server as web_app
from imud.web.budgets import OPEN_REQUESTS, WebBudget, WebClock
from imud.web.connections import LimitedSite, WebConnections
from imud.web.guard import COOKIE, WebGuard
from imud.web.server import STATIC, Busy, Calls, WebServer, bundle, server_log, static_files
from tests.support import socket_rig
from tests.support.socket_rig import batch, serving, until

AT_A_TIME_MAX, CHECKS_MAX, CHECK_S, CONNECTIONS_MAX, FAILURES_MAX, IDLE_S = 16, 32, 1.0, 200, 8, 60.0
CLOCK = WebClock(monotonic_ns, thread_time_ns)
TOKEN = "correct-horse-battery-staple"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


class Site:
    def __init__(self, web: WebServer, client: Any, daemon: SocketServer) -> None:
        self.web = web
        self.client = client
        self.daemon = daemon
        self.origin = {"Origin": str(client.make_url("")).rstrip("/")}

    async def post(self, path: str, body: object, **headers: str) -> tuple[int, Any]:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        async with self.client.post(path, data=data, headers={**self.origin, **headers}) as response:
            return response.status, json.loads(await response.read())

    async def get(self, path: str, **headers: str) -> tuple[int, Any]:
        async with self.client.get(path, headers=headers) as response:
            return response.status, json.loads(await response.read())

    async def stream(self, **look: Any) -> ClientWebSocketResponse:
        socket: ClientWebSocketResponse = await self.client.ws_connect("/api/stream", headers=self.origin)
        await socket.send_json(look)
        return socket


@asynccontextmanager
async def running(
    folder: Path, *, token: str = TOKEN, reading_needs_token: bool = False, small_buffers: bool = False
) -> AsyncIterator[Site]:
    async with serving(folder) as daemon:
        web = WebServer(
            daemon.hub.path, WebGuard(token.encode(), lambda: 1e9, reading_needs_token=reading_needs_token), CLOCK
        )
        server = TestServer(web.make_app(), socket_factory=small_socket if small_buffers else get_port_socket)
        async with TestClient(server) as client:
            yield Site(web, client, daemon)
        await until(lambda: not daemon.hub.connections)


def small_socket(host: str, port: int, family: socket.AddressFamily) -> socket.socket:
    listening = get_port_socket(host, port, family)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, StalledPage.BUFFER_BYTES)
    return listening


class StalledPage:
    """A page that reads no byte, and still acknowledges messages."""

    BUFFER_BYTES = 4096
    """Minimum receive buffer of the kernel."""

    def __init__(self, site: Site) -> None:
        url = site.client.make_url("")
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self.BUFFER_BYTES)
        self._socket.setblocking(False)
        self._address = (url.host, url.port)
        self._head = (
            f"GET /api/stream HTTP/1.1\r\nHost: {url.host}:{url.port}\r\nOrigin: {site.origin['Origin']}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}\r\n\r\n"
        )

    async def open(self, **look: Any) -> None:
        loop = asyncio.get_running_loop()
        await loop.sock_connect(self._socket, self._address)
        await loop.sock_sendall(self._socket, self._head.encode())
        await self.send(**look)

    async def send(self, **look: Any) -> None:
        text = json.dumps(look).encode()
        assert len(text) < 126
        frame = bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text
        await asyncio.get_running_loop().sock_sendall(self._socket, frame)

    def close(self) -> None:
        self._socket.close()


async def message(socket: ClientWebSocketResponse, kind: str) -> dict[str, Any]:
    while (found := json.loads((await socket.receive()).data))["kind"] != kind:
        pass
    assert isinstance(found, dict)
    return found


async def test_the_page_has_safe_headers_and_other_names_and_sites_are_refused(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        page = await site.client.get("/")
        text = await page.text()
        assert page.headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'")
        assert page.headers["X-Content-Type-Options"] == "nosniff"
        for path in re.findall(r'(?:src|href)="(/[^"]+)"', text):
            answer = await site.client.get(path)
            assert answer.status == 200, path
            assert "Content-Security-Policy" in answer.headers
            assert (answer.headers["Content-Encoding"], answer.charset) == ("gzip", "utf-8")
            name = path.removeprefix("/static/")
            file = static_files()[name].body
            assert name == "main.js" or file == (STATIC / name).read_bytes()
            assert await answer.read() == file
            assert int(answer.headers["Content-Length"]) < 0.8 * len(file)
            plain = await site.client.get(path, headers={"Accept-Encoding": "identity"})
            assert (await plain.read(), plain.headers.get("Content-Encoding")) == (file, None)
            known = await site.client.get(path, headers={"If-None-Match": plain.headers["ETag"]})
            assert (known.status, await known.read()) == (304, b"")
        assert (await site.client.get("/static/../app.py")).status == 404
        assert (await site.client.get("/static/")).status in (403, 404)
        missing = await site.client.get("/none")
        assert missing.status == 404
        assert "Content-Security-Policy" in missing.headers, "errors have them too"
        assert (await site.get("/api/session", Host="attacker.example"))[0] == 421
        call = {"method": "actions", "params": {"device": "imu0"}}
        assert (await site.post("/api/call", call))[0] == 200
        assert (await site.post("/api/call", call, Origin="http://attacker.example"))[0] == 403
        assert (await site.client.post("/api/call", json=call)).status == 403, "a browser always has an Origin"
        assert (await site.client.post("/api/call", json=call, headers=BEARER)).status == 200
        for headers in ({"Origin": "http://attacker.example"}, {}, {**BEARER, "Origin": "null"}):
            with pytest.raises(WSServerHandshakeError, match="403"):
                await site.client.ws_connect("/api/stream", headers=headers)
        answer = await site.client.options("/api/call", headers={"Origin": "http://attacker.example"})
        assert not [name for name in answer.headers if name.startswith("Access-Control")]


def test_nothing_is_loaded_from_elsewhere() -> None:
    page = (STATIC / "index.html").read_text()
    assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=|style=|javascript:", page)
    for file in STATIC.rglob("*"):
        if file.suffix in (".html", ".js", ".css") and file.parent == STATIC:
            text = file.read_text()
            assert "innerHTML" not in text, file
            assert not re.search(r"(?:src|href|import|url|fetch)\W*https?://", text), file
    modules = {"main.js": 'import { b } from "./b.js";\nb();\n', "b.js": "export const b = () => 1; // it's `1`\n"}
    assert bundle(modules) == "const b = () => 1;\nb();\n"
    texts = 'f(`x \\`\n  // y $ ${a ? `  b\n  c` : `${d}`}\n  z`, \'a  //  `\', "`  // \\" `");\n'
    assert bundle({"a.js": f"/** `A\n *  b` */\nif (a)\n  // it's `c\n\n  {texts}"}) == f"if (a)\n{texts}"
    page = bundle({file.name: file.read_text() for file in STATIC.glob("*.js")})
    lines = "\n".join(file.read_text() for file in STATIC.glob("*.js")).split("\n")
    code = [one.strip().removeprefix("export ").split("; // ")[0] for one in lines if not re.match(r" *(//|/?\*)", one)]
    assert [one for one in code if "`" in one and one not in page] == []


def test_the_page_names_uplot_only_if_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(STATIC, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("uplot"))
    monkeypatch.setattr(web_app, "STATIC", tmp_path)
    files = static_files()
    whole = (STATIC / "index.html").read_bytes().splitlines()
    assert files["index.html"].body.splitlines() == [line for line in whole if b"uplot" not in line] != whole
    assert [name for name in files if "uplot" in name] == []
    (tmp_path / "uplot").mkdir()
    (tmp_path / "uplot/LICENSE").touch()
    assert static_files()["index.html"].body.splitlines() == whole


async def test_control_needs_the_token_and_a_cookie_does_for_it(tmp_path: Path) -> None:
    orders: tuple[tuple[str, dict[str, object]], ...] = (
        ("settings.plan", {}), ("settings.apply", {}),
        ("command", {"name": "yaw", "arguments": {"angle_deg": 5}}),
        ("calibrate", {"kind": "heading"}), ("stop_calibration", {}), ("settings.get", {"fresh": True}),
    )  # fmt: skip
    async with running(tmp_path) as site:
        for method, params in orders:
            call = {"method": method, "params": {"device": "imu0", **params}}
            assert (await site.post("/api/call", call))[0] == 401, method
            status, answer = await site.post("/api/call", call, **BEARER)
            assert (status, "result" in answer) == (200, True), (method, answer)
        session = (await site.get("/api/session"))[1] | {"version": ""}
        assert session == {"read": True, "control": False, "has_token": True, "version": ""}
        response = await site.client.post("/api/login", json={"token": TOKEN}, headers=site.origin)
        cookie = response.headers["Set-Cookie"]
        assert response.status == 200
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert TOKEN not in cookie
        value = cookie.partition("=")[2].partition(";")[0]
        as_browser = {"Cookie": f"{COOKIE}={value}"}
        order = {"method": "calibrate", "params": {"device": "imu0", "kind": "heading"}}
        status, answer = await site.post("/api/call", order, **as_browser)
        assert (status, answer["result"]["verified"]) == (200, True)
        assert (await site.post("/api/call", order, **as_browser, Origin="http://attacker.example"))[0] == 403
        assert (await site.post("/api/logout", {}))[1] == {"control": False}


async def test_reading_can_need_the_token_too(tmp_path: Path) -> None:
    async with running(tmp_path, reading_needs_token=True) as site:
        call = {"method": "actions", "params": {"device": "imu0"}}
        assert (await site.post("/api/call", call))[0] == 401
        with pytest.raises(WSServerHandshakeError, match="401"):
            await site.client.ws_connect("/api/stream", headers=site.origin)
        assert (await site.post("/api/call", call, **BEARER))[0] == 200
        socket = await site.client.ws_connect("/api/stream", headers=BEARER)
        await socket.send_json({"look": "overview"})
        await message(socket, "overview")
        await socket.close()


async def login(site: Site) -> tuple[int, dict[str, str]]:
    """Log in. Return the status, and the header with the cookie."""
    async with site.client.post("/api/login", json={"token": TOKEN}, headers=site.origin) as response:
        return response.status, {"Cookie": f"{COOKIE}={response.cookies[COOKIE].value}"}


async def test_replies_to_wrong_tokens_are_delayed_and_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failure_s, sleep, delays_s = web_app.FAILURE_S, asyncio.sleep, set[float]()
    monkeypatch.setattr(web_app, "FAILURE_S", 3600.0)
    async with running(tmp_path) as site:
        _, session = await login(site)
        site.client.session.cookie_jar.clear()
        wrong = {"Authorization": "Bearer wrong"}
        forged = {"Cookie": f"{COOKIE}=9999999999.0"}  # a cookie with a wrong signature
        third = FAILURES_MAX // 3
        guesses = [asyncio.create_task(site.post("/api/login", {"token": "wrong"})) for _ in range(third)]
        guesses += [asyncio.create_task(site.get("/api/session", **wrong)) for _ in range(third)]
        many = CHECKS_MAX - 2 * third - 1
        guesses += [asyncio.create_task(site.get("/api/session", **forged)) for _ in range(many)]
        right = asyncio.create_task(site.get("/api/session", **BEARER))
        await until(lambda: site.web.checks.total == CHECKS_MAX)
        assert not any(one.done() for one in (right, *guesses))
        assert (await site.get("/api/session", **forged))[0] == 429, "imud checks no further token"
        assert (await site.get("/api/session", **session))[1]["control"], "a session continues"
        for one in guesses:
            one.cancel()
        assert (await right)[1]["control"], "a right token waits and is accepted"
        async with site.client.get("/", headers=forged) as page:
            assert (page.status, page.cookies[COOKIE].value) == (200, "")
    monkeypatch.setattr(web_app, "FAILURE_S", failure_s)

    async def skip(delay_s: float) -> None:
        delays_s.add(delay_s)
        await sleep(0 if delay_s == 2.0 else delay_s)

    async with running(tmp_path) as site:
        with monkeypatch.context() as patch:
            patch.setattr(asyncio, "sleep", skip)
            assert await site.post("/api/login", {"token": "wrong"}) == (401, {"error": "wrong token"})
        assert 2.0 in delays_s
        requests: list[Any] = [SimpleNamespace(remote=f"192.0.2.{number % 3}") for number in range(64)]
        checks = [asyncio.create_task(site.web.checks.check(one, lambda: False)) for one in requests]
        await until(lambda: site.web.checks.total == len(checks))
        assert (await site.post("/api/login", {"token": TOKEN}))[0] == 429, "too many from all addresses"
        for check in checks:
            check.cancel()
    async with running(tmp_path, token="") as site:
        assert (await site.post("/api/login", {"token": ""}))[0] == 403


BAD_BODIES = (
    b"", b"{", b"[]", b'{"method": 5}', b'{"method": "actions", "params": []}', b"\xff", b'{"x": 1}',
    b'{"method":"actions","params":{"a":' + b"[" * 30_000, b'{"method":"\xff"}',
)  # fmt: skip


async def test_bad_bodies_and_errors_of_the_daemon_are_reported(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        for bad in BAD_BODIES:
            for path in ("/api/call", "/api/login"):
                status, answer = await site.post(path, bad)
                assert (status, answer["error"][:11]) == (400, "expected a "), (path, bad)
        status, answer = await site.post("/api/call", {"method": "watch"})
        assert status == 404
        assert "settings.get" in answer["error"]
        assert (await site.client.post("/api/call", data=b" " * 100_000, headers=site.origin)).status == 413
        status, answer = await site.post("/api/call", {"method": "actions", "params": {"device": "none"}})
        assert (status, answer["code"]) == (200, -32602)
        assert 'a device that imud knows, got "none"' in answer["error"]
        site.daemon.close()
        status, answer = await site.post("/api/call", {"method": "actions", "params": {"device": "imu0"}})
        assert (status, "no daemon at" in answer["error"]) == (502, True)


async def test_samples_statuses_and_events_come_only_while_a_page_is_open(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        assert not site.daemon.hub.connections
        socket = await site.stream(look="device", device="imu0", rate_hz=50)
        status = await message(socket, "status")
        assert (status["device"], status["status"]["name"], len(site.daemon.hub.connections)) == ("imu0", "imu0", 1)
        site.daemon.publish(batch("imu0", 1, 100))
        got = await message(socket, "samples")
        assert sum(one["count"] for one in got["buckets"]) >= 19
        site.daemon.event(Event(5, "imu0", EventKind.UP, "is there"))
        assert (await message(socket, "events"))["events"][0]["message"] == "is there"
        await socket.send_json({"look": "overview", "acknowledged": 3})
        assert [row["name"] for row in (await message(socket, "overview"))["devices"]] == ["imu0", "imu1"]
        others = [await site.stream(look="overview") for _ in range(5)]
        for other in others:
            await message(other, "overview")
        assert len(site.daemon.hub.connections) == 1, "one connection for all pages"
        for one in (socket, *others):
            await one.close()
        await until(lambda: not site.daemon.hub.connections)


async def test_a_page_that_does_not_read_delays_no_other_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page acknowledges although its connection is full, so that only the connection can stop the server."""
    rounds, samples, waiting_max = 50, 400, 20
    look = {"look": "device", "device": "imu0", "rate_hz": 50, "spectrum": "accel_m_s2"}

    async def watched(site: Site, stalled: StalledPage) -> None:
        await stalled.open(**look)
        quick = await site.stream(**look)
        await message(quick, "status")
        assert site.web.hub is not None
        browsers = site.web.hub.browsers
        await until(lambda: len(browsers) == 2)
        seen: list[int] = []
        most = {"mailbox": 0, "daemon": 0}
        for number in range(rounds):
            site.daemon.publish(batch("imu0", 1 + samples * number, samples))
            while not seen or seen[-1] < samples * (number + 1):
                seen += (await message(quick, "raw"))["seq"]
            await quick.send_json({**look, "acknowledged": 1000})
            await stalled.send(**look, acknowledged=1000)
            most["mailbox"] = max(most["mailbox"], *(one.mailbox.waiting for one in browsers))
            (connection,) = site.daemon.hub.connections.values()
            most["daemon"] = max(most["daemon"], connection.status("").queue_samples)
        assert seen == [*range(1, rounds * samples + 1)], "the quick one got every sample"
        full = [one for one in browsers if one.mailbox.dropped]
        assert len(full) == 1, "the stalled one, and the quick one missed nothing"
        assert full[0].mailbox.dropped > rounds // 2, "of two messages a round"
        assert most["mailbox"] <= waiting_max + 5, "state, status, dropped and such are there once each"
        assert most["daemon"] <= samples, "the daemon's queue does not grow for it"
        assert site.web.hub.dropped_samples == 0
        await quick.close()

    monkeypatch.setattr(mailbox, "FRAMES_MAX", waiting_max)
    async with running(tmp_path, small_buffers=True) as site:
        with closing(StalledPage(site)) as stalled:
            await watched(site, stalled)


async def test_an_invalid_message_of_a_page_is_reported_to_it(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        socket = await site.stream(look="everything")
        assert "reload the page" in (await message(socket, "problem"))["message"]
        for text in ("{", "[]", '{"look": "overview", "more": 1}', '{"rate_hz": 7}', '{"acknowledged": "x"}'):
            await socket.send_str(text)
            assert (await message(socket, "problem"))["message"]
        await socket.send_json({"look": "overview"})
        assert await message(socket, "overview")
        await socket.send_str("x" * 5000)
        while (last := await socket.receive()).type is WSMsgType.TEXT:
            pass
        assert last.type is WSMsgType.CLOSE
        assert last.data == 1009, "too long a message ends the connection"


async def test_pages_are_bounded(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        assert site.web.hub is not None
        for _ in range(63):
            site.web.hub.add(mailbox.Browser())
        socket = await site.stream(look="overview")
        with pytest.raises(WSServerHandshakeError, match="503"):
            await site.client.ws_connect("/api/stream", headers=site.origin)
        await socket.close()
        browsers = site.web.hub.browsers
        await until(lambda: len(browsers) == 63)
        await (await site.stream(look="overview")).close()


class FakeTransport(asyncio.Transport):
    aborted = False

    def abort(self) -> None:
        self.aborted = True


class FakeHandler:
    def __init__(self) -> None:
        self.transport = FakeTransport()


def connected(connections: WebConnections) -> tuple[FakeHandler, FakeTransport]:
    one = FakeHandler()
    connections.accept(one)  # type: ignore[arg-type]  # only its transport is used
    return one, one.transport


def test_idle_connections_are_closed_and_a_new_connection_replaces_the_oldest() -> None:
    connections = WebConnections(WebBudget(OPEN_REQUESTS, CLOCK))
    (page, page_transport), *others = [connected(connections) for _ in range(CONNECTIONS_MAX)]
    with connections.in_use(SimpleNamespace(protocol=page)):  # type: ignore[arg-type]
        _, newest = connected(connections)
        assert [transport.aborted for _, transport in others[:3]] == [True, False, False]
        for _ in range(round(IDLE_S / CHECK_S) - 1):
            connections.close_idle()
        used = others[1][0]
        connections.end_request(SimpleNamespace(protocol=used))  # type: ignore[arg-type]
        assert not newest.aborted
        connections.close_idle()
        assert newest.aborted
        assert [transport.aborted for one, transport in others if one is used] == [False]
        assert not page_transport.aborted
    connections.close_idle()
    assert page_transport.aborted


@asynccontextmanager
async def listening(tmp_path: Path) -> AsyncIterator[tuple[str, int]]:
    """Run the server as the command does. Yield its address."""
    web = WebServer(str(tmp_path / "none"), WebGuard(b"", lambda: 1e9, reading_needs_token=False), CLOCK)
    runner = AppRunner(web.make_app(), access_log=None, logger=server_log())
    await runner.setup()
    await LimitedSite(runner, "127.0.0.1", 0, web.connections).start()
    yield runner.addresses[0][:2]
    await runner.cleanup()


MALFORMED = (
    b"\x00\x01\x02\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 9000 + b"\r\n\r\n",
    b"POST /api/call HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    b"POST /api/call HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Length: 3\r\n"
    b"Content-Encoding: gzip\r\n\r\nabc",
    b"POST /api/login HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Length: -3\r\n\r\nabc",
)  # fmt: skip


@pytest.mark.parametrize("request_bytes", MALFORMED)
async def test_bad_requests_make_no_log(tmp_path: Path, caplog: pytest.LogCaptureFixture, request_bytes: bytes) -> None:
    async with listening(tmp_path) as (host, port):
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(request_bytes.replace(b"HOST", f"{host}:{port}".encode()))
        assert (await reader.readline()).split()[1] in (b"400", b"431", b"505")
        writer.close()
    assert not caplog.records


async def test_connections_without_a_complete_request_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("IDLE_S", "CHECK_S"):
        monkeypatch.setattr(web_connections, name, 0.01)
    async with listening(tmp_path) as (host, port):
        reader, writer = await asyncio.open_connection(host, port)
        assert await reader.read() == b""
        writer.close()
        for is_pipelined in (False, True):  # a client that closes its sending direction receives all replies
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode() * (1 + is_pipelined))
            if not is_pipelined:
                await reader.readuntil(b"\r\n\r\n")
            writer.write_eof()
            assert (await reader.read()).endswith(b"</html>\n")
            writer.close()
    limits = Mock(return_value=asyncio.timeout(0))
    monkeypatch.setattr(asyncio, "timeout", limits)
    with pytest.raises(HTTPRequestTimeout):
        await web_app._body(SimpleNamespace(read=asyncio.Event().wait))  # type: ignore[arg-type]
    limits.assert_called_once_with(10.0)


async def test_a_request_has_its_own_connection_and_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = Mock(wraps=asyncio.timeout)
    monkeypatch.setattr(asyncio, "timeout", limits)
    async with serving(tmp_path) as server:
        calls = Calls(server.hub.path)
        assert (await calls.call("settings.get", {"device": "imu0"}))["settings"][0]["actual"] == "6-axis"
        request = {"device": "imu0", "name": "yaw", "arguments": {"angle_deg": 5}}
        assert await calls.call("command", request) is None
        assert limits.call_args_list == [call(10.0), call(660.0)], "a calibration takes up to 600 s"
        await socket_rig.until(lambda: not server.hub.connections)
        with pytest.raises(RpcError, match='got "none"; known: imu0') as caught:
            await Calls(server.hub.path).call("actions", {"device": "none"})
        assert caught.value.code == Code.INVALID_PARAMS
    with pytest.raises(LinkMissing, match=r"no daemon at .*/none: No such file"):
        await Calls(str(tmp_path / "none")).call("schema", {})


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


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (b"", "closed the connection"), (b"GET / HTTP/1.1\n", "not JSON"), (b"x" * 5_000_000, "at most 4194304 bytes"),
        (b'{"jsonrpc":"2.0","method":"hello","params":{"protocol":9}}\n', "protocol 1"),
        (b'{"jsonrpc":"2.0","method":"hello","params":{"protocol":1}}\nhalf', "closed the connection|is lost"),
        (b'{"jsonrpc":"2.0","id":null,"error":{"code":-32002,"message":"too many clients"}}\n', "too many clients"),
    ],
)  # fmt: skip
async def test_invalid_replies_raise_errors(sent: bytes, problem: str, tmp_path: Path) -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(sent)
        writer.close()

    path = str(tmp_path / "fake")
    async with await asyncio.start_unix_server(serve, path):
        with pytest.raises(ImudError, match=problem):
            await Calls(path).call("schema", {})
