"""The gate of `imud foxglove`: it listens, looks at the first request of each connection, and joins those that may read
with the server behind it. After that it passes bytes on and does not look at them.

    viewer ──▶ gate: Host, Origin ──▶ server of foxglove-sdk, on a random address of 127.0.0.0/8

The server of foxglove-sdk accepts whoever connects. Any page in a browser of this machine can open a WebSocket to a
port of it, and what tells it from a viewer is only the header Origin, which browsers send and pages cannot change.
"""

import asyncio
import socket
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable
from contextlib import suppress
from email.errors import MessageError
from http.client import HTTPException, parse_headers
from io import BytesIO
from threading import Event as ThreadEvent
from threading import Thread
from typing import Final

from imud.cli.foxglove.origins import ViewerOrigins
from imud.errors import ServerError, reason_of

HEAD_BYTES_MAX: Final = 16384
"""Of a request: a browser sends about 600 bytes, and its cookies for this host."""
HEAD_S: Final = 10.0
"""Time for the request to come."""
CONNECTIONS_MAX: Final = 32
"""Viewers at a time: each has a backlog of 1024 messages in the server."""
READ_BYTES: Final = 65536
GATHER_S: Final = 0.005
"""Pause after each read of messages: the server writes each message alone, and a viewer draws every 16 ms."""
NOTES_MAX: Final = 20
"""Refusals that are printed, each once: a page may try again for ever."""


class ViewerGate:
    """The gate in front of a server, in a thread of its own. Synchronization: `close` in the thread that made it."""

    def __init__(
        self, host: str, port: int, server: tuple[str, int], origins: ViewerOrigins, *, note: Callable[[str], None]
    ) -> None:
        """Listen on `host` and `port` (0: a free one) for the server at the address and port `server`.

        `note` is called in another thread with each refusal for the first time. Raises ServerError.
        """
        self._server = server
        self._origins = origins
        self._note = note
        self._noted: set[str] = set()
        self._connections: set[asyncio.Task[None]] = set()
        self._socket = _listening(host, port)
        self.port: Final = int(self._socket.getsockname()[1])
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._ready = ThreadEvent()
        self._thread = Thread(target=self._run, name="foxglove-gate", daemon=True)
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """End all connections; may be called twice."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())  # the runner cancels the connections that are left

    async def _serve(self) -> None:
        listening = await asyncio.start_server(self._accept, sock=self._socket, limit=HEAD_BYTES_MAX)
        self._ready.set()
        await self._stopped.wait()
        listening.close()

    def _accept(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve a connection; its writer is closed even where the gate ends before the task has begun."""
        task = self._loop.create_task(self._take(reader, writer))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)
        task.add_done_callback(lambda _: writer.close())

    async def _take(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve a connection to its end."""
        try:
            async with asyncio.timeout(HEAD_S):
                head = await reader.readuntil(b"\r\n\r\n")
            status, problem = self._judge(head)
            if problem:
                writer.write(_refusal(status, problem))
                await writer.drain()
            else:
                await self._join(head, reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # it went away, or it is no viewer

    def _judge(self, head: bytes) -> tuple[str, str]:
        """Return the HTTP status and the words of a refusal; empty words where the request may pass."""
        if len(self._connections) > CONNECTIONS_MAX:
            return "503 Service Unavailable", f"{CONNECTIONS_MAX} viewers are connected, which is the most"
        request, _, rest = head.partition(b"\r\n")
        try:
            headers = parse_headers(BytesIO(rest))
        except (HTTPException, MessageError):
            return "400 Bad Request", "expected a request of a WebSocket"
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if headers.defects or len(hosts) != 1 or len(origins) > 1 or not request.endswith(b" HTTP/1.1"):
            return "400 Bad Request", "expected a request of a WebSocket"
        if headers.get("Upgrade", "").lower() != "websocket":
            return "426 Upgrade Required", "expected a WebSocket: open ws:// and this address in a viewer"
        problem = self._origins.problem(hosts[0].strip(), origins[0].strip() if origins else "")
        if problem and problem not in self._noted and len(self._noted) < NOTES_MAX:
            self._noted.add(problem)
            self._note(f"refused a connection: {problem}")
        return "403 Forbidden", problem

    async def _join(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Pass bytes on in both directions until one end closes."""
        server_reader, server_writer = await asyncio.open_connection(*self._server, limit=READ_BYTES)
        server_writer.write(head)
        ways = (
            asyncio.create_task(_pass_on(reader, server_writer, 0.0)),
            asyncio.create_task(_pass_on(server_reader, writer, GATHER_S)),
        )
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            server_writer.close()  # before the wait: the end of the gate may cancel that
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _pass_on(reader: StreamReader, writer: StreamWriter, pause_s: float) -> None:
    with suppress(OSError):
        while data := await reader.read(READ_BYTES):
            writer.write(data)
            await writer.drain()
            await asyncio.sleep(pause_s)


def _listening(host: str, port: int) -> socket.socket:
    """Open the socket. Raises ServerError naming what to look at."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise ServerError(
            f"cannot listen on {host} port {port}: {reason_of(error)}; is another `imud foxglove` running? (ss -ltnp)"
        ) from error


def _refusal(status: str, problem: str) -> bytes:
    words = f"imud foxglove: {problem}\n".encode()
    head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(words)}\r\n"
    return f"{head}Connection: close\r\n\r\n".encode() + words
