"""Connection: access request, token, verification and failures with a server of the test; then the real Signal K
server, whose REST API shows the values."""

import asyncio
import os
import re
import shutil
import ssl
import stat
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import msgspec
import pytest
from aiohttp import ClientSession, web

from imud.attitude.conventions import Heading
from imud.contracts.publisher import Batch
from imud.contracts.status import FrameStatus
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.signalk import server as module
from imud.publishers.signalk.publisher import SignalK, delta
from imud.publishers.signalk.server import DENIED, QUEUE_MAX, REJECTIONS_MAX, WAITING, SignalKServer
from imud.publishers.signalk.settings import SignalKOptions
from tests.fleet.authority import Authority
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import publisher_context
from tests.support.socket_rig import alone, device_status, in_context
from tests.support.surroundings import free_port

ROOT = Path(__file__).parents[3]
PATH, SOURCE = "navigation.attitude", "imud.bow"
SHORT_S = 0.01
TOKEN = "header.content.signature"
POLL = "GET /signalk/v1/requests"
REST = "/signalk/v1/api/vessels/self/navigation/attitude"


class FakeSignalK:
    """Signal K server with security. The attributes change its behavior."""

    def __init__(self) -> None:
        self.security, self.can_write, self.reads = True, True, True
        self.permission = "PENDING"
        self.tokens = {TOKEN}
        self.replies: dict[str, web.Response] = {}  # replies that replace the normal reply, by the start of "GET /path"
        self.requests: list[str] = []  # bodies of access requests
        self.href = "/signalk/v1/requests/1"
        self.deltas: list[dict[str, Any]] = []
        self.seen: list[str] = []  # Authorization of each connection
        self.stored: dict[str, Any] = {}
        self.open: set[web.WebSocketResponse] = set()
        self.port = 0

    @asynccontextmanager
    async def running(self, context: ssl.SSLContext | None = None) -> AsyncIterator[None]:
        app = web.Application(middlewares=[self._checked])
        app.router.add_post("/signalk/v1/access/requests", self._post)
        app.router.add_get("/signalk/v1/stream", self._stream)
        app.router.add_get(REST, self._rest)
        app.router.add_get("/{path:.*}", self._poll)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", self.port, ssl_context=context)
        await site.start()
        self.port = runner.addresses[0][1]
        try:
            yield
        finally:
            await self.disconnect()
            await runner.cleanup()

    async def disconnect(self) -> None:
        for one in list(self.open):
            await one.close()

    @web.middleware
    async def _checked(self, request: web.Request, handler: Any) -> web.StreamResponse:
        name = f"{request.method} {request.path}"
        for begin, reply in self.replies.items():
            if name.startswith(begin):
                return web.Response(status=reply.status, body=reply.body)
        is_public = "/access/" in name or request.path == self.href
        if self.security and not is_public:
            self.seen.append(request.headers.get("Authorization", ""))
            if self.seen[-1].removeprefix("Bearer ") not in self.tokens:
                return web.Response(status=401, text="bad auth token")
        response: web.StreamResponse = await handler(request)
        return response

    async def _post(self, request: web.Request) -> web.Response:
        if not self.security:
            return web.json_response({"message": "Server security is not enabled."}, status=404)
        self.requests.append(await request.text())
        return web.json_response({"state": "PENDING", "statusCode": 202, "href": self.href}, status=202)

    async def _poll(self, request: web.Request) -> web.Response:
        if request.path != self.href:
            return web.Response(status=500, text="Unable to check request: not found")
        if self.permission == "PENDING":
            return web.json_response({"state": "PENDING"})
        access = {"permission": self.permission, "token": TOKEN}
        return web.json_response({"state": "COMPLETED", "statusCode": 200, "accessRequest": access})

    async def _rest(self, _request: web.Request) -> web.Response:
        return web.json_response(self.stored, status=200 if self.stored else 404)

    async def _stream(self, request: web.Request) -> web.WebSocketResponse:
        stream = web.WebSocketResponse()
        await stream.prepare(request)
        self.open.add(stream)
        await stream.send_str('{"name":"fake","version":"2.32.0","self":"vessels.urn:mrn:signalk:uuid:1"}')
        while not self.reads:
            await asyncio.sleep(SHORT_S)
        async for message in stream:
            self.deltas.append(msgspec.json.decode(message.data))
            if self.can_write:
                other = {"timestamp": "2026-11-28T04:51:41.454Z"}
                own = {"timestamp": f"{len(self.deltas)}"}
                self.stored = {"value": {}, "$source": "ais", **other, "values": {"ais": other, SOURCE: own}}
        self.open.discard(stream)
        return stream


