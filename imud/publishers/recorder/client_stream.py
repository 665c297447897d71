"""Recording for one client: imud sends the blocks of the recording through a socket.

    feed ──put──▶ queue ──once a second, or RING_BYTES──▶ thread: block, compress ──▶ socket ──▶ the client, its file

The daemon opens no file for a client and never waits for a client. It writes the socket with MSG_DONTWAIT. If the
socket is full, records wait in the queue. If the queue is full, imud drops records and marks the loss in the recording.
A pipe cannot replace the socket: `imud.publishers.socket.client` contains the reason.
"""

import select
import socket
from collections.abc import Callable, Collection
from typing import Final, NamedTuple

from imud.contracts.publisher import PublisherContext
from imud.formats.recording import BlockGatherer
from imud.host.threads import BusThread, StartWorker
from imud.model.event import Event
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.recorder.writer import WRITE_NS, RecordFeed, RecordQueue

FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
# Requested size of the socket buffer, bytes. The kernel limits it, usually to 208 KiB (net.core.wmem_max), two blocks.
BUFFER_BYTES: Final = 1 << 20
CLOSE_TRIES: Final = 10
# Interval of the checks during half a second in which a client can receive waiting records when imud ends, ms
CLOSE_WAIT_MS: Final = 50
FULL_NS: Final = 20 * NS_PER_MS  # time between two attempts on a full socket, ns: 10 MB/s with 208 KiB
LINGER_NS: Final = 10 * NS_PER_S  # time without progress after which a client loses the rest of an ended recording, ns


def stream_pair() -> tuple[socket.socket, socket.socket]:
    """Return the end of the daemon, which receives nothing, and the end of the client. Raises OSError."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    ours.shutdown(socket.SHUT_RD)
    return ours, theirs


class LastRecords(NamedTuple):
    """Mark at the end of a recording."""

    records: bytes  # complete records, for which there is always room


class BlockSender:
    """Daemon's end of a client's socket. This class closes the socket. Synchronization: one thread at a time."""

    def __init__(self, sock: socket.socket, now_ns: Callable[[], int]) -> None:
        self.sent_bytes = 0
        self.ended = False  # True if the socket is closed: all blocks were sent, or the client disconnected
        self._sock = sock
        self._now_ns = now_ns
        self._rest = memoryview(b"")
        self._moved_ns = now_ns()  # time of the last progress

    def send(self, block: bytes = b"") -> bool:
        """Send the rest of the previous block and then `block`. Return whether all is sent. Do not give the next block
        before. Data for a disconnected client is discarded."""
        if block:
            self._rest = memoryview(block)
        try:
            while self._rest:
                count = self._sock.send(self._rest, FLAGS)
                self._rest = self._rest[count:]
                self.sent_bytes += count
                self._moved_ns = self._now_ns()
        except BlockingIOError:
            return False
        except OSError:  # the client closed its end
            self.close()
        return True

    @property
    def is_stuck(self) -> bool:
        """Return whether the client made no progress for LINGER_NS."""
        return bool(self._rest) and self._now_ns() - self._moved_ns >= LINGER_NS

    def close(self) -> None:
        """Close the socket. The client reads the buffered data, then end of file. A second call does nothing."""
        self.ended = True
        self._rest = memoryview(b"")
        self._sock.close()


class StreamWriter:
    """Thread of a recording for a client. Synchronization: any thread may read `ended` and `failure`."""

    def __init__(
        self, queue: RecordQueue[LastRecords], sock: socket.socket, now_ns: Callable[[], int], start_worker: StartWorker
    ) -> None:
        self.failure: BaseException | None = None  # internal error that ended the thread
        self._queue = queue
        self._sock = sock
        self._sender = BlockSender(sock, now_ns)
        self._gatherer = BlockGatherer()
        self.is_ending = False  # True if the last records are in the queue; set by the event loop
        self._is_last = False  # True if the last records are in the present block
        self._hurry = False
        self._worker = start_worker("record", self)
        queue.ring = self._worker.ring

    @property
    def ended(self) -> bool:
        """Return whether the recording has ended: all records were sent, or the client disconnected."""
        return self._sender.ended

    def close(self, *, flush: bool) -> None:
        """End the thread. With `flush`, give the client a short time to read. A second call does nothing."""
        self._queue.ring = lambda: None
        self._hurry = True
        self._worker.end()
        self._hurry = False
        poll = select.poll()
        for _ in range(CLOSE_TRIES if flush else 0):
            self.do_round()
            if self.ended:
                break
            poll.register(self._sock, select.POLLOUT)
            poll.poll(CLOSE_WAIT_MS)
        self._sender.close()

    def do_round(self) -> int:
        """Send waiting records until the socket is full. Return the time until the next round, ns."""
        sender = self._sender
        while not (self._hurry or sender.ended):
            if not sender.send():
                if self.is_ending and sender.is_stuck:
                    sender.close()
                return FULL_NS
            if self._is_last:
                sender.close()
                break
            item = self._queue.take()
            if isinstance(item, LastRecords):
                self._is_last = True
                block = self._gatherer.add(item.records) + self._gatherer.finish()
            else:
                block = self._gatherer.finish() if item is None else self._gatherer.add(item)
            if block:
                sender.send(block)
            elif item is None:
                break
        return WRITE_NS

    def round_failed(self, error: BaseException) -> None:
        self.failure = error


class ClientRecording:
    """Recording for a client. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        context: PublisherContext,
        devices: Collection[str] | None,
        sock: socket.socket,
        start_worker: StartWorker = BusThread,
    ) -> None:
        """`devices` are device names, None for all. `sock` is the daemon's end of the client's socket."""
        self._queue = RecordQueue[LastRecords]()
        self._feed = RecordFeed(context, self._queue, devices)
        self._writer = StreamWriter(self._queue, sock, context.clock.now_ns, start_worker)
        self._stopped = False
        self._feed.put(self._feed.session(0, context.clock.now_ns()))
        self._feed.describe(at_once=True)
        self._feed.follow()

    @property
    def records_dropped(self) -> int:
        """Return the number of records that imud dropped because the client was too slow."""
        return self._queue.dropped

    @property
    def ended(self) -> bool:
        """Return whether `close` may be called: all records were sent, or the client disconnected."""
        return self._writer.ended

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. Record it if the client selected it."""
        self._feed.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        self._feed.remove_device(name)

    def event(self, event: Event) -> None:
        if not self._stopped:
            self._feed.event(event)

    def tick(self, now_ns: int) -> None:
        """Record new devices, checks and losses. Raises the exception that ended the thread."""
        if self._writer.failure is not None:
            raise self._writer.failure
        if not self._stopped:
            self._feed.follow()
            self._feed.note_losses(now_ns)
            self._feed.check_if_due(now_ns)

    def stop(self, reason: str) -> None:
        """End the recording with its end record. imud still sends waiting records. A second call does nothing."""
        if self._stopped:
            return
        self._stopped = True
        self._queue.mark(LastRecords(self._feed.finish(reason)))
        self._writer.is_ending = True

    def close(self, *, flush: bool = False) -> None:
        """Close the recording. With `flush`, give the client a short time to read. A second call does nothing."""
        self._stopped = True
        self._feed.stop()
        self._writer.close(flush=flush)
