"""The thread that talks to the broker: connects, sends what it is given, and passes on what was acknowledged.

    writer ──give──▶ outbox ──▶ connection ──▶ broker
    writer ◀──acknowledged── … ◀── PUBACK

It holds a few messages at a time, so that the spool keeps all others. Each connection has a number, its session: what
was given in one is given again in the next, and an acknowledgement of an earlier one does not count.
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

REPLIES_MAX: Final = 32
"""Answers that wait for a connection; the oldest go first."""
OUTBOX_MAX: Final = 60
"""Messages that are held in memory: three windows of those without an acknowledgement, 6 MB at most."""
WAIT_S: Final = 1.0
"""Longest sleep: keep-alives and the end are looked at so often."""
CLOSE_S: Final = 0.5
"""The end waits so long for the farewell: samples wait for it when the configuration is read again."""
FAREWELL_S: Final = 0.3
"""Of that, for the acknowledgement of the farewell."""


class MqttSender:
    """The thread. Synchronization: methods from the writer's thread, counters read by any; `run` is the thread's."""

    def __init__(
        self, settings: MqttOptions, client_id: str, will: Will, turn: BrokerTurn, connect: Connect,
        now_ns: Callable[[], int], commands: CommandChannel | None = None,
    ) -> None:  # fmt: skip
        self.session = 0
        """Number of the connection; changes when it is made and when it is lost."""
        self.connected = False
        self.broker = ""
        """Name of the broker that is connected; empty while there is none."""
        self.problem = ""
        """Why nothing is sent now, one sentence; empty while all is well, or before the first attempt."""
        self.sent = 0
        """Messages of the spool that were sent, those sent again included."""
        self.acknowledged = 0
        """Messages of the spool that the broker has taken."""
        self.reconnects = 0
        """Connections after the first."""
        self.failure: BaseException | None = None
        """The exception that ended the thread, which is an internal error."""
        self.wanting: Callable[[], None] = lambda: None
        """Called in the thread when there is room for messages, or acknowledgements wait; set by the writer."""
        self._settings, self._client_id, self._will = settings, client_id, will
        self._turn, self._connect, self._now_ns = turn, connect, now_ns
        self._commands = commands
        self._replies: deque[CommandReply] = deque(maxlen=REPLIES_MAX)
        self._sent_replies: dict[int, CommandReply] = {}
        """Answers without an acknowledgement, by the numbers of their messages."""
        self._lock = threading.Lock()
        self._outbox: deque[SpoolRow] = deque()
        self._in_flight: dict[int, int] = {}
        self._answers: list[tuple[int, int]] = []
        self._retained: dict[str, bytes] = {}
        self._due: dict[str, None] = {}
        self._connection: BrokerConnection | None = None
        self._wake = WakeEvent()
        self._ended = False
        self._last_words = b""
        self._thread: threading.Thread | None = None
        self._was_connected = False

    def start(self) -> None:
        """Start the thread."""
        self._thread = threading.Thread(target=self._main, name="mqtt sender", daemon=True)
        self._thread.start()

    def close(self, last_words: bytes) -> None:
        """Publish the retained farewell and end; may be called twice. What is not acknowledged stays in the spool.

        A thread that is still connecting makes no connection any more: its name may be that of the next output's.
        """
        self._last_words = last_words
        self._ended = True
        self._ring()
        self.join(CLOSE_S)

    def join(self, seconds: float) -> None:
        """Return when the thread has ended, or after so much time."""
        if self._thread is not None:
            self._thread.join(seconds)

    # --- the writer's side -------------------------------------------------------------------------------------------

    def room(self) -> int:
        """How many messages may be given now."""
        with self._lock:
            return OUTBOX_MAX - len(self._outbox) - len(self._in_flight) if self.connected else 0

    def give(self, session: int, rows: list[SpoolRow]) -> None:
        """Have messages sent, in their order; ignored when the session is over."""
        with self._lock:
            if session != self.session:
                return
            self._outbox.extend(rows)
        self._ring()

    def retain(self, messages: Mapping[str, bytes]) -> None:
        """Publish messages that the broker keeps, by topic: now, and at each new connection. An empty one removes."""
        with self._lock:
            for topic, payload in messages.items():
                if self._retained.get(topic) != payload:
                    self._retained[topic] = payload
                    self._due[topic] = None
        self._ring()

    def reply(self, reply: CommandReply) -> None:
        """Send an answer to a request, before all else, and again if its connection is lost. From any thread."""
        with self._lock:
            self._replies.append(reply)
        self._ring()

    def take_acknowledged(self) -> list[tuple[int, int]]:
        """Return session and id of what was acknowledged since the last call."""
        with self._lock:
            answers, self._answers = self._answers, []
            return answers

    def _ring(self) -> None:
        self._wake.ring()
        connection = self._connection
        if connection is not None:
            connection.ring()

    # --- the thread --------------------------------------------------------------------------------------------------

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
        """Sleep between attempts: only the end is a reason to wake."""
        due_ns = self._now_ns() + round(seconds * NS_PER_S)
        while not self._ended and (rest_ns := due_ns - self._now_ns()) > 0:
            self._wake.wait(min(rest_ns / NS_PER_S, WAIT_S))

    def work(self) -> float:
        """Connect, or send and wait for the broker once; return how long nothing is to be done, s."""
        connection = self._connection
        try:
            if connection is None:
                self._open()
            else:
                self._send(connection)
                connection.wait(WAIT_S)
                self._pass_on(connection)
                self._take_requests(connection)
        except BrokerError as error:
            self._lose(str(error))
            return self._turn.failed(self._now_ns())
        return 0.0

    def _open(self) -> None:
        broker = self._turn.broker
        connection = self._connect(broker, self._settings, self._client_id, self._will, lambda: not self._ended)
        if self._ended:
            connection.close()
            return
        if self._commands is not None:
            connection.subscribe(self._commands.subscription)
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
        """Send what the window has room for, what is retained first."""
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
        """Send the oldest answer; return whether there was one."""
        with self._lock:
            if not self._replies:
                return False
            reply = self._replies[0]
        number = connection.publish(reply.topic, reply.payload, JSON_TYPE, retain=False, correlation=reply.correlation)
        with self._lock:
            if self._replies and self._replies[0] is reply:  # it is not where newer ones took its room meanwhile
                self._replies.popleft()
            self._sent_replies[number] = reply
            self._in_flight[number] = 0
        return True

    def _pass_on(self, connection: BrokerConnection) -> None:
        """Pass on what was acknowledged."""
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
        """Check what came; the event loop carries it out."""
        received, connection.received = connection.received, []
        for one in received:
            if self._commands is not None:
                self._commands.take(one)

    def _lose(self, problem: str) -> None:
        connection = self._connection
        if connection is not None:
            self._pass_on(connection)
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
            number = connection.publish(self._will.topic, self._last_words, JSON_TYPE, retain=True)
            end_ns = self._now_ns() + round(FAREWELL_S * NS_PER_S)
            while number not in connection.acknowledged and (rest_ns := end_ns - self._now_ns()) > 0:
                connection.wait(rest_ns / NS_PER_S)
        except BrokerError:
            pass  # the broker publishes the last will
        self._pass_on(connection)
        connection.close()
        self._connection = None