class Bench:
    """A fake server, and imud's connection with short pauses."""

    def __init__(self, folder: Path) -> None:
        self.fake, self.folder = FakeSignalK(), folder
        self.clock = publisher_context(now_ns=time.monotonic_ns).clock
        self.server: SignalKServer | None = None
        self.sent = 0

    def start(self, host: str = "127.0.0.1", ca_file: str | None = None) -> SignalKServer:
        url = f"{'http' if ca_file is None else 'https'}://{host}:{self.fake.port}"
        self.server = SignalKServer(SignalKOptions(url=url, ca_file=ca_file), self.folder, self.clock)
        self.server.start()
        return self.server

    async def stop(self) -> None:
        if self.server is not None:
            task = self.server._task
            self.server.close()
            self.server.close()
            if task is not None:
                await asyncio.gather(task, return_exceptions=True)

    @property
    def problem(self) -> str:
        assert self.server is not None
        return self.server.status().problem

    @property
    def kept(self) -> dict[str, str]:
        file = self.folder / "signalk.json"
        return msgspec.json.decode(file.read_bytes(), type=dict[str, str]) if file.exists() else {}

    async def until(self, condition: Callable[[], object], count: int = 1) -> None:
        """Send deltas until the condition is true."""
        assert self.server is not None
        while not condition():
            for _ in range(count):
                self.sent += 1
                self.server.put(PATH, SOURCE, delta(SOURCE, None, [(PATH, {"roll": self.sent})]))
            await asyncio.sleep(0.002)

    async def until_problem(self, words: str) -> None:
        await self.until(lambda: words in self.problem if words else not self.problem)


@asynccontextmanager
async def bench_in(folder: Path) -> AsyncIterator[Bench]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("POLL_S", "VERIFY_FIRST_S", "RETRY_FIRST_S"):
            patch.setattr(module, name, SHORT_S)
        patch.setattr(module, "VERIFY_S", 5 * SHORT_S)
        patch.setattr(module, "UNSTORED_S", 5 * SHORT_S)
        patch.setattr(module, "RETRY_MOST_S", 4 * SHORT_S)
        bench = Bench(folder)
        async with bench.fake.running():
            yield bench
            await bench.stop()


with_server = in_context("bench", bench_in)


@with_server
async def test_an_approved_request_gives_a_token_for_this_and_later_starts(bench: Bench, tmp_path: Path) -> None:
    server = bench.start()
    await bench.until_problem(WAITING)
    assert (server.status().readers, server.status().dropped) == (0, bench.sent)
    asked = msgspec.json.decode(bench.fake.requests[0])
    assert re.fullmatch(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}", asked.pop("clientId"))
    assert asked == {"description": "imud", "permissions": "readwrite"}
    await bench.stop()  # imud restarts before the approval
    bench.start()
    await bench.until_problem(WAITING)
    bench.fake.permission = "APPROVED"
    await bench.until_problem("")
    await bench.stop()
    assert bench.kept["token"] == TOKEN
    assert stat.S_IMODE((tmp_path / "signalk.json").stat().st_mode) == 0o600
    bench.start()
    await bench.until_problem("")
    assert (len(bench.fake.requests), set(bench.fake.seen)) == (1, {f"Bearer {TOKEN}"})
    values = [one["updates"][0]["values"] for one in bench.fake.deltas]
    assert values[-1][0]["path"] == PATH
    rolls = [one[0]["value"]["roll"] for one in values]
    assert rolls == sorted(rolls)


