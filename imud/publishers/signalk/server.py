"""Connection to a Signal K server: access request, WebSocket, and verification that the server stores the values.

    no token ─POST─▶ request ─poll─▶ approved: token in the state file ─▶ WebSocket ─deltas─▶ server
                                └─▶ denied: stop                             └─ REST: are the values stored?

Signal K specification 1.7.0, "Access Requests" and "Streaming WebSocket API". The WebSocket needs one approval in the
server. Its TCP port 8375 ignores deltas if security is enabled, and a data connection needs settings in the server.

A server ignores deltas without the permission to write, and reports nothing. Therefore imud reads its values back.
"""

import asyncio
import logging
import re
import ssl
import uuid
from collections import deque
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from imud.contracts.publisher import PublisherClock
from imud.contracts.status import OutputStatus
from imud.host.files import StateFile
from imud.model.errors import reason_of
from imud.model.options import shown
from imud.publishers.signalk.client import HandshakeRefused, SignalKClient
from imud.publishers.signalk.settings import WHO, SignalKOptions, address_of
from imud.publishers.signalk.websocket import REPLY_S, UnusableServer, WebSocket

log = logging.getLogger(__name__)

FILE_NAME: Final = "signalk.json"
QUEUE_MAX: Final = 32  # Maximum number of deltas that wait. At 10 Hz, older values are of no use for an instrument.
# Time between two pings, and maximum time until the pong, s. imud detects a server without a reply within 10 s.
PING_S: Final = 5.0
PONG_S: Final = 5.0
POLL_S: Final = 5.0  # time between two reads of a pending access request, s
VERIFY_FIRST_S: Final = 2.0  # time between two reads of the stored values until they are verified, s
FAILURES_MAX: Final = 3  # number of successive reads without a new value after which imud reports the problem
UNSTORED_S: Final = 60.0  # time without a stored value after which imud connects again, s
VERIFY_S: Final = 10.0  # time between two reads of verified values, s
RETRY_FIRST_S: Final = 1.0  # first pause between two connections, s. The pause doubles up to RETRY_MOST_S.
RETRY_MOST_S: Final = 30.0
# Number of successive connections whose token the server rejects (2 minutes), after which imud also makes a new access
# request. It keeps the token and tries it again: a server that is starting rejects a valid token.
REJECTIONS_MAX: Final = 8
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
REJECTED_TOKEN: Final = "{} rejects the token; imud keeps the token and tries it again"
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


class TokenRejected(Exception):
    """The server rejected the token."""


