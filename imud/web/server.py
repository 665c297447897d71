"""HTTP server of `imud web` (aiohttp): the page, its WebSocket, login, and requests to the daemon.

GET  /                 the page; its files are below /static/
GET  /api/session      the permissions of this browser
POST /api/login        {"token": …}: returns a cookie        POST /api/logout
GET  /api/stream       WebSocket: `messages.Look` from the page, `messages.ToPage` to it
POST /api/call         {"method": …, "params": {…}}: a method of docs/socket.md
"""

import asyncio
import gzip
import logging
import re
import zlib
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple

import msgspec
from aiohttp import WSMessage, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from imud import __version__
from imud.client.connection import params_of, rpc_error
from imud.client.feed import Feed
from imud.formats.jsonrpc import PROTOCOL, RpcError, encode_request, line_of, parse_object
from imud.model.errors import ImudError, LinkDenied, LinkMissing, ServerError, reason_of
from imud.web import messages
from imud.web.budgets import (
    OPEN_PAGES,
    OPEN_REQUESTS,
    TOKEN_PAGES,
    TOKEN_REQUESTS,
    MeasuredCall,
    PageTurns,
    RequestQueue,
    WebBudget,
    WebClock,
)
from imud.web.connections import MeteredProtocol, WebConnections
from imud.web.guard import COOKIE, SESSION_S, WebGuard, WebRights, safety_headers
from imud.web.hub import Browser, BrowserHub

READING: Final = frozenset(("settings.get", "actions", "calibrations", "events", "history", "schema"))
"""Methods that need the right to read."""
CONTROLLING: Final = frozenset(("settings.plan", "settings.apply", "command", "calibrate", "stop_calibration"))
"""Methods that need the right to control, here and at the daemon."""
REPLY_S: Final = 10.0
LONG_REPLY_S: Final = 660.0
"""Time limit of long requests, s. The daemon ends a calibration after 600 s."""
LONG: Final = frozenset(("command", "calibrate", "settings.apply"))
REPLY_BYTES_MAX: Final = 1 << 22
"""Maximum size of a reply, bytes: ten times the reply to `schema` for 256 devices."""
AT_A_TIME_MAX: Final = 16
"""Maximum number of concurrent requests. Each uses a connection to the daemon."""


class Busy(ServerError):
    """Too many concurrent requests."""


class Calls:
    """Requests to the daemon at `path`. Synchronization: one event loop."""

    # each request uses its own connection, so that a calibration of minutes delays no other request

    def __init__(self, path: str) -> None:
        self._path = path
        self._count = 0

    async def call(self, method: str, params: Mapping[str, Any]) -> Any:
        """Call a method of the daemon. Return its result as JSON values.

        Raises RpcError (the daemon refuses the request), LinkMissing, LinkDenied, ServerError, TimeoutError, Busy.
        """
        if self._count >= AT_A_TIME_MAX:
            raise Busy(f"the limit of {AT_A_TIME_MAX} concurrent requests is reached; try again later")
        self._count += 1
        try:
            async with asyncio.timeout(LONG_REPLY_S if method in LONG else REPLY_S):
                return await self._request(method, params)
        except TimeoutError:
            raise TimeoutError(f"{self._path}: no reply of the daemon to {method} within the time limit") from None
        finally:
            self._count -= 1

    async def _request(self, method: str, params: Mapping[str, Any]) -> Any:
        try:
            reader, writer = await asyncio.open_unix_connection(self._path, limit=REPLY_BYTES_MAX)
        except PermissionError as error:
            raise LinkDenied(f"no permission for {self._path}: is the user of imud web in group imud?") from error
        except OSError as error:
            raise LinkMissing(f"no daemon at {self._path}: {reason_of(error)}") from error
        try:
            hello = await self._message(reader)
            if "error" in hello:
                raise LinkDenied(f"the daemon refuses: {rpc_error(hello['error'])}")
            if params_of(hello).get("protocol") != PROTOCOL:
                raise ServerError(f"{self._path}: expected a daemon of protocol {PROTOCOL}")
            writer.write(line_of(encode_request(method, params, 1)))
            await writer.drain()
            while (reply := await self._message(reader)).get("id", 0) not in (1, None):
                pass
        except OSError as error:
            raise LinkMissing(f"{self._path}: the connection to the daemon is lost: {reason_of(error)}") from error
        finally:
            writer.close()
        if "error" in reply:
            raise rpc_error(reply["error"])
        return reply.get("result")

    async def _message(self, reader: asyncio.StreamReader) -> dict[str, Any]:
        try:
            line = await reader.readline()
        except ValueError:
            raise ServerError(f"{self._path}: expected a reply of at most {REPLY_BYTES_MAX} bytes") from None
        if not line.endswith(b"\n"):
            raise LinkMissing(f"{self._path}: the daemon closed the connection")
        return parse_object(line)


