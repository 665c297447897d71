"""Thread that connects to the broker, sends messages, and passes the acknowledgements to the writer.

    writer ──give──▶ outbox ──▶ connection ──▶ broker
    writer ◀──acknowledged── … ◀── PUBACK

The sender holds only a few messages; the spool contains all others. Each connection has a number, the session. In the
next session the writer gives messages without an acknowledgement again. The sender ignores acknowledgements of earlier
sessions.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from imud.fleet.broker import BrokerConnection, BrokerError, BrokerTurn, Connect, Will
from imud.fleet.commands import CommandChannel, CommandReply
from imud.fleet.messages import JSON_TYPE, MAGIC, SLOTS_TYPE
from imud.fleet.settings import MqttOptions
from imud.fleet.spool import SpoolRow
from imud.host.threads import WakeEvent
from imud.model.units import NS_PER_S

REPLIES_MAX: Final = 32  # Maximum number of replies that wait for a connection. The sender drops the oldest.
OUTBOX_MAX: Final = 60  # maximum number of messages in memory, 6 MB at most: three times IN_FLIGHT_MAX
WAIT_S: Final = 1.0  # Maximum wait, s. The thread then checks keep-alives and the end.
# Maximum wait of `close` for the thread, s. Samples wait for it during a reload of the configuration.
CLOSE_S: Final = 0.5
# Number of connections in sequence that were lost soon, after which imud names the usual cause: the broker closes a
# connection if another client connects with the same client ID. Most brokers do not report this reason.
SHORT_RUNS: Final = 3
FAREWELL_S: Final = 0.3  # part of CLOSE_S for the acknowledgement of the farewell, s


class MqttSender:
    """Thread of the connection. The writer calls the methods, any thread reads counters, the thread calls `work`."""

    def __init__(
        self, settings: MqttOptions, client_id: str, will: Will, turn: BrokerTurn, connect: Connect,
        now_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        self.session = 0  # Number of the connection. It changes at each connection and each loss.
        self.connected = False
        self.broker = ""  # name of the connected broker; empty if there is none
        # Cause of a missing connection, one sentence; empty if the connection works, and before the first attempt
        self.problem = ""
        self.sent = 0  # number of sent messages of the spool, including repeated messages
        self.acknowledged = 0  # number of acknowledged messages of the spool
        self.reconnects = 0  # number of connections after the first
        self.failure: BaseException | None = None  # internal error that ended the thread
        # Called by the thread if messages are wanted or acknowledgements wait. The writer sets it.
        self.wanting: Callable[[], None] = lambda: None
        self.commands: CommandChannel | None = None  # receiver of requests; set before `start`
        self._settings, self._client_id, self._will = settings, client_id, will
        self._turn, self._connect, self._now_ns = turn, connect, now_ns
        self._replies: deque[CommandReply] = deque(maxlen=REPLIES_MAX)
        self._sent_replies: dict[int, CommandReply] = {}  # replies without an acknowledgement, by packet identifier
        self._lock = threading.Lock()
        self._outbox: deque[SpoolRow] = deque()  # rows of the spool
        self._in_flight: dict[int, int] = {}  # row ID by packet identifier, 0 for other messages
        self._answers: list[tuple[int, int]] = []
        self._retained: dict[str, bytes] = {}  # newest payload by topic
        self._due: dict[str, None] = {}  # topics of retained messages to send, in order
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
            self._outbox.extend(rows)
        self._ring()

    def retain(self, messages: Mapping[str, bytes]) -> None:
        """Publish retained messages by topic, now and at each new connection. An empty payload removes the message."""
        with self._lock:
            for topic, payload in messages.items():
                if self._retained.get(topic) != payload:
                    self._retained[topic] = payload
                    self._due[topic] = None
        self._ring()

    def reply(self, reply: CommandReply) -> None:
        """Send a reply before all other messages, and again after a lost connection. Any thread may call it."""
        with self._lock:
            self._replies.append(reply)
        self._ring()

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
        except BaseException as error:  # noqa: BLE001 - an internal error must end the daemon, not just this thread
            self.failure = error

    def _wake_after(self, seconds: float) -> None:
        """Sleep between two attempts. Only the end wakes the thread earlier."""
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
                self._send(connection)
                connection.wait(WAIT_S)
                self._take_acknowledgements(connection)
                self._take_requests(connection)
        except BrokerError as error:
            pause_s, problem = self._turn.failed(self._now_ns()), str(error)
            if self._turn.short_runs >= SHORT_RUNS:
                problem += f"; does another gateway use the client ID {self._client_id} (mqtt.gateway)?"
            self._disconnect(problem)
            return pause_s
        return 0.0

    def _open(self) -> None:
        broker = self._turn.broker
        connection = self._connect(broker, self._settings, self._client_id, self._will, lambda: not self._ended)
        if self._ended:
            connection.close()
            return
        if self.commands is not None:
            connection.subscribe(self.commands.subscription)
        self._turn.connected(self._now_ns())
        self.reconnects += self._was_connected
        self._was_connected = True
        with self._lock:
            self._connection = connection
            self._due = dict.fromkeys(self._retained)
            self.session += 1
            self.connected, self.broker, self.problem = True, broker.name, ""
        self.wanting()

    def _send(self, connection: BrokerConnection) -> None:
        """Send messages up to the window of the broker: replies first, then retained messages, then the spool."""
        while len(self._in_flight) < connection.in_flight_max:
            if self._send_reply(connection):
                continue
            with self._lock:
                topic = next(iter(self._due), None)
                if topic is not None:
                    del self._due[topic]
                    payload = self._retained[topic]
                    if not payload:
                        del self._retained[topic]
                row = self._outbox.popleft() if topic is None and self._outbox else None
            if topic is not None:
                self._in_flight[connection.publish(topic, payload, JSON_TYPE, retain=True)] = 0
            elif row is not None:
                kind = SLOTS_TYPE if row.payload.startswith(MAGIC) else JSON_TYPE
                self._in_flight[connection.publish(row.topic, row.payload, kind, retain=False)] = row.id
                self.sent += 1
            else:
                return

    def _send_reply(self, connection: BrokerConnection) -> bool:
        """Send the oldest reply. Return whether there was one."""
        with self._lock:
            if not self._replies:
                return False
            reply = self._replies[0]
        number = connection.publish(reply.topic, reply.payload, JSON_TYPE, retain=False, correlation=reply.correlation)
        with self._lock:
            if self._replies and self._replies[0] is reply:  # newer replies can have removed it from the full queue
                self._replies.popleft()
            self._sent_replies[number] = reply
            self._in_flight[number] = 0
        return True

    def _take_acknowledgements(self, connection: BrokerConnection) -> None:
        """Pass the acknowledgements to the writer."""
        if not connection.acknowledged:
            return
        numbers = connection.acknowledged[:]
        connection.acknowledged.clear()
        with self._lock:
            ids = [self._in_flight.pop(number, 0) for number in numbers]
            for number in numbers:
                self._sent_replies.pop(number, None)
            self._answers += [(self.session, one) for one in ids if one]
            self.acknowledged += sum(map(bool, ids))
            is_low = 2 * (len(self._outbox) + len(self._in_flight)) <= OUTBOX_MAX
        if is_low:
            self.wanting()

    def _take_requests(self, connection: BrokerConnection) -> None:
        """Check received requests. The event loop runs them."""
        received, connection.received = connection.received, []
        for one in received:
            if self.commands is not None:
                self.commands.take(one)

    def _disconnect(self, problem: str) -> None:
        connection = self._connection
        if connection is not None:
            self._take_acknowledgements(connection)
            connection.close()
        with self._lock:
            self._connection = None
            self.session += 1
            self.connected, self.broker, self.problem = False, "", problem
            self._outbox.clear()
            self._in_flight.clear()
            self._replies = deque([*self._sent_replies.values(), *self._replies], REPLIES_MAX)
            self._sent_replies.clear()
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
        except BrokerError:
            pass  # the broker publishes the last will
        self._take_acknowledgements(connection)
        connection.close()
        self._connection = None
