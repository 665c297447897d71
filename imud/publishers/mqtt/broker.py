"""One connection to a broker, by paho-mqtt, without a thread of its own: the sender's thread waits on its socket.

A connection is used once: after a loss a new one is made, which begins without any state of the old one. What the old
one had sent without an answer is in the spool and is sent again.
"""

import importlib
import logging
import os
import select
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, NamedTuple, Protocol

from imud.errors import ServerError
from imud.publishers.mqtt.access import (
    CONNECT_S,
    LOST,
    REFUSED,
    UNANSWERED,
    BrokerError,
    connection_problem,
    paho_client,
    properties_of,
)
from imud.publishers.mqtt.settings import Broker, MqttSettings

log = logging.getLogger(__name__)

IN_FLIGHT_MAX: Final = 20
"""Messages without an acknowledgement, unless the broker allows fewer: what brokers usually allow."""
LOOK_S: Final = 0.1
"""While the broker's answer is waited for, the end of the output is looked at so often: less than it waits itself."""
PACKET_BYTES: Final = 16_384
"""The broker may send so much at once: four times the longest request."""
PACKET_BYTES_MOST: Final = 268_435_460
"""The longest packet that MQTT has (MQTT 5.0, section 2.1.4), where the broker does not say less."""
OVERHEAD_BYTES: Final = 200
"""Of a message besides topic and payload: type, lengths, number, content type, and correlation data of 128 bytes."""
EXTRA_MISSING: Final = "the output mqtt needs the extra mqtt: pip install 'imud[mqtt]'"


class Will(NamedTuple):
    """What the broker publishes, retained, when the connection ends without a farewell."""

    topic: str
    payload: bytes


class Received(NamedTuple):
    """A message from the broker."""

    topic: str
    payload: bytes
    retain: bool
    """Whether the broker had kept it."""
    response_topic: str
    """Where the answer is to go; empty where the message says nothing, and with MQTT 3.1.1."""
    correlation: bytes | None
    """To be sent back with the answer; with MQTT 5 only."""


class BrokerConnection(Protocol):
    """A connection to one broker. Synchronization: one thread; `ring` from any."""

    acknowledged: list[int]
    """Numbers of messages that the broker has taken; whoever reads them clears them."""
    in_flight_max: int
    """Messages that may be without an acknowledgement."""
    received: list[Received]
    """Messages of subscriptions; whoever reads them clears them."""

    def subscribe(self, topic: str) -> None:
        """Ask for messages of a topic. Raises BrokerError."""
        ...

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        """Send a message with QoS 1; return its number. Raises BrokerError."""
        ...

    def wait(self, seconds: float) -> None:
        """Read and write what is there; return after so much time, after something came, or on `ring`.

        Raises BrokerError when the connection is lost, or a message was refused.
        """
        ...

    def ring(self) -> None:
        """End the present wait, or the next."""
        ...

    def close(self) -> None:
        """End the connection with a farewell; may be called twice."""
        ...


class Connect(Protocol):
    """Function that connects to a broker."""

    def __call__(
        self, broker: Broker, settings: MqttSettings, client_id: str, will: Will, is_wanted: Callable[[], bool], /
    ) -> BrokerConnection:
        """Return a connection that the broker has accepted. Raises BrokerError, also once `is_wanted` returns False."""
        ...


def check_extra() -> None:
    """Raise ServerError where paho-mqtt is missing."""
    try:
        importlib.import_module("paho.mqtt.client")
    except ImportError as error:
        raise ServerError(EXTRA_MISSING) from error


