"""One client of the socket: its requests, its replies, events and samples, and its descriptors."""

import logging
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import BinaryIO, Final

from imud.contracts.status import ClientStatus
from imud.formats.jsonrpc import LINE_MAX_BYTES, Code, RpcError, encode_error, frame_of, line_of
from imud.publishers.socket.admission import Peer, Place, RateLimitedLog, Rights
from imud.publishers.socket.outbox import NO_FD, Outbox, Pool
from imud.publishers.socket.scheduler import ScheduledClient, Scheduler

log = logging.getLogger(__name__)

BYTE: Final = b"\1"
FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
BUFFER_BYTES: Final = 1
"""Size of a waker's send buffer. The kernel raises it to its minimum. One byte in it is enough."""
RECV_BYTES: Final = 16384
"""Maximum number of bytes per read. A client reads nothing while its input contains a complete line. Thus the input
has at most this size and one line."""
BLANK: Final = b" \t\r\n"
LINGER_TICKS: Final = 20
"""Time for a client that has shut down its side to read its queue, ticks of 100 ms."""


class Waker:
    """A socket pair: `wake` makes the client's end readable. Raises OSError if it cannot be made.

    Synchronization: the event loop's thread.
    """

    # Nothing that the client does with its descriptor may block the daemon. Other descriptors cannot guarantee this:
    # - eventfd: both sides share one open file description. A client that clears O_NONBLOCK and fills the counter
    #   blocks the next write of the daemon.
    # - pipe: a read holds the lock of the pipe while it copies to the memory of the reader. A write waits for this
    #   lock, also with O_NONBLOCK. The client can delay the copy with a page fault (userfaultfd, FUSE).
    # A UNIX socket has one description per end, MSG_DONTWAIT for each call, and no lock during the copy.

    __slots__ = ("_client_sock", "_send", "_sock")

    def __init__(self) -> None:
        self._sock, self._client_sock = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._client_sock.setblocking(False)  # only a default: the client may change it
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._sock.shutdown(socket.SHUT_RD)  # the client cannot send bytes or descriptors, which nothing would read
        self._send = self._sock.send

    @property
    def client_end(self) -> int:
        """The descriptor for the client; NO_FD after `close_copy`."""
        return self._client_sock.fileno()

    @property
    def fds(self) -> tuple[int, int]:
        return self._sock.fileno(), self._client_sock.fileno()

    def close_copy(self) -> None:
        """Close the daemon's copy of the client's end, so that `wake` detects that the client closed its own."""
        self._client_sock.close()

    def wake(self) -> bool:
        """Make the client's end readable, without waiting. Return False if the client has closed it."""
        try:
            self._send(BYTE, FLAGS)
        except BlockingIOError:  # the buffer is full, so the client's end is readable
            return True
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close both ends. The client reads the pending bytes, then end of file. A second call does nothing."""
        self._sock.close()
        self._client_sock.close()


class Clients(ABC):
    """Base class of the hub: all clients, their common memory, and the counters of `status`."""

    def __init__(
        self, pool: Pool, now_ns: Callable[[], int], handle_line: Callable[["ClientConnection", bytes], None]
    ) -> None:
        """`handle_line` carries out the request in a line."""
        self.pool = pool
        self.handle_line = handle_line
        self.connections: dict[int, ClientConnection] = {}  # the clients by number
        # clients that need ticks: they have shut down their sending direction, or only send their queue
        self.ending: dict[ClientConnection, None] = {}
        self.accepted = 0  # connections accepted since start; the number of the newest
        self.refused = 0
        self.evicted = 0  # clients disconnected because they exceeded a limit
        self._failed = 0
        self._failures = RateLimitedLog(now_ns)

    @abstractmethod
    def remove(self, connection: "ClientConnection") -> None:
        """Remove a client that has ended. Do nothing if it is unknown."""

    @abstractmethod
    def has_news_for(self, connection: "ClientConnection") -> bool:
        """Return whether a client gets more messages or wakes without another request."""

    def count_failed(self, error: Exception) -> None:
        """Count a client that an internal error ended. Log the error at most once a minute."""
        self._failed += 1
        count = self._failures.count()
        if count:
            log.error("internal error while serving a client (%d since the last report)", count, exc_info=error)


class ClientConnection(Outbox, ScheduledClient):
    """A connected client that may at least read. Synchronization: the event loop's thread.

    The daemon keeps a copy of each descriptor for the client until the reply with it is sent. A client that does not
    read its replies must not accumulate descriptors in the daemon: a waker for each device, and one other descriptor.
    """

    def __init__(
        self, sock: socket.socket, peer: Peer, rights: Rights, place: Place, clients: Clients, scheduler: Scheduler
    ) -> None:
        clients.accepted += 1
        Outbox.__init__(self, sock, clients.pool, peer.uid)
        ScheduledClient.__init__(self, scheduler, sock.fileno(), clients.accepted, peer.uid)
        self.peer = peer
        self.rights = rights
        self.place = place
        self.wakers: dict[str, Waker] = {}  # by device
        self._lent: socket.socket | BinaryIO | None = None  # the socket of the other descriptor
        self.closed = False
        self.text_numbers = False  # whether imud sends integers that may exceed 2⁵³ as strings
        self.framed = False  # whether imud sends messages as frames; never reset
        self._clients = clients
        self._scheduler = scheduler
        self._input = bytearray()
        self._searched = 0  # bytes of the input that contain no newline
        self._work: Iterator[int] | None = None  # an unfinished reply
        self._work_bytes = 0
        self._readable = self._writable = False
        self.finishing = False  # whether the connection only sends its queue and then ends
        self._linger_ticks = LINGER_TICKS
        self._input_ended = False  # whether the client has shut down its sending direction

    def post(self, body: bytes, fd: int = NO_FD) -> None:
        """Send one JSON object, with a copy of `fd` if given."""
        if not self.closed:
            self.put_reply(frame_of(body) if self.framed else line_of(body), fd)
            if not self.waiting:
                self._close_copies()

    def status(self, encoding: str) -> ClientStatus:
        """Return the state of this client; `encoding` is the encoding of its subscription, empty without one."""
        return ClientStatus(
            number=self.number,
            pid=self.peer.pid,
            uid=self.peer.uid,
            control=Rights.CONTROL in self.rights,
            encoding=encoding,
            sent=self.sent,
            dropped=self.dropped,
            queue_samples=self.queue_samples,
            queue_bytes=self.queue_bytes,
        )

    def work_on(self, work: Iterator[int]) -> None:
        """Make a reply in pieces: one now, the others in later turns. Read no request until it is complete.

        Each piece yields the number of bytes that the reply occupies so far. The last piece posts the reply.
        """
        self._work = work
        self._step()

    def finish(self) -> None:
        """Stop reading, send the queue, then close. A second call does nothing."""
        if self.closed or self.finishing:
            return
        self._drop_requests()
        self.finishing = True
        self._clients.ending[self] = None
        if not self.waiting:
            self.close()

    def tick(self) -> None:
        """Close the connection LINGER_TICKS after `finish`. Finish it after the last reply to a client that has shut
        down its sending direction."""
        if self._input_ended:
            self._finish_if_done()
        if self.finishing:
            self._linger_ticks -= 1
            if self._linger_ticks <= 0:
                self.close()

    def close(self) -> None:
        """Close the connection immediately. A second call does nothing."""
        if self.closed:
            return
        self.closed = True
        with ExitStack() as steps:  # after an error of a step, the other steps run, so that the client keeps no place
            steps.callback(self._clients.remove, self)
            steps.callback(self._drop_requests)
            steps.callback(self.wakers.clear)
            for waker in self.wakers.values():
                steps.callback(waker.close)
            steps.callback(self._close_copies)
            steps.callback(self._sock.close)
            steps.callback(self.discard)
            steps.callback(self._scheduler.remove, self)

    # --- descriptors for the client -----------------------------------------------------------------------------------

    def lend(self, sock: socket.socket | BinaryIO) -> int:
        """Take a socket or a file, and close it when its descriptor is sent. Return the descriptor for the next reply.

        Raises RpcError if the previous one is not sent yet.
        """
        if self._lent is not None:
            message = "the previous reply with a descriptor is not sent yet; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        self._lent = sock
        return sock.fileno()

    def make_waker(self, device: str, check: Callable[[Sequence[int]], None]) -> int:
        """Make a waker in place of the previous waker of `device`. Return the descriptor for the next reply.

        `check` receives both descriptors, and raises RpcError if clients may not use them. Raises RpcError also if no
        socket pair can be made, or if the previous descriptor is not sent yet.
        """
        old = self.wakers.get(device)
        if old is not None and old.client_end != NO_FD:
            message = "notify: the previous reply for this device is not sent yet; read it, then ask again"
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
        self.wakers[device] = waker
        return waker.client_end

    def wake(self, device: str) -> bool:
        """Wake the client if it has a waker for `device`. Return False, once, if the client has closed the waker."""
        waker = self.wakers.get(device)
        if waker is None or waker.wake():
            return True
        self.wakers.pop(device).close()
        return False

    def _close_copies(self) -> None:
        """Close the daemon's copies of descriptors, because all replies are sent."""
        for waker in self.wakers.values():
            waker.close_copy()
        if self._lent is not None:
            self._lent.close()
            self._lent = None

    # --- called by the scheduler --------------------------------------------------------------------------------------

    def on_ready(self, events: int) -> None:
        ends = select.EPOLLHUP | select.EPOLLERR  # the next read or send reports an end or an error
        self._readable = self._readable or bool(events & (select.EPOLLIN | ends))
        self._writable = self._writable or bool(events & (select.EPOLLOUT | ends))

    def serve(self) -> bool:
        """Send one piece of the queue, and carry out one request or one piece of it."""
        if self._writable and self.waiting:
            self.flush()
        if not self.closed and not self.finishing:
            if self._work is not None:
                self._step()
            else:
                line = self._next_line()
                if line is None and self._readable and not self.finishing:
                    self._read()
                    line = self._next_line()
                if line is not None:
                    self._clients.handle_line(self, line)
        if self.closed:
            return False
        self.set_request_bytes(len(self._input) + self._work_bytes)
        if self.closed:
            return False
        if self._writable and self.waiting:
            return True
        return not self.finishing and (
            self._work is not None or self._readable or self._input.find(b"\n", self._searched) >= 0
        )

    def wanted_events(self) -> int:
        # a client that has shut down its sending direction stays readable: EPOLLHUP reports that it closes the socket
        waits_for = select.EPOLLHUP if self._input_ended else select.EPOLLIN
        events = 0 if self.finishing or self._readable else waits_for
        return events | select.EPOLLOUT if self.waiting and not self._writable else events

    def on_failure(self, error: Exception) -> None:
        self._clients.count_failed(error)
        if self.closed:
            return
        self._drop_requests()
        try:
            message = "internal error in the daemon, see its log; this connection ends"
            self.post(encode_error(RpcError(Code.INTERNAL, message)))
            self.finish()
        except Exception:
            log.exception("cannot send the error to client %d; its connection ends without it", self.number)
            self.close()

    def evict(self, reason: str) -> None:
        if not self.closed:
            self._clients.evicted += 1
            self.on_broken(reason)

    def _step(self) -> None:
        assert self._work is not None
        work_bytes = next(self._work, None)
        if work_bytes is None:
            self._work = None
        self._work_bytes = work_bytes or 0

    def _drop_requests(self) -> None:
        self._input.clear()
        self._work = None
        self._work_bytes = 0

    # --- input --------------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        try:
            data = self._sock.recv(RECV_BYTES)
        except BlockingIOError:
            self._readable = False
            return
        except OSError:  # reset by the peer
            self.close()
            return
        if not data and self._input_ended:  # EPOLLHUP
            self.finish()
            return
        if not data:
            self._input_ended, self._readable = True, False
            self._clients.ending[self] = None
            self._finish_if_done()
            return
        self._readable = len(data) == RECV_BYTES
        self.data.use(len(data))
        self._input += data if self._input else data.lstrip(BLANK)

    def _finish_if_done(self) -> None:
        if self._work is None and not self._clients.has_news_for(self):
            self.finish()

    def _next_line(self) -> bytes | None:
        """Take the next complete line from the input; None if there is none. A line above the limit ends the client."""
        data = self._input
        end = data.find(b"\n", self._searched)
        if (len(data) if end < 0 else end) > LINE_MAX_BYTES:
            self._clients.evicted += 1
            message = f"a line has at most {LINE_MAX_BYTES} bytes; this connection ends"
            self.post(encode_error(RpcError(Code.LINE_TOO_LONG, message)))
            self.finish()
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

    # --- called by the outbox -----------------------------------------------------------------------------------------

    def on_broken(self, reason: str) -> None:
        if not self.closed:
            log.info("client %d (pid %d, uid %d) disconnected: %s", self.number, self.peer.pid, self.peer.uid, reason)
            self.close()

    def on_full(self) -> None:
        self._writable = False
        self._scheduler.arm(self)

    def on_deferred(self) -> None:
        self._writable = True
        self._scheduler.enqueue(self)

    def on_emptied(self) -> None:
        self._close_copies()
        if self.finishing:
            self.close()
