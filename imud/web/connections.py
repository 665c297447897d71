"""TCP connections of `imud web`: their number, their idle time, and the CPU time of each read.

kernel ──at most READ_BYTES──▶ MeteredProtocol ──▶ aiohttp ──▶ WebServer
"""

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from aiohttp import web

from imud.web.budgets import PAUSE_S, WebBudget

READ_BYTES: Final = 4096
"""Maximum number of bytes that one read processes: 680 empty WebSocket frames."""
CONNECTIONS_MAX: Final = 200
"""Maximum number of connections, with open pages. A new connection then closes the connection that is idle longest."""
IDLE_S: Final = 60.0
"""Maximum time of a connection without a complete request, or to send a reply, s."""
CHECK_S: Final = 1.0
"""Time between two checks for idle connections, s."""


class WebConnections:
    """TCP connections of the server. Synchronization: one event loop.

    aiohttp limits neither their number nor the time to send a request.
    """

    def __init__(self, budget: WebBudget) -> None:
        """`budget` is the budget of HTTP requests without the token."""
        self._budget = budget
        self._protocols: dict[web.RequestHandler, MeteredProtocol] = {}
        self._now_s = 0.0  # time of the newest check, s
        # start of the connection, or end of its last request, oldest first
        self._since_s: dict[web.RequestHandler, float] = {}
        self._busy: set[web.RequestHandler] = set()
        self._answering: set[web.RequestHandler] = set()  # connections whose request has no reply
        self._half_closed: set[web.RequestHandler] = set()  # clients that closed their sending direction

    def protocol(self, connection: web.RequestHandler) -> "MeteredProtocol":
        """Return the protocol of a new connection."""
        protocol = MeteredProtocol(self.accept(connection), self, self._budget)
        self._protocols[connection] = protocol
        return protocol

    def protocol_of(self, request: web.Request) -> "MeteredProtocol | None":
        """Return the protocol of a request's connection; None if another server accepted the connection."""
        return self._protocols.get(request.protocol)

    def accept(self, connection: web.RequestHandler) -> web.RequestHandler:
        """Add a new connection and return it. Close the oldest idle connection if there are too many."""
        self._close(lambda idle_s: len(self._since_s) >= CONNECTIONS_MAX)
        self._since_s[connection] = self._now_s
        return connection

    def close_idle(self) -> None:
        """Close the connections that are idle for IDLE_S, and half-closed ones after the reply to their last request.

        Call this method every CHECK_S.
        """
        self._now_s += CHECK_S
        self._close(lambda idle_s: idle_s >= IDLE_S)
        for connection in self._half_closed - self._busy - self._answering:
            # two checks: the next of several requests can start between them
            if connection.transport is not None and self._now_s - self._since_s.get(connection, 0.0) > CHECK_S:
                connection.transport.close()  # sends the rest of the reply

    def half_close(self, connection: web.RequestHandler) -> None:
        """Note that the client of a connection sends no further requests, but can receive replies."""
        self._half_closed.add(connection)

    def remove(self, connection: web.RequestHandler) -> None:
        """Remove a closed connection."""
        self._protocols.pop(connection, None)
        self._since_s.pop(connection, None)
        self._half_closed.discard(connection)
        self._answering.discard(connection)

    def _close(self, is_wanted: Callable[[float], bool]) -> None:
        for connection, since_s in list(self._since_s.items()):
            idle_s = self._now_s - since_s
            transport = connection.transport
            if transport is None and idle_s > CHECK_S:  # already closed; a new connection gets its transport soon
                del self._since_s[connection]
            elif transport is not None and connection not in self._busy and is_wanted(idle_s):
                del self._since_s[connection]
                transport.abort()

    @contextmanager
    def in_use(self, request: web.Request) -> Iterator[None]:
        """Keep the connection of a request during a long reply."""
        connection = request.protocol
        self._busy.add(connection)
        try:
            yield
        finally:
            self._busy.discard(connection)

    def begin_request(self, request: web.Request) -> None:
        """Note that a connection has a request without a reply."""
        self._answering.add(request.protocol)

    def end_request(self, request: web.Request) -> None:
        """Restart the idle time of a connection."""
        self._answering.discard(request.protocol)
        if self._since_s.pop(request.protocol, None) is not None:
            self._since_s[request.protocol] = self._now_s

    async def run(self, _app: web.Application) -> Any:
        """Close idle connections while the application runs."""

        async def check() -> None:
            while True:
                await asyncio.sleep(CHECK_S)
                self.close_idle()

        checking = asyncio.create_task(check())
        yield
        checking.cancel()


