"""Sends to one client: directly from `publish` while its socket has room, otherwise through a bounded queue.

At 1 kHz one `send` per client and batch is the complete cost: a client without a queue gets the bytes that all clients
share. A queue exists only while a socket is full, or if `publish` has used up its time. The scheduler sends it.

The order of messages is kept. Samples and replies wait in two queues with common order numbers, because their bounds
differ. imud drops the oldest samples, but never a reply: it disconnects a client with too many replies. imud finishes a
partly sent message before all others and never drops it. The queue of samples contains deliveries, which the clients
of one form share: messages, or a batch that `publish` had no time to encode.
"""

import array
import os
import socket
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

from imud.attitude.conventions import Convention
from imud.contracts.publisher import Batch
from imud.formats import kernel
from imud.formats.jsonrpc import FRAME_HEADER, encode, encode_notification, frame_of, line_of, with_texts
from imud.formats.slot import SLOT_BYTES, EqualPieces, slots_in
from imud.model.errors import reason_of
from imud.model.sample import Sample

ALWAYS_FIELDS: Final = ("device", "seq", "t_ns")
"""Members of every JSON sample, for any selection of fields: they identify the sample."""
MESSAGE_GUESS_BYTES: Final = 700
"""Size of a JSON sample with all values of an HI91 frame."""
_HEAD: Final = b'{"jsonrpc":"2.0","method":"sample","params":'
_TAIL: Final = b"}"
_SLOT_HEADER: Final = FRAME_HEADER.pack(SLOT_BYTES)
_FRAMED_BYTES: Final = FRAME_HEADER.size + SLOT_BYTES


