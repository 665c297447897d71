"""Sends to one client: straight from `publish` while its socket has room, through a bounded queue while it has not.

Goal: at 1 kHz one `send` per client and batch is the whole cost. A client with nothing queued gets the bytes that all
clients share, in one system call; a queue, sent by the scheduler (serving.py), exists only while a socket is full or
while `publish` has used up its time.

Order is kept. Two queues hold what waits, joined by an order number, because they are bounded differently: samples go
oldest first when there are too many, replies never, but a client for which too many gather is disconnected. A message
that was sent in part is finished before anything else and cannot be dropped. A queue of samples holds references to
deliveries, which all clients of one form share: messages, or, where `publish` had no time to encode, the batch, which
is encoded when the first client sends it.
"""

import array
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final, Protocol

from imud.attitude.conventions import Convention
from imud.contracts.publisher import Batch
from imud.formats.jsonrpc import FRAME_HEADER, encode, encode_notification, frame_of, line_of, with_texts
from imud.formats.slot import SLOT_BYTES
from imud.model.errors import reason_of
from imud.model.sample import Sample

ALWAYS_FIELDS: Final = ("device", "seq", "t_ns")
"""Members of every JSON sample, whatever was selected: without them it cannot be identified."""
MESSAGE_GUESS_BYTES: Final = 700
"""What a sample with the values of a whole HI91 message has as JSON."""
_HEAD: Final = b'{"jsonrpc":"2.0","method":"sample","params":'
_TAIL: Final = b"}"
_SLOT_HEADER: Final = FRAME_HEADER.pack(SLOT_BYTES)


class Encoding(Protocol):
    """Makes messages of samples. One message is one sample, so that a queue can drop by the sample."""

    @property
    def message_bytes(self) -> int:
        """Size of the message that was encoded last; a guess before the first."""
        ...

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a message."""
        ...

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a message."""
        ...

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """`message`, of `device`, with the number of samples dropped before it, by device."""
        ...


class JsonEncoding:
    """`sample` notifications, all members or the selected ones, as lines or as frames."""

    def __init__(self, fields: tuple[str, ...] | None, framed: bool, texts: bool = False) -> None:
        """`texts`: integers that may exceed 2⁵³ are text."""
        self._texts = texts
        self._wrap = frame_of if framed else line_of
        self._select = None if fields is None else selector(fields)
        self._last: bytes = bytes(MESSAGE_GUESS_BYTES)

    @property
    def message_bytes(self) -> int:
        """Size of the notification that was encoded last."""
        return len(self._last)

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a notification."""
        messages = [self._message(sample) for sample in batch.samples]
        self._last = messages[-1]
        return messages

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a notification."""
        self._last = self._message(batch.samples[index])
        return self._last

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Add the device's own number as a member of the sample, and put notifications of the others before it."""
        notices = [_dropped_notice(name, count, self._wrap) for name, count in dropped.items() if name != device]
        own = dropped.get(device)
        if own is not None:
            body = message[message.index(_HEAD) :].rstrip(b"\n")
            message = self._wrap(b'%b,"dropped":%d}}' % (body[:-2], own))
        return b"".join((*notices, message))

    def _message(self, sample: Sample) -> bytes:
        shown: object = self._select(sample) if self._select else sample
        return self._wrap(_HEAD + encode(with_texts(shown) if self._texts else shown) + _TAIL)


class BinaryEncoding:
    """Frames of one slot each."""

    message_bytes = FRAME_HEADER.size + SLOT_BYTES

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a frame."""
        slots = batch.slots()
        if len(slots) == 1:  # the usual case, without a call for the list
            return [_SLOT_HEADER + slots[0]]
        return [_SLOT_HEADER + slot for slot in slots]

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a frame."""
        return _SLOT_HEADER + batch.slots()[index]

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Put `dropped` notifications before the slot."""
        return b"".join((*(_dropped_notice(name, count, frame_of) for name, count in dropped.items()), message))


class ConvertedEncoding:
    """Another encoding, of samples in a convention that the client asked for."""

    def __init__(self, encoding: Encoding, convention: Convention) -> None:
        self._encoding = encoding
        self._convention = convention

    @property
    def message_bytes(self) -> int:
        """Size of the message that was encoded last."""
        return self._encoding.message_bytes

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a message."""
        return self._encoding.encode(batch.converted(self._convention))

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a message."""
        return self._encoding.encode_one(batch.converted(self._convention), index)

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Add the number of samples dropped, as the other encoding does."""
        return self._encoding.with_dropped(message, device, dropped)