@with_server
async def test_a_server_without_security_needs_no_token(bench: Bench) -> None:
    bench.fake.security = False
    server = bench.start()
    await bench.until_problem("")
    assert (bench.kept.get("token"), server.status().readers, server.status().name) == (
        None, 1, f"http://127.0.0.1:{bench.fake.port}",
    )  # fmt: skip
    await bench.fake.disconnect()  # a restart of the server
    await bench.until(lambda: not server.status().readers)
    await bench.until_problem("")


@with_server
async def test_a_denied_request_is_not_repeated(bench: Bench) -> None:
    bench.fake.permission = "DENIED"
    server = bench.start()
    await bench.until_problem(DENIED)
    task = server._task
    assert task is not None
    await task
    assert len(bench.fake.requests) == 1


@with_server
async def test_a_lost_request_is_repeated_with_the_same_client(bench: Bench) -> None:
    bench.start()
    await bench.until_problem(WAITING)
    bench.fake.href = "/signalk/v1/requests/2"  # the server restarted
    await bench.until(lambda: len(bench.fake.requests) == 2)
    bench.fake.permission = "APPROVED"
    await bench.until_problem("")
    assert len(set(bench.fake.requests)) == 1


@with_server
async def test_a_rejected_token_is_kept_and_tried_again(bench: Bench) -> None:
    """A server that starts rejects valid tokens for some seconds."""
    bench.fake.permission = "APPROVED"
    bench.start()
    await bench.until_problem("")
    bench.fake.tokens, bench.fake.permission = set(), "PENDING"
    bench.fake.seen.clear()
    await bench.until_problem("rejects the token; imud keeps the token and tries it again")
    await bench.until(lambda: len(bench.fake.seen) == REJECTIONS_MAX - 1)
    assert len(bench.fake.requests) == 1
    bench.fake.tokens = {TOKEN}
    await bench.until_problem("")
    assert (len(bench.fake.requests), bench.kept["token"]) == (1, TOKEN)


@with_server
async def test_a_revoked_token_gets_a_new_access_request(bench: Bench) -> None:
    bench.fake.permission = "APPROVED"
    bench.start()
    await bench.until_problem("")
    bench.fake.tokens, bench.fake.permission = set(), "PENDING"  # an administrator revokes the token
    bench.fake.seen.clear()
    await bench.until_problem(WAITING)
    assert len(bench.fake.seen) >= REJECTIONS_MAX
    rejections = len(bench.fake.seen)
    await bench.until(lambda: len(bench.fake.seen) > rejections + 3)
    assert (len(bench.fake.requests), bench.kept["token"]) == (2, TOKEN), "imud tries the old token again"
    bench.fake.tokens = {TOKEN}
    await bench.until_problem("")
    await bench.stop()
    assert bench.kept["href"] == "", "imud forgets the request, because the old token is valid"


@with_server
async def test_a_denied_request_ends_a_rejected_token(bench: Bench) -> None:
    bench.fake.permission = "APPROVED"
    server = bench.start()
    await bench.until_problem("")
    bench.fake.tokens, bench.fake.permission = set(), "DENIED"
    await bench.until_problem(DENIED)
    assert server._task is not None
    await server._task


@with_server
async def test_the_token_of_another_server_is_not_sent(bench: Bench) -> None:
    content = {"url": "http://127.0.0.1:1", "client_id": "other", "href": "", "token": "secret"}
    (bench.folder / "signalk.json").write_bytes(msgspec.json.encode(content))
    bench.start()
    await bench.until_problem(WAITING)
    assert "other" not in bench.fake.requests[0]
    assert bench.fake.seen == []


@with_server
async def test_values_that_the_server_does_not_store_are_a_problem(bench: Bench) -> None:
    bench.fake.permission, bench.fake.can_write = "APPROVED", False  # approved with "Read Only"
    server = bench.start()
    await bench.until_problem("does not store the values of imud.bow; give imud the permission Read/Write")
    status = server.status()
    assert (status.readers, server.connections) == (0, 1), "connected, but no value is delivered"
    await bench.until(lambda: server.connections > 1)
    bench.fake.can_write = True
    await bench.until_problem("")
    assert server.status().readers == 1