class Encoding(ABC):
    """Base class of the encodings of samples. A message contains one sample, so that a queue can drop one sample."""

    message_bytes: int  # size of the last message; an estimate before the first

    def __init__(self, convention: Convention | None = None) -> None:
        """Convert samples to `convention` if it is not None."""
        self._convention = convention

    @abstractmethod
    def encode(self, batch: Batch) -> Sequence[bytes]:
        """Return a message for each sample of the batch."""

    @abstractmethod
    def encode_one(self, batch: Batch, index: int) -> bytes:
        """Return a message for one sample of the batch."""

    @abstractmethod
    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Add the numbers of samples dropped before `message`, by device. `device` is the device of `message`."""


class JsonEncoding(Encoding):
    """`sample` notifications with all members or with selected members, as lines or as frames."""

    def __init__(
        self, fields: tuple[str, ...] | None, framed: bool, texts: bool = False, convention: Convention | None = None
    ) -> None:
        """Write integers that may exceed 2⁵³ as strings if `texts` is true."""
        super().__init__(convention)
        self._texts = texts
        self._wrap = frame_of if framed else line_of
        self._select = None if fields is None else selector(fields)
        self.message_bytes = MESSAGE_GUESS_BYTES

    def encode(self, batch: Batch) -> list[bytes]:
        if self._convention is not None:
            batch = batch.converted(self._convention)
        messages = [self._message(sample) for sample in batch.samples]
        self.message_bytes = len(messages[-1])
        return messages

    def encode_one(self, batch: Batch, index: int) -> bytes:
        if self._convention is not None:
            batch = batch.converted(self._convention)
        message = self._message(batch.samples[index])
        self.message_bytes = len(message)
        return message

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        notices = [_dropped_notice(name, count, self._wrap) for name, count in dropped.items() if name != device]
        own = dropped.get(device)
        if own is not None:  # a member of the sample itself
            body = message[message.index(_HEAD) :].rstrip(b"\n")
            message = self._wrap(b'%b,"dropped":%d}}' % (body[:-2], own))
        return b"".join((*notices, message))

    def _message(self, sample: Sample) -> bytes:
        selected: object = self._select(sample) if self._select else sample
        return self._wrap(_HEAD + encode(with_texts(selected) if self._texts else selected) + _TAIL)


class BinaryEncoding(Encoding):
    """Frames with one slot each."""

    message_bytes = _FRAMED_BYTES

    def encode(self, batch: Batch) -> Sequence[bytes]:
        if self._convention is not None:
            batch = batch.converted(self._convention)
        packed = batch.packed
        if len(packed) == SLOT_BYTES:  # the usual case: faster than a list comprehension
            return [_SLOT_HEADER + packed]
        if kernel.present.module is not None:
            return EqualPieces(kernel.present.module.frame_slots(packed), _FRAMED_BYTES)
        return [_SLOT_HEADER + slot for (slot,) in slots_in(packed)]

    def encode_one(self, batch: Batch, index: int) -> bytes:
        if self._convention is not None:
            batch = batch.converted(self._convention)
        return _SLOT_HEADER + batch.packed[index * SLOT_BYTES : (index + 1) * SLOT_BYTES]

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        return b"".join((*(_dropped_notice(name, count, frame_of) for name, count in dropped.items()), message))


def selector(fields: tuple[str, ...]) -> Callable[[Sample], dict[str, object]]:
    """Return a function that returns the selected members and ALWAYS_FIELDS of a sample, without absent members."""
    names = tuple(dict.fromkeys((*ALWAYS_FIELDS, *fields)))
    values = attrgetter(*names)

    def select(sample: Sample) -> dict[str, object]:
        pairs = zip(names, values(sample), strict=True)
        return {name: value for name, value in pairs if value is not None}

    return select


def _dropped_notice(device: str, count: int, wrap: Callable[[bytes], bytes]) -> bytes:
    return wrap(encode_notification("dropped", {"device": device, "dropped": count}))


CHUNK_BYTES: Final = 32768
"""Size at which a piece of the queue is complete. A socket buffer of the usual 208 KiB has room for it."""
SAMPLE_BYTES: Final = 300
"""Memory of a queued sample without its message. Clients of one form share most of it."""
REPLY_BYTES: Final = 200
"""Memory of the objects around a queued reply."""
NO_FD: Final = -1


@dataclass(frozen=True, slots=True)
class Limits:
    """Maximum queue of one client."""

    samples: int
    sample_bytes: int
    replies: int = 1024
    reply_bytes: int = 1 << 20


class Delivery:
    """Samples of one batch in one form, all or the `chosen` indices. The first client that sends it encodes it.

    A delivery with messages does not refer to the batch. A sample consists of about 30 small objects, and the
    interpreter keeps their memory until it ends. 20 clients of 100 devices that read nothing for 8 s would cost 29 MB
    as samples, and cost 11 MB as messages.
    """

    __slots__ = ("_batch", "_chosen", "_messages", "count", "device", "each_bytes", "encoding", "order")

    def __init__(
        self,
        order: int,
        batch: Batch,
        encoding: Encoding,
        messages: Sequence[bytes] | None,
        chosen: Sequence[int] | None = None,
    ) -> None:
        self.order = order
        self.device = batch.device
        self.encoding = encoding
        self._batch = batch if messages is None else None
        self._chosen = chosen
        self.count = len(batch) if chosen is None else len(chosen)
        self._messages = messages
        # memory of a sample with its message; with the size of the last message before encoding
        self.each_bytes = SAMPLE_BYTES + (encoding.message_bytes if messages is None else len(messages[0]))

    def messages(self) -> Sequence[bytes]:
        if self._messages is None:
            encoding, batch = self.encoding, self._batch
            assert batch is not None
            if self._chosen is None:
                self._messages = encoding.encode(batch)
            else:
                self._messages = [encoding.encode_one(batch, index) for index in self._chosen]
            self._batch = None
        return self._messages


class Pool:
    """All memory that imud holds for clients: half of `limit_bytes` for samples, half for everything else.

    Samples: three eighths of the limit, in equal shares for the clients with a queue. The share shrinks with each
    client that begins to queue. If the queued samples reach half of the limit, all clients lose the samples above their
    share.

    Everything else: replies, partly sent messages, requests that are not carried out yet, unfinished replies. Above
    half of the limit, imud evicts clients: of the user with the most memory, the client with the highest product of
    memory and time without progress. Thus a client that reads a large reply stays, and a client that does not read is
    evicted. The time is the number of progress events of all clients, so that no clock is necessary.
    """

    def __init__(self, limit_bytes: int, limits: Limits) -> None:
        self.limits = limits
        self._share_bytes = limit_bytes * 3 // 8
        self._half_bytes = limit_bytes // 2
        self._waiting: dict[Outbox, None] = {}
        self._holding: dict[Outbox, None] = {}  # clients with memory other than samples
        self._sample_bytes = 0
        self._other_bytes = 0
        self._order = 0
        self._progress = 0

    def next_order(self) -> int:
        """Return the order number of the next queued message. The numbers of all clients ascend."""
        self._order += 1
        return self._order

    def next_progress(self) -> int:
        self._progress += 1
        return self._progress

    @property
    def held_bytes(self) -> int:
        return self._sample_bytes + self._other_bytes

    @property
    def share_bytes(self) -> int:
        """Maximum memory of the queued samples of one client."""
        return self._share_bytes // (len(self._waiting) or 1)

    def add(self, outbox: "Outbox") -> None:
        """Add a client with a queue."""
        self._waiting[outbox] = None

    def remove(self, outbox: "Outbox") -> None:
        """Remove a client whose queue is empty."""
        self._waiting.pop(outbox, None)

    def count_samples(self, size_bytes: int) -> None:
        """Add to the memory of queued samples; subtract if negative."""
        self._sample_bytes += size_bytes

    def count_others(self, outbox: "Outbox", size_bytes: int) -> None:
        """Add to the other memory of a client; subtract if negative."""
        self._other_bytes += size_bytes
        if outbox.held_bytes:
            self._holding[outbox] = None
        else:
            self._holding.pop(outbox, None)

    def evict(self) -> None:
        """Evict clients until the memory other than samples is within its half.

        Do not call this method while `put_samples` sends to a list of clients: it could close one of them.
        """
        while self._other_bytes > self._half_bytes and self._holding:
            worst = self._worst()
            del self._holding[worst]
            worst.evict(HOLDS_TOO_MUCH)

    def trim(self) -> None:
        """Drop the samples of clients above their share."""
        for outbox in self._waiting:
            outbox.trim()

    def trim_if_full(self) -> None:
        """Call `trim` if the queued samples exceed half of the limit."""
        # rare: it frees an eighth of the limit
        if self._sample_bytes > self._half_bytes:
            self.trim()

    def _worst(self) -> "Outbox":
        users: Counter[int] = Counter()
        for outbox in self._holding:
            users[outbox.uid] += outbox.held_bytes
        uid = max(users, key=users.__getitem__)
        progress = self._progress
        return max(
            (outbox for outbox in self._holding if outbox.uid == uid),
            key=lambda outbox: outbox.held_bytes * (progress - outbox.progress + 1),
        )


HOLDS_TOO_MUCH: Final = "its unread replies and unfinished requests occupy too much memory"


class Outbox(ABC):
    """Base class of a client: the sending side of its non-blocking socket.

    Synchronization: the event loop's thread.
    """

    # an object with more than 30 attributes is slower without slots
    __slots__ = (
        "_fd", "_limits", "_partial", "_partial_fd", "_pool", "_replies", "_request_bytes", "_sample_bytes",
        "_sample_count", "_samples", "_send", "_skip", "_sock", "_unreported", "dropped", "held_bytes", "progress",
        "reply_bytes", "sent", "uid", "waiting",
    )  # fmt: skip

    def __init__(self, sock: socket.socket, pool: Pool, uid: int) -> None:
        self.uid = uid
        self.sent = 0  # number of samples passed to the socket
        self.dropped = 0  # number of dropped samples
        self.waiting = False  # whether anything is queued; then imud appends new messages to the queue
        self.reply_bytes = 0  # size of the queued replies
        self.held_bytes = 0  # memory held for the client without samples, as counted in the pool
        self.progress = 0  # count of the pool at the last progress of this client
        self._request_bytes = 0
        self._sock = sock
        # `write` needs 15 % fewer instructions than `socket.send`. Python ignores SIGPIPE, so it also raises EPIPE.
        self._send: Callable[[int, bytes], int] = os.write
        self._fd = sock.fileno()  # -1 after `discard`, because another socket can get the number
        self._limits = pool.limits
        self._pool = pool
        self._samples: deque[Delivery] = deque()
        self._skip = 0  # number of samples of the first delivery that are already sent or dropped
        self._sample_count = 0
        self._sample_bytes = 0
        self._replies: deque[tuple[int, bytes, int]] = deque()
        self._partial = b""  # unsent rest of a message, or messages taken from the queues
        self._partial_fd = NO_FD
        # number of dropped samples per device that no message has reported to the client yet
        self._unreported: dict[str, int] = {}

    @abstractmethod
    def on_broken(self, reason: str) -> None:
        """End the connection because the socket failed. `put_samples` calls this method while it sends to others."""

    @abstractmethod
    def evict(self, reason: str) -> None:
        """End the connection because the client exceeded a limit."""

    @abstractmethod
    def on_full(self) -> None:
        """Call `flush` when the socket is writable."""

    @abstractmethod
    def on_deferred(self) -> None:
        """Call `flush` when there is time. The socket may have room."""

    @abstractmethod
    def on_emptied(self) -> None:
        """Note that the queue is sent completely."""

    @property
    def queue_samples(self) -> int:
        """Number of completely queued samples."""
        return self._sample_count

    @property
    def queue_bytes(self) -> int:
        return self._sample_bytes + self.reply_bytes + len(self._partial)

    @staticmethod
    def put_samples(
        outboxes: Iterable["Outbox"], messages: Sequence[bytes], batch: Batch, encoding: Encoding,
        chosen: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Send samples of one device to several clients: the same bytes, one `send` each."""
        # one loop here: a method call per client would cost as much as all other code around `send`
        if type(messages) is EqualPieces:
            whole, samples = messages.whole, messages.number
        else:
            samples = len(messages)
            whole = messages[0] if samples == 1 else b"".join(messages)
        size = len(whole)
        delivery: Delivery | None = None
        for outbox in outboxes:
            if outbox.waiting:
                delivery = delivery or Delivery(outbox._pool.next_order(), batch, encoding, messages, chosen)
                outbox._queue_samples(delivery)
                continue
            send = outbox._send
            try:
                count = send(outbox._fd, whole)
            except BlockingIOError:
                count = 0
            except OSError as error:
                outbox.on_broken(reason_of(error))
                continue
            if count == size:
                outbox.sent += samples
            else:
                delivery = delivery or Delivery(outbox._pool.next_order(), batch, encoding, messages, chosen)
                outbox._queue_rest(count, delivery)

    def defer(self, delivery: Delivery) -> None:
        """Queue samples because `publish` has no more time. The scheduler sends them."""
        self._queue_samples(delivery)
        if not self.waiting:
            self._wait()
            self.on_deferred()

    def put_reply(self, message: bytes, fd: int = NO_FD) -> None:
        """Send a message other than a sample, and a copy of the descriptor `fd` with its first byte if given."""
        if not self.waiting:
            self._partial, self._partial_fd = message, fd
            self.flush()
            return
        self._replies.append((self._pool.next_order(), message, fd))
        self.reply_bytes += len(message)
        self._count_held()
        if len(self._replies) > self._limits.replies or self.reply_bytes > self._limits.reply_bytes:
            self.evict(HOLDS_TOO_MUCH)
        else:
            self._pool.evict()

    def set_request_bytes(self, size_bytes: int) -> None:
        """Set the memory of the client's input and of its unfinished reply."""
        if size_bytes != self._request_bytes:
            self._request_bytes = size_bytes
            self.progress = self._pool.next_progress()
            self._count_held()
            self._pool.evict()

    def trim(self) -> None:
        """Drop the oldest samples above the limit: complete deliveries, but single samples of the last delivery."""
        limits, samples = self._limits, self._samples
        most_bytes = min(limits.sample_bytes, self._pool.share_bytes)
        while self._sample_count > limits.samples or self._sample_bytes > most_bytes:
            delivery = samples[0]
            if len(samples) == 1:
                count = 1
                self._take_sample()
            else:
                count = delivery.count - self._skip
                samples.popleft()
                self._skip = 0
                self._count_samples(-count, delivery)
            device = delivery.device
            self._unreported[device] = self._unreported.get(device, 0) + count
            self.dropped += count

    def discard(self) -> None:
        """Discard the queue, because the connection ends."""
        was_waiting, self.waiting = self.waiting, False
        self._fd = -1
        self._samples.clear()
        self._replies.clear()
        self._partial = b""
        self.reply_bytes = self._request_bytes = 0
        if was_waiting:
            self._pool.remove(self)
            self._pool.count_samples(-self._sample_bytes)
            self._sample_bytes = self._sample_count = 0
        if self.held_bytes:
            self._count_held()

    # --- queueing ---------------------------------------------------------------------------------------------------

    def _queue_rest(self, count: int, delivery: Delivery) -> None:
        """Queue the rest of a delivery. The socket took its first `count` bytes."""
        messages = delivery.messages()
        whole = 0
        while count >= len(messages[whole]):
            count -= len(messages[whole])
            whole += 1
        if count:
            self._partial = messages[whole][count:]
            whole += 1
        self.sent += whole
        if whole < len(messages):
            self._skip = whole
            self._count_samples(-whole, delivery)
            self._queue_samples(delivery)
        self._wait()
        self._count_held()
        self.on_full()

    def _queue_samples(self, delivery: Delivery) -> None:
        self._samples.append(delivery)
        self._count_samples(delivery.count, delivery)
        limits, size_bytes = self._limits, self._sample_bytes
        if self._sample_count > limits.samples or size_bytes > min(limits.sample_bytes, self._pool.share_bytes):
            self.trim()
        self._pool.trim_if_full()

    def _count_samples(self, count: int, delivery: Delivery) -> None:
        """Add samples of a delivery to the queue; subtract if negative."""
        size_bytes = count * delivery.each_bytes
        self._sample_count += count
        self._sample_bytes += size_bytes
        self._pool.count_samples(size_bytes)

    def _count_held(self) -> None:
        """Update the memory without samples in the pool."""
        held = self.reply_bytes + REPLY_BYTES * len(self._replies) + len(self._partial) + self._request_bytes
        change = held - self.held_bytes
        if change:
            if not self.held_bytes:
                self.progress = self._pool.next_progress()
            self.held_bytes = held
            self._pool.count_others(self, change)

    def _take_sample(self) -> tuple[Delivery, int]:
        """Remove the oldest sample from the queue. Return its delivery and its index."""
        delivery, place = self._samples[0], self._skip
        self._count_samples(-1, delivery)
        self._skip += 1
        if self._skip == delivery.count:
            self._samples.popleft()
            self._skip = 0
        return delivery, place

    def _wait(self) -> None:
        if not self.waiting:
            self.waiting = True
            self._pool.add(self)

    # --- sending the queue ------------------------------------------------------------------------------------------

    def flush(self) -> bool:
        """Send one piece of the queue. Return whether the queue contains more and the socket may have room."""
        try:
            if not self._partial and not self._next():
                self._emptied()
                return False
            if self._partial_fd == NO_FD:
                count = self._send(self._fd, self._partial)
            else:
                rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [self._partial_fd]))
                count = self._sock.sendmsg([self._partial], [rights])
                self._partial_fd = NO_FD  # sent with the first byte
        except BlockingIOError:
            self._keep(self.on_full)
            return False
        except OSError as error:
            self.on_broken(reason_of(error))
            return False
        self._partial = self._partial[count:]
        if self._partial or self._samples or self._replies:
            self.progress = self._pool.next_progress()
            self._keep(self.on_deferred)
            return self.waiting
        if self.waiting:
            self._emptied()
        return False

    def _keep(self, report: Callable[[], None]) -> None:
        """Keep the unsent rest, call `report`, and evict clients if their memory exceeds the limit."""
        self._wait()
        self._count_held()
        report()
        self._pool.evict()

    def _emptied(self) -> None:
        self.waiting = False
        self._pool.remove(self)
        self._count_held()
        self.on_emptied()

    def _next(self) -> bool:
        """Move the next messages to `_partial`, or one reply with its descriptor. Return False if there is none."""
        chunk: list[bytes] = []
        size = 0
        samples, replies = self._samples, self._replies
        while size < CHUNK_BYTES and (samples or replies):
            if replies and (not samples or replies[0][0] < samples[0].order):
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
        self.reply_bytes -= len(message)
        return message

    def _next_sample(self) -> bytes:
        delivery, place = self._take_sample()
        message = delivery.messages()[place]
        self.sent += 1
        if self._unreported:
            message = delivery.encoding.with_dropped(message, delivery.device, self._unreported)
            self._unreported.clear()
        return message
