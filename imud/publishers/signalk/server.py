"""Connection to a Signal K server: access request, WebSocket, and verification that the server stores the values.

    no token ─POST─▶ request ─poll─▶ approved: token in the state file ─▶ WebSocket ─deltas─▶ server
                                └─▶ denied: stop                             └─ REST: are the values stored?

Signal K specification 1.7.0, "Access Requests" and "Streaming WebSocket API". The WebSocket needs one approval in the
server. Its TCP port 8375 ignores deltas if security is enabled, and a data connection needs settings in the server.

A server ignores deltas without the permission to write, and reports nothing. Therefore imud reads its values back.
"""

import asyncio
import importlib
import importlib.util
import logging
import re
import socket
import ssl
import uuid
from collections import deque
from collections.abc import Coroutine
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from imud.contracts.status import OutputStatus
from imud.host.files import StateFile
from imud.host.installation import needs_extra
from imud.host.network import resolve, tls_context
from imud.host.threads import call_in_thread
from imud.model.errors import ServerError, reason_of
from imud.model.options import shown
from imud.publishers.signalk.settings import WHO, SignalKOptions, address_of

if TYPE_CHECKING:
    from aiohttp import ClientSession, ClientWebSocketResponse
    from aiohttp.abc import AbstractResolver

log = logging.getLogger(__name__)

FILE_NAME: Final = "signalk.json"
QUEUE_MAX: Final = 32  # Maximum number of deltas that wait. At 10 Hz, older values are of no use for an instrument.
REPLY_S: Final = 10.0  # maximum time for one reply of the server, s
REPLY_BYTES_MAX: Final = 65_536  # maximum size of a reply, bytes. Values of one path with 100 sources need 20 kB.
HEARTBEAT_S: Final = 20.0  # time between two pings, s. A connection without a pong ends after half of this time.
CLOSE_S: Final = 1.0  # maximum time for the end of a WebSocket, s. The end of the daemon waits for it.
POLL_S: Final = 5.0  # time between two reads of a pending access request, s
VERIFY_FIRST_S: Final = 2.0  # time between two reads of the stored values until they are verified, s
FAILURES_MAX: Final = 3  # number of successive reads without a new value after which imud reports the problem
VERIFY_S: Final = 60.0  # time between two reads of verified values, s
RETRY_FIRST_S: Final = 1.0  # first pause between two connections, s. The pause doubles up to RETRY_MOST_S.
RETRY_MOST_S: Final = 30.0
# Number of successive connections whose token the server rejects, after which imud makes a new access request. A
# server that is starting may reject a valid token.
REJECTIONS_MAX: Final = 3
REQUESTS: Final = "/signalk/v1/access/requests"
STREAM: Final = "/signalk/v1/stream?subscribe=none"
VALUES: Final = "/signalk/v1/api/vessels/self/"
HREF: Final = re.compile(r"/(?!/)[!-~]{1,512}")  # path on the same server
TOKEN: Final = re.compile(r"[!-~]{1,8192}")  # visible characters, as in an HTTP header
REJECTED: Final = (401, 403)
WITHOUT_SECURITY: Final = (404, 501)  # status of an access request if the server does not use security

WAITING: Final = "waits for approval in the Signal K server (Security, Access Requests)"
DENIED: Final = "the Signal K server denied the access request; restart imud for a new request"
UNVERIFIED: Final = "not verified yet: imud has not read its values from the Signal K server"
NOT_STORED: Final = (
    "not verified: the Signal K server does not store the values of {}; give imud the permission Read/Write (Security, "
    "Devices), and check the source priorities"
)


T = TypeVar("T")


class AccessReply(msgspec.Struct):
    """Permission that the server granted."""

    permission: str = ""
    token: str = ""


class RequestReply(msgspec.Struct, rename={"status_code": "statusCode", "access": "accessRequest"}):
    """Reply to an access request."""

    state: str = ""
    status_code: int = 0
    href: str = ""
    message: str | None = None
    access: AccessReply | None = None


class StoredValue(msgspec.Struct, rename={"source": "$source"}):
    """Value of a path in the server. `values` has all sources if there are several."""

    source: str = ""
    timestamp: str = ""
    values: dict[str, "StoredValue"] = {}


