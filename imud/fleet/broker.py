"""Connection to one MQTT broker with paho-mqtt. The thread of the sender waits on the socket.

After a lost connection, imud makes a new object without old state. The spool contains the messages without an
acknowledgement, and the sender sends them again.
"""

import importlib
import logging
import os
import select
import threading
from collections.abc import Callable
from contextlib import closing
from random import random
from typing import Any, Final, NamedTuple, Protocol

from imud.fleet.paho_client import (
    CONNECT_S,
    CONNECTION_S,
    ConnectDeadline,
    close_client,
    connection_problem,
    open_client,
    paho_client,
    properties_of,
)
from imud.fleet.settings import Broker, MqttOptions
from imud.host.installation import needs_extra
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget, WorkLimits

LOST: Final = "the connection was lost"
UNANSWERED: Final = (
    "the broker closed the connection without a reply; check the log of the broker, and whether the port requires TLS "
    "or a client certificate"
)
# MQTT 3.1.1 has no reason code for this refusal
UNANSWERED_V3: Final = "; or whether it permits retained messages and a retained last will"
REFUSED: Final = 0x80  # lowest reason code of a refusal (MQTT 5.0, section 2.4)
TOO_LARGE: Final = 0x95  # reason code "Packet too large" (MQTT 5.0, section 2.4)
QUOTA: Final = 0x97  # reason code "Quota exceeded" (MQTT 5.0, section 2.4)
WITHOUT_RETAIN: Final = 0x9A  # reason code "Retain not supported" (MQTT 5.0, section 2.4)
UNCLAIMED: Final = 0x10  # reason code "No matching subscribers" (MQTT 5.0, section 2.4)


class BrokerError(Exception):
    """Cannot connect to a broker, or the broker ended the connection. Example: connection refused."""


class RetainRefused(BrokerError):
    """The broker permits no retained messages, and refuses the connection because of the retained last will."""


class MessageRefused(Exception):
    """The broker does not accept a message. The connection continues."""


log = logging.getLogger(__name__)

IN_FLIGHT_MAX: Final = 20  # Maximum number of messages without an acknowledgement. A broker can set a lower limit.
# Time between two checks for the end of the output, s, while imud waits for CONNACK. It is shorter than CLOSE_S of the
# sender.
LOOK_S: Final = 0.1
PACKET_BYTES: Final = 16_384  # maximum length of a packet from the broker, bytes: four times the longest request
# Maximum length of an MQTT packet, bytes (MQTT 5.0, section 2.1.4), if the broker does not set a lower limit
PACKET_BYTES_MOST: Final = 268_435_460
# Work that the packets of a broker may cause in the thread of the sender. Acknowledgements count too: 4,000 per second
# cost about 0.2 s. A request on the command channel has at most one reply.
BROKER_LIMITS: Final = WorkLimits(second_cpu_ns=200_000_000, turn_replies=8, second_replies=20)
DEFER_S: Final = 0.05  # time for which imud does not read from a broker above its budget, s
RECEIVED_MAX: Final = 100  # Maximum number of received messages in memory. imud takes them in each turn.
# Bytes of a packet without topic and payload: type, lengths, packet identifier, content type, and correlation data of
# 128 bytes
OVERHEAD_BYTES: Final = 200


class Will(NamedTuple):
    """Retained message that the broker publishes if the connection ends without DISCONNECT."""

    topic: str
    payload: bytes


class Received(NamedTuple):
    """Message from the broker."""

    topic: str
    payload: bytes
    retain: bool  # True if the broker stored the message (retained)
    response_topic: str  # topic for the reply; empty if the message does not contain it, and with MQTT 3.1.1
    correlation: bytes | None  # correlation data for the reply (MQTT 5 only)