def selector(fields: tuple[str, ...]) -> Callable[[Sample], dict[str, object]]:
    """Return a function that gives the selected members of a sample and ALWAYS_FIELDS; absent ones are left out."""
    names = tuple(dict.fromkeys((*ALWAYS_FIELDS, *fields)))
    values = attrgetter(*names)

    def select(sample: Sample) -> dict[str, object]:
        pairs = zip(names, values(sample), strict=True)
        return {name: value for name, value in pairs if value is not None}

    return select


def _dropped_notice(device: str, count: int, wrap: Callable[[bytes], bytes]) -> bytes:
    return wrap(encode_notification("dropped", {"device": device, "dropped": count}))


CHUNK_BYTES: Final = 32768
"""Queued messages are sent together up to this size: what a socket buffer of the usual 208 KiB takes at once."""
SAMPLE_BYTES: Final = 300
"""What a sample in a queue needs in addition to its message, most of it shared by the clients of a form."""
REPLY_BYTES: Final = 200
"""What a reply in a queue needs in addition to its text: the objects around it."""
NO_FD: Final = -1


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may wait for one client."""

    samples: int
    sample_bytes: int
    replies: int = 1024
    reply_bytes: int = 1 << 20


class Delivery:
    """Samples of one batch in one form, or those of `chosen` indices; encoded on first use, for all clients.

    What is encoded does not hold the batch: a sample is some thirty small objects, whose memory the interpreter keeps
    until its end when thousands have waited (20 clients of 100 devices that do not read for 8 s: 29 MB, as messages
    11).
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
        self.count = len(batch.samples) if chosen is None else len(chosen)
        self._messages = messages
        self.each_bytes = SAMPLE_BYTES + (encoding.message_bytes if messages is None else len(messages[0]))
        """Memory that a message and its sample need; before it is encoded, by the one encoded last."""

    def messages(self) -> Sequence[bytes]:
        """The samples as messages."""
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
    """All memory that clients make the daemon hold: half of `limit_bytes` for samples, half for everything else.

    Samples: each client that waits has an equal share of three eighths of the limit. The share shrinks with each client
    that begins to wait; when half of the limit is full in between, all are cut to their share at once.

    Everything else (replies, messages that were sent in part, what clients have sent and is not carried out yet,
    answers in the making): over the limit, clients are disconnected until it is kept. Of the user that makes the daemon
    hold most, it is the client with most, times how long none of it has moved: one that reads its reply, however
    large, stays before one that does not. Time is counted in moves of all clients, so that no clock is needed.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._share_bytes = limit_bytes * 3 // 8
        self._half_bytes = limit_bytes // 2
        self._waiting: dict[Outbox, None] = {}
        self._holding: dict[Outbox, None] = {}
        """Clients for which anything but samples is held."""
        self._sample_bytes = 0
        self._other_bytes = 0
        self._order = 0
        self._moves = 0

    def next_order(self) -> int:
        """The number of the next message that is queued, for all clients: within each they ascend."""
        self._order += 1
        return self._order

    def next_move(self) -> int:
        """Count that something moved that is held for a client."""
        self._moves += 1
        return self._moves

    @property
    def held_bytes(self) -> int:
        """All that is held for all clients."""
        return self._sample_bytes + self._other_bytes

    @property
    def share_bytes(self) -> int:
        """The samples that may wait for one client: an equal share for each that waits."""
        return self._share_bytes // (len(self._waiting) or 1)

    def add(self, outbox: "Outbox") -> None:
        """Count a client for which something waits from now on."""
        self._waiting[outbox] = None

    def remove(self, outbox: "Outbox") -> None:
        """Count a client no longer."""
        self._waiting.pop(outbox, None)

    def count_samples(self, size_bytes: int) -> None:
        """Add to the bytes of samples that wait; negative to subtract."""
        self._sample_bytes += size_bytes

    def count_others(self, outbox: "Outbox", size_bytes: int) -> None:
        """Add to the bytes of everything else that is held for a client; negative to subtract."""
        self._other_bytes += size_bytes
        if outbox.held_bytes:
            self._holding[outbox] = None
        else:
            self._holding.pop(outbox, None)

    def evict(self) -> None:
        """Report clients to their owners until what is held in addition to samples is within the limit.

        Not to be called while samples are sent to a list of clients: one of them could be closed in between.
        """
        while self._other_bytes > self._half_bytes and self._holding:
            worst = self._worst()
            del self._holding[worst]
            worst.flood()

    def trim(self) -> None:
        """Drop samples of clients that have more than the share, which shrinks with each client that waits."""
        for outbox in self._waiting:
            outbox.trim()

    def trim_if_full(self) -> None:
        """The same when too many wait for all; it frees an eighth of the limit, so it is seldom."""
        if self._sample_bytes > self._half_bytes:
            self.trim()

    def _worst(self) -> "Outbox":
        users: Counter[int] = Counter()
        for outbox in self._holding:
            users[outbox.uid] += outbox.held_bytes
        uid = max(users, key=users.__getitem__)
        moves = self._moves
        return max(
            (outbox for outbox in self._holding if outbox.uid == uid),
            key=lambda outbox: outbox.held_bytes * (moves - outbox.moved + 1),
        )


class Owner(Protocol):
    """Whose outbox it is."""

    @property
    def uid(self) -> int:
        """The user that it serves."""
        ...

    def on_broken(self, reason: str) -> None:
        """The socket failed."""
        ...

    def on_flooded(self) -> None:
        """More is held for the client than may be."""
        ...

    def on_full(self) -> None:
        """The socket is full: call `flush` when it is writable."""
        ...

    def on_deferred(self) -> None:
        """Samples wait although the socket may have room: call `flush` when there is time."""
        ...

    def on_emptied(self) -> None:
        """All that waited is sent."""
        ...


class Outbox:
    """The sending side of one non-blocking socket. Synchronization: the event loop's thread."""

    __slots__ = (
        "_limits", "_owned_bytes", "_owner", "_partial", "_partial_fd", "_pool", "_replies", "_sample_bytes",
        "_sample_count", "_samples", "_send", "_skip", "_sock", "_unreported", "dropped", "held_bytes", "moved",
        "reply_bytes", "sent", "uid", "waiting",
    )  # fmt: skip

    def __init__(self, sock: socket.socket, limits: Limits, pool: Pool, owner: Owner) -> None:
        self.sent = 0
        """Samples given to the socket."""
        self.dropped = 0
        """Samples dropped."""
        self.waiting = False
        """Whether anything waits; then everything new has to wait behind it."""
        self.reply_bytes = 0
        """Bytes of replies that wait."""
        self.held_bytes = 0
        """All but samples that the daemon holds for the client, as the pool has it."""
        self.moved = 0
        """The pool's count of moves when something of it was sent or carried out last."""
        self.uid = owner.uid
        self._owned_bytes = 0
        self._sock = sock
        self._send = sock.send
        self._limits = limits
        self._pool = pool
        self._owner = owner
        self._samples: deque[Delivery] = deque()
        self._skip = 0
        """Samples of the first delivery that were sent or dropped already."""
        self._sample_count = 0
        self._sample_bytes = 0
        self._replies: deque[tuple[int, bytes, int]] = deque()
        self._partial = b""
        self._partial_fd = NO_FD
        self._unreported: dict[str, int] = {}
        """Samples dropped per device that no message has reported to the client yet."""

    @property
    def queue_samples(self) -> int:
        """Whole samples that wait."""
        return self._sample_count

    @property
    def queue_replies(self) -> int:
        """Whole messages other than samples that wait."""
        return len(self._replies)

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait."""
        return self._sample_bytes + self.reply_bytes + len(self._partial)

    @staticmethod
    def put_samples(
        outboxes: Iterable["Outbox"], messages: Sequence[bytes], batch: Batch, encoding: Encoding,
        chosen: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Send samples of one device to several clients: the same bytes, one `send` each.

        The loop is in here because a call per client would cost as much as all the rest around `send`.
        """
        whole = messages[0] if len(messages) == 1 else b"".join(messages)
        size, samples = len(whole), len(messages)
        delivery: Delivery | None = None
        for outbox in outboxes:
            if outbox.waiting:
                delivery = delivery or Delivery(outbox._pool.next_order(), batch, encoding, messages, chosen)
                outbox._queue_samples(delivery)
                continue
            try:
                count = outbox._send(whole)
            except BlockingIOError:
                count = 0
            except OSError as error:
                outbox._owner.on_broken(reason_of(error))
                continue
            if count == size:
                outbox.sent += samples
            else:
                delivery = delivery or Delivery(outbox._pool.next_order(), batch, encoding, messages, chosen)
                outbox._keep_rest(count, delivery)

    def defer(self, delivery: Delivery) -> None:
        """Queue samples for the scheduler to send, because `publish` has no more time."""
        self._queue_samples(delivery)
        if not self.waiting:
            self._wait()
            self._owner.on_deferred()

    def put_reply(self, message: bytes, fd: int = NO_FD) -> None:
        """Send anything that is not a sample; with `fd`, a copy of that descriptor goes with its first byte."""
        if not self.waiting:
            self._partial, self._partial_fd = message, fd
            self.flush()
            return
        self._replies.append((self._pool.next_order(), message, fd))
        self.reply_bytes += len(message)
        self._count_held()
        if len(self._replies) > self._limits.replies or self.reply_bytes > self._limits.reply_bytes:
            self.flood()
        else:
            self._pool.evict()

    def count_owned(self, size_bytes: int) -> None:
        """Set what the owner itself holds for the client: its input, and an answer in the making."""
        if size_bytes != self._owned_bytes:
            self._owned_bytes = size_bytes
            self.moved = self._pool.next_move()
            self._count_held()
            self._pool.evict()

    def flood(self) -> None:
        """Report to the owner that more is held for the client than may be."""
        self._owner.on_flooded()

    def trim(self) -> None:
        """Drop the oldest samples that are more than may wait: whole deliveries, while a later one is there."""
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

    def close(self) -> None:
        """Drop everything that waits; the owner closes the socket."""
        self.waiting = False
        self._samples.clear()
        self._replies.clear()
        self._partial = b""
        self.reply_bytes = self._owned_bytes = 0
        self._pool.remove(self)
        self._pool.count_samples(-self._sample_bytes)
        self._sample_bytes = self._sample_count = 0
        self._count_held()

    # --- queueing ---------------------------------------------------------------------------------------------------

    def _keep_rest(self, count: int, delivery: Delivery) -> None:
        """The socket took `count` bytes of a delivery: keep the rest, the cut message apart."""
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
        self._owner.on_full()

    def _queue_samples(self, delivery: Delivery) -> None:
        self._samples.append(delivery)
        self._count_samples(delivery.count, delivery)
        limits, size_bytes = self._limits, self._sample_bytes
        if self._sample_count > limits.samples or size_bytes > min(limits.sample_bytes, self._pool.share_bytes):
            self.trim()
        self._pool.trim_if_full()

    def _count_samples(self, count: int, delivery: Delivery) -> None:
        """Add samples of a delivery to those that wait; negative to subtract."""
        size_bytes = count * delivery.each_bytes
        self._sample_count += count
        self._sample_bytes += size_bytes
        self._pool.count_samples(size_bytes)

    def _count_held(self) -> None:
        """Have the pool count what is held besides samples as it is now."""
        held = self.reply_bytes + REPLY_BYTES * len(self._replies) + len(self._partial) + self._owned_bytes
        change = held - self.held_bytes
        if change:
            if not self.held_bytes:
                self.moved = self._pool.next_move()
            self.held_bytes = held
            self._pool.count_others(self, change)

    def _take_sample(self) -> tuple[Delivery, int]:
        """Remove the oldest sample from the queue: its delivery and its place in it."""
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

    # --- sending what waited ----------------------------------------------------------------------------------------

    def flush(self) -> bool:
        """Send one piece of what waits. Returns whether there is more and the socket may have room."""
        try:
            if not self._partial and not self._next():
                return self._emptied()
            count = self._send_partial()
        except BlockingIOError:
            self._keep(self._owner.on_full)
            return False
        except OSError as error:
            self._owner.on_broken(reason_of(error))
            return False
        self._partial = self._partial[count:]
        if self._partial or self._samples or self._replies:
            self.moved = self._pool.next_move()
            self._keep(self._owner.on_deferred)
            return self.waiting
        return self._emptied()

    def _keep(self, report: Callable[[], None]) -> None:
        """Keep what is not sent yet, and report that; all that is held may be too much then."""
        self._wait()
        self._count_held()
        report()
        self._pool.evict()

    def _emptied(self) -> bool:
        if self.waiting:
            self.waiting = False
            self._pool.remove(self)
            self._count_held()
            self._owner.on_emptied()
        return False

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
