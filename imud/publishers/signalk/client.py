"""HTTP and WebSocket client of one Signal K server, within a work budget.

Each request has a connection of its own, and one deadline from the connection to the complete reply. The bytes of the
server are limited in number and in CPU time (`PeerStream`): a server that floods waits, and delays no sample.
"""

import asyncio
import ssl
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Final, NamedTuple

import msgspec

from imud.contracts.publisher import PublisherClock
from imud.host.http_reply import SWITCHING_PROTOCOLS, HttpReply, InvalidReply
from imud.host.network import certificates_of, tls_context
from imud.host.peer_stream import PeerStream, open_peer_stream
from imud.host.threads import call_in_thread
from imud.model.work_budget import WorkBudget, WorkLimits
from imud.publishers.signalk.settings import ServerAddress
from imud.publishers.signalk.websocket import REPLY_S, UnusableServer, WebSocket, accept_of, new_key

# Maximum size of the content of a reply, bytes. Values of one path with 100 sources need 20 kB.
CONTENT_BYTES_MAX: Final = 65_536
# OpenSSL rejects certificates with these codes because of the date: not yet valid, expired.
DATE_CODES: Final = (9, 10)
# Key of 1024 bits, as in certificates of older Signal K servers. imud accepts such a key only if `ca_file` contains
# exactly this certificate.
SHORT_KEYS: Final = "DEFAULT:@SECLEVEL=1"


class HandshakeRefused(Exception):
    """The server replied to the request for a WebSocket with another status."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class ServerTls(NamedTuple):
    """TLS of the connections to a server."""

    context: ssl.SSLContext  # requires a valid certificate for the host
    pinning: ssl.SSLContext  # accepts each certificate; the client compares it with `certificates`
    certificates: frozenset[bytes]  # certificates of `ca_file` (DER)


class SignalKClient:
    """Client of one server. Synchronization: the event loop's thread only."""

    def __init__(self, address: ServerAddress, ca_file: str | None, clock: PublisherClock) -> None:
        self._address = address
        self._ca_file = ca_file
        self._clock = clock
        self._tls: ServerTls | None = None
        self._budget = WorkBudget(WorkLimits(), clock.cpu_ns)

    @property
    def problem(self) -> str:
        """Present problem with the amount of the server's data; empty if there is no problem."""
        return self._budget.problem(self._clock.now_ns())

    @property
    def refused(self) -> int:
        """Number of inputs above the budget."""
        return self._budget.refused

    async def load_certificates(self) -> None:
        """Read `ca_file`, again for each connection. Raises OSError."""
        if self._address.scheme == "https":
            self._tls = await call_in_thread("signalk", partial(_load_tls, self._ca_file))

    async def request(
        self, method: str, path: str, headers: Mapping[str, str], content: object = None
    ) -> tuple[int, bytes]:
        """Return status and body of a reply. Raises UnusableServer for invalid replies, TimeoutError after REPLY_S, and
        OSError."""
        body = b""
        if content is not None:
            body = msgspec.json.encode(content)
            headers = {**headers, "Content-Type": "application/json"}
        async with asyncio.timeout(REPLY_S):
            stream = await self._connect()
            try:
                reply = await self._exchange(stream, method, path, {**headers, "Connection": "close"}, body)
            finally:
                stream.end_turn()
                stream.abort()
        return reply.status, bytes(reply.content)

    async def open_websocket(self, path: str, headers: Mapping[str, str]) -> WebSocket:
        """Open a WebSocket. Raises HandshakeRefused, and the errors of `request`."""
        key = new_key()
        upgrade = {
            **headers,
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": key,
        }
        stream = None
        try:
            async with asyncio.timeout(REPLY_S):
                stream = await self._connect()
                reply = await self._exchange(stream, "GET", path, upgrade, b"")
            if reply.status != SWITCHING_PROTOCOLS:
                raise HandshakeRefused(reply.status)
            if reply.headers.get("sec-websocket-accept") != accept_of(key):
                raise UnusableServer(f"{self._address.url}{path}: expected the key of the WebSocket, got another key")
        except BaseException:
            if stream is not None:
                stream.end_turn()
                stream.abort()
            raise
        return WebSocket(stream, reply.rest, self._address.url, self._budget)

    async def _connect(self) -> PeerStream:
        """Connect. Raises OSError. The certificate must be valid for the host, or be in `ca_file` itself."""
        address, tls = self._address, self._tls
        connect = partial(open_peer_stream, address.host, address.port, address.url, self._budget, self._clock.now_ns)
        if tls is None:
            return await connect(None)
        try:
            return await connect(tls.context)
        except ssl.SSLCertVerificationError as error:
            if not tls.certificates or error.verify_code in DATE_CODES:
                raise
            with suppress(OSError):
                stream = await connect(tls.pinning)
                if stream.get_extra_info("ssl_object").getpeercert(binary_form=True) in tls.certificates:
                    return stream
                stream.abort()
            raise

    async def _exchange(
        self, stream: PeerStream, method: str, path: str, headers: Mapping[str, str], body: bytes
    ) -> HttpReply:
        """Send a request and return the complete reply."""
        host = self._address.url.partition("://")[2]
        lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", "User-Agent: imud", "Accept: application/json"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        stream.write("\r\n".join((*lines, "", "")).encode("ascii") + body)
        reply = HttpReply(CONTENT_BYTES_MAX)
        try:
            while not reply.is_complete:
                data = await stream.read()
                if data:
                    reply.feed(data)
                else:
                    reply.end()
        except InvalidReply as error:
            raise UnusableServer(f"{self._address.url}{path}: {error}; set signalk.url to a Signal K server") from None
        return reply


def _load_tls(ca_file: str | None) -> ServerTls:
    """Read the certificates. Raises OSError. Runs in a thread: a bundle of CAs takes 20 ms."""
    pinning = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    pinning.check_hostname = False
    pinning.verify_mode = ssl.CERT_NONE
    pinning.set_ciphers(SHORT_KEYS)
    return ServerTls(tls_context(ca_file), pinning, certificates_of(ca_file))
