"""One client of the socket: reads its lines, sends it replies, events and samples, and ends the connection."""

import logging
import select
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from imud.contracts.status import ClientStatus
from imud.formats.jsonrpc import LINE_MAX_BYTES, Code, RpcError, encode_error, frame_of, line_of
from imud.publishers.socket.admission import Peer, Rights
from imud.publishers.socket.outbox import NO_FD, Limits, Outbox, Pool
from imud.publishers.socket.scheduler import Scheduler

BYTE: Final = b"\1"
FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
BUFFER_BYTES: Final = 1
"""The kernel makes its minimum of this: a few wake-ups may wait, and one is as good as a thousand."""


class Waker:
    """The daemon's end. Raises OSError when it cannot be made. Synchronization: the event loop's thread."""

    __slots__ = ("_send", "_sock", "_theirs")

    def __init__(self) -> None:
        self._sock, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._theirs.setblocking(False)  # a convenience of the client's, which may change it
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._sock.shutdown(socket.SHUT_RD)  # the client cannot send bytes or descriptors, which would not be read
        self._send = self._sock.send

    @property
    def client_end(self) -> int:
        """The descriptor for the client, NO_FD once it is handed over."""
        return self._theirs.fileno()

    @property
    def fds(self) -> tuple[int, int]:
        """Both descriptors."""
        return self._sock.fileno(), self._theirs.fileno()

    def handed_over(self) -> None:
        """Close the daemon's copy of the client's end, so that it shows when the client closes its own."""
        self._theirs.close()

    def wake(self) -> bool:
        """Make the client's end readable, at once whatever the client does. False when the client closed it."""
        try:
            self._send(BYTE, FLAGS)
        except BlockingIOError:  # full, so it is readable
            return True
        except OSError:
            return False
        return True

    def close(self) -> None:
        """End the descriptor: the client reads what waits, then end of file; may be called twice."""
        self._sock.close()
        self._theirs.close()


class ClientWakers:
    """The wakers of one client, at most one per device. Synchronization: the event loop's thread."""

    def __init__(self) -> None:
        self._wakers: dict[str, Waker] = {}
        self._lent: list[socket.socket] = []
        """Other descriptors of the client's whose replies wait to be sent."""

    def __contains__(self, device: object) -> bool:
        return device in self._wakers

    def __iter__(self) -> Iterator[str]:
        return iter(self._wakers)

    def __len__(self) -> int:
        return len(self._wakers)

    @property
    def client_ends(self) -> int:
        """Descriptors of the client's that the daemon still holds because their replies wait to be sent."""
        return sum(waker.client_end != NO_FD for waker in self._wakers.values()) + len(self._lent)

    def lend(self, sock: socket.socket) -> int:
        """Take a socket whose descriptor is for the client, to be sent with the next reply, and close it then.

        Raises RpcError while one before still waits to be sent, as `make`.
        """
        if self._lent:
            message = "the reply with the descriptor before still waits for this client; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        self._lent.append(sock)
        return sock.fileno()

    def make(self, device: str, check: Callable[[Sequence[int]], None]) -> int:
        """Make a descriptor for the client, to be sent with the next reply; it replaces the one of `device` before.

        `check` is given the numbers of the new descriptors and raises RpcError when clients may not use them.
        Raises RpcError also when none can be made, or while the one before still waits to be sent: a client that never
        reads would gather descriptors in the daemon.
        """
        old = self._wakers.get(device)
        if old is not None and old.client_end != NO_FD:
            message = "notify: the reply to the one before still waits for this client; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        try:
            waker = Waker()
        except OSError as error:
            raise RpcError(Code.UNAVAILABLE, f"notify: the daemon cannot make a descriptor: {error.strerror}") from None
        try:
            check(waker.fds)
        except RpcError:
            waker.close()
            raise
        if old is not None:
            old.close()
        self._wakers[device] = waker
        return waker.client_end

    def wake(self, device: str) -> bool:
        """Wake the client if it asked for that; False, once, when it has closed its descriptor, which ends it."""
        waker = self._wakers.get(device)
        if waker is None or waker.wake():
            return True
        self._wakers.pop(device).close()
        return False

    def handed_over(self) -> None:
        """All replies are sent, and their descriptors with them."""
        for waker in self._wakers.values():
            waker.handed_over()
        self._close_lent()

    def close(self) -> None:
        """End all descriptors; may be called twice."""
        for waker in self._wakers.values():
            waker.close()
        self._wakers.clear()
        self._close_lent()

    def _close_lent(self) -> None:
        while self._lent:
            self._lent.pop().close()


log = logging.getLogger(__name__)

RECV_BYTES: Final = 16384
"""What is read at once; nothing is read while a whole line waits, so a client has at most this and a line in memory,
which the pool counts."""
BLANK: Final = b" \t\r\n"
LINGER_TICKS: Final = 20
"""A client that ended its side has so many ticks (100 ms each) to read what still waits for it."""


@dataclass(frozen=True, slots=True)
class ServerSide:
    """What a connection needs of the server."""

    on_line: Callable[["ClientConnection", bytes], None]
    on_close: Callable[["ClientConnection"], None]
    on_evicted: Callable[[], None]
    on_failed: Callable[[Exception], None]
    limits: Limits
    pool: Pool
    scheduler: Scheduler