STATIC: Final = Path(__file__).parent / "static"
STATIC_TYPES: Final = {
    ".css": "text/css", ".html": "text/html", ".js": "text/javascript", ".svg": "image/svg+xml"
}  # fmt: skip
IMPORT: Final = re.compile(r'^import .* from "\./(.+)";\n', re.MULTILINE)
"""Import of a module of the page; group 1: its name."""
SPARE: Final = re.compile(
    r"""((["'])(?:(?!\2)[^\\\n]|\\.)*\2  # string
        | `(?:[^`$\\]|\\(?s:.)|\$(?!\{)|\$\{(?:[^`}]|`[^`]*`)*\})*`)  # template with templates
    | ^[ ]*(?:(?://.*|/\*\*(?s:.*?)\*/)?\n)? | [ ]+//[ ].*  # indentation, line without code, comment after code
    """, re.MULTILINE | re.VERBOSE,
)  # fmt: skip
"""Texts that JavaScript does not need; group 1: a text that JavaScript needs unchanged."""
BODY_BYTES_MAX: Final = 65536
"""Maximum body of a POST, bytes: the maximum line of the daemon's socket."""
LOOK_BYTES_MAX: Final = 4096
"""Maximum message of a page, bytes. The name of a device is its longest part."""
BROWSERS_MAX: Final = 64
"""Maximum number of open pages. It limits the memory and the time to send."""
HEARTBEAT_S: Final = 20.0
"""Time between two pings of a page, s. A page that does not reply in half of this time is closed."""
FAILURES_MAX: Final = 8
FAILURE_S: Final = 2.0
"""Delay of the reply to a wrong token, s. With at most FAILURES_MAX at a time, four guesses per second are possible."""
GUESSING: Final = "too many wrong tokens; try again in a few seconds"

CHECKS_MAX: Final = 32
"""Maximum number of tokens and cookies of one address that wait for a check. A right one then waits for at most 8 s."""
CHECKS_TOTAL_MAX: Final = 64
"""Maximum number of tokens and cookies of all addresses that wait for a check."""
BODY_S: Final = 10.0
"""Maximum time to receive the body of a POST, s."""
OPEN_BROWSERS_MAX: Final = 48
"""Maximum number of open pages without the token. The other places are for users with the token."""
OPEN_CALLS_MAX: Final = 8
"""Maximum number of concurrent requests to the daemon without the token."""
DELAYS_MAX: Final = 100
"""Delayed messages of a page minus other messages, after which imud names the page: one second of its budget."""
SEND_S: Final = 10.0
"""Maximum time to send the reply to a request to the daemon, s. The reply uses a place of AT_A_TIME_MAX."""
BAD_INPUT: Final = (HttpProcessingError, web.RequestPayloadError)
"""Errors of aiohttp about malformed requests."""


