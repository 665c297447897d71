"""Destinations of lines: a queue with its accounts, a thread that delivers it, and the kinds of receivers.

    put ─▶ open batch ──full or old──▶ queue ──thread──▶ LineDelivery.send: file, TCP, HTTP
    UDP: put ─▶ datagrams, in the thread of the loop

lines made = acknowledged + waiting + dropped, at every moment. For UDP and TCP, the kernel accepted the acknowledged
lines: imud cannot verify that the receiver stored them. A file or an HTTP server confirms them.
"""

import errno
import logging
import os
import socket
import stat
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final, NamedTuple, Protocol

from imud.contracts.status import OutputStatus
from imud.formats.influx import cut
from imud.host.files import READ_FLAGS, NotRegularFile
from imud.host.http_post import HttpPost, RequestRejected, RequestTooLarge, halves_of
from imud.host.network import open_socket
from imud.host.threads import StartWorker, Worker
from imud.host.timed_connection import TimedConnection
from imud.model.errors import reason_of
from imud.model.units import NS_PER_S
from imud.publishers.influx.settings import LINES_MAX

log = logging.getLogger(__name__)

DATAGRAM_BYTES: Final = 1400  # maximum size of a datagram: below the MTU of Ethernet with IPv6, VPN and UDP headers
BATCH_BYTES: Final = 1_000_000  # maximum size of a request, bytes: below the smallest limit of known servers (25 MB)
RETRY_FIRST_NS: Final = NS_PER_S  # first pause after a failure, ns. The pause doubles up to RETRY_MOST_NS.
RETRY_MOST_NS: Final = 60 * NS_PER_S
IDLE_NS: Final = 3600 * NS_PER_S  # sleep of a thread without work, ns; new lines end it
TCP_S: Final = 10.0  # maximum time to connect to a TCP receiver and to send a batch, s
# Maximum length of the data that a TCP receiver sends during one batch, bytes. No receiver of line protocol replies.
IGNORED_BYTES: Final = 1 << 20
TAIL_BYTES: Final = 1 << 16  # part of an existing file in which imud looks for the end of the last complete line, bytes
OWN_LINE: Final = b"imud_"  # start of each line of imud
UNDELIVERED_NS: Final = 10 * NS_PER_S  # time without a delivery while lines wait, after which it is a problem, ns
# Number of accepted requests in sequence after which imud tries requests of twice the size again, up to BATCH_BYTES
GROWTH_REQUESTS: Final = 64


class LineAccount(NamedTuple):
    """Counts of lines. made = acknowledged + waiting + dropped."""

    made: int
    acknowledged: int
    waiting: int
    dropped: int


class Destination(Protocol):
    """Receiver of lines. Synchronization: the event loop's thread only."""

    def put(self, lines: bytes, count: int, now_ns: int) -> None:
        """Send or queue complete lines. Does not block."""
        ...

    def tick(self, now_ns: int) -> None:
        """Pass on an open batch that is old enough."""
        ...

    def account(self) -> LineAccount:
        """Return the counts of lines."""
        ...

    def status(self) -> OutputStatus:
        """Return counts and problem."""
        ...

    def finish(self) -> None:
        """Start to deliver all lines."""
        ...

    def close(self) -> None:
        """Drop and count the remaining lines and release everything. A second call does nothing."""
        ...