class BrokerConnection(Protocol):
    """Connection to one broker. Synchronization: one thread; any thread may call `ring`."""

    # Packet identifiers of acknowledged messages and accepted subscriptions. The reader clears the list.
    acknowledged: list[int]
    # Packet identifiers in `acknowledged` of messages that the broker discarded, because no client has a subscription.
    # Only some brokers with MQTT 5 report this. The reader clears the set.
    unclaimed: set[int]
    in_flight_max: int  # maximum number of messages without an acknowledgement
    received: list[Received]  # Messages received from subscriptions. The reader clears the list.
    # Packet identifiers of refused messages and subscriptions with the reason. The reader clears the list.
    refused: list[tuple[int, str]]
    has_retain: bool  # whether the broker permits retained messages
    # Budget of the work that the packets of the broker cause; None: no limit. The owner starts its turns.
    budget: WorkBudget | None

    def subscribe(self, topic: str) -> int:
        """Subscribe to a topic. Return the packet identifier. Raises BrokerError."""
        ...

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        """Send a message with QoS 1. Return its packet identifier. Without `has_retain`, the message is not retained.
        Raises BrokerError, and MessageRefused if the message is longer than the broker accepts."""
        ...

    def wait(self, seconds: float) -> None:
        """Read and write pending data. Return after `seconds`, after data arrived, or after `ring`. Raises BrokerError
        if the connection is lost."""
        ...

    def ring(self) -> None:
        """Wake `wait`. If no call is waiting, the next call returns immediately."""
        ...

    def close(self) -> None:
        """Send DISCONNECT and close the connection. A second call does nothing."""
        ...


# Function that returns an accepted connection, with the arguments of `PahoConnection`. Raises BrokerError, and
# RetainRefused.
Connect = Callable[[Broker, MqttOptions, str, Will | None, Callable[[], bool]], BrokerConnection]


def check_extra() -> None:
    """Raise ServerError if paho-mqtt is not installed."""
    with needs_extra("mqtt", ServerError):
        importlib.import_module("paho.mqtt.client")


