"""Thread that connects to the broker, sends messages, and passes the acknowledgements to the writer.

    writer ──give──▶ outbox ──▶ connection ──▶ broker
    writer ◀──acknowledged── … ◀── PUBACK

The sender holds only a few messages; the spool contains all others. Each connection has a number, the session. In the
next session the writer gives messages without an acknowledgement again. The sender ignores acknowledgements of earlier
sessions.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Final, NamedTuple

from imud.fleet.broker import (
    LOST,
    BrokerConnection,
    BrokerError,
    BrokerTurn,
    Connect,
    MessageRefused,
    Received,
    RetainRefused,
    Will,
)
from imud.fleet.commands import CommandChannel, CommandReply
from imud.fleet.messages import JSON_TYPE, MAGIC, SLOTS_TYPE
from imud.fleet.paho_client import CONNECT_S
from imud.fleet.settings import Broker, MqttOptions
from imud.fleet.spool import SpoolRow
from imud.fleet.topics import (
    UNCLAIMED_NS,
    UNCLAIMED_SKIP_NS,
    TopicRefusals,
    TopicSubscribers,
    is_subscription,
)
from imud.host.threads import WakeEvent
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget

log = logging.getLogger(__name__)

REPLIES_MAX: Final = 32  # Maximum number of replies that wait for a connection. The sender drops the oldest.
OUTBOX_MAX: Final = 60  # maximum number of messages in memory, 6 MB at most: three times IN_FLIGHT_MAX
WAIT_S: Final = 1.0  # Maximum wait, s. The thread then checks keep-alives and the end.
# Maximum wait of `close` for the thread, s. Samples wait for it during a reload of the configuration.
CLOSE_S: Final = 0.5
# Number of connections in sequence that were lost soon, after which imud names the usual cause: the broker closes a
# connection if another client connects with the same client ID. Most brokers do not report this reason.
SHORT_RUNS: Final = 3
FAREWELL_S: Final = 0.3  # part of CLOSE_S for the acknowledgement of the farewell, s
# Maximum time without any acknowledgement while messages are in flight, s. A message of 130 kB takes 52 s at 20 kbit/s.
UNANSWERED_S: Final = 60.0
LINK_BYTES_S: Final = 2500.0  # bytes per second of the slowest expected link (20 kbit/s)


NO_RETAIN: Final = (
    "the broker does not permit retained messages: imud sends its messages without a last will, and a reader receives "
    "the state of a device only when imud sends it again"
)


class _Message(NamedTuple):
    """Message or subscription that the sender sends next, or that is in flight."""

    topic: str
    payload: bytes
    row: int = 0  # ID of a row of the spool; 0 for other messages
    reply: CommandReply | None = None  # reply to a request
    is_retained: bool = False
    due_ns: int = 0  # time of the acknowledgement at the latest, for a message in flight


def connect_to(
    connect: Connect, arguments: tuple[Broker, MqttOptions, str], will: Will, is_wanted: Callable[[], bool]
) -> BrokerConnection:
    """Connect, and without a last will if the broker does not permit retained messages. Raises BrokerError."""
    try:
        return connect(*arguments, will, is_wanted)
    except RetainRefused:
        return connect(*arguments, None, is_wanted)


def loss_advice(client_id: str, size: int, largest_bytes: int) -> str:
    """Return the usual causes of repeated losses without a reason, the more probable cause first. `size` is the length
    of the largest message in flight, and `largest_bytes` of the largest acknowledged message, bytes."""
    other_client = f"does another gateway use the client ID {client_id} (mqtt.gateway)?"
    if size <= largest_bytes:
        return f"; {other_client}"
    return (
        f"; does the broker accept messages of {size} bytes (largest acknowledged message: {largest_bytes} bytes)? "
        f"Otherwise: {other_client}"
    )


def take_requests(commands: CommandChannel, received: list[Received], budget: WorkBudget | None, broker: str) -> None:
    """Check received requests within the budget of the broker, and count the others."""
    for message in received:
        if budget is None or budget.admit(broker):
            commands.take(message)
        else:
            commands.refuse_excess()
    if budget is not None:
        budget.end_turn()


def late_text(broker: str, topic: str) -> str:
    """Return the start of the problem of a missing acknowledgement."""
    packet = f"the subscription to {topic}" if is_subscription(topic) else f"a message of {topic}"
    return f"{broker}: expected an acknowledgement of {packet} within"


def late_result(topic: str, size: int) -> str:
    """Return the end of the problem of a missing acknowledgement. `size` is the length of the message, bytes."""
    limit_s = round(CONNECT_S + size / LINK_BYTES_S)
    return f" {limit_s} s, got none" + "; commands over MQTT do not work" * is_subscription(topic)


class MqttSender:
    """Thread of the connection. The writer calls the methods, any thread reads counters, the thread calls `work`."""

    def __init__(
        self, settings: MqttOptions, client_id: str, will: Will, turn: BrokerTurn, connect: Connect,
        now_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        self.session = 0  # Number of the connection. It changes at each connection and each loss.
        self.connected = False
        self.broker = ""  # name of the connected broker; empty if there is none
        # Cause of a missing connection or of missing acknowledgements, one sentence; empty if the connection works, and
        # before the first attempt
        self.problem = ""
        self.sent = 0  # number of sent messages of the spool, including repeated messages
        self.acknowledged = 0  # number of acknowledged messages of the spool
        self.limit = ""  # part of the output that the broker does not permit, one sentence; empty without a limit
        # Budget of the work that the packets of the broker cause. The output sets it before `start`.
        self.budget: WorkBudget | None = None
        self.replies_lost = 0  # number of discarded replies: the broker refuses the topic, or too many wait
        self.reconnects = 0  # number of connections after the first
        self.failure: BaseException | None = None  # internal error that ended the thread
        self.refused: Mapping[str, str] = {}  # reason for each topic that the broker refuses
        self.skipped: frozenset[str] = frozenset()  # topics that imud does not send now
        # Called by the thread if messages are wanted or acknowledgements wait. The writer sets it.
        self.wanting: Callable[[], None] = lambda: None
        self.commands: CommandChannel | None = None  # receiver of requests; set before `start`
        self._settings, self._client_id, self._will = settings, client_id, will
        self._turn, self._connect, self._now_ns = turn, connect, now_ns
        self._replies: deque[CommandReply] = deque(maxlen=REPLIES_MAX)
        self._lock = threading.Lock()
        self._outbox: deque[SpoolRow] = deque()  # rows of the spool
        self._in_flight: dict[int, _Message] = {}  # messages without an acknowledgement, by packet identifier
        self._answered_ns = 0  # time of the newest acknowledgement, or of the first message in flight
        self._unanswered = ""  # `problem` of missing acknowledgements
        self._has_answer = False  # whether an acknowledgement arrived after `_unanswered`
        self._largest_bytes = 0  # length of the largest payload that a broker acknowledged, bytes
        self._refusals = TopicRefusals()
        self._subscribers = TopicSubscribers()
        self._answers: list[tuple[int, int]] = []
        self._retained: dict[str, bytes] = {}  # newest payload by topic
        self._due: dict[str, None] = {}  # topics of retained messages to send, in order
        self._subscription = ""  # filter of the subscription to send; empty if there is none
        self._connection: BrokerConnection | None = None
        self._wake = WakeEvent()
        self._ended = False
        self._farewell = b""
        self._thread: threading.Thread | None = None
        self._was_connected = False

    def start(self) -> None:
        self._thread = threading.Thread(target=self._main, name="mqtt sender", daemon=True)
        self._thread.start()

    def close(self, farewell: bytes) -> None:
        """Publish the retained farewell and end the thread.

        Messages without an acknowledgement stay in the spool. A second call does nothing.

        A thread that is still connecting does not complete its connection, because the next output may use the same
        client ID.
        """
        self._farewell = farewell
        self._ended = True
        self._ring()
        self.join(CLOSE_S)

    def join(self, seconds: float) -> None:
        """Wait for the end of the thread, at most `seconds`."""
        if self._thread is not None:
            self._thread.join(seconds)

    # --- methods for the writer ---------------------------------------------------------------------------------------

    def room(self) -> int:
        """Return how many messages the sender accepts now."""
        with self._lock:
            return OUTBOX_MAX - len(self._outbox) - len(self._in_flight) if self.connected else 0

    def give(self, session: int, rows: list[SpoolRow]) -> None:
        """Send messages in their order. Do nothing if the session is over."""
        with self._lock:
            if session != self.session:
                return
            self._outbox.extend(row for row in rows if row.topic not in self.skipped)
        self._ring()

    def retain(self, messages: Mapping[str, bytes]) -> None:
        """Publish retained messages by topic, now and at each new connection. An empty payload removes the message."""
        with self._lock:
            for topic, payload in messages.items():
                if self._retained.get(topic) != payload:
                    self._retained[topic] = payload
                    if topic not in self.skipped:
                        self._due[topic] = None
        self._ring()

    def retained_topics(self) -> frozenset[str]:
        """Return the topics of retained messages, until the broker has acknowledged their removal."""
        with self._lock:
            return frozenset(self._retained)

    def reply(self, reply: CommandReply) -> None:
        """Send a reply before all other messages, and again after a lost connection. Any thread may call it."""
        with self._lock:
            if reply.topic in self.skipped:
                self.replies_lost += 1
                log.warning("mqtt: discarding a reply, because the broker refuses messages of %s", reply.topic)
                return
            self.replies_lost += len(self._replies) == REPLIES_MAX
            self._replies.append(reply)
        self._ring()

    def held(self) -> set[int]:
        """Return the IDs of the rows that the sender has, acknowledged rows included."""
        with self._lock:
            rows = [row.id for row in self._outbox] + [one.row for one in self._in_flight.values()]
            return {*rows, *[number for _, number in self._answers]}

    def take_acknowledged(self) -> list[tuple[int, int]]:
        """Return session and row ID of each acknowledgement since the last call."""
        with self._lock:
            answers, self._answers = self._answers, []
            return answers

    def _ring(self) -> None:
        self._wake.ring()
        connection = self._connection
        if connection is not None:
            connection.ring()

    # --- thread -------------------------------------------------------------------------------------------------------

    def _main(self) -> None:
        try:
            while not self._ended:
                rest_s = self.work()
                if rest_s > 0 and not self._ended:
                    self._wake_after(rest_s)
            self._say_farewell()
        except BaseException as error:  # noqa: BLE001 - `MqttPublisher.tick` raises the error again
            self.failure = error

    def _wake_after(self, seconds: float) -> None:
        """Sleep between two attempts. Only the end of the sender wakes the thread earlier."""
        due_ns = self._now_ns() + round(seconds * NS_PER_S)
        while not self._ended and (rest_ns := due_ns - self._now_ns()) > 0:
            self._wake.wait(min(rest_ns / NS_PER_S, WAIT_S))

    def work(self) -> float:
        """Connect, or send and wait for the broker once. Return the time until the next call, s."""
        connection = self._connection
        try:
            if connection is None:
                self._open()
            else:
                self._end_refusals()
                self._send(connection)
                if self.budget is not None:
                    self.budget.start_turn(self._now_ns())
                connection.wait(WAIT_S)
                self._take_acknowledgements(connection)
                self._take_requests(connection)
                self._check_answers()
        except BrokerError as error:
            pause_s, problem = self._turn.failed(self._now_ns()), str(error)
            is_repeated = self._turn.short_runs >= SHORT_RUNS and problem.endswith(LOST)
            size = max((len(message.payload) for message in self._in_flight.values()), default=0)
            advice = loss_advice(self._client_id, size, self._largest_bytes) if is_repeated else ""
            self._disconnect(problem, advice)
            return pause_s
        return 0.0

    def _open(self) -> None:
        broker = self._turn.broker
        arguments = (broker, self._settings, self._client_id)
        connection = connect_to(self._connect, arguments, self._will, lambda: not self._ended)
        if self._ended:
            connection.close()
            return
        self._turn.connected(self._now_ns())
        self.reconnects += self._was_connected
        self._was_connected = True
        with self._lock:
            self._connection = connection
            connection.budget = self.budget
            self.limit = "" if connection.has_retain else NO_RETAIN
            self._due = dict.fromkeys(topic for topic in self._retained if topic not in self.skipped)
            wanted = self.commands.subscription if self.commands is not None else ""
            self._subscription = wanted if wanted not in self.skipped else ""
            self.session += 1
            self.connected, self.broker, self.problem = True, broker.name, self._unanswered
        self.wanting()

    def _send(self, connection: BrokerConnection) -> None:
        """Send packets up to the window of the broker: subscription, replies, retained messages, then the spool."""
        while len(self._in_flight) < connection.in_flight_max:
            with self._lock:
                message = self._next_message()
            if message is None:
                return
            self._publish(connection, message)

    def _publish(self, connection: BrokerConnection, message: _Message) -> None:
        kind = SLOTS_TYPE if message.payload.startswith(MAGIC) else JSON_TYPE
        correlation = message.reply.correlation if message.reply is not None else None
        try:
            if is_subscription(message.topic):
                number = connection.subscribe(message.topic)
            else:
                number = connection.publish(
                    message.topic, message.payload, kind, retain=message.is_retained, correlation=correlation
                )
        except MessageRefused as error:
            self.replies_lost += message.reply is not None
            self._refuse(message.topic, str(error))
            return
        self.sent += bool(message.row)
        now_ns = self._now_ns()
        with self._lock:
            if not self._in_flight:
                self._answered_ns = now_ns
            # earlier messages delay the acknowledgement
            size = len(message.payload) + sum(len(one.payload) for one in self._in_flight.values())
            due_ns = now_ns + round((CONNECT_S + size / LINK_BYTES_S) * NS_PER_S)
            self._in_flight[number] = message._replace(due_ns=due_ns)

    def _next_message(self) -> _Message | None:
        """Remove and return the next message; None if there is none. A message of a suspected topic follows all other
        messages, and it is the only message in flight. The caller holds the lock."""
        refusals = self._refusals
        if any(refusals.is_suspect(one.topic) for one in self._in_flight.values()):
            return None
        found = next((one for one in self._waiting() if not refusals.is_suspect(one.topic)), None)
        if found is None and not self._in_flight:
            found = min(self._waiting(), key=lambda one: refusals.losses(one.topic), default=None)
        if found is None:
            return None
        if is_subscription(found.topic):
            self._subscription = ""
        elif found.reply is not None:
            self._replies.remove(found.reply)
        elif found.is_retained:
            del self._due[found.topic]
        else:
            self._outbox.remove(next(row for row in self._outbox if row.id == found.row))
        return found

    def _waiting(self) -> Iterator[_Message]:
        """Yield all waiting messages in their order."""
        replies = (_Message(one.topic, one.payload, reply=one) for one in self._replies)
        due = (_Message(topic, self._retained[topic], is_retained=True) for topic in self._due)
        rows = (_Message(row.topic, row.payload, row.id) for row in self._outbox)
        subscription = (_Message(topic, b"") for topic in (self._subscription,) if topic)
        return chain(subscription, replies, due, rows)

    def _take_acknowledgements(self, connection: BrokerConnection) -> None:
        """Pass the acknowledgements to the writer, and skip the topics of refused messages."""
        refused, connection.refused = connection.refused, []
        for number, problem in refused:
            with self._lock:
                message = self._in_flight.pop(number, None)
            if message is not None:
                self.replies_lost += message.reply is not None
                self._refuse(message.topic, problem)
        if not connection.acknowledged:
            return
        numbers, connection.acknowledged = connection.acknowledged, []
        unclaimed, connection.unclaimed = connection.unclaimed, set()
        numbers = [one for one in numbers if not self._is_kept(one, is_claimed=one not in unclaimed)]
        with self._lock:
            self._answered_ns, self._has_answer = self._now_ns(), True
            messages = [self._in_flight.pop(number) for number in numbers if number in self._in_flight]
            for one in messages:
                self._refusals.accept(one.topic)
                self._largest_bytes = max(self._largest_bytes, len(one.payload))
                if one.is_retained and not one.payload and not self._retained.get(one.topic, b"-"):
                    del self._retained[one.topic]  # the broker removed the message
            ids = [one.row for one in messages if one.row]
            self._answers += [(self.session, one) for one in ids]
            self.acknowledged += len(ids)
            is_low = 2 * (len(self._outbox) + len(self._in_flight)) <= OUTBOX_MAX
        self._update_refusals()
        if is_low:
            self.wanting()

    def _check_answers(self) -> None:
        """Set `problem` if the broker does not acknowledge a message or the subscription. Raise BrokerError after
        UNANSWERED_S without any acknowledgement."""
        now_ns = self._now_ns()
        late = next((one for one in self._in_flight.values() if now_ns > one.due_ns), None)
        if late is not None:
            text = late_text(self.broker, late.topic)
            if not self._unanswered.startswith(text):
                self._has_answer = False
                self._unanswered = text + late_result(late.topic, len(late.payload))
            self.problem = self._unanswered
        elif self._unanswered and self._has_answer:
            self.problem = self._unanswered = ""
        if not self._in_flight:
            return
        silent_s = (now_ns - self._answered_ns) / NS_PER_S
        if silent_s > UNANSWERED_S:
            raise BrokerError(
                f"{self.broker}: no acknowledgement of {len(self._in_flight)} messages within {UNANSWERED_S:g} s"
            )

    # --- refused topics -----------------------------------------------------------------------------------------------

    def _is_kept(self, number: int, *, is_claimed: bool) -> bool:
        """Return whether an acknowledged message stays in the spool, so that imud sends it again."""
        message = self._in_flight.get(number)
        if message is None or not message.row:
            return False
        if is_claimed:
            self._subscribers.note(message.topic)
            return False
        if not self._subscribers.are_expected(message.topic, self._now_ns()):
            return False
        with self._lock:
            del self._in_flight[number]
        problem = (
            "no client has a subscription of this topic any more; imud keeps the messages for at most "
            f"{UNCLAIMED_NS // NS_PER_S} s: does a collector run?"
        )
        self._refuse(message.topic, problem, UNCLAIMED_SKIP_NS)
        return True

    def _refuse(self, topic: str, problem: str, skip_ns: int | None = None) -> None:
        """Skip a topic. Its rows stay in the spool; the newest retained message stays in memory."""
        with self._lock:
            self._refusals.refuse(topic, problem, self._now_ns(), skip_ns)
        self._update_refusals()

    def _end_refusals(self) -> None:
        """Send messages of a refused topic again after its time."""
        with self._lock:
            ended = self._refusals.take_ended(self._now_ns())
            self._due |= dict.fromkeys(topic for topic in ended if topic in self._retained)
            self._subscription = next(filter(is_subscription, ended), self._subscription)
        if ended:
            self._update_refusals()

    def _update_refusals(self) -> None:
        """Publish the refused topics for other threads, and remove the waiting messages of skipped topics."""
        problems = self._refusals.problems
        if self.skipped == self._refusals.skipped and self.refused == problems:
            return
        with self._lock:
            self.skipped, self.refused = frozenset(self._refusals.skipped), problems
            kept = [one for one in self._replies if one.topic not in self.skipped]
            self.replies_lost += len(self._replies) - len(kept)
            self._replies = deque(kept, REPLIES_MAX)
            self._due = {topic: None for topic in self._due if topic not in self.skipped}
            self._outbox = deque(row for row in self._outbox if row.topic not in self.skipped)
        self.wanting()

    def _take_requests(self, connection: BrokerConnection) -> None:
        """Check received requests. The event loop runs them."""
        received, connection.received = connection.received, []
        if self.commands is not None:
            take_requests(self.commands, received, self.budget, self.broker)

    def may_reply(self) -> bool:
        """Return whether the budget permits one more reply to a rejected request."""
        return self.budget is None or self.budget.take_reply(self.broker)

    def _disconnect(self, problem: str, advice: str = "") -> None:
        connection = self._connection
        if connection is not None:
            self._take_acknowledgements(connection)
            connection.close()
        with self._lock:
            self._connection = None
            self.session += 1
            self.connected, self.broker, self.problem = False, "", problem + advice
            self.limit = ""
            self._outbox.clear()
            messages, self._in_flight = list(self._in_flight.values()), {}
            self._refusals.lose([one.topic for one in messages], problem, self._now_ns())
            replies = [one.reply for one in messages if one.reply is not None]
            replies = [*replies, *self._replies]
            self.replies_lost += max(0, len(replies) - REPLIES_MAX)
            self._replies = deque(replies, REPLIES_MAX)
        self._update_refusals()
        self.wanting()

    def _say_farewell(self) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            number = connection.publish(self._will.topic, self._farewell, JSON_TYPE, retain=True)
            end_ns = self._now_ns() + round(FAREWELL_S * NS_PER_S)
            while number not in connection.acknowledged and (rest_ns := end_ns - self._now_ns()) > 0:
                connection.wait(rest_ns / NS_PER_S)
        except (BrokerError, MessageRefused):
            pass  # the broker publishes the last will
        self._take_acknowledgements(connection)
        connection.close()
        self._connection = None