class UdpDestination:
    """Datagrams with complete lines. The kernel accepts them; whether they arrive is not verified."""

    def __init__(self, name: str, address: tuple[str, int]) -> None:
        self._name, self._address = name, address
        self._sock: socket.socket | None = None
        self._sent = self._dropped = 0
        self._problem = ""

    def put(self, lines: bytes, count: int, _now_ns: int) -> None:
        """Send lines as datagrams of at most DATAGRAM_BYTES. Drop a longer line."""
        for datagram in cut(lines, DATAGRAM_BYTES):
            if len(datagram) <= DATAGRAM_BYTES:
                self._send(datagram)
            else:
                self._dropped += 1
                self._problem = (
                    f"expected lines of at most {DATAGRAM_BYTES} bytes, got {len(datagram)}; try tcp or http"
                )

    def _send(self, datagram: bytes) -> None:
        count = datagram.count(b"\n")
        try:
            if self._sock is None:
                self._sock = open_socket(self._address[0], socket.SOCK_DGRAM)
            self._sock.sendto(datagram, self._address)
        except OSError as error:  # no route, network down, buffer full, or no receiver: the next datagram can arrive
            self._dropped += count
            problem = reason_of(error)
            if problem != self._problem:
                log.warning("influx: %s: %s", self._name, problem)
            self._problem = problem
        else:
            self._sent += count
            self._problem = ""

    def tick(self, now_ns: int) -> None:
        """Do nothing: no line waits."""

    def finish(self) -> None:
        """Do nothing: no line waits."""

    def account(self) -> LineAccount:
        return LineAccount(self._sent + self._dropped, self._sent, 0, self._dropped)

    def status(self) -> OutputStatus:
        return OutputStatus(self._name, self._sent, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        if self._sock is not None:
            self._sock.close()


class LineDelivery(Protocol):
    """Transport of batches. Called in the thread of the destination. May block."""

    def send(self, batch: bytes) -> None:
        """Deliver a batch of lines. Raises RequestTooLarge for its size, RequestRejected for its values, otherwise
        OSError: a later attempt can succeed."""
        ...

    def stop(self) -> None:
        """End a call of `send`, because imud ends. From any thread."""
        ...

    def close(self) -> None:
        """Release the connection or the file."""
        ...


class HttpDelivery:
    """Requests to the write URL of a database. Its reply 2xx confirms the lines."""

    def __init__(self, post: HttpPost) -> None:
        self.send = post.post
        self.stop = post.stop
        self.close = post.close


class TcpDelivery:
    """Lines over a TCP connection. The kernel accepts them; whether the receiver reads them is not verified."""

    def __init__(self, address: tuple[str, int], now_ns: Callable[[], int]) -> None:
        self._address = address
        self._connection = TimedConnection(now_ns)
        self.stop = self._connection.stop
        self.close = self._connection.close

    def send(self, batch: bytes) -> None:
        """Send a batch. Raises OSError after a failure: the new connection begins with the first line of the batch."""
        connection = self._connection
        connection.start(TCP_S)
        try:
            if connection.is_open and connection.has_input():
                self.close()  # the receiver closed the connection, or sent data: it may have lost lines
            if not connection.is_open:
                connection.open(*self._address)
            self._send_all(batch)
        except OSError:
            self.close()
            raise

    def _send_all(self, batch: bytes) -> None:
        """Send a batch and ignore the data of the receiver."""
        rest, ignored_bytes = memoryview(batch), 0
        while rest := rest[self._connection.send(rest) :]:
            data = self._connection.receive()
            ignored_bytes += len(data)
            if not data:
                raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
            if ignored_bytes > IGNORED_BYTES:
                raise OSError(f"expected a receiver that sends nothing, got {ignored_bytes} bytes")


class FileDelivery:
    """Lines at the end of a file with a maximum size. Keeps `files` files: NAME, NAME.1 (newest) …"""

    def __init__(self, path: str, bytes_max: int, files: int) -> None:
        self._path, self._bytes_max, self._files = path, bytes_max, files
        self._descriptor: int | None = None

    def send(self, batch: bytes) -> None:
        """Append a batch. After a failure, the file ends with the previous batch. Raises OSError."""
        descriptor = self._opened()
        size = os.fstat(descriptor).st_size
        if size and size + len(batch) > self._bytes_max:
            self._rotate()
            descriptor, size = self._opened(), 0
        try:
            rest = memoryview(batch)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(descriptor, size)
            raise

    def stop(self) -> None:
        """Do nothing: the write to a disk cannot be ended."""

    def close(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _opened(self) -> int:
        """Return the descriptor of the file at the path, also after another program replaced or removed the file."""
        if self._descriptor is not None:
            with suppress(FileNotFoundError):
                if os.path.samestat(os.stat(self._path, follow_symlinks=False), os.fstat(self._descriptor)):
                    return self._descriptor
            self.close()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
        descriptor = os.open(self._path, flags, 0o640)
        self._descriptor = descriptor
        try:
            self._check_end(descriptor)
        except OSError:
            self.close()
            raise
        return descriptor

    def _check_end(self, descriptor: int) -> None:
        """Check that imud wrote the file. Remove an incomplete last line of imud: it would be a wrong value. Raises
        OSError for the file of another program, and changes nothing."""
        _check_own(descriptor, self._path)
        size = os.fstat(descriptor).st_size
        tail_offset = max(size - TAIL_BYTES, 0)
        tail = os.pread(descriptor, TAIL_BYTES, tail_offset)
        end = tail.rfind(b"\n") + 1
        cut_line = tail[end:]
        if not cut_line:
            return
        # imud writes lines that are much shorter than TAIL_BYTES, so the tail contains the start of a cut line
        is_own = cut_line.startswith(OWN_LINE) or OWN_LINE.startswith(cut_line)
        if (not end and tail_offset) or not is_own:
            raise ForeignFile(f"{self._path} ends with data that imud did not write; {OTHER_PATH}")
        os.ftruncate(descriptor, tail_offset + end)

    def _rotate(self) -> None:
        """Rename the files and remove the oldest file. Raises OSError if imud did not write one of them."""
        self.close()
        for number in range(1, self._files):
            _check_own_path(f"{self._path}.{number}")
        if self._files == 1:
            os.unlink(self._path)
        for number in range(self._files - 1, 0, -1):
            older = f"{self._path}.{number}"
            with suppress(FileNotFoundError):
                os.replace(self._path if number == 1 else f"{self._path}.{number - 1}", older)


OTHER_PATH: Final = "set another path in influx.to"


class ForeignFile(OSError):
    """File of another program. imud does not change it."""


def _check_own(descriptor: int, path: str) -> None:
    """Raise OSError if an open file is neither empty nor a file of imud."""
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        raise NotRegularFile(0, "expected a regular file", path)
    start = os.pread(descriptor, len(OWN_LINE), 0)
    if not OWN_LINE.startswith(start):
        raise ForeignFile(f"{path} contains data that imud did not write; {OTHER_PATH}")


def _check_own_path(path: str) -> None:
    """Raise OSError if a path exists and is not a file of imud."""
    try:
        descriptor = os.open(path, READ_FLAGS | os.O_NOFOLLOW)
    except FileNotFoundError:
        return
    try:
        _check_own(descriptor, path)
    finally:
        os.close(descriptor)


class _Batch(NamedTuple):
    lines: bytes
    number: int  # number of lines
    # Number of lines that the receiver had accepted when it refused the size of this single line; None: not refused
    refused_after: int | None = None


class QueuedDestination:
    """Queue of batches that a thread delivers. Methods of `Destination`: the event loop's thread; `do_round`: the
    thread of the worker. The lock protects the accounts and the queue, never a delivery."""

    def __init__(
        self, name: str, delivery: LineDelivery, limits: tuple[int, int], now_ns: Callable[[], int],
        start_worker: StartWorker,
    ) -> None:  # fmt: skip
        """`limits`: maximum size of the queue, bytes, and maximum age of an open batch, ns."""
        self.name = name
        self._delivery, (self._bytes_max, self._age_ns), self._now_ns = delivery, limits, now_ns
        self._start_worker = start_worker
        self._worker: Worker | None = None
        self._lock = threading.Lock()
        self._open: list[bytes] = []
        self._open_count = self._open_bytes = 0
        self._open_since_ns = 0
        self._queue: deque[_Batch] = deque()
        self._queue_bytes = 0
        self._flight: _Batch | None = None  # batch that the thread delivers
        self._made = self._acknowledged = self._dropped = 0
        self._problem = ""
        # CLOCK_MONOTONIC of the newest delivery, or since lines wait; None if no line waits
        self._waiting_ns: int | None = None
        self._is_ending = False
        self._batch_bytes = BATCH_BYTES  # maximum size of a request. The thread reduces it if the receiver refuses it.
        self._accepted_requests = 0  # number of accepted requests since the last change of `_batch_bytes`
        self._pause_ns = RETRY_FIRST_NS
        self._due_ns = 0  # CLOCK_MONOTONIC of the next attempt after a failure
        self._idle = threading.Event()  # set while no batch waits, and after a failure

    def start(self) -> None:
        """Start the thread."""
        self._worker = self._start_worker("influx", self)

    # --- thread of the loop -------------------------------------------------------------------------------------------

    def put(self, lines: bytes, count: int, now_ns: int) -> None:
        """Add lines to the open batch. Drop the oldest batches above the limit of the queue."""
        if len(lines) <= self._batch_bytes:
            self._add(lines, count, now_ns)
            return
        for part in cut(lines, self._batch_bytes):
            self._add(part, part.count(b"\n"), now_ns)

    def _add(self, lines: bytes, count: int, now_ns: int) -> None:
        if self._open and self._open_bytes + len(lines) > self._batch_bytes:
            self._seal()
        with self._lock:
            if not self._open:
                self._open_since_ns = now_ns
            self._open.append(lines)
            self._open_count += count
            self._open_bytes += len(lines)
            self._made += count
            is_full = self._open_count >= LINES_MAX or self._open_bytes >= self._batch_bytes
        if is_full:
            self._seal()

    def tick(self, now_ns: int) -> None:
        """Pass the open batch to the thread if it is old enough."""
        if self._open and now_ns - self._open_since_ns >= self._age_ns:
            self._seal()

    def finish(self) -> None:
        """Pass the open batch to the thread."""
        self._seal()

    def wait(self, seconds: float) -> None:
        """Wait until all batches are delivered, at most `seconds`. Return immediately if the destination fails."""
        if not self.status().problem:
            self._idle.wait(seconds)

    def stop(self) -> None:
        """End the present delivery: the destination closes."""
        self._is_ending = True
        self._delivery.stop()

    def account(self) -> LineAccount:
        with self._lock:
            flight = 0 if self._flight is None else self._flight.number
            waiting = self._open_count + flight + sum(batch.number for batch in self._queue)
            return LineAccount(self._made, self._acknowledged, waiting, self._dropped)

    def status(self) -> OutputStatus:
        now_ns = self._now_ns()
        with self._lock:
            problem = self._problem
            if not problem and self._waiting_ns is not None and now_ns - self._waiting_ns >= UNDELIVERED_NS:
                silent_s = (now_ns - self._waiting_ns) // NS_PER_S
                problem = f"no delivery for {silent_s} s: the receiver has not confirmed a request; check the receiver"
            return OutputStatus(self.name, self._acknowledged, self._dropped, int(not problem), problem)

    def close(self) -> None:
        self.stop()
        worker, self._worker = self._worker, None
        is_over = worker is None or worker.end()
        waiting = self.account().waiting
        if waiting:
            log.warning("influx: %s: dropping %d lines at the end", self.name, waiting)
        with self._lock:
            self._dropped += self._open_count + sum(batch.number for batch in self._queue)
            self._open, self._open_count, self._open_bytes = [], 0, 0
            self._queue.clear()
            self._queue_bytes = 0
            if self._flight is not None and is_over:
                self._dropped += self._flight.number
                self._flight = None
        if is_over:
            self._delivery.close()

    def _seal(self) -> None:
        with self._lock:
            if not self._open:
                return
            batch = _Batch(b"".join(self._open), self._open_count)
            self._open, self._open_count, self._open_bytes = [], 0, 0
            self._queue.append(batch)
            self._queue_bytes += len(batch.lines)
            while self._queue_bytes > self._bytes_max and len(self._queue) > 1:
                oldest = self._queue.popleft()
                self._queue_bytes -= len(oldest.lines)
                self._dropped += oldest.number
            if self._waiting_ns is None:
                self._waiting_ns = self._now_ns()
            self._idle.clear()
        if self._worker is not None:
            self._worker.ring()

    # --- thread of the worker -----------------------------------------------------------------------------------------

    def do_round(self) -> int:
        """Deliver the oldest batch. Return the time until the next attempt, ns."""
        rest_ns = self._due_ns - self._now_ns()
        if rest_ns > 0:
            return rest_ns
        with self._lock:
            batch = self._flight = self._flight or self._next_batch()
            if batch is None:
                self._idle.set()
                return IDLE_NS
        try:
            self._delivery.send(batch.lines)
        except RequestTooLarge as error:
            return self._divide(batch, error)
        except RequestRejected as error:
            self._take(batch, 0, f"{error}; imud dropped {batch.number} lines")
        except OSError as error:
            return self._pause(reason_of(error))
        else:
            self._accepted_requests += 1
            if self._accepted_requests >= GROWTH_REQUESTS:
                self._set_batch_bytes(min(2 * self._batch_bytes, BATCH_BYTES))
            self._take(batch, batch.number, "")
        return 0

    def round_failed(self, error: BaseException) -> None:
        """Report an internal error. The thread has ended, and lines wait until the queue drops them."""
        log.error("influx: %s: internal error", self.name, exc_info=error)
        self._report(f"internal error {type(error).__name__}: {error}")

    def _next_batch(self) -> _Batch | None:
        """Remove and return the oldest lines, at most `_batch_bytes`; None without lines. The caller holds the lock."""
        if not self._queue:
            return None
        batch = self._queue.popleft()
        self._queue_bytes -= len(batch.lines)
        while batch.number > 1 and len(batch.lines) > self._batch_bytes:
            first, second = halves_of(batch.lines)
            count = first.count(b"\n")
            self._queue.appendleft(_Batch(second, batch.number - count))
            self._queue_bytes += len(second)
            batch = _Batch(first, count)
        return batch

    def _divide(self, batch: _Batch, error: RequestTooLarge) -> int:
        """Put a batch that is too large for the receiver back into the queue. Return the time until the next attempt.

        A receiver can refuse a single line for its length, or refuse all requests for a reason that a person can
        repair. imud drops the line only if the receiver has accepted other lines between two refusals of the line.
        """
        if batch.refused_after is not None and self._acknowledged > batch.refused_after:
            self._take(batch, 0, f"{error}; imud dropped 1 line of {len(batch.lines)} bytes")
            return 0

        is_single = batch.number == 1
        with self._lock:
            self._flight = None
            self._queue_bytes += len(batch.lines)
            if is_single:
                self._queue.append(batch._replace(refused_after=self._acknowledged))
            else:
                self._queue.appendleft(batch)
        if is_single:
            return self._pause(f"{error} to a request of {len(batch.lines)} bytes")
        self._set_batch_bytes(len(batch.lines) // 2)
        return 0

    def _set_batch_bytes(self, size: int) -> None:
        self._batch_bytes = size
        self._accepted_requests = 0

    def _pause(self, problem: str) -> int:
        """Report a failure that a later attempt can repair. Return the time until this attempt, ns."""
        self._idle.set()
        if self._is_ending:
            return IDLE_NS
        pause_ns = self._pause_ns
        self._pause_ns = min(2 * pause_ns, RETRY_MOST_NS)
        self._due_ns = self._now_ns() + pause_ns
        self._report(f"{problem}; trying again")
        return pause_ns

    def _take(self, batch: _Batch, acknowledged: int, problem: str) -> None:
        """Count the lines of a batch that the receiver accepted or rejected."""
        with self._lock:
            self._acknowledged += acknowledged
            self._dropped += batch.number - acknowledged
            self._flight = None
            self._waiting_ns = self._now_ns() if self._queue else None
        self._pause_ns = RETRY_FIRST_NS
        self._report(problem)

    def _report(self, problem: str) -> None:
        with self._lock:
            before, self._problem = self._problem, problem
        if problem and problem != before:
            log.warning("influx: %s: %s", self.name, problem)
        elif before and not problem:
            log.info("influx: %s: works again", self.name)
