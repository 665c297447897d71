"""Thread of the spool: stores samples and events as messages on disk and gives them to the sender.

    loop ──put──▶ queue ──▶ streams ──messages──▶ spool (one transaction per second) ──▶ sender
                                                    ▲────────acknowledged──────────────┘

The event loop never waits. If the queue is full, the loop drops and counts samples, and a message covers the gap in
their numbers. If the disk is full or fails, messages wait in memory up to PENDING_BYTES; after that, imud keeps only
their numbers. If the process is killed, the samples since the last transaction and the samples of an unfinished
`batch_s` are lost.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, NamedTuple

import msgspec

from imud.contracts.publisher import Batch, PublisherClock
from imud.contracts.status import DeviceStatus
from imud.fleet.accounts import StreamPosition
from imud.fleet.messages import DropCause, Stream
from imud.fleet.sender import MqttSender
from imud.fleet.settings import DeviceSending, MqttOptions
from imud.fleet.spool import Spool, SpoolError, SpoolRow
from imud.fleet.streams import DeviceStreams, Gateway, notes_of
from imud.host.threads import END_LIMIT_S, StartWorker, Worker
from imud.model.event import Event
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

# Maximum number of samples in the queue: 20 s at 1 kHz, about 20 MB. A flash card can stall for one second while it
# erases.
QUEUE_SAMPLES: Final = 20_000
QUEUE_EVENTS: Final = 2_000
COMMIT_NS: Final = NS_PER_S  # Time between two transactions, ns. If the process is killed, newer messages are lost.
DISK_RETRY_NS: Final = 10 * NS_PER_S  # time between two attempts on a full or failed disk, ns
# Maximum size of the messages in memory while the disk fails, bytes. Above it, imud keeps only their numbers.
PENDING_BYTES: Final = 8 << 20


class SentState(NamedTuple):
    """Retained states of devices and gateway, by topic."""

    statuses: Mapping[str, DeviceStatus]
    other: Mapping[str, object]  # further messages by topic; None removes the message from the broker


class MissedEvents:
    """Events of a device that had no room in the queue, at their position in the queue."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.count = 0
        self.t_ns = 0  # CLOCK_MONOTONIC of the newest event


Item = Batch | Event | MissedEvents | SentState


class WriterQueue:
    """Queue from the event loop to the writer. Synchronization: one thread puts, one thread takes."""

    def __init__(self, samples_max: int = QUEUE_SAMPLES, events_max: int = QUEUE_EVENTS) -> None:
        self.queued = 0  # number of samples and events since the start
        self.dropped = 0  # number of samples and events that had no room
        self._samples_max, self._events_max = samples_max, events_max
        self._items: deque[Batch | Event | MissedEvents] = deque()
        self._lock = threading.Lock()  # protects states and counts of missed events; never held during disk access
        self._missed: dict[str, MissedEvents] = {}  # the newest entry of each device whose newest event had no room
        self._statuses: dict[str, DeviceStatus] = {}
        self._other: dict[str, object] = {}
        self._put = self._taken = 0
        self._events_put = self._events_taken = 0

    @property
    def waiting(self) -> int:
        """Return the number of samples in the queue."""
        return self._put - self._taken

    def put_batch(self, batch: Batch) -> None:
        """Add samples, or drop and count them."""
        count = len(batch)
        self.queued += count
        if self._put - self._taken + count > self._samples_max:
            self.dropped += count
            return
        self._items.append(batch)
        self._put += count

    def put_event(self, event: Event) -> None:
        """Add an event. Count it only if the queue is full."""
        self.queued += 1
        if self._events_put - self._events_taken >= self._events_max:
            self.dropped += 1
            self._miss(event)
            return
        self._missed.pop(event.device, None)
        self._items.append(event)
        self._events_put += 1

    def put_state(self, state: SentState) -> None:
        """Add states. The queue keeps only the newest state of each topic, so it always has room."""
        with self._lock:
            for topic, status in state.statuses.items():
                self._other.pop(topic, None)
                self._statuses[topic] = status
            for topic, other in state.other.items():
                self._statuses.pop(topic, None)
                self._other[topic] = other

    def take(self) -> Item | None:
        """Return all states, or else the oldest batch or event; None if the queue is empty."""
        if self._statuses or self._other:
            with self._lock:
                state = SentState(self._statuses, self._other)
                self._statuses, self._other = {}, {}
            return state
        try:
            item = self._items.popleft()
        except IndexError:
            return None
        if isinstance(item, Batch):
            self._taken += len(item.samples)
        elif isinstance(item, Event):
            self._events_taken += 1
        else:
            with self._lock:  # count later events in a new entry
                if self._missed.get(item.device) is item:
                    self._missed.pop(item.device, None)
        return item

    def _miss(self, event: Event) -> None:
        """Count an event at its position in the queue. There is at most one entry between two events."""
        with self._lock:
            missed = self._missed.get(event.device)
            if missed is None:
                missed = self._missed[event.device] = MissedEvents(event.device)
                self._items.append(missed)
            missed.count += 1
            missed.t_ns = event.t_ns