@with_server
async def test_a_server_that_stops_storing_is_a_problem(bench: Bench) -> None:
    bench.fake.permission = "APPROVED"
    server = bench.start()
    await bench.until_problem("")
    bench.fake.can_write = False
    await bench.until_problem("does not store the values")
    assert server.status().readers == 0


@with_server
async def test_a_slow_server_loses_the_oldest_deltas(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("UNSTORED_S", "PING_S", "VERIFY_FIRST_S"):  # the connection remains on a slow host
        monkeypatch.setattr(module, name, 600.0)
    bench.fake.permission, bench.fake.reads = "APPROVED", False
    server = bench.start()
    await bench.until(lambda: server.is_open)
    long = delta(SOURCE, None, [(PATH, "x" * 100_000)])
    long_count = 0
    while len(server._queue) < QUEUE_MAX:
        server.put(PATH, SOURCE, long)
        long_count += 1
        await asyncio.sleep(0)
    before = server.status().dropped
    for number in range(1000):
        server.put(PATH, SOURCE, str(number))
    assert (server.status().dropped - before, list(server._queue)) == (1000, [str(n) for n in range(968, 1000)])
    await bench.stop()
    status = server.status()
    assert status.sent + status.dropped == bench.sent + long_count + 1000, "the last deltas count as dropped"


@pytest.mark.parametrize(
    ("name", "status", "body", "words"),
    [
        ("POST", 202, "<html>", "expected a reply of a Signal K server, got \"<html>\""),
        ("POST", 202, "[" * 50_000, "expected a reply of a Signal K server"),
        ("POST", 202, '{"href": "//example.org/1"}', "expected status 202 for the access request, got 202"),
        ("POST", 202, '{"href": "http://example.org/1"}', "expected status 202"),
        ("POST", 202, '{"href": 5}', "expected a reply"),
        ("POST", 403, '{"state": "COMPLETED"}', "got 403 \"\"; enable access requests in the server"),
        ("POST", 400, '{"message": "already requested"}', 'got 400 "already requested"'),
        ("POST", 302, "", "expected a reply"),
        ("POST", 202, "x" * 70_000, "expected at most 65536 bytes, got more"),
        (POLL, 200, '{"state": "COMPLETED", "statusCode": 400, "message": "no"}', 'got status 400 "no"'),
        (POLL, 200, '{"accessRequest": {"permission": "APPROVED", "token": "a\\nb"}}', "expected a token"),
        (POLL, 500, "", "imud makes a new request"),
        ("GET /signalk/v1/stream", 404, "", "expected a WebSocket, got status 404"),
        ("GET /signalk/v1/stream", 403, "", "rejects the token"),
        ("GET /signalk/v1/stream", 200, "", "expected a WebSocket"),
        (f"GET {REST}", 200, "[]", "expected a reply of a Signal K server"),
        (f"GET {REST}", 403, "", "rejects the token"),
    ],
)  # fmt: skip
@with_server
async def test_unexpected_replies_are_explained_and_tried_again(
    bench: Bench, name: str, status: int, body: str, words: str
) -> None:
    bench.fake.permission = "APPROVED"
    bench.fake.replies[name] = web.Response(status=status, text=body)
    bench.start()
    await bench.until_problem(words)
    bench.fake.replies.clear()
    await bench.until_problem("")


@with_server
async def test_an_absent_server_is_tried_with_doubling_pauses(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pauses: list[float] = []
    sleep = asyncio.sleep

    async def noted(seconds: float) -> None:
        pauses.append(seconds)
        await sleep(0)

    monkeypatch.setattr(module, "RETRY_FIRST_S", 1.0)
    monkeypatch.setattr(module, "RETRY_MOST_S", 30.0)
    bench.fake.port, port = free_port(), bench.fake.port
    server = bench.start(host="localhost")
    monkeypatch.setattr(asyncio, "sleep", noted)
    while len(pauses) < 7:
        server.put(PATH, SOURCE, "{}")
        await sleep(0.002)
    monkeypatch.undo()
    assert pauses[:7] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert server.status().problem == f"cannot connect to http://localhost:{bench.fake.port}: Connection refused"
    assert caplog.text.count("Connection refused") == 1
    assert server.status().dropped
    bench.fake.port = port


@with_server
async def test_https_needs_a_trusted_certificate(bench: Bench, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (make mqtt-deps)")
    authority = Authority(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(authority["broker.pem"], authority["broker.key"])
    bench.fake.port, bench.fake.permission = 0, "APPROVED"
    async with bench.fake.running(context):
        for ca_file, words in (
            (authority["gateway.pem"], "set signalk.url to a name in the certificate"),
            (str(tmp_path / "no"), "No such file"),
        ):
            bench.start(ca_file=ca_file)
            await bench.until_problem(words)
            await bench.stop()
        bench.start(ca_file=authority["ca.pem"])
        await bench.until_problem("")
        await bench.stop()


# --- the real server ----------------------------------------------------------------------------------------------

NODE = shutil.which("node")
PROGRAM = ROOT / "build/signalk/node_modules/signalk-server/bin/signalk-server"
NO_SERVER = "" if NODE and PROGRAM.exists() else "signalk-server is not installed (make signalk-deps)"
# the bcrypt hash of "pw", with four rounds
PASSWORD = "$2a$04$1Ji3pXfs88ByMRutc0GguOdFtz4CTWkm5ikKLYpg/DyJtLUYwkiwO"


@contextmanager
def real_server(folder: Path, port: int) -> Iterator[None]:
    """Run a Signal K server with security. Its administrator is `admin` with the password `pw`."""
    folder.mkdir()
    unused = dict.fromkeys(("appstore", "webapps", "plugins", "tcp", "nmea-tcp", "mfd_webapp"), False)
    settings = {
        "interfaces": unused, "mdns": False, "pipedProviders": [], "security": {"strategy": "./tokensecurity"},
    }  # fmt: skip
    users = [{"username": "admin", "type": "admin", "password": PASSWORD}]
    security = {
        "allow_readonly": False, "expiration": "NEVER", "secretKey": "0" * 64, "users": users, "devices": [],
        "immutableConfig": False, "acls": [], "allowDeviceAccessRequests": True, "allowNewUserRegistration": False,
    }  # fmt: skip
    (folder / "settings.json").write_bytes(msgspec.json.encode(settings))
    (folder / "security.json").write_bytes(msgspec.json.encode(security))
    (folder / "security.json").chmod(0o600)
    environment = {**os.environ, "SIGNALK_NODE_CONFIG_DIR": str(folder), "PORT": str(port), "HOME": str(folder)}
    with (folder / "log").open("w") as log:
        process = subprocess.Popen([str(NODE), str(PROGRAM)], env=environment, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait(60)


class Admin:
    """The administrator of a real server."""

    def __init__(self, session: ClientSession) -> None:
        self._session = session
        self._headers: dict[str, str] = {}

    async def log_in(self) -> None:
        """Wait for the server and log in."""
        body = {"username": "admin", "password": "pw"}
        while not self._headers:
            try:
                async with self._session.post("/signalk/v1/auth/login", json=body) as reply:
                    self._headers = {"Authorization": f"Bearer {(await reply.json())['token']}"}
            except OSError:
                await asyncio.sleep(0.1)

    async def do(self, method: str, path: str, body: object = None) -> Any:
        async with self._session.request(method, path, json=body, headers=self._headers) as reply:
            assert reply.status == 200, await reply.text()
            text = await reply.text()
        return msgspec.json.decode(text) if text[:1] in "[{" else text


def motion(seq: int) -> Batch:
    """Return a sample: right side down by 10°, bow up by 5°, heading 45°, turning to starboard at 2° per second."""
    t_ns = seq * 20 * NS_PER_MS
    sample = Sample(
        "bow", seq, t_ns, 0, Sync.ARRIVAL, t_ns, NS_PER_S + t_ns, euler_rad=(radians(10), radians(5), radians(-45)),
        gyro_rad_s=(0.0, 0.0, radians(-2)), temperature_c=25.0, pressure_pa=101325.0,
    )  # fmt: skip
    return Batch("bow", 0, [sample])


async def attitude_is_null(output: SignalK, admin: Admin) -> None:
    """Let the device be silent for 2 s, and wait until the server has `null`."""
    output.tick(VirtualClock().now_ns() + 2 * NS_PER_S)
    while (await admin.do("GET", "/signalk/v1/api/vessels/self/navigation/attitude"))["value"] is not None:
        await asyncio.sleep(0.02)


@pytest.mark.live
@pytest.mark.timeout(180)
@pytest.mark.skipif(bool(NO_SERVER), reason=NO_SERVER)
@alone()
async def test_the_rest_api_of_a_real_server_shows_the_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("POLL_S", "VERIFY_FIRST_S", "RETRY_FIRST_S", "RETRY_MOST_S"):
        monkeypatch.setattr(module, name, 0.2)
    monkeypatch.setattr(module, "VERIFY_S", 1.0)
    port = free_port()
    frame = FrameStatus("", "device", "", "", Heading.TRUE, 3.0, {})
    status = msgspec.structs.replace(device_status("bow", 0), frame=frame)
    context = replace(publisher_context(lambda: [status], 1, VirtualClock().now_ns), state_dir=tmp_path)
    output = SignalK(SignalKOptions(url=f"http://127.0.0.1:{port}"), context)
    seq = 0

    async def publish() -> None:
        nonlocal seq
        seq += 1
        output.publish(motion(seq))
        await asyncio.sleep(0.02)

    async def publish_until(words: str) -> None:
        while (words not in output.status()[0].problem) if words else output.status()[0].problem:
            await publish()

    with real_server(tmp_path / "server", port):
        output.start()
        output.add_device("bow", 0)
        output.tick(NS_PER_S)
        async with ClientSession(f"http://127.0.0.1:{port}") as session:
            admin = Admin(session)
            await publish_until(WAITING)
            await admin.log_in()
            (asked,) = await admin.do("GET", "/skServer/security/access/requests")
            assert (asked["accessDescription"], asked["permissions"]) == ("imud", "readwrite")
            grant = {"expiration": "NEVER", "permissions": "readwrite", "config": {}}
            name = asked["accessIdentifier"]
            await admin.do("PUT", f"/skServer/security/access/requests/{name}/approved", grant)
            await publish_until("")
            found: Any = {}
            while not {"inside", "outside"} <= found.get("environment", {}).keys():  # sent once per second
                await publish()
                found = await admin.do("GET", "/signalk/v1/api/vessels/self")
            meta = await admin.do("GET", "/signalk/v1/api/vessels/self/navigation/headingTrue/meta")
            await attitude_is_null(output, admin)
            await admin.do("DELETE", f"/skServer/security/devices/{name}")  # revoke the token
            await publish_until(WAITING)
        task = output._server._task
        output.close()
        assert task is not None
        await asyncio.gather(task, return_exceptions=True)
    assert meta["timeout"] == 1
    navigation, inside = found["navigation"], found["environment"]["inside"]["imu"]
    assert navigation["attitude"]["$source"] == SOURCE
    assert {name: round(value, 6) for name, value in navigation["attitude"]["value"].items()} == {
        "roll": 0.174533, "pitch": 0.087266, "yaw": 0.785398,
    }  # fmt: skip
    values = {name: (one["value"], one["meta"]["units"]) for name, one in navigation.items() if name != "attitude"}
    assert values == {
        "headingTrue": (pytest.approx(0.785398, abs=1e-6), "rad"),
        "headingMagnetic": (pytest.approx(0.733038, abs=1e-6), "rad"),
        "magneticVariation": (pytest.approx(0.052360, abs=1e-6), "rad"),
        "rateOfTurn": (pytest.approx(0.034507, abs=1e-6), "rad/s"),
    }
    assert (inside["temperature"]["value"], inside["temperature"]["meta"]["units"]) == (pytest.approx(298.15), "K")
    assert found["environment"]["outside"]["pressure"]["value"] == 101325.0