class StaticFile(NamedTuple):
    """File of the page, in memory."""

    content_type: str
    body: bytes
    compressed: bytes  # gzip
    tag: str  # header ETag

    def reply(self, request: web.Request) -> web.Response:
        """Return the file, compressed if the browser accepts gzip; status 304 if the browser has this version."""
        headers = {"ETag": self.tag, "Vary": "Accept-Encoding"}
        if self.tag in request.headers.get("If-None-Match", ""):
            return web.Response(status=304, headers=headers)
        body = self.body
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            body, headers["Content-Encoding"] = self.compressed, "gzip"
        return web.Response(body=body, content_type=self.content_type, charset="utf-8", headers=headers)


def bundle(modules: Mapping[str, str]) -> str:
    """Return JavaScript modules by their names as one module without comments, each after the modules that it imports.

    The names at the top level of all modules must differ.
    """
    imports = {name: set(IMPORT.findall(text)) for name, text in modules.items()}
    order: list[str] = []
    while len(order) < len(modules):
        order.append(next(name for name in modules if name not in order and imports[name] <= set(order)))
    text = SPARE.sub(r"\1", IMPORT.sub("", "".join(modules[name] for name in order)))
    return re.sub(r"^export ", "", text, flags=re.MULTILINE)


def static_files() -> dict[str, StaticFile]:
    """Return the files of the page by their path. The compression of all files needs 20 ms.

    main.js contains all modules: 3 requests replace 26, and one stream needs 9 kB less than 24 compressed modules.
    """
    bodies = {file.relative_to(STATIC).as_posix(): file.read_bytes() for file in STATIC.rglob("*") if file.is_file()}
    # the largest first: similar modules are then closer to each other than the 32 kB that deflate remembers
    modules = sorted(STATIC.glob("*.js"), key=lambda file: (-file.stat().st_size, file.name))
    bodies["main.js"] = bundle({file.name: file.read_text("utf-8") for file in modules}).encode()
    if "uplot/LICENSE" not in bodies:  # built without npm
        bodies["index.html"] = re.sub(rb".*/static/uplot/.*\n", b"", bodies["index.html"])
    return {
        name: StaticFile(
            STATIC_TYPES.get(PurePath(name).suffix, "text/plain"), body, gzip.compress(body),
            f'W/"{zlib.crc32(body):08x}"',
        )
        for name, body in bodies.items()
    }  # fmt: skip