class PahoConnection:
    """`BrokerConnection` with paho-mqtt."""

    def __init__(
        self, broker: Broker, settings: MqttOptions, client_id: str, will: Will | None,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:  # fmt: skip
        """Connect within CONNECTION_S, and wait for CONNACK. `will` None: no last will, and no retained messages.

        Raises BrokerError, and RetainRefused if the broker refuses the retained last will. This method calls
        `is_wanted` after the socket is open and then every LOOK_S. If it returns False, another output may use the same
        client ID soon.
        """
        self.acknowledged: list[int] = []
        self.unclaimed: set[int] = set()
        self.in_flight_max = IN_FLIGHT_MAX
        self.received: list[Received] = []
        self.refused: list[tuple[int, str]] = []
        self.has_retain = will is not None
        self.budget: WorkBudget | None = None
        self._broker = broker
        self._is_v5 = settings.version == "5"
        self._answered = self._closed = self._woke = False
        self._is_retain_refused = False
        self._problem = ""
        self._topics: dict[int, str] = {}
        self._requested: set[int] = set()  # packet identifiers of subscriptions without an acknowledgement
        self._packet_bytes = PACKET_BYTES_MOST
        self._client: Any = None
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # another thread closes the descriptor, and its number may then belong to another file
        self._bell_lock = threading.Lock()
        try:
            self._client = paho_client(
                broker, settings, client_id, self, is_v5=self._is_v5, packet_bytes=PACKET_BYTES
            )  # fmt: skip
            if will is not None:
                self._client.will_set(will.topic, will.payload, qos=1, retain=True)
            self._client.on_socket_open = lambda *_: self._check_wanted(is_wanted)
            self._open(settings, is_wanted)
        except BrokerError as error:
            self.close()
            raise type(error)(f"{broker.name}: {error}") from error
        except (OSError, ValueError) as error:
            self.close()
            raise BrokerError(f"{broker.name}: {connection_problem(error)}") from error

    def _open(self, settings: MqttOptions, is_wanted: Callable[[], bool]) -> None:
        """Connect and wait for CONNACK, at most CONNECTION_S. Raises BrokerError, OSError and ValueError."""
        with closing(ConnectDeadline(self._client, CONNECTION_S)) as deadline:
            try:
                open_client(self._client, self._broker, settings.keep_alive_s, IN_FLIGHT_MAX, PACKET_BYTES)
                self._wait_for_answer(is_wanted)
            except (BrokerError, OSError, ValueError) as error:
                if deadline.is_over:
                    raise BrokerError(deadline.problem) from error
                raise

    def _wait_for_answer(self, is_wanted: Callable[[], bool]) -> None:
        """Raise BrokerError if the broker refuses the connection, does not reply, or if the output ends."""
        silent = 0
        # the number of turns is limited: a broker that sends data without CONNACK must not block the thread
        for _ in range(1000):
            if self._answered or self._problem:
                break
            self._turn(LOOK_S)
            self._check_wanted(is_wanted)
            silent = 0 if self._woke else silent + 1
            if silent * LOOK_S >= CONNECT_S and not self._answered:
                self._problem = self._problem or f"no answer within {CONNECT_S:g} s"
        if self._is_retain_refused:
            raise RetainRefused(self._problem)
        if self._problem:
            raise BrokerError(self._problem)

    def _check_wanted(self, is_wanted: Callable[[], bool]) -> None:
        if not is_wanted():
            raise BrokerError("the output ends")

    # --- as a connection ---------------------------------------------------------------------------------------------

    def subscribe(self, topic: str) -> int:
        """Subscribe to a topic. Return the packet identifier. Raises BrokerError."""
        try:
            failure, number = self._client.subscribe(topic, qos=1)
        except (OSError, ValueError) as error:
            raise BrokerError(f"{self._broker.name}: {connection_problem(error)}") from error
        if failure:
            self._fail(LOST)
        self._requested.add(number)
        return int(number)

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        """Send a message with QoS 1. Return its packet identifier. Raises BrokerError or MessageRefused."""
        properties = None
        if self._is_v5:
            given = {"ContentType": content_type or None, "CorrelationData": correlation}
            properties = properties_of("PUBLISH", **{name: one for name, one in given.items() if one is not None})
        if len(topic) + len(payload) + OVERHEAD_BYTES > self._packet_bytes:
            raise MessageRefused(
                f"the broker accepts messages of at most {self._packet_bytes} bytes, got a message of {topic} with "
                f"{len(payload)}: raise the limit of the broker"
            )
        try:
            is_retained = retain and self.has_retain
            info = self._client.publish(topic, payload, qos=1, retain=is_retained, properties=properties)
        except (OSError, ValueError) as error:
            raise BrokerError(f"{self._broker.name}: {connection_problem(error)}") from error
        if info.rc:
            self._fail(LOST)
        self._topics[info.mid] = topic
        return int(info.mid)

    def wait(self, seconds: float) -> None:
        """Read and write pending data. Raises BrokerError."""
        self._turn(seconds)
        if self._problem:
            raise BrokerError(f"{self._broker.name}: {self._problem}")

    def ring(self) -> None:
        """Wake `wait`."""
        with self._bell_lock:
            if not self._closed:
                os.eventfd_write(self._bell, 1)

    def close(self) -> None:
        """Send DISCONNECT and close the connection. A second call does nothing."""
        with self._bell_lock:
            if self._closed:
                return
            self._closed = True
        if self._client is not None:
            close_client(self._client)
        os.close(self._bell)

    # --- socket -------------------------------------------------------------------------------------------------------

    def _turn(self, seconds: float) -> None:
        """Wait once for the socket or for `ring`, then process pending data."""
        client, sock = self._client, self._client.socket()
        if sock is None:
            self._problem = self._problem or self._loss
            return
        poll = select.poll()
        poll.register(sock.fileno(), select.POLLIN | (select.POLLOUT if client.want_write() else 0))
        poll.register(self._bell, select.POLLIN)
        # bytes that the TLS library already read: poll does not report them
        pending = getattr(sock, "pending", lambda: 0)()
        ready = dict(poll.poll(0 if pending else seconds * 1000))
        self._woke = bool(ready) or bool(pending)
        if self._bell in ready:
            os.eventfd_read(self._bell)
        events = ready.get(sock.fileno(), 0)
        try:
            if (pending or events & ~select.POLLOUT) and self._may_read():
                client.loop_read()
            if events & select.POLLOUT and client.socket() is not None:
                client.loop_write()
            client.loop_misc()
        except (OSError, ValueError) as error:
            self._problem = self._problem or connection_problem(error)
        if self.budget is not None:
            self.budget.end_turn()
        if client.socket() is None:
            self._problem = self._problem or self._loss

    @property
    def _loss(self) -> str:
        """Problem of a connection that the broker closed."""
        if self._answered:
            return LOST
        return UNANSWERED + UNANSWERED_V3 * (not self._is_v5 and self.has_retain)

    def _may_read(self) -> bool:
        """Return whether the budget permits a read. Otherwise wait for DEFER_S: the data stay in the kernel."""
        if self.budget is None or self.budget.admit(self._broker.name):
            return True
        poll = select.poll()
        poll.register(self._bell, select.POLLIN)
        poll.poll(DEFER_S * 1000)
        return False

    def _fail(self, problem: str) -> None:
        self._problem = self._problem or problem
        raise BrokerError(f"{self._broker.name}: {self._problem}")

    # --- callbacks of paho-mqtt, called in `_turn`
    # -----------------------------------------------------------------------

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._problem = f"the broker refuses the connection: {reason}"
            self._is_retain_refused = self.has_retain and reason.value == WITHOUT_RETAIN
            return
        self.has_retain = self.has_retain and bool(getattr(properties, "RetainAvailable", 1))
        allowed = getattr(properties, "ReceiveMaximum", IN_FLIGHT_MAX)
        self.in_flight_max = max(1, min(IN_FLIGHT_MAX, allowed))
        self._packet_bytes = getattr(properties, "MaximumPacketSize", PACKET_BYTES_MOST)
        self._answered = True

    def _on_publish(self, _client: Any, _data: Any, mid: int, reason: Any, _properties: Any) -> None:
        topic = self._topics.pop(mid, "")
        if reason is not None and reason.value >= REFUSED:
            if reason.value == QUOTA:  # the broker can accept the same message later
                self._problem = self._problem or f"the broker refuses messages of {topic}: {reason}"
            else:
                self.refused.append((mid, f"{reason}{_advice(reason.value)}"))
            return
        self.acknowledged.append(mid)
        if reason is not None and reason.value == UNCLAIMED:
            self.unclaimed.add(mid)

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        if not self._answered or len(self.received) >= RECEIVED_MAX:
            self._problem = self._problem or "the broker sent a message that imud did not request"
            return
        properties = message.properties
        self.received.append(
            Received(
                message.topic,
                message.payload,
                bool(message.retain),
                getattr(properties, "ResponseTopic", ""),
                getattr(properties, "CorrelationData", None),
            )
        )

    def _on_subscribe(self, _client: Any, _data: Any, mid: int, reasons: Any, _properties: Any) -> None:
        if mid not in self._requested:
            self._problem = self._problem or "the broker confirmed a subscription that imud did not request"
            return
        self._requested.remove(mid)
        if len(reasons) != 1:
            self._problem = self._problem or (
                f"expected 1 reason code for a subscription from the broker, got {len(reasons)}"
            )
            return
        if reasons[0].value >= REFUSED:
            self.refused.append((mid, f"{reasons[0]}{RIGHTS}"))
        else:
            self.acknowledged.append(mid)

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            advice = SIZE_LIMIT if reason.value == TOO_LARGE else ""
            self._problem = self._problem or f"the broker ended the connection: {reason}{advice}"


RIGHTS: Final = "; check the access rights of the gateway"
SIZE_LIMIT: Final = "; raise the size limit of the broker"


def _advice(reason: int) -> str:
    """Return the next step after the refusal of a message."""
    return SIZE_LIMIT if reason == TOO_LARGE else RIGHTS


FIRST_S: Final = 4.0  # Maximum length of the first pause, s. 500 gateways then reconnect at 125 per second.
# Minimum duration of a stable connection, ns. After it, pauses start with FIRST_S again.
STABLE_NS: Final = 30 * NS_PER_S


class BrokerTurn:
    """Order of the brokers and pauses between attempts. Synchronization: one thread."""

    def __init__(self, brokers: list[Broker], most_s: float, draw: Callable[[], float] = random) -> None:
        """`draw` returns random numbers from 0 to below 1."""
        self._brokers = brokers
        self._most_s = most_s
        self._draw = draw
        self._at = 0
        self._failed = 0
        self.short_runs = 0  # number of connections in sequence that were lost within STABLE_NS
        self._up_ns: int | None = None

    @property
    def broker(self) -> Broker:
        """Return the broker of the next attempt."""
        return self._brokers[self._at]

    def connected(self, now_ns: int) -> None:
        """Store the time of an accepted connection."""
        self._up_ns = now_ns

    def failed(self, now_ns: int) -> float:
        """Store a failed attempt or a lost connection. Return the pause before the next attempt, s. After a lost
        connection, imud tries the same broker again. After a failed attempt, it tries the next broker."""
        up_ns, self._up_ns = self._up_ns, None
        if up_ns is not None:
            self.short_runs = self.short_runs + 1 if now_ns - up_ns < STABLE_NS else 0
            self._failed = self._failed if self.short_runs else 0
        if up_ns is None:
            self._at = (self._at + 1) % len(self._brokers)
        length_s: float = min(self._most_s, FIRST_S * 2.0 ** min(self._failed // len(self._brokers), 16))
        self._failed += 1
        return self._draw() * length_s
