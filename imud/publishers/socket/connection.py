"""One client of the socket: reads its lines, sends it replies, events and samples, and ends the connection."""

import asyncio
import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from imud.contracts.status import ClientStatus
from imud.formats.jsonrpc import LINE_MAX_BYTES, Code, RpcError, encode_error, frame_of, line_of
from imud.publishers.socket.outbox import NO_FD, Limits, Outbox
from imud.publishers.socket.rights import Peer, Rights
from imud.publishers.socket.waker import ClientWakers

log = logging.getLogger(__name__)

RECV_BYTES: Final = 65536
LINES_PER_TURN: Final = 4
"""After so many requests of one client others have their turn: 64 KiB hold a thousand `status` requests."""
LINGER_TICKS: Final = 20
"""A client that ended its side has so many ticks (100 ms each) to read what still waits for it."""


@dataclass(frozen=True, slots=True)
class Owner:
    """What a connection needs of the server."""

    on_line: Callable[["Connection", bytes], None]
    on_close: Callable[["Connection"], None]
    on_evicted: Callable[[], None]
    limits: Limits


class Connection:
    """A connected client with at least the right to read. Synchronization: the event loop's thread."""

    def __init__(self, number: int, sock: socket.socket, peer: Peer, rights: Rights, owner: Owner) -> None:
        self.number = number
        self.peer = peer
        self.rights = rights
        self.outbox = Outbox(sock, owner.limits, self._broken, self._flooded, self._emptied)
        self.wakers = ClientWakers()
        self.closed = False
        self._framed = False
        self._sock = sock
        self._owner = owner
        self._input = bytearray()
        self._searched = 0
        self._linger_ticks: int | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._readable)

    def post(self, body: bytes, fd: int = NO_FD) -> None:
        """Send one JSON object, with a copy of a descriptor where one is given."""
        if not self.closed:
            self.outbox.put_reply(frame_of(body) if self._framed else line_of(body), fd)
            if not self.outbox.waiting:
                self.wakers.handed_over()

    @property
    def framed(self) -> bool:
        """Whether messages go out as frames."""
        return self._framed

    def use_frames(self) -> None:
        """Send everything from now on as frames; there is no way back to lines."""
        self._framed = True

    @property
    def finishing(self) -> bool:
        """Whether the connection only sends what waits, and ends then."""
        return self._linger_ticks is not None

    def status(self, encoding: str) -> ClientStatus:
        """The state of this client now; `encoding` is that of its subscription, empty without one."""
        outbox = self.outbox
        return ClientStatus(
            number=self.number,
            pid=self.peer.pid,
            uid=self.peer.uid,
            control=Rights.CONTROL in self.rights,
            encoding=encoding,
            sent=outbox.sent,
            dropped=outbox.dropped,
            queue_samples=outbox.queue_samples,
            queue_bytes=outbox.queue_bytes,
        )

    def finish(self) -> None:
        """Read nothing more from the client, send what waits, then close; no-op if already so."""
        if self.closed or self.finishing:
            return
        self._loop.remove_reader(self._sock)
        self._linger_ticks = LINGER_TICKS
        if not self.outbox.waiting:
            self.close()

    def tick(self) -> None:
        """Called ten times a second."""
        if self._linger_ticks is not None:
            self._linger_ticks -= 1
            if self._linger_ticks <= 0:
                self.close()

    def close(self) -> None:
        """Close at once; may be called twice."""
        if self.closed:
            return
        self.closed = True
        self._loop.remove_reader(self._sock)
        self.outbox.close()
        self._sock.close()
        self.wakers.close()
        self._input.clear()
        self._owner.on_close(self)

    # --- reading ----------------------------------------------------------------------------------------------------

    def _readable(self) -> None:
        try:
            data = self._sock.recv(RECV_BYTES)
        except BlockingIOError:
            return
        except OSError:  # reset by the peer
            self.close()
            return
        if not data:
            self.finish()
            return
        self._input += data
        self._work()

    def _work(self) -> None:
        """Handle the lines that are there; after LINES_PER_TURN, go on in the next turn of the event loop."""
        for _ in range(LINES_PER_TURN):
            if self.closed or self.finishing:
                return
            line = self._next_line()
            if line is None:
                return
            if line.strip():
                self._owner.on_line(self, line)
        if not self.closed:
            self._loop.remove_reader(self._sock)
            self._loop.call_soon(self._resume)

    def _resume(self) -> None:
        if self.closed or self.finishing:
            return
        self._loop.add_reader(self._sock, self._readable)
        self._work()

    def _next_line(self) -> bytes | None:
        """The next whole line; None when there is none yet, or when the client is over the limit and finished."""
        data = self._input
        end = data.find(b"\n", self._searched)
        if (len(data) if end < 0 else end) > LINE_MAX_BYTES:
            self._refuse_line()
            return None
        if end < 0:
            self._searched = len(data)
            return None
        line = bytes(data[:end])
        del data[: end + 1]
        self._searched = 0
        return line

    def _refuse_line(self) -> None:
        self._input.clear()
        self._owner.on_evicted()
        message = f"a line has at most {LINE_MAX_BYTES} bytes; this connection ends"
        self.post(encode_error(RpcError(Code.LINE_TOO_LONG, message)))
        self.finish()

    # --- callbacks of the outbox --------------------------------------------------------------------------------------

    def _broken(self, reason: str) -> None:
        """Close: the client is gone, or was evicted. Called during `publish` too, which iterates over outboxes."""
        if not self.closed:
            log.info("client %d (pid %d, uid %d) is gone: %s", self.number, self.peer.pid, self.peer.uid, reason)
            self.close()

    def _flooded(self) -> None:
        self._owner.on_evicted()
        self._broken("it does not read the answers to what it asks")

    def _emptied(self) -> None:
        self.wakers.handed_over()
        if self.finishing:
            self.close()