class SignalKServer:
    """Client of one Signal K server. Synchronization: the event loop's thread only."""

    def __init__(self, options: SignalKOptions, state_dir: Path | None, clock: PublisherClock) -> None:
        """`state_dir` contains the token; None: imud makes an access request at each start."""
        address = address_of(options.url)
        assert address is not None  # a check of the options
        self.connections = 0  # number of opened WebSockets
        self.is_open = False  # whether a WebSocket is open
        self._url = address.url
        self._client = SignalKClient(address, options.ca_file, clock)
        self._state_dir = state_dir
        self._file: StateFile | None = None
        self._access: dict[str, str] = {}  # content of the state file: url, client_id, href, token
        self._queue: deque[str] = deque()
        self._has_more = asyncio.Event()
        self._path = self._source = ""  # path and source of the newest delta
        self._task: asyncio.Task[None] | None = None
        self._is_storing = False  # whether the server may store the values: verified, or not yet read
        self._pause_s = RETRY_FIRST_S
        self._rejections = 0
        self._sent = self._dropped = 0
        self._problem = "not connected yet"

    def start(self) -> None:
        """Read the token and start to connect."""
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
        if not self.is_open:
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
        readers = int(self.is_open and self._is_storing)
        problem = "; ".join(filter(None, (self._problem, self._client.problem)))
        return OutputStatus(self._url, self._sent, self._dropped, readers, problem, self._client.refused)

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
        while self._problem != DENIED:
            try:
                await self._load_certificates()
                await self._connect_with_token()
            except TimeoutError:
                self._report(f"{self._url}: no complete reply within {REPLY_S:.0f} s")
            except UnusableServer as error:
                self._report(str(error))
            except OSError as error:
                self._report(f"cannot connect to {self._url}: {_reason(error)}")
            if self._problem != DENIED:
                await asyncio.sleep(self._pause_s)
                self._pause_s = min(2 * self._pause_s, RETRY_MOST_S)

    async def _load_certificates(self) -> None:
        try:
            await self._client.load_certificates()
        except OSError as error:
            raise UnusableServer(
                f"signalk: {_reason(error)}; set signalk.ca_file to a file with certificates"
            ) from None

    async def _connect_with_token(self) -> None:
        """Serve one connection. If the server rejects the token, keep it, and make a new access request after some
        rejections: a person may have removed imud from the server."""
        try:
            await self._connect()
        except TokenRejected:
            self._rejections += 1
            problem = REJECTED_TOKEN.format(self._url)
            if self._rejections >= REJECTIONS_MAX:
                result = await self._poll_access()
                if self._problem == DENIED:
                    return
                if result is None:
                    problem = f"{problem}; {WAITING}"
            self._report(problem)

    async def _connect(self) -> None:
        """Get a token if the server wants one, and send deltas until the connection ends."""
        if not self._access.get("token") and not await self._get_access():
            return
        try:
            websocket = await self._client.open_websocket(STREAM, self._headers())
        except HandshakeRefused as error:
            if error.status in REJECTED:
                raise TokenRejected from None
            raise UnusableServer(
                f"{self._url}{STREAM}: expected a WebSocket, got status {error.status}; set signalk.url to a Signal K "
                f"server"
            ) from None
        log.info("signalk: connected to %s", self._url)
        self.connections += 1
        self.is_open = self._is_storing = True
        self._problem = UNVERIFIED
        try:
            await _first_of(self._send(websocket), websocket.receive(), self._ping(websocket), self._verify())
        finally:
            self.is_open = False
            self._dropped += len(self._queue)
            self._queue.clear()
            await websocket.close()

    async def _send(self, websocket: WebSocket) -> None:
        """Send the queued deltas. Wait while the server does not read."""
        while True:
            while self._queue:
                delta = self._queue.popleft()
                try:
                    await websocket.send(delta)
                except BaseException:
                    self._dropped += 1
                    raise
                self._sent += 1
            self._has_more.clear()
            await self._has_more.wait()

    async def _ping(self, websocket: WebSocket) -> None:
        """Check that the server replies."""
        while True:
            await asyncio.sleep(PING_S)
            await websocket.ping(PONG_S)

    async def _verify(self) -> None:
        """Read the stored values. They are verified if the server stored a new value between two reads.

        If not, keep the connection: the server may prefer another source until this source fails. Raise UnusableServer
        after UNSTORED_S, to connect again: a server reads the permission only at the start of a connection.
        """
        stored: str | None = None
        sent, failures = self._sent, 0
        while failures * VERIFY_FIRST_S < UNSTORED_S:
            is_verified = not self._problem and not failures
            await asyncio.sleep(VERIFY_S if is_verified else VERIFY_FIRST_S)
            if self._sent == sent:  # nothing to verify
                continue
            previous_time = stored
            stored = await self._stored_time()
            sent = self._sent
            if previous_time is None:  # the first read
                continue
            if stored and stored != previous_time:
                failures = 0
                self._confirm()
            else:
                failures += 1
            if failures >= FAILURES_MAX:
                self._is_storing = False
                self._report(NOT_STORED.format(self._source))
        self._pause_s = RETRY_FIRST_S
        raise UnusableServer(self._problem)

    def _confirm(self) -> None:
        """Note that the server stores the values: its token is valid."""
        self._is_storing = True
        self._problem = ""
        self._pause_s = RETRY_FIRST_S
        self._rejections = 0
        if self._access.get("href"):
            self._keep(href="")

    async def _stored_time(self) -> str:
        """Return the time stamp of the value of `$source` in the server; empty without a value."""
        status, body = await self._client.request("GET", VALUES + self._path.replace(".", "/"), self._headers())
        if status in REJECTED:
            raise TokenRejected
        stored = self._decoded(body, StoredValue) if status == 200 else StoredValue()
        return (stored if stored.source == self._source else stored.values.get(self._source, StoredValue())).timestamp

    # --- access ------------------------------------------------------------------------------------------------------

    async def _get_access(self) -> bool:
        """Make an access request, or continue a pending request, and wait for its result. Return whether imud may
        connect: with a token, or without a token to a server without security. Raises UnusableServer."""
        while (result := await self._poll_access()) is None:
            self._report(WAITING)
            await asyncio.sleep(POLL_S)
        return result

    async def _poll_access(self) -> bool | None:
        """Make an access request if there is none, and read its result once. Return None while it is pending, otherwise
        as `_get_access`."""
        if not self._access.get("href"):
            content = {"clientId": self._access["client_id"], "description": "imud", "permissions": "readwrite"}
            status, body = await self._client.request("POST", REQUESTS, {}, content)
            if status in WITHOUT_SECURITY:
                return True
            reply = self._decoded(body, RequestReply)
            if status != 202 or not HREF.fullmatch(reply.href):
                raise UnusableServer(
                    f"{self._url}{REQUESTS}: expected status 202 for the access request, got {status} "
                    f"{shown((reply.message or '')[:200])}; enable access requests in the server (Security, Settings)"
                )
            self._keep(href=reply.href)

        status, body = await self._client.request("GET", self._access["href"], {})
        if status != 200:  # the server restarted or removed the request after one hour
            self._keep(href="")
            raise UnusableServer(f"{WAITING}; the server lost the access request, imud makes a new request")
        reply = self._decoded(body, RequestReply)
        if reply.state == "PENDING":
            return None

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

    def _keep(self, **changes: str) -> None:
        """Change and save the access data."""
        self._access |= changes
        if self._file is not None:
            self._file.write(self._access)

    def _headers(self) -> dict[str, str]:
        token = self._access.get("token")
        return {"Authorization": f"Bearer {token}"} if token else {}

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
    """Return the reason of a connection error, with the next step for a certificate."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"{error.verify_message}; set signalk.url to a name in the certificate of the server, or signalk.ca_file "
            f"to a copy of this certificate"
        )
    return str(error) if isinstance(error, ssl.SSLError) else reason_of(error)  # the numbers of SSLError are of OpenSSL


def _raise_error(task: "asyncio.Task[None]") -> None:
    """Raise the exception of a task in a callback of the loop. The daemon then restarts the output."""
    if not task.cancelled() and (error := task.exception()) is not None:
        raise error
