"""A recording for one client: blocks go to it through a socket, and it does with them what it likes.

    feed ──put──▶ queue ──once a second, or RING_BYTES──▶ thread: block, compress ──▶ socket ──▶ the client, its file

The daemon opens no file for a client, and never waits for one: the socket is written with MSG_DONTWAIT, and while it
is full records wait in the queue, which is bounded; what has no room there is dropped, and stands in the recording as
lost.
A pipe would not do (`imud.publishers.socket.client` has the reason).
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
BUFFER_BYTES: Final = 1 << 20
"""Asked of the kernel for a socket, which gives what it may: usually 208 KiB (net.core.wmem_max), two blocks."""
CLOSE_TRIES: Final = 10
CLOSE_WAIT_MS: Final = 50
"""When imud stops, a client has half a second to take what waits for it."""
FULL_NS: Final = 20 * NS_PER_MS
"""A socket that is full is looked at again after so long: at 208 KiB, 10 MB/s."""
LINGER_NS: Final = 10 * NS_PER_S
"""After the end of a recording a client that takes nothing for so long has lost the rest."""


def stream_pair() -> tuple[socket.socket, socket.socket]:
    """Make the daemon's end, which takes nothing in, and the client's. Raises OSError."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    ours.shutdown(socket.SHUT_RD)
    return ours, theirs


class LastRecords(NamedTuple):
    """The mark at the end of a recording."""

    records: bytes
    """Whole records, for which there is always room."""


class BlockSender:
    """The daemon's end of a client's socket. It closes the socket. Synchronization: one thread at a time."""

    def __init__(self, sock: socket.socket, now_ns: Callable[[], int]) -> None:
        self.sent_bytes = 0
        self.ended = False
        """Whether the socket is closed: all was sent, or the client has closed its end or reads no more."""
        self._sock = sock
        self._now_ns = now_ns
        self._rest = memoryview(b"")
        self._moved_ns = now_ns()
        """When the socket took something last."""

    def send(self, block: bytes = b"") -> bool:
        """Send what is left of the block before and then this one; return whether all is sent.

        Give the next block only when it is; a client that has closed its end takes everything.
        """
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
        except OSError:  # closed by the client
            self.close()
        return True

    @property
    def is_stuck(self) -> bool:
        """Whether the client has taken nothing for LINGER_NS."""
        return bool(self._rest) and self._now_ns() - self._moved_ns >= LINGER_NS

    def close(self) -> None:
        """Close the socket: the client reads what is in it, then end of file; may be called twice."""
        self.ended = True
        self._rest = memoryview(b"")
        self._sock.close()


class StreamWriter:
    """The thread of a recording for a client. Synchronization: `ended` and `failure` are read by any thread."""

    def __init__(
        self, queue: RecordQueue[LastRecords], sock: socket.socket, now_ns: Callable[[], int], start_worker: StartWorker
    ) -> None:
        self.failure: BaseException | None = None
        """The exception that ended the thread, which is an internal error."""
        self._queue = queue
        self._sock = sock
        self._sender = BlockSender(sock, now_ns)
        self._gatherer = BlockGatherer()
        self.is_ending = False
        """Whether the last records wait in the queue, or are gathered: set by the loop."""
        self._is_last = False
        """Whether all records are gathered."""
        self._hurry = False
        self._worker = start_worker("record", self._round, self._failed)
        queue.ring = self._worker.ring

    @property
    def ended(self) -> bool:
        """Whether nothing is sent any more: all was, or the client has gone."""
        return self._sender.ended

    def close(self, *, flush: bool) -> None:
        """End the thread; with `flush` the client has a moment to take what waits. May be called twice."""
        self._queue.ring = lambda: None
        self._hurry = True
        self._worker.end()
        self._hurry = False
        poll = select.poll()
        for _ in range(CLOSE_TRIES if flush else 0):
            self._round()
            if self.ended:
                break
            poll.register(self._sock, select.POLLOUT)
            poll.poll(CLOSE_WAIT_MS)
        self._sender.close()

    def _round(self) -> int:
        """Send what waits, as far as the socket takes it; return the time until the next round, ns."""
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

    def _failed(self, error: BaseException) -> None:
        self.failure = error


class ClientRecording:
    """A recording that a client asked for. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        context: PublisherContext,
        devices: Collection[str] | None,
        sock: socket.socket,
        start_worker: StartWorker = BusThread,
    ) -> None:
        """`devices` are names, None for all; `sock` is the daemon's end of the client's socket."""
        self._queue = RecordQueue[LastRecords]()
        self._feed = RecordFeed(context, self._queue, devices)
        self._writer = StreamWriter(self._queue, sock, context.clock.now_ns, start_worker)
        self._stopped = False
        self._feed.put(self._feed.session(0, context.clock.now_ns()))
        self._feed.describe(at_once=True)
        self._feed.follow()

    @property
    def records_dropped(self) -> int:
        """Records that had no room, because the client does not read."""
        return self._queue.dropped

    @property
    def ended(self) -> bool:
        """Whether it is over, and `close` may be called: all is sent, or the client has gone."""
        return self._writer.ended

    def add_device(self, name: str, device_id: int) -> None:
        """Note a device, which is recorded if it was asked for."""
        self._feed.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """Forget a device that left the configuration."""
        self._feed.remove_device(name)

    def event(self, event: Event) -> None:
        """Record an event."""
        if not self._stopped:
            self._feed.event(event)

    def tick(self, now_ns: int) -> None:
        """Record devices that are new, checks, and losses. Raises what ended the thread."""
        if self._writer.failure is not None:
            raise self._writer.failure
        if not self._stopped:
            self._feed.follow()
            self._feed.note_losses(now_ns)
            self._feed.check_if_due(now_ns)

    def stop(self, reason: str) -> None:
        """End the recording regularly; what waits is still sent. No-op if stopped."""
        if self._stopped:
            return
        self._stopped = True
        self._queue.mark(LastRecords(self._feed.finish(reason)))
        self._writer.is_ending = True

    def close(self, *, flush: bool = False) -> None:
        """End it; with `flush` a client has a moment to take what waits. May be called twice."""
        self._stopped = True
        self._feed.stop()
        self._writer.close(flush=flush)