class SpoolWriter:
    """Thread with the spool and its streams. Any thread may read the counters; the thread owns the rest."""

    def __init__(
        self, settings: MqttOptions, gateway: Gateway, queue: WriterQueue, spool: Spool, sender: MqttSender,
        clock: PublisherClock,
    ) -> None:  # fmt: skip
        """Messages have no age before the clock is synchronized."""
        self.problem = ""  # cause of a failed transaction, one sentence; empty if the spool works
        self.lost_on_disk = 0  # number of samples and events that imud lost because the disk failed
        self.failure: BaseException | None = None  # internal error that ended the thread
        self.positions: list[StreamPosition] = []  # positions of the streams at the last transaction
        # Called by the closing thread after the spool is closed. The owner of the lock file sets it.
        self.closed: Callable[[], None] = lambda: None
        self._is_closing = self._is_closed = False
        self._settings, self._gateway = settings, gateway
        self._queue, self._spool, self._sender = queue, spool, sender
        self._clock = clock
        self._worker: Worker | None = None
        # True after the first synchronized reading: the clock stays accurate enough without the network
        self._is_set = False
        self._streams: dict[str, DeviceStreams] = {}
        self._resumable: dict[str, list[StreamPosition]] = {}
        self._boots: dict[str, int] = {}
        self._rows: list[SpoolRow] = []
        self._acknowledged: set[int] = set()
        # Topics of retained messages of earlier runs, without the topics that this run has published or removed
        self.former: set[str] = set()
        self._topics: frozenset[str] = frozenset()  # topics of retained messages in the spool
        self._session = 0
        self._skipped: frozenset[str] = frozenset()  # topics that the sender did not want at the last call
        self._due_ns = 0
        # number of messages that `messages_per_s` allows now, and the time of this number
        self._allowed, self._allowed_ns = 1.0, clock.now_ns()
        self._resume()

    def start(self, start_worker: StartWorker) -> None:
        """Start the thread."""
        self._worker = start_worker("mqtt spool", self)
        self._sender.wanting = self._worker.ring

    def close(self) -> None:
        """Store all waiting messages and end the thread. A second call does nothing. If the disk blocks the thread, it
        stores the messages later, when the disk works again."""
        self._sender.wanting = lambda: None
        self._is_closing = True
        if self._worker is None or self._worker.end():
            self._finish()
        else:
            log.error(
                "mqtt: the thread of the spool did not end within %g s because the disk does not respond; %d samples "
                "wait, and imud stores them if the disk responds before imud ends", END_LIMIT_S, self._queue.waiting,
            )  # fmt: skip

    def _finish(self) -> None:
        """Store all waiting messages and close the spool, once: in the thread, or in `close` after its end."""
        if self._is_closed:
            return
        self._is_closed = True
        self._take_answers()
        self._take_all()
        for streams in self._streams.values():
            self._rows += streams.flush()
        self._due_ns = 0
        self._store_topics()
        self._store(self._clock.now_ns())
        if self._rows:
            log.error(
                "mqtt: %d messages are lost at the end because the spool failed: %s",
                len(self._rows), self.problem,
            )  # fmt: skip
        self._spool.close()
        self.closed()

    # --- thread -------------------------------------------------------------------------------------------------------

    def do_round(self) -> int:
        """Do the due work. Return the time until the next round, ns."""
        rest_ns = self._do_due()
        if self._is_closing:
            self._finish()
        return rest_ns

    def _do_due(self) -> int:
        self._take_answers()
        self._take_all()
        now_ns = self._clock.now_ns()
        if now_ns >= self._due_ns:
            self._store_topics()
            for streams in self._streams.values():
                self._rows += streams.take_due(now_ns)
            self._store(now_ns)
        pause_ns = self._give(now_ns)
        return max(1, min(COMMIT_NS, self._due_ns - self._clock.now_ns(), pause_ns))

    def _take_answers(self) -> None:
        """Take the acknowledgements. After a new connection, give the oldest messages again."""
        session = self._sender.session
        for of_session, number in self._sender.take_acknowledged():
            if of_session == self._session:
                self._acknowledged.add(number)
        if session != self._session:
            self._session = session
            self._spool.rewind()

    def _take_all(self) -> None:
        """Make messages of the items in the queue."""
        while (item := self._queue.take()) is not None:
            if isinstance(item, Batch):
                self._take_batch(item)
            elif isinstance(item, Event):
                streams = self._streams_of(item.device, 0)
                if streams is not None:
                    self._rows += streams.event(item, item.t_ns + self._clock.utc_offset_ns())
            elif isinstance(item, MissedEvents):
                streams = self._streams_of(item.device, 0)
                if streams is not None:
                    self._rows += streams.missed_events(item.count, item.t_ns + self._clock.utc_offset_ns())
            else:
                made = {topic: msgspec.json.encode(status) for topic, status in item.statuses.items()}
                made |= {
                    topic: b"" if value is None else msgspec.json.encode(value) for topic, value in item.other.items()
                }
                self.former -= made.keys()
                self._sender.retain(made)

    def _take_batch(self, batch: Batch) -> None:
        streams = self._streams_of(batch.device, batch.device_id)
        if streams is None:
            return
        if batch.samples[0].seq < streams.next_seq:  # the device was created again and counts from 1
            self._rows += streams.flush()
            del self._streams[batch.device]
            self._resumable.pop(batch.device, None)
            self._boots[batch.device] = self._boots.get(batch.device, 1) + 1
            streams = self._streams_of(batch.device, batch.device_id)
            assert streams is not None
        self._rows += streams.add(batch.samples)

    def _streams_of(self, device: str, device_id: int) -> DeviceStreams | None:
        found = self._streams.get(device)
        if found is None:
            sending = self._settings.sending(device) if device else DeviceSending(rate_hz=None)
            if sending is None:
                return None
            number = self._boots.get(device, 1)
            gateway = self._gateway if number == 1 else self._gateway._replace(boot=f"{self._gateway.boot}-{number}")
            found = self._streams[device] = DeviceStreams(gateway, device, device_id, sending, self._clock)
            for position in self._resumable.pop(device, []):
                found.resume(position.stream, position)
        return found

    def _resume(self) -> None:
        """Continue the streams of an earlier run of the output in the same boot."""
        try:
            self._spool.open()
            self.positions = self._spool.positions()
            self._topics = frozenset(self._spool.retained_topics())
            self.former = set(self._topics)
        except SpoolError as error:
            self.problem = str(error)
            return
        for position in self.positions:
            boot, _, number = position.boot.partition("-")
            # the identifier of a boot is `EPOCH`, and `EPOCH-N` after the N-th start of a device
            if boot == self._gateway.boot and position.stream in Stream.__members__.values():
                known = self._boots.get(position.device, 1)
                if int(number or "1") > known:
                    self._boots[position.device] = known = int(number)
                    self._resumable.pop(position.device, None)
                if int(number or "1") == known:
                    self._resumable.setdefault(position.device, []).append(position)

    # --- spool --------------------------------------------------------------------------------------------------------

    def _store(self, now_ns: int) -> None:
        """Write one transaction with all new messages and acknowledgements, if there are any."""
        self._due_ns = now_ns + COMMIT_NS
        if not self._rows and not self._acknowledged and not self.problem:
            return
        if self.problem and sum([len(row.payload) for row in self._rows]) > PENDING_BYTES:
            lost = sum([row.items for row in self._rows if row.kind != "dropped"])
            self._rows = notes_of(self._rows, DropCause.DISK, self._gateway.gateway)
            self.lost_on_disk += lost
        acknowledged = frozenset(self._acknowledged)
        try:
            self._commit(acknowledged, now_ns)
            self.positions = self._spool.positions()
        except SpoolError as error:
            self.problem = str(error)
            self._due_ns = now_ns + DISK_RETRY_NS
            self._make_room(acknowledged, now_ns)
            return
        self.problem = ""
        self._acknowledged -= acknowledged

    def _store_topics(self) -> None:
        """Store the topics of retained messages. After a restart, imud removes the messages of removed devices."""
        topics = self._sender.retained_topics() | self.former
        if topics != self._topics:
            with suppress(SpoolError):  # the next transaction reports the problem
                self._spool.store_topics(topics)
                self._topics = topics

    def _commit(self, acknowledged: frozenset[int], now_ns: int) -> None:
        """Store the waiting messages. Raises SpoolError. After a problem, store them one by one, because a full disk
        may not have room for all."""
        utc_ns, most = self._stored_utc_ns(now_ns), 1 if self.problem else max(len(self._rows), 1)
        self._spool.commit(self._rows[:most], acknowledged, now_ns, utc_ns)
        del self._rows[:most]
        while self._rows:
            self._spool.commit(self._rows[:most], (), now_ns, utc_ns)
            del self._rows[:most]

    def _stored_utc_ns(self, now_ns: int) -> int:
        """Return CLOCK_REALTIME of the transaction; 0 before the clock was synchronized: then messages have no age."""
        self._is_set = self._is_set or self._clock.utc_reference() is not None
        return now_ns + self._clock.utc_offset_ns() if self._is_set else 0

    def _make_room(self, acknowledged: frozenset[int], now_ns: int) -> None:
        """Remove acknowledged messages. A full disk can have room for this although it has no room for new messages."""
        if acknowledged:
            with suppress(SpoolError):
                self._spool.remove(acknowledged, now_ns, self._stored_utc_ns(now_ns))
                self._acknowledged -= acknowledged
                self._due_ns = now_ns + COMMIT_NS

    def _give(self, now_ns: int) -> int:
        """Give messages to the sender up to its free places. Return the time until more messages are allowed, ns."""
        room, rate_hz = self._sender.room(), self._settings.messages_per_s
        if rate_hz is not None:
            self._allowed += (now_ns - self._allowed_ns) * rate_hz / NS_PER_S
            # at most one second of messages accumulates
            self._allowed, self._allowed_ns = min(self._allowed, max(rate_hz, 1.0)), now_ns
            room = min(room, int(self._allowed))
        try:
            skipped, held = self._sender.skipped, self._sender.held()
            if not self._skipped <= skipped:
                self._spool.rewind()
            self._skipped = skipped
            while room > 0:
                rows = self._spool.after(room, skipped)
                if not rows:
                    return COMMIT_NS
                fresh = [row for row in rows if row.id not in self._acknowledged and row.id not in held]
                self._sender.give(self._session, fresh)
                room -= len(fresh)
                self._allowed -= len(fresh) if rate_hz is not None else 0
        except SpoolError as error:
            self.problem = self.problem or str(error)
        return COMMIT_NS if rate_hz is None else round(max(1.0 - self._allowed, 0.0) * NS_PER_S / rate_hz) or COMMIT_NS

    def round_failed(self, error: BaseException) -> None:
        self.failure = error
