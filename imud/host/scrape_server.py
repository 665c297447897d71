"""Small HTTP/1.1 server for scrapes, in a thread with its own event loop.

A connection has one request and one reply. A silent or slow client occupies one of CONNECTIONS_MAX places for at most
CONNECTION_S. If all places are taken, the server closes the oldest connection, so that silent clients cannot block
other clients. Synchronization: one thread calls `start` and `close`; the thread of the server calls `answer`.

Libraries need more resources. With 300 silent clients, `start_http_server` of prometheus_client keeps 300 threads and
300 descriptors, aiohttp 300 descriptors (and 180 ms of imports and 11 MB). This server needs 31 descriptors, and 0
after 5 s.
"""

import asyncio
import errno
import socket
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from imud.host.network import listen
from imud.host.threads import share_interpreter
from imud.model.errors import ServerError

CONNECTION_S: Final = 5.0  # Maximum time from the connection to the end of the reply, s. Prometheus waits 10 s.
CONNECTIONS_MAX: Final = 32  # Maximum number of connections. The server is for a few scrapers.
REQUEST_BYTES_MAX: Final = 8192  # Maximum length of a request, bytes. Prometheus sends about 400 bytes.

ACCEPT_PAUSE_S: Final = 1.0  # pause of accept after the process ran out of descriptors, s

TEXT: Final = "text/plain; charset=utf-8"


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """Used parts of an HTTP request."""

    method: str
    path: str  # path without the query
    accept: str  # accept header; empty if there is none


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """Reply to an HTTP request."""

    status: str  # code and reason, for example `200 OK`
    body: bytes
    content_type: str = TEXT


Answer = Callable[[HttpRequest], Awaitable[HttpResponse]]  # returns the reply to a request, in the thread of the server


async def _no_answer(_request: HttpRequest) -> HttpResponse:
    raise AssertionError("the server has not started")