class UnusableServer(Exception):
    """The server does not reply as specified."""


class TokenRejected(Exception):
    """The server rejected the token."""


class SignalKServer:
    """Client of one Signal K server. Synchronization: the event loop's thread only."""

    def __init__(self, settings: SignalKOptions, state_dir: Path | None) -> None:
        """`state_dir` contains the token; None: imud makes an access request at each start."""
        address = address_of(settings.url)
        assert address is not None  # a check of the options
        self._url = address.url
        self._ca_file = settings.ca_file
        self._state_dir = state_dir
        self._file: StateFile | None = None
        self._access: dict[str, str] = {}  # content of the state file: url, client_id, href, token
        self._queue: deque[str] = deque()
        self._has_more = asyncio.Event()
        self._path = self._source = ""  # path and source of the newest delta
        self._task: asyncio.Task[None] | None = None
        self._is_open = False
        self._pause_s = RETRY_FIRST_S
        self._rejections = 0
        self._sent = self._dropped = 0
        self._problem = "not connected yet"

    def start(self) -> None:
        """Read the token and start to connect. Raises ServerError if aiohttp is not installed."""
        with needs_extra("signalk", ServerError):
            if importlib.util.find_spec("aiohttp") is None:
                raise ModuleNotFoundError(name="aiohttp")
        file = None if self._state_dir is None else self._state_dir / FILE_NAME
        self._file = StateFile(file, WHO, "imud makes a new access request", mode=0o600)
        self._access = self._file.read(dict[str, str])
        if self._access.get("url") != self._url:  # a token is for one server only
            self._access = {"url": self._url, "client_id": str(uuid.uuid4())}
        self._task = asyncio.get_running_loop().create_task(self._run())
        self._task.add_done_callback(_raise_error)

    def put(self, path: str, source: str, delta: str) -> None:
        """Queue a delta, or drop it if there is no connection. If the queue is full, drop its oldest delta. `path` is
        a path in the delta."""
        if not self._is_open:
            self._dropped += 1
            return
        if len(self._queue) == QUEUE_MAX:
            self._queue.popleft()
            self._dropped += 1
        self._path, self._source = path, source
        self._queue.append(delta)
        self._has_more.set()

    def status(self) -> OutputStatus:
        """Return the counters and the problem of the connection."""
        return OutputStatus(self._url, self._sent, self._dropped, int(self._is_open), self._problem)

    def close(self) -> None:
        """Disconnect. A second call does nothing."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        if self._file is not None:
            self._file.close()
            self._file = None

    # --- connections -------------------------------------------------------------------------------------------------

    async def _run(self) -> None:
        """Connect again and again, until the server denies the access."""
        await call_in_thread("signalk", partial(importlib.import_module, "aiohttp"))  # an import of 0.3 s
        from aiohttp import ClientError  # not at the top of the module: see above

        while self._problem != DENIED:
            try:
                async with await self._session() as session:
                    await self._connect(session)
            except TokenRejected:
                self._reject()
            except TimeoutError:
                self._report(f"{self._url}: no reply within {REPLY_S:.0f} s")
            except UnusableServer as error:
                self._report(str(error))
            except (ClientError, OSError) as error:
                self._report(f"cannot connect to {self._url}: {_reason(error)}")
            if self._problem != DENIED:
                await asyncio.sleep(self._pause_s)
                self._pause_s = min(2 * self._pause_s, RETRY_MOST_S)

    async def _session(self) -> "ClientSession":
        """Return an HTTP session. Raises OSError if the CA certificates cannot be read."""
        from aiohttp import ClientSession, ClientTimeout, DummyCookieJar, TCPConnector  # see `_run`

        context: ssl.SSLContext | bool = True
        if self._url.startswith("https:"):
            context = await call_in_thread("signalk", partial(tls_context, self._ca_file))
        connector = TCPConnector(ssl=context, resolver=_resolver(), limit=2)
        timeout = ClientTimeout(total=None)  # every request has the timeout REPLY_S
        return ClientSession(self._url, connector=connector, timeout=timeout, cookie_jar=DummyCookieJar())

    async def _connect(self, session: "ClientSession") -> None:
        """Get a token if the server wants one, and send deltas until the connection ends."""
        from aiohttp import ClientWSTimeout, WSServerHandshakeError  # see `_run`

        if not self._access.get("token") and not await self._get_access(session):
            return
        try:
            async with asyncio.timeout(REPLY_S):
                stream = await session.ws_connect(
                    STREAM, headers=self._headers(), heartbeat=HEARTBEAT_S, max_msg_size=REPLY_BYTES_MAX,
                    timeout=ClientWSTimeout(ws_close=CLOSE_S),
                )  # fmt: skip
        except WSServerHandshakeError as error:
            if error.status in REJECTED:
                raise TokenRejected from None
            raise UnusableServer(
                f"{self._url}{STREAM}: expected a WebSocket, got status {error.status}; set signalk.url to a Signal K "
                f"server"
            ) from None
        log.info("signalk: connected to %s", self._url)
        self._is_open, self._problem = True, UNVERIFIED
        try:
            await _first_of(self._send(stream), self._receive(stream), self._verify(session))
        finally:
            self._is_open = False
            self._dropped += len(self._queue)
            self._queue.clear()
            await stream.close()

    async def _send(self, stream: "ClientWebSocketResponse") -> None:
        """Send the queued deltas. Wait while the server does not read."""
        while True:
            while self._queue:
                await stream.send_str(self._queue.popleft())
                self._sent += 1
            self._has_more.clear()
            await self._has_more.wait()

    async def _receive(self, stream: "ClientWebSocketResponse") -> None:
        """Ignore the messages of the server. Raise UnusableServer at the end of the connection."""
        async for _message in stream:
            pass
        raise UnusableServer(f"{self._url} closed the connection")

    async def _verify(self, session: "ClientSession") -> None:
        """Read the stored values. They are verified if the server stored a new value between two reads.

        If not, keep the connection: the server may prefer another source until this source fails. Raise UnusableServer
        after VERIFY_S, to connect again: a server reads the permission only at the start of a connection.
        """
        stored: str | None = None
        sent, failures = self._sent, 0
        while failures * VERIFY_FIRST_S < VERIFY_S:
            await asyncio.sleep(VERIFY_FIRST_S if self._problem else VERIFY_S)
            if self._sent == sent:  # nothing to verify
                continue
            before, stored, sent = stored, await self._stored_time(session), self._sent
            if before is None:  # the first read
                continue
            if stored and stored != before:
                self._problem, self._pause_s, self._rejections, failures = "", RETRY_FIRST_S, 0, 0
            else:
                failures += 1
            if failures >= FAILURES_MAX:
                self._report(NOT_STORED.format(self._source))
        self._pause_s = RETRY_FIRST_S
        raise UnusableServer(self._problem)

    async def _stored_time(self, session: "ClientSession") -> str:
        """Return the time stamp of the value of `$source` in the server; empty without a value."""
        status, body = await self._request(session, "GET", VALUES + self._path.replace(".", "/"))
        if status in REJECTED:
            raise TokenRejected
        stored = self._decoded(body, StoredValue) if status == 200 else StoredValue()
        return (stored if stored.source == self._source else stored.values.get(self._source, StoredValue())).timestamp

    # --- access ------------------------------------------------------------------------------------------------------

    async def _get_access(self, session: "ClientSession") -> bool:
        """Make an access request, or continue a pending request, and wait for its result. Return whether imud may
        connect: with a token, or without a token to a server without security. Raises UnusableServer."""
        if not self._access.get("href"):
            content = {"clientId": self._access["client_id"], "description": "imud", "permissions": "readwrite"}
            status, body = await self._request(session, "POST", REQUESTS, content)
            if status in WITHOUT_SECURITY:
                return True
            reply = self._decoded(body, RequestReply)
            if status != 202 or not HREF.fullmatch(reply.href):
                raise UnusableServer(
                    f"{self._url}{REQUESTS}: expected status 202 for the access request, got {status} "
                    f"{shown((reply.message or '')[:200])}; enable access requests in the server (Security, Settings)"
                )
            self._keep(href=reply.href)
        self._report(WAITING)
        while True:
            status, body = await self._request(session, "GET", self._access["href"])
            if status != 200:  # the server restarted or removed the request after one hour
                self._keep(href="")
                raise UnusableServer(f"{WAITING}; the server lost the access request, imud makes a new request")
            reply = self._decoded(body, RequestReply)
            if reply.state != "PENDING":
                break
            await asyncio.sleep(POLL_S)
        self._keep(href="")
        access = reply.access or AccessReply()
        if access.permission == "DENIED":
            self._report(DENIED)
            return False
        if access.permission != "APPROVED" or not TOKEN.fullmatch(access.token):
            raise UnusableServer(
                f"{self._url}: expected a token for the access request, got status {reply.status_code} "
                f"{shown((reply.message or access.permission)[:200])}"
            )
        self._keep(token=access.token)
        self._rejections, self._pause_s = 0, RETRY_FIRST_S
        return True

    def _reject(self) -> None:
        """Count a rejected token. Discard the token after REJECTIONS_MAX connections."""
        self._rejections += 1
        if self._rejections >= REJECTIONS_MAX:
            self._rejections = 0
            self._keep(token="")
        self._report(
            f"{self._url} rejects the token; imud makes a new access request after {REJECTIONS_MAX} rejections"
        )

    def _keep(self, **changes: str) -> None:
        """Change and save the access data."""
        self._access |= changes
        if self._file is not None:
            self._file.write(self._access)

    def _headers(self) -> dict[str, str]:
        token = self._access.get("token")
        return {"Authorization": f"Bearer {token}"} if token else {}

    # --- requests ----------------------------------------------------------------------------------------------------

    async def _request(
        self, session: "ClientSession", method: str, path: str, content: object = None
    ) -> tuple[int, bytes]:
        """Return status and body of a reply. Raises UnusableServer if the body is too long, and errors of aiohttp."""
        async with (
            asyncio.timeout(REPLY_S),
            session.request(method, path, json=content, headers=self._headers(), allow_redirects=False) as response,
        ):
            body = b""
            async for piece in response.content.iter_any():
                body += piece
                if len(body) > REPLY_BYTES_MAX:
                    raise UnusableServer(f"{self._url}{path}: expected at most {REPLY_BYTES_MAX} bytes, got more")
            return response.status, body

    def _decoded(self, body: bytes, content_type: type[T]) -> T:
        try:
            return msgspec.json.decode(body, type=content_type)
        except (msgspec.DecodeError, UnicodeError, RecursionError):
            raise UnusableServer(
                f"{self._url}: expected a reply of a Signal K server, got {shown(body[:80].decode(errors='replace'))}; "
                "set signalk.url to a Signal K server"
            ) from None

    def _report(self, problem: str) -> None:
        """Set the problem, and log a new problem once."""
        if problem != self._problem:
            log.warning("signalk: %s", problem)
        self._problem = problem


async def _first_of(*bodies: Coroutine[Any, Any, None]) -> None:
    """Run coroutines until one of them ends, and raise its exception."""
    tasks = [asyncio.ensure_future(body) for body in bodies]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _reason(error: Exception) -> str:
    """Return the reason of a connection error. The text of aiohttp itself has no reason."""
    cause: Exception = getattr(error, "certificate_error", getattr(error, "os_error", error))
    return str(cause) if isinstance(cause, ssl.SSLError) else reason_of(cause)  # the numbers of SSLError are of OpenSSL


def _raise_error(task: "asyncio.Task[None]") -> None:
    """Raise the exception of a task in a callback of the loop. The daemon then restarts the output."""
    if not task.cancelled() and (error := task.exception()) is not None:
        raise error


def _resolver() -> "AbstractResolver":
    """Return a resolver with a thread of its own per request (`imud.host.network.resolve`)."""
    from aiohttp.abc import AbstractResolver, ResolveResult  # see `SignalKServer._run`

    class ThreadResolver(AbstractResolver):
        async def resolve(self, host: str, port: int = 0, family: int = 0) -> list[ResolveResult]:
            found = await resolve(host, port)
            return [
                ResolveResult(
                    hostname=host, host=one, port=port, proto=0, flags=socket.AI_NUMERICHOST,
                    family=socket.AF_INET6 if ":" in one else socket.AF_INET,
                )
                for one in found
            ]  # fmt: skip

        async def close(self) -> None: ...

    return ThreadResolver()