class PahoConnection:
    """A connection by paho-mqtt. Synchronization: as `BrokerConnection`."""

    def __init__(
        self, broker: Broker, settings: MqttSettings, client_id: str, will: Will,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:  # fmt: skip
        """Connect and wait for the answer. Raises BrokerError.

        `is_wanted` is asked when the socket is open and then every LOOK_S: the name of the client is another's soon.
        """
        self.acknowledged: list[int] = []
        self.in_flight_max = IN_FLIGHT_MAX
        self.received: list[Received] = []
        self._broker = broker
        self._is_v5 = settings.version == "5"
        self._answered = self._closed = self._woke = False
        self._problem = ""
        self._topics: dict[int, str] = {}
        self._packet_bytes = PACKET_BYTES_MOST
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._bell_lock = threading.Lock()
        """Held while the bell is rung: it is closed by another thread, and its number may then be another file's."""
        try:
            self._client = self._made(settings, client_id, will)
            self._client.on_socket_open = lambda *_: self._check_wanted(is_wanted)
            self._client.connect(
                broker.host, broker.port, keepalive=settings.keep_alive_s, properties=self._connect_properties()
            )
            self._wait_for_answer(is_wanted)
        except BrokerError as error:
            self.close()
            raise BrokerError(f"{broker.name}: {error}") from error
        except (OSError, ValueError) as error:
            self.close()
            raise BrokerError(f"{broker.name}: {connection_problem(error)}") from error

    def _made(self, settings: MqttSettings, client_id: str, will: Will) -> Any:
        """A client of paho-mqtt with everything but a connection. Raises OSError for files, ValueError."""
        client = paho_client(self._broker, settings, client_id, is_v5=self._is_v5)
        client.will_set(will.topic, will.payload, qos=1, retain=True)
        client.on_connect = self._on_connect
        client.on_publish = self._on_publish
        client.on_disconnect = self._on_disconnect
        client.on_message = self._on_message
        client.on_subscribe = self._on_subscribe
        return client

    def _wait_for_answer(self, is_wanted: Callable[[], bool]) -> None:
        """Raises BrokerError for a refusal, without an answer, and where it is not wanted any more."""
        silent = 0
        for _ in range(1000):
            if self._answered or self._problem:
                break
            self._turn(LOOK_S)
            self._check_wanted(is_wanted)
            silent = 0 if self._woke else silent + 1
            if silent * LOOK_S >= CONNECT_S and not self._answered:
                self._problem = self._problem or f"no answer within {CONNECT_S:g} s"
        if self._problem:
            raise BrokerError(self._problem)

    def _check_wanted(self, is_wanted: Callable[[], bool]) -> None:
        if not is_wanted():
            raise BrokerError("the output ends")

    def _connect_properties(self) -> Any:
        """How much the broker may send at once; None with MQTT 3.1.1."""
        return (
            properties_of("CONNECT", MaximumPacketSize=PACKET_BYTES, ReceiveMaximum=IN_FLIGHT_MAX)
            if self._is_v5
            else None
        )

    # --- as a connection ---------------------------------------------------------------------------------------------

    def subscribe(self, topic: str) -> None:
        """Ask for messages of a topic. Raises BrokerError."""
        try:
            self._client.subscribe(topic, qos=1)
        except (OSError, ValueError) as error:
            raise BrokerError(f"{self._broker.name}: {connection_problem(error)}") from error

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        """Send a message. Raises BrokerError."""
        properties = None
        if self._is_v5:
            given = {"ContentType": content_type or None, "CorrelationData": correlation}
            properties = properties_of("PUBLISH", **{name: one for name, one in given.items() if one is not None})
        if len(topic) + len(payload) + OVERHEAD_BYTES > self._packet_bytes:
            self._fail(
                f"expected messages of at most {self._packet_bytes} bytes, which is what the broker takes, got one of "
                f"{topic} with {len(payload)}: raise the broker's limit"
            )
        try:
            info = self._client.publish(topic, payload, qos=1, retain=retain, properties=properties)
        except (OSError, ValueError) as error:
            raise BrokerError(f"{self._broker.name}: {connection_problem(error)}") from error
        if info.rc:
            self._fail(LOST)
        self._topics[info.mid] = topic
        return int(info.mid)

    def wait(self, seconds: float) -> None:
        """Read and write what is there. Raises BrokerError."""
        self._turn(seconds)
        if self._problem:
            raise BrokerError(f"{self._broker.name}: {self._problem}")

    def ring(self) -> None:
        """End the present wait, or the next."""
        with self._bell_lock:
            if not self._closed:
                os.eventfd_write(self._bell, 1)

    def close(self) -> None:
        """End the connection; may be called twice."""
        with self._bell_lock:
            if self._closed:
                return
            self._closed = True
        client = getattr(self, "_client", None)
        if client is not None:
            with suppress(OSError, ValueError):  # it is gone already
                client.disconnect()
                sock = client.socket()
                if sock is not None:  # what the farewell would follow was not sent: nothing is read at the other end
                    sock.close()
        os.close(self._bell)

    # --- the socket --------------------------------------------------------------------------------------------------

    def _turn(self, seconds: float) -> None:
        """Wait for the socket once and do what paho-mqtt has to do."""
        client, sock = self._client, self._client.socket()
        if sock is None:
            self._problem = self._problem or (LOST if self._answered else UNANSWERED)
            return
        poll = select.poll()
        poll.register(sock.fileno(), select.POLLIN | (select.POLLOUT if client.want_write() else 0))
        poll.register(self._bell, select.POLLIN)
        pending = getattr(sock, "pending", lambda: 0)()
        ready = dict(poll.poll(0 if pending else seconds * 1000))
        self._woke = bool(ready) or bool(pending)
        if self._bell in ready:
            os.eventfd_read(self._bell)
        events = ready.get(sock.fileno(), 0)
        try:
            if pending or events & ~select.POLLOUT:
                client.loop_read()
            if events & select.POLLOUT and client.socket() is not None:
                client.loop_write()
            client.loop_misc()
        except (OSError, ValueError) as error:
            self._problem = self._problem or connection_problem(error)
        if client.socket() is None:
            self._problem = self._problem or (LOST if self._answered else UNANSWERED)

    def _fail(self, problem: str) -> None:
        self._problem = self._problem or problem
        raise BrokerError(f"{self._broker.name}: {self._problem}")

    # --- what paho-mqtt calls, in `_turn` ----------------------------------------------------------------------------

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._problem = f"the broker refuses the connection: {reason}"
            return
        allowed = getattr(properties, "ReceiveMaximum", IN_FLIGHT_MAX)
        self.in_flight_max = max(1, min(IN_FLIGHT_MAX, allowed))
        self._packet_bytes = getattr(properties, "MaximumPacketSize", PACKET_BYTES_MOST)
        self._answered = True

    def _on_publish(self, _client: Any, _data: Any, mid: int, reason: Any, _properties: Any) -> None:
        topic = self._topics.pop(mid, "")
        if reason is not None and reason.value >= REFUSED:
            self._problem = self._problem or f"the broker refuses messages of {topic}: {reason}"
            return
        self.acknowledged.append(mid)

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
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

    def _on_subscribe(self, _client: Any, _data: Any, _mid: int, reasons: Any, _properties: Any) -> None:
        for reason in reasons:
            if reason.value >= REFUSED:
                log.warning("mqtt: %s: the broker refuses to send requests: %s", self._broker.name, reason)

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._problem = self._problem or f"the broker ended the connection: {reason}"