class MeteredProtocol(asyncio.BufferedProtocol):
    """Protocol of aiohttp that charges the CPU time of each read to the client, and stops reading above the budget.

    A client can close its sending direction before it receives the reply. asyncio closes the connection of such a
    client if `eof_received` does not return True.
    """

    def __init__(self, handler: web.RequestHandler, connections: WebConnections, budget: WebBudget) -> None:
        self._handler, self._connections, self._budget = handler, connections, budget
        self._buffer = bytearray(READ_BYTES)
        self._transport: asyncio.Transport | None = None
        self._peer = ""
        self._is_page = False  # whether the connection is a WebSocket, which reads only after `read_next`
        self._is_paused = False
        self._is_waiting: Callable[[], bool] = lambda: False  # whether the page has no message in its queue
        self._retry: asyncio.TimerHandle | None = None  # next check of the budget
        self.pause_writing, self.resume_writing = handler.pause_writing, handler.resume_writing  # type: ignore[method-assign]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._peer = address_of(transport)
        self._handler.connection_made(transport)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(memoryview(self._buffer)[:nbytes])
        self._budget.measure(self._peer, lambda: self._handler.data_received(data))
        if self._is_page:
            self._stop_reading()
            asyncio.get_running_loop().call_soon(self._continue_reading)
        elif not self._budget.has_time(self._peer):
            self._pause()

    def follow_page(self, page: str, budget: WebBudget) -> None:
        """Charge the next reads to a page. Read only after `read_next`, so that no queue of messages can grow."""
        self._peer, self._budget, self._is_page = page, budget, True
        self._stop_reading()

    def read_next(self, is_waiting: Callable[[], bool]) -> None:
        """Read within the budget while `is_waiting` returns True."""
        self._is_waiting = is_waiting
        self._continue_reading()

    def _continue_reading(self) -> None:
        if self._is_paused and self._retry is None and self._is_waiting():
            self._resume()

    def _stop_reading(self) -> None:
        assert self._transport is not None
        self._is_paused = True
        self._transport.pause_reading()

    def _pause(self) -> None:
        """Read again after a pause, as soon as the budget permits it."""
        assert self._transport is not None
        if not self._transport.is_closing():
            self._stop_reading()
            self._retry = asyncio.get_running_loop().call_later(PAUSE_S, self._resume)

    def _resume(self) -> None:
        assert self._transport is not None
        self._retry = None
        if self._budget.has_time(self._peer):
            self._is_paused = False
            self._transport.resume_reading()
        else:
            self._pause()

    def eof_received(self) -> bool:
        self._connections.half_close(self._handler)
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        if self._retry is not None:
            self._retry.cancel()
        self._connections.remove(self._handler)
        self._handler.connection_lost(exc)


def address_of(transport: asyncio.BaseTransport | None) -> str:
    """Return the address of a client; empty if it has left."""
    name = None if transport is None else transport.get_extra_info("peername")
    return str(name[0]) if name else ""


class LimitedSite(web.TCPSite):
    """Listening socket whose connections are in a `WebConnections`."""

    def __init__(self, runner: web.AppRunner, host: str, port: int, connections: WebConnections) -> None:
        super().__init__(runner, host, port)
        self._address, self._connections = (host, port), connections

    async def start(self) -> None:
        await web.BaseSite.start(self)
        make = self._runner.server
        assert make is not None
        host, port = self._address
        # asyncio does not report a family that the kernel lacks
        socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET).close()
        self._server = await asyncio.get_running_loop().create_server(
            lambda: self._connections.protocol(make()),
            host,
            port,
            backlog=self._backlog,
        )
