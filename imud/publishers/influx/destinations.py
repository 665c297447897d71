"""Destinations of lines: a queue with its accounts, a thread that delivers it, and the kinds of receivers.

    put ─▶ open batch ──full or old──▶ queue ──thread──▶ LineDelivery.send: file, TCP, HTTP
    UDP: put ─▶ datagrams, in the thread of the loop

lines made = acknowledged + waiting + dropped, at every moment. For UDP and TCP, the kernel accepted the acknowledged
lines: imud cannot verify that the receiver stored them. A file or an HTTP server confirms them.
"""

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
from imud.host.files import NotRegularFile
from imud.host.http_post import HttpPost, RequestRejected
from imud.host.network import open_socket
from imud.host.threads import StartWorker, Worker
from imud.model.errors import reason_of
from imud.model.units import NS_PER_S
from imud.publishers.influx.settings import LINES_MAX

log = logging.getLogger(__name__)

DATAGRAM_BYTES: Final = 1400  # maximum size of a datagram: below the MTU of Ethernet with IPv6, VPN and UDP headers
BATCH_BYTES: Final = 1_000_000  # maximum size of a request, bytes: below the smallest limit of known servers (25 MB)
RETRY_FIRST_NS: Final = NS_PER_S  # first pause after a failure, ns. The pause doubles up to RETRY_MOST_NS.
RETRY_MOST_NS: Final = 60 * NS_PER_S
IDLE_NS: Final = 3600 * NS_PER_S  # sleep of a thread without work, ns; new lines end it
TCP_S: Final = 10.0  # maximum wait for a TCP connection or for room in its buffer, s
TAIL_BYTES: Final = 1 << 16  # part of an existing file in which imud looks for the end of the last complete line, bytes


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
        """Deliver a batch of lines. Raises RequestRejected if a later attempt would fail too, otherwise OSError."""
        ...

    def close(self) -> None:
        """Release the connection or the file."""
        ...


class HttpDelivery:
    """Requests to the write URL of a database. Its reply 2xx confirms the lines."""

    def __init__(self, post: HttpPost) -> None:
        self.send = post.post
        self.close = post.close


class TcpDelivery:
    """Lines over a TCP connection. The kernel accepts them; whether the receiver reads them is not verified."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._sock: socket.socket | None = None

    def send(self, batch: bytes) -> None:
        """Send a batch. Raises OSError after a failure: the new connection begins with the first line of the batch."""
        try:
            sock = self._usable() or socket.create_connection(self._address, TCP_S)
            self._sock = sock
            sock.settimeout(TCP_S)
            sock.sendall(batch)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        sock, self._sock = self._sock, None
        if sock is not None:
            sock.close()

    def _usable(self) -> socket.socket | None:
        """Return the connection; None if the receiver closed it. Ignore data from the receiver."""
        if self._sock is None:
            return None
        try:
            while self._sock.recv(1 << 16, socket.MSG_DONTWAIT):
                pass
        except BlockingIOError:
            return self._sock
        except OSError:
            pass
        self.close()
        return None


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
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            self.close()
            raise NotRegularFile(0, "expected a regular file", self._path)
        tail = os.pread(descriptor, TAIL_BYTES, max(status.st_size - TAIL_BYTES, 0))
        if tail and not tail.endswith(b"\n"):  # a power failure cut the last line, which would be a wrong value
            os.ftruncate(descriptor, status.st_size - len(tail) + tail.rfind(b"\n") + 1)
        return descriptor

    def _rotate(self) -> None:
        """Rename the files and remove the oldest file."""
        self.close()
        if self._files == 1:
            os.unlink(self._path)
        for number in range(self._files - 1, 0, -1):
            older = f"{self._path}.{number}"
            with suppress(FileNotFoundError):
                os.replace(self._path if number == 1 else f"{self._path}.{number - 1}", older)


class _Batch(NamedTuple):
    lines: bytes
    number: int  # number of lines


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
        self._pause_ns = RETRY_FIRST_NS
        self._due_ns = 0  # CLOCK_MONOTONIC of the next attempt after a failure
        self._idle = threading.Event()  # set while no batch waits, and after a failure

    def start(self) -> None:
        """Start the thread."""
        self._worker = self._start_worker("influx", self)

    # --- thread of the loop -------------------------------------------------------------------------------------------

    def put(self, lines: bytes, count: int, now_ns: int) -> None:
        """Add lines to the open batch. Drop the oldest batches above the limit of the queue."""
        with self._lock:
            if not self._open:
                self._open_since_ns = now_ns
            self._open.append(lines)
            self._open_count += count
            self._open_bytes += len(lines)
            self._made += count
            is_full = self._open_count >= LINES_MAX or self._open_bytes >= BATCH_BYTES
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
        if not self._problem:
            self._idle.wait(seconds)

    def account(self) -> LineAccount:
        with self._lock:
            flight = 0 if self._flight is None else self._flight.number
            waiting = self._open_count + flight + sum(one.number for one in self._queue)
            return LineAccount(self._made, self._acknowledged, waiting, self._dropped)

    def status(self) -> OutputStatus:
        with self._lock:
            return OutputStatus(self.name, self._acknowledged, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        worker, self._worker = self._worker, None
        is_over = worker is None or worker.end()
        waiting = self.account().waiting
        if waiting:
            log.warning("influx: %s: dropping %d lines at the end", self.name, waiting)
        with self._lock:
            self._dropped += self._open_count + sum(one.number for one in self._queue)
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
            if self._flight is None and self._queue:
                self._flight = self._queue.popleft()
                self._queue_bytes -= len(self._flight.lines)
            batch = self._flight
            if batch is None:
                self._idle.set()
                return IDLE_NS
        try:
            self._delivery.send(batch.lines)
        except RequestRejected as error:
            self._take(batch, 0, f"{error}; imud dropped {batch.number} lines")
        except OSError as error:
            pause_ns, self._pause_ns = self._pause_ns, min(2 * self._pause_ns, RETRY_MOST_NS)
            self._due_ns = self._now_ns() + pause_ns
            self._report(f"{reason_of(error)}; trying again")
            self._idle.set()
            return pause_ns
        else:
            self._take(batch, batch.number, "")
        return 0

    def round_failed(self, error: BaseException) -> None:
        """Report an internal error. The thread has ended, and lines wait until the queue drops them."""
        log.error("influx: %s: internal error", self.name, exc_info=error)
        self._report(f"internal error {type(error).__name__}: {error}")

    def _take(self, batch: _Batch, acknowledged: int, problem: str) -> None:
        """Count the lines of a batch that the receiver accepted or rejected."""
        with self._lock:
            self._acknowledged += acknowledged
            self._dropped += batch.number - acknowledged
            self._flight = None
        self._pause_ns = RETRY_FIRST_NS
        self._report(problem)

    def _report(self, problem: str) -> None:
        with self._lock:
            before, self._problem = self._problem, problem
        if problem and problem != before:
            log.warning("influx: %s: %s", self.name, problem)
        elif before and not problem:
            log.info("influx: %s: works again", self.name)