class ClientConnection:
    """A connected client with at least the right to read. Synchronization: the event loop's thread."""

    def __init__(
        self, number: int, sock: socket.socket, peer: Peer, rights: Rights, server: ServerSide, reserved: bool = False
    ) -> None:
        self.number = number
        self.peer = peer
        self.uid = peer.uid
        self.rights = rights
        self.reserved = reserved
        """Whether it has one of the places that are reserved for those who can set things right."""
        self.outbox = Outbox(sock, server.limits, server.pool, self)
        self.wakers = ClientWakers()
        self.closed = False
        self.text_numbers = False
        """Whether integers that may exceed 2⁵³ go out as text."""
        self._framed = False
        self._sock = sock
        self._server = server
        self._input = bytearray()
        self._searched = 0
        self._work: Iterator[int] | None = None
        """An answer in the making."""
        self._made_bytes = 0
        self._readable = self._writable = False
        self._linger_ticks: int | None = None
        self._place = server.scheduler.add(self, sock.fileno(), number, peer.uid)

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
    def unread_bytes(self) -> int:
        """What the client has sent and is not carried out yet, and its answer in the making."""
        return len(self._input) + self._made_bytes

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

    def work_on(self, work: Iterator[int]) -> None:
        """Have an answer made in pieces, one now and one in each turn of the client; no request is read meanwhile.

        Each piece gives the bytes that it holds by then; the last one posts the answer.
        """
        self._work = work
        self._step()

    def finish(self) -> None:
        """Read nothing more from the client, send what waits, then close; no-op if already so."""
        if self.closed or self.finishing:
            return
        self._drop_requests()
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
        self._place.leave()
        self.outbox.close()
        self._sock.close()
        self.wakers.close()
        self._drop_requests()
        self._server.on_close(self)

    def evict(self, reason: str) -> None:
        """Close, and count and log why."""
        if not self.closed:
            self._server.on_evicted()
            self.on_broken(reason)

    # --- served by the scheduler --------------------------------------------------------------------------------------

    def on_ready(self, events: int) -> None:
        """The socket has data or room; an error or an end shows when it is read or written."""
        ends = select.EPOLLHUP | select.EPOLLERR
        self._readable = self._readable or bool(events & (select.EPOLLIN | ends))
        self._writable = self._writable or bool(events & (select.EPOLLOUT | ends))

    def serve(self) -> bool:
        """Send one piece of what waits, and read one piece or carry out one request."""
        if self._writable and self.outbox.waiting:
            self.outbox.flush()
        if not self.closed and not self.finishing:
            if self._work is not None:
                self._step()
            else:
                self._serve_line()
        if not self.closed:
            self.outbox.count_owned(self.unread_bytes)
        return self._has_work()

    def wanted_events(self) -> int:
        """Input, unless the connection is finishing or has some to read; room, if something waits for it."""
        events = 0 if self.finishing or self._readable else select.EPOLLIN
        return events | select.EPOLLOUT if self.outbox.waiting and not self._writable else events

    def on_failure(self, error: Exception) -> None:
        """End the connection after an internal error in serving its request."""
        self._server.on_failed(error)
        if self.closed:
            return
        self._drop_requests()
        try:
            self.post(
                encode_error(RpcError(Code.INTERNAL, "an error in the daemon, which is logged; this connection ends"))
            )
            self.finish()
        except Exception:
            log.exception("client %d is closed without the reason: that cannot be sent either", self.number)
            self.close()

    def on_overload(self) -> None:
        """Evict the client."""
        self.evict("it goes on asking for more than a client may have")

    def _has_work(self) -> bool:
        if self.closed:
            return False
        if self._writable and self.outbox.waiting:
            return True
        return not self.finishing and (
            self._work is not None or self._readable or self._input.find(b"\n", self._searched) >= 0
        )

    def _serve_line(self) -> None:
        line = self._next_line()
        if line is None and self._readable and not self.finishing:
            self._read()
            line = self._next_line()
        if line is not None:
            self._server.on_line(self, line)

    def _step(self) -> None:
        """Make the next piece of the answer."""
        assert self._work is not None
        made_bytes = next(self._work, None)
        if made_bytes is None:
            self._work = None
        self._made_bytes = made_bytes or 0

    def _drop_requests(self) -> None:
        """Forget what the client has sent and asked."""
        self._input.clear()
        self._work = None
        self._made_bytes = 0

    def _read(self) -> None:
        try:
            data = self._sock.recv(RECV_BYTES)
        except BlockingIOError:
            self._readable = False
            return
        except OSError:  # reset by the peer
            self.close()
            return
        if not data:
            self.finish()
            return
        self._readable = len(data) == RECV_BYTES
        self._place.count_bytes(len(data))
        self._input += data if self._input else data.lstrip(BLANK)

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
        if data and data[0] in BLANK:
            self._input = data.lstrip(BLANK)
        self._searched = 0
        return line if line.strip(BLANK) else None

    def _refuse_line(self) -> None:
        self._server.on_evicted()
        message = f"a line has at most {LINE_MAX_BYTES} bytes; this connection ends"
        self.post(encode_error(RpcError(Code.LINE_TOO_LONG, message)))
        self.finish()

    # --- callbacks of the outbox --------------------------------------------------------------------------------------

    def on_broken(self, reason: str) -> None:
        """Close: the client is gone, or was evicted. Called during `publish` too, which iterates over outboxes."""
        if not self.closed:
            log.info("client %d (pid %d, uid %d) is gone: %s", self.number, self.peer.pid, self.peer.uid, reason)
            self.close()

    def on_flooded(self) -> None:
        """Evict the client."""
        self.evict("it makes the daemon hold too much: it does not read the answers to what it asks")

    def on_full(self) -> None:
        """Go on sending when the socket has room."""
        self._writable = False
        self._place.arm()

    def on_deferred(self) -> None:
        """Go on sending when it is the client's turn."""
        self._writable = True
        self._place.line_up()

    def on_emptied(self) -> None:
        """Everything is sent, descriptors too."""
        self.wakers.handed_over()
        if self.finishing:
            self.close()