class ScrapeServer:
    """HTTP server with its own thread."""

    def __init__(
        self,
        address: str,
        port: int,
        *,
        connection_s: float = CONNECTION_S,
        connections_max: int = CONNECTIONS_MAX,
        keys: tuple[str, str] = ("metrics.address", "metrics.port"),
    ) -> None:
        """`keys`: configuration keys or options of address and port, for error messages."""
        self.address = address
        self.port = port  # bound port after the start, also if the configured port is 0
        self._answer: Answer = _no_answer
        self._connection_s = connection_s
        self._connections_max = connections_max
        self._keys = keys
        self._connections: dict[asyncio.Task[None], None] = {}
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None

    @property
    def connections(self) -> int:
        """Return the number of open connections."""
        return len(self._connections)

    def start(self, answer: Answer) -> None:
        """Start the server, which calls `answer` for each request.

        Raises ServerError if address and port cannot be used."""
        share_interpreter()
        self._answer = answer
        try:
            self._listener = listen(self.address, self.port)
        except OSError as error:
            raise ServerError(self._bind_message(error)) from error
        self.port = self._listener.getsockname()[1]
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._listener, ready), name="scrape", daemon=True)
        self._thread.start()
        ready.wait()
        if self._stop is None:
            self._thread.join()
            self._listener.close()
            raise ServerError(f"cannot serve metrics at {self.address} port {self.port}: the thread did not start")

    def close(self) -> None:
        """Close all connections and end the thread. A second call does nothing."""
        if self._thread and self._loop and self._stop:
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()
        if self._listener:
            self._listener.close()
        self._thread = self._listener = None

    def _bind_message(self, error: OSError) -> str:
        address_key, port_key = self._keys
        hint = f"set {address_key} to an address of the host, for example 127.0.0.1 or 0.0.0.0"
        if error.errno == errno.EADDRINUSE:
            hint = f"another program uses this port (`ss -ltnp 'sport = {self.port}'`); stop it, or set {port_key}"
        elif error.errno == errno.EACCES:
            hint = f"ports below 1024 need CAP_NET_BIND_SERVICE; set {port_key} to a higher port"
        return f"cannot serve metrics at {self.address} port {self.port}: {error.strerror}; {hint}"

    def _run(self, listener: socket.socket, ready: threading.Event) -> None:
        try:
            asyncio.run(self._serve(listener, ready))
        finally:
            ready.set()

    async def _serve(self, listener: socket.socket, ready: threading.Event) -> None:
        loop = self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        loop.add_reader(listener, self._accept, loop, listener)
        ready.set()
        await self._stop.wait()
        loop.remove_reader(listener)  # `asyncio.run` cancels the tasks of all connections

    def _accept(self, loop: asyncio.AbstractEventLoop, listener: socket.socket) -> None:
        """Accept one client. `asyncio.start_server` may neither report nor close a client accepted at the end."""
        try:
            client, _ = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError:  # out of descriptors: the listener stays readable, so an immediate retry would be a busy loop
            loop.remove_reader(listener)
            loop.call_later(ACCEPT_PAUSE_S, loop.add_reader, listener, self._accept, loop, listener)
            return
        if len(self._connections) >= self._connections_max:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            oldest.cancel()
        client.setblocking(False)
        connection = loop.create_task(self._serve_client(loop, client))
        self._connections[connection] = None
        connection.add_done_callback(lambda done: self._ended(done, client))

    def _ended(self, connection: asyncio.Task[None], client: socket.socket) -> None:
        """Close the socket. The task cannot do this: a task that is cancelled before its first step runs no code."""
        self._connections.pop(connection, None)
        client.close()

    async def _serve_client(self, loop: asyncio.AbstractEventLoop, client: socket.socket) -> None:
        try:
            async with asyncio.timeout(self._connection_s):
                head = await _read_head(loop, client)
                if head is not None:
                    request = parse_request(head)
                    answer = (
                        await self._answer(request)
                        if request
                        else HttpResponse("400 Bad Request", b"expected HTTP/1.1\n")
                    )
                    with_body = request is None or request.method != "HEAD"
                    await loop.sock_sendall(client, _response(answer, with_body=with_body))
        except (TimeoutError, ConnectionError):
            pass  # silent, slow or disconnected client: no reply


async def _read_head(loop: asyncio.AbstractEventLoop, client: socket.socket) -> bytes | None:
    """Return the data up to the empty line; None if the client disconnects or sends more than REQUEST_BYTES_MAX."""
    data = b""
    while b"\r\n\r\n" not in data:
        part = await loop.sock_recv(client, REQUEST_BYTES_MAX)
        data += part
        if not part or len(data) > REQUEST_BYTES_MAX:
            return None
    return data[: data.index(b"\r\n\r\n")]


def parse_request(head: bytes) -> HttpRequest | None:
    """Return path and headers of a request (RFC 9112, sections 3 and 5); None if it is not HTTP/1."""
    line, *headers = head.decode("latin-1").split("\r\n")
    words = line.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return None
    accepted = []
    for header in headers:
        name, _, value = header.partition(":")
        if name.lower() == "accept":
            accepted.append(value.strip())
    return HttpRequest(words[0], words[1].partition("?")[0], ",".join(accepted))


def _response(answer: HttpResponse, *, with_body: bool) -> bytes:
    head = (
        f"HTTP/1.1 {answer.status}\r\nContent-Type: {answer.content_type}\r\n"
        f"Content-Length: {len(answer.body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode("latin-1") + (answer.body if with_body else b"")


def encoder_for(accept: str) -> tuple[Callable[[CollectorRegistry], bytes], str]:
    """Return the encoder and the content type for an Accept header; the defaults if the header is invalid.
    `choose_encoder` of prometheus_client raises if `version` is not a number (seen with 0.26)."""
    try:
        return choose_encoder(accept)
    except (TypeError, ValueError):
        return choose_encoder("")
