"""Sends to one client: straight from `publish` while its socket has room, through a bounded queue while it has not.

Goal: at 1 kHz one `send` per client and batch is the whole cost. A client with nothing queued gets the bytes that all
clients share, in one system call; a queue, and a writer in the event loop, exist only while a socket is full.

Order is kept. Two queues hold what waits, joined by an order number, because they are bounded differently: samples go
oldest first when there are too many, replies never, but a client for which too many gather is disconnected. A message
that was sent in part is finished before anything else and cannot be dropped.
"""

import array
import asyncio
import socket
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from imud.publishers.socket.encoding import Encoding

CHUNK_BYTES: Final = 32768
"""Queued messages are sent together up to this size: what a socket buffer of the usual 208 KiB takes at once."""
NO_FD: Final = -1


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may wait for one client."""

    samples: int
    sample_bytes: int
    replies: int = 1024
    reply_bytes: int = 1 << 20


class Outbox:
    """The sending side of one non-blocking socket. Synchronization: the event loop's thread.

    `on_broken` is called with the reason when the socket fails, `on_flooded` when more replies wait than may,
    `on_empty` when all that waited is sent.
    """

    __slots__ = (
        "_limits", "_loop", "_on_broken", "_on_empty", "_on_flooded", "_order", "_partial", "_partial_fd", "_replies",
        "_reply_bytes", "_sample_bytes", "_samples", "_send", "_sock", "_unreported", "dropped", "sent", "waiting",
    )  # fmt: skip

    def __init__(
        self,
        sock: socket.socket,
        limits: Limits,
        on_broken: Callable[[str], None],
        on_flooded: Callable[[], None],
        on_empty: Callable[[], None],
    ) -> None:
        self.sent = 0
        """Samples given to the socket."""
        self.dropped = 0
        """Samples dropped."""
        self.waiting = False
        """Whether anything waits; then everything new has to wait behind it."""
        self._sock = sock
        self._send = sock.send
        self._limits = limits
        self._on_broken = on_broken
        self._on_flooded = on_flooded
        self._on_empty = on_empty
        self._loop = asyncio.get_running_loop()
        self._order = 0
        self._samples: deque[tuple[int, bytes, str, Encoding]] = deque()
        self._sample_bytes = 0
        self._replies: deque[tuple[int, bytes, int]] = deque()
        self._reply_bytes = 0
        self._partial = b""
        self._partial_fd = NO_FD
        self._unreported: dict[str, int] = {}
        """Samples dropped per device that no message has reported to the client yet."""

    @property
    def queue_samples(self) -> int:
        """Whole samples that wait."""
        return len(self._samples)

    @property
    def queue_replies(self) -> int:
        """Whole messages other than samples that wait."""
        return len(self._replies)

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait."""
        return self._sample_bytes + self._reply_bytes + len(self._partial)

    @staticmethod
    def put_samples(outboxes: Iterable["Outbox"], messages: Sequence[bytes], device: str, encoding: Encoding) -> None:
        """Send samples of one device to several clients: the same bytes, one `send` each.

        The loop is in here because a call per client would cost as much as all the rest around `send`.
        """
        whole = messages[0] if len(messages) == 1 else b"".join(messages)
        size, samples = len(whole), len(messages)
        for outbox in outboxes:
            if outbox.waiting:
                outbox._queue_samples(messages, device, encoding)
                continue
            try:
                count = outbox._send(whole)
            except BlockingIOError:
                count = 0
            except OSError as error:
                outbox._on_broken(str(error))
                continue
            if count == size:
                outbox.sent += samples
            else:
                outbox._keep_rest(count, messages, device, encoding)

    def put_reply(self, message: bytes, fd: int = NO_FD) -> None:
        """Send anything that is not a sample; with `fd`, a copy of that descriptor goes with its first byte."""
        self._order += 1
        self._replies.append((self._order, message, fd))
        self._reply_bytes += len(message)
        if not self.waiting:
            self._flush()
        elif len(self._replies) > self._limits.replies or self._reply_bytes > self._limits.reply_bytes:
            self._on_flooded()

    def close(self) -> None:
        """Drop everything that waits; the owner closes the socket."""
        if self._sock.fileno() >= 0:
            self._loop.remove_writer(self._sock)
        self.waiting = False
        self._samples.clear()
        self._replies.clear()
        self._partial = b""
        self._sample_bytes = self._reply_bytes = 0

    # --- queueing ---------------------------------------------------------------------------------------------------

    def _keep_rest(self, count: int, messages: Sequence[bytes], device: str, encoding: Encoding) -> None:
        """The socket took `count` bytes of `messages`: keep the rest, the cut message apart."""
        whole = 0
        while count >= len(messages[whole]):
            count -= len(messages[whole])
            whole += 1
        if count:
            self._partial = messages[whole][count:]
            whole += 1
        self.sent += whole
        self._queue_samples(messages[whole:], device, encoding)
        self._wait()

    def _queue_samples(self, messages: Sequence[bytes], device: str, encoding: Encoding) -> None:
        queue = self._samples
        for message in messages:
            self._order += 1
            queue.append((self._order, message, device, encoding))
            self._sample_bytes += len(message)
        while queue and (len(queue) > self._limits.samples or self._sample_bytes > self._limits.sample_bytes):
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        _, message, device, _ = self._samples.popleft()
        self._sample_bytes -= len(message)
        self._unreported[device] = self._unreported.get(device, 0) + 1
        self.dropped += 1

    def _wait(self) -> None:
        if not self.waiting:
            self.waiting = True
            self._loop.add_writer(self._sock, self._flush)

    # --- sending what waited ----------------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Send until all is sent or the socket is full."""
        try:
            while self._partial or self._next():
                count = self._send_partial()
                self._partial = self._partial[count:]
        except BlockingIOError:
            self._wait()
        except OSError as error:
            self._on_broken(str(error))
        else:
            if self.waiting:
                self.waiting = False
                self._loop.remove_writer(self._sock)
                self._on_empty()

    def _send_partial(self) -> int:
        if self._partial_fd == NO_FD:
            return self._send(self._partial)
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [self._partial_fd]))
        count = self._sock.sendmsg([self._partial], [rights])
        self._partial_fd = NO_FD  # it went with the first byte
        return count

    def _next(self) -> bool:
        """Move what is sent next into `_partial`: some messages, or one reply with its descriptor. False if none is."""
        chunk: list[bytes] = []
        size = 0
        samples, replies = self._samples, self._replies
        while size < CHUNK_BYTES and (samples or replies):
            if replies and (not samples or replies[0][0] < samples[0][0]):
                if replies[0][2] != NO_FD and chunk:
                    break
                chunk.append(self._next_reply())
                if self._partial_fd != NO_FD:
                    break
            else:
                chunk.append(self._next_sample())
            size += len(chunk[-1])
        self._partial = b"".join(chunk)
        return bool(chunk)

    def _next_reply(self) -> bytes:
        _, message, self._partial_fd = self._replies.popleft()
        self._reply_bytes -= len(message)
        return message

    def _next_sample(self) -> bytes:
        _, message, device, encoding = self._samples.popleft()
        self._sample_bytes -= len(message)
        self.sent += 1
        if self._unreported:
            message = encoding.with_dropped(message, device, self._unreported)
            self._unreported.clear()
        return message