class _OfPrograms(logging.Filter):
    """Filter that keeps errors of imud, and discards errors about malformed requests and disconnected clients."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not (record.exc_info and isinstance(record.exc_info[1], (*BAD_INPUT, ConnectionError)))


def server_log() -> logging.Logger:
    """Return the log of aiohttp without malformed requests: a client must not be able to fill the log."""
    log = logging.getLogger("imud.web.aiohttp")
    if not log.filters:
        log.addFilter(_OfPrograms())
    return log


class SecretChecks:
    """Checks of tokens and cookies, at most FAILURES_MAX at a time for each address. Synchronization: one event loop.

    A wrong secret occupies its place for FAILURE_S.
    """

    def __init__(self) -> None:
        self._places: dict[str, asyncio.Semaphore] = {}  # by address
        self._count: Counter[str] = Counter()  # checks that wait or last, by address

    @property
    def total(self) -> int:
        """Number of checks that wait or last."""
        return self._count.total()

    async def check(self, request: web.Request, is_right: Callable[[], bool]) -> web.Response | None:
        """Return the refusal of a wrong secret, or None for a right one."""
        address = request.remote or ""
        if self._count[address] >= CHECKS_MAX or self.total >= CHECKS_TOTAL_MAX:
            return _refusal(429, GUESSING)
        self._count[address] += 1
        try:
            async with self._places.setdefault(address, asyncio.Semaphore(FAILURES_MAX)):
                if is_right():
                    return None
                await asyncio.sleep(FAILURE_S)
        finally:
            self._count[address] -= 1
            if not self._count[address]:
                del self._count[address], self._places[address]
        return _refusal(401, "wrong token")


PAGE_MESSAGES: Final = (WSMsgType.TEXT, WSMsgType.BINARY, WSMsgType.PING, WSMsgType.PONG)
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class WebServer:
    """HTTP server for the daemon at `path`. aiohttp runs the application of `make_app`."""

    def __init__(self, path: str, guard: WebGuard, clock: WebClock) -> None:
        self._guard = guard
        self._calls = Calls(path)
        self._path = path
        self.checks = SecretChecks()
        self.requests = {False: WebBudget(OPEN_REQUESTS, clock), True: WebBudget(TOKEN_REQUESTS, clock)}  # by token
        self.pages = {False: PageTurns(WebBudget(OPEN_PAGES, clock)), True: PageTurns(WebBudget(TOKEN_PAGES, clock))}
        self._queues = {has_token: RequestQueue(budget) for has_token, budget in self.requests.items()}
        self._open_calls = 0  # number of concurrent requests to the daemon without the token
        self._open_pages = 0  # number of pages without the token
        self._page_number = 0  # number of the newest page
        self.connections = WebConnections(self.requests[False])
        self.hub: BrowserHub | None = None  # the hub; None before the application runs
        self._files = static_files()

    def make_app(self) -> web.Application:
        app = web.Application(middlewares=[self._guarded], client_max_size=BODY_BYTES_MAX)
        app.router.add_get("/", self._page)
        app.router.add_get("/api/session", self._session)
        app.router.add_post("/api/login", self._login)
        app.router.add_post("/api/logout", self._logout)
        app.router.add_get("/api/stream", self._stream)
        app.router.add_post("/api/call", self._call)
        app.router.add_get("/static/{path:.+}", self._static)
        app.on_response_prepare.append(_add_headers)
        app.cleanup_ctx.append(self._reading)
        app.cleanup_ctx.append(self.connections.run)
        return app

    async def _reading(self, _app: web.Application) -> Any:
        """Run the feeds while the application runs."""
        self.hub = hub = BrowserHub(asyncio.get_running_loop().call_soon_threadsafe)
        feed, compared = Feed(self._path, None), Feed(self._path, None)
        hub.attach(feed, compared)
        feed.start(hub.take)
        compared.start(hub.take_compared)
        yield
        for one in (feed, compared):
            await asyncio.get_running_loop().run_in_executor(None, one.close)

    # --- permissions ------------------------------------------------------------------------------------------------

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse malformed requests, and requests that another site could have sent."""
        self.connections.begin_request(request)
        try:
            return await self._measured(request, handler)
        except BAD_INPUT:
            return _refusal(400, "expected a valid HTTP request")
        finally:
            self.connections.end_request(request)

    async def _measured(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request within the budget of its address."""
        has_token = self._rights_of(request).control
        peer = request.remote or ""
        has_waited = await self._queues[has_token].wait(peer)
        if request.path == "/api/stream":  # a page has a budget of its own
            return await self._checked(request, handler)
        response = await MeasuredCall(self.requests[has_token], peer, self._checked(request, handler))
        if has_waited:
            response.force_close()  # discards the requests that the client sent without waiting for the replies
        return response

    async def _checked(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        headers = request.headers
        if problem := self._guard.host_problem(headers.get("Host")):
            return _refusal(421, problem)
        token = self._guard.bearer(headers.get("Authorization"))
        if token is not None and (refusal := await self.checks.check(request, lambda: self._guard.is_token(token))):
            return refusal
        if request.path.startswith("/api/") and self._is_forged(request):
            refusal = await self.checks.check(request, lambda: False)
            assert refusal is not None
            refusal.del_cookie(COOKIE, httponly=True, samesite="Strict")
            return refusal
        rights = self._rights_of(request)
        if request.method != "GET" or request.path == "/api/stream":
            with_token = rights.control and not rights.by_cookie
            if problem := self._guard.origin_problem(headers.get("Origin"), headers.get("Host"), with_token=with_token):
                return _refusal(403, problem)
        return await handler(request)

    def _rights_of(self, request: web.Request) -> WebRights:
        return self._guard.rights(request.headers.get("Authorization"), request.cookies.get(COOKIE))

    async def _session(self, request: web.Request) -> web.StreamResponse:
        rights = self._rights_of(request)
        return _reply(
            {"read": rights.read, "control": rights.control, "has_token": self._guard.has_token, "version": __version__}
        )

    async def _login(self, request: web.Request) -> web.StreamResponse:
        try:
            token = messages.decode_body(await _body(request), messages.LoginRequest).token
        except ValueError:
            return _refusal(400, 'expected a token, as {"token": "…"}')
        if not self._guard.has_token:
            return _refusal(403, "this server has no token, so no login is possible; start imud web with --token-file")
        if refusal := await self.checks.check(request, lambda: self._guard.is_token(token)):
            return refusal
        response = _reply({"control": True})
        response.set_cookie(COOKIE, self._guard.new_session(), max_age=SESSION_S, httponly=True, samesite="Strict")
        return response

    def _is_forged(self, request: web.Request) -> bool:
        """Return whether the cookie has a wrong signature: a guess, or a cookie for another token."""
        return self._guard.is_forged(request.cookies.get(COOKIE, ""))

    async def _logout(self, _request: web.Request) -> web.StreamResponse:
        response = _reply({"control": False})
        response.del_cookie(COOKIE, httponly=True, samesite="Strict")
        return response

    # --- the page ---------------------------------------------------------------------------------------------------

    async def _page(self, request: web.Request) -> web.StreamResponse:
        response = self._files["index.html"].reply(request)
        if self._is_forged(request):  # a browser with a cookie for a former token can log in again
            response.del_cookie(COOKIE, httponly=True, samesite="Strict")
        return response

    async def _static(self, request: web.Request) -> web.StreamResponse:
        file = self._files.get(request.match_info["path"])
        return _refusal(404, "no such file") if file is None else file.reply(request)

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        assert self.hub is not None
        if not self._rights_of(request).read:
            return _refusal(401, "no permission; log in with the token")
        has_token = self._rights_of(request).control
        if len(self.hub.browsers) >= BROWSERS_MAX:
            return _refusal(503, f"{BROWSERS_MAX} pages are open, the maximum; close one")
        if not has_token and self._open_pages >= OPEN_BROWSERS_MAX:
            return _refusal(503, f"{OPEN_BROWSERS_MAX} pages without the token are open, the maximum; close one")
        # the page replies to pings of the server; imud replies to pings of the page within its budget
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=LOOK_BYTES_MAX, compress=False, autoping=False
        )
        await socket.prepare(request)
        browser = Browser()
        self.hub.add(browser)
        self._open_pages += not has_token
        self._page_number += 1
        page = f"page {self._page_number} of {request.remote}"
        turns = self.pages[has_token]
        sending = asyncio.create_task(_send_all(browser, socket))
        try:
            with self.connections.in_use(request):
                protocol = self.connections.protocol_of(request)
                if protocol is not None:
                    protocol.follow_page(page, turns.budget)
                await MeasuredCall(turns.budget, page, self._read_page(browser, page, turns, socket, protocol))
        finally:
            self._open_pages -= not has_token
            self.hub.remove(browser)
            sending.cancel()
            with suppress(asyncio.CancelledError):
                await sending
        return socket

    async def _read_page(
        self, browser: Browser, page: str, turns: PageTurns, socket: web.WebSocketResponse,
        protocol: MeteredProtocol | None,
    ) -> None:  # fmt: skip
        """Process the messages of a page until it closes."""
        delays = 0  # number of delayed messages minus number of other messages
        while (message := await _next_message(socket, protocol)).type in PAGE_MESSAGES:
            is_delayed = await turns.process(page, partial(self._take, browser, message))
            if message.type is WSMsgType.PING:
                await socket.pong(message.data)
            delays = max(0, delays + (1 if is_delayed else -1))
            if delays == DELAYS_MAX:
                turns.budget.report(page)
                problem = messages.ProblemMessage("this page sends more than imud web processes; reload the page")
                browser.mailbox.put_newest("problem", messages.encode(problem).decode())

    def _take(self, browser: Browser, message: WSMessage) -> None:
        if message.type is WSMsgType.TEXT:
            self._look(browser, message.data)

    def _look(self, browser: Browser, text: str) -> None:
        assert self.hub is not None
        try:
            self.hub.look(browser, messages.decode_body(text, messages.Look))
        except ValueError:
            problem = messages.ProblemMessage("imud web does not know this request of the page; reload the page")
            browser.mailbox.put_newest("problem", messages.encode(problem).decode())

    async def _call(self, request: web.Request) -> web.StreamResponse:
        try:
            asked = messages.decode_body(await _body(request), messages.CallRequest)
        except ValueError:
            return _refusal(400, 'expected a method and its parameters, as {"method": "status", "params": {}}')
        rights = self._rights_of(request)
        if asked.method not in READING | CONTROLLING:
            return _refusal(404, f"no method {asked.method!r}; there are: {', '.join(sorted(READING | CONTROLLING))}")
        is_control = asked.method in CONTROLLING or asked.params.get("fresh") not in (None, False)
        if not (rights.control if is_control else rights.read):
            return _refusal(401, "no permission; log in with the token")
        with self.connections.in_use(request):
            if rights.control:
                return await self._forwarded(asked)
            return await self._forwarded_openly(request, asked)

    async def _forwarded_openly(self, request: web.Request, asked: messages.CallRequest) -> web.StreamResponse:
        """Forward a request without the token. A client that does not read its reply keeps its place for SEND_S."""
        if self._open_calls >= OPEN_CALLS_MAX:
            return _refusal(503, f"the limit of {OPEN_CALLS_MAX} concurrent requests without the token is reached; "
                                 "try again later")  # fmt: skip
        self._open_calls += 1
        try:
            response = await self._forwarded(asked)
            async with asyncio.timeout(SEND_S):
                await response.prepare(request)
                await response.write_eof()
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()
        finally:
            self._open_calls -= 1
        return response

    async def _forwarded(self, asked: messages.CallRequest) -> web.Response:
        try:
            return _reply({"result": await self._calls.call(asked.method, asked.params)})
        except RpcError as error:
            return _reply({"error": str(error), "code": error.code})
        except Busy as error:
            return _refusal(503, str(error))
        except (ImudError, TimeoutError) as error:
            return _refusal(502, str(error))


async def _body(request: web.Request) -> bytes:
    """Return the body of a POST. Raises HTTPRequestTimeout if it does not arrive in BODY_S."""
    try:
        async with asyncio.timeout(BODY_S):
            return await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout from None


async def _next_message(socket: web.WebSocketResponse, protocol: MeteredProtocol | None) -> WSMessage:
    """Return the next message of a page. Read from the connection only if no message is queued."""
    receiving = asyncio.ensure_future(socket.receive())
    try:
        await asyncio.sleep(0)
        if not receiving.done() and protocol is not None:
            protocol.read_next(lambda: not receiving.done())
        return await receiving
    finally:
        receiving.cancel()


async def _send_all(browser: Browser, socket: web.WebSocketResponse) -> None:
    with suppress(ConnectionError):
        while True:
            await socket.send_str(await browser.mailbox.take())


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(safety_headers())
    response.headers.setdefault("Cache-Control", "no-cache")
    response.headers["Server"] = "imud"


def _reply(value: object) -> web.Response:
    return web.Response(body=msgspec.json.encode(value), content_type="application/json")


def _refusal(status: int, problem: str) -> web.Response:
    return web.Response(status=status, body=msgspec.json.encode({"error": problem}), content_type="application/json")
