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
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from random import random
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec

from imud.fleet.settings import Broker, MqttOptions
from imud.host.files import read_regular
from imud.host.installation import needs_extra
from imud.host.network import tls_context
from imud.model.errors import ServerError, reason_of
from imud.model.units import NS_PER_S

if TYPE_CHECKING:
    import ssl

CONNECT_S: Final = 4.0  # Time limit for each of TCP, TLS and CONNACK, s. Satellite links take 2 s.
LOST: Final = "the connection was lost"
UNANSWERED: Final = (
    "the broker closed the connection without a reply; check the log of the broker, and whether the port requires TLS "
    "or a client certificate"
)
REFUSED: Final = 0x80  # lowest reason code of a refusal (MQTT 5.0, section 2.4)
QUOTA: Final = 0x97  # reason code "Quota exceeded" (MQTT 5.0, section 2.4)
UNCLAIMED: Final = 0x10  # reason code "No matching subscribers" (MQTT 5.0, section 2.4)
# Maximum length of a file of certificates, bytes. The file with all authorities of Debian has 0.2 MB.
PEM_BYTES: Final = 4 << 20
MQTT_5: Final = 5  # value of `MQTTv5` in paho-mqtt: protocol version in CONNECT (MQTT 5.0, section 3.1.2.2)
PASSWORD_BYTES: Final = 65_535  # maximum length of a password, bytes (MQTT 5.0, section 3.1.3.6)


class BrokerError(Exception):
    """Cannot connect to a broker, or the broker ended the connection. Example: connection refused."""


class MessageRefused(Exception):
    """The broker does not accept a message. The connection continues."""


class ReaderAccess(msgspec.Struct, frozen=True):
    """User and certificates of a reader. The keys of `mqtt` with the same names describe the fields."""

    user: str = ""
    password_file: str | None = None
    ca_file: str | None = None
    cert_file: str | None = None
    key_file: str | None = None


BrokerAccess = MqttOptions | ReaderAccess

# Callbacks of paho-mqtt. The owner of a client implements the callbacks that it needs as `_on_connect`, ….
CALLBACKS: Final = ("on_connect", "on_disconnect", "on_message", "on_publish", "on_subscribe")


# Maximum number of packets from a broker that does not read the replies
UNREAD_MAX: Final = 10_000
# Maximum length of an incomplete WebSocket frame, bytes. paho-mqtt keeps the whole frame in memory.
WEBSOCKET_BYTES: Final = 16 << 20
PUBLISH: Final = 0x30  # type of a PUBLISH packet in the first byte (MQTT 5.0, section 2.1.2)


class PacketGuard:
    """Check of the packets from a broker before paho-mqtt stores them. A hostile broker must not fill the memory."""

    def __init__(self, packet_bytes: int) -> None:
        """`packet_bytes` is the maximum length of a packet after its fixed header."""
        self._packet_bytes = packet_bytes
        self._left = 0  # bytes of the packet that have not arrived
        self._shift = -1  # position of the next 7 bits of the length; -1 before the first byte of a packet
        self._length = 0
        self._unread = 0  # number of packets since all replies were written

    def take(self, data: bytes, *, is_writing: bool) -> None:
        """Check received bytes. `is_writing`: replies wait, because the broker does not read. Raises ValueError."""
        at = 0
        self._unread = self._unread if is_writing else 0
        while at < len(data):
            if self._left:
                step = min(self._left, len(data) - at)
                at, self._left = at + step, self._left - step
                continue
            byte, at = data[at], at + 1
            if self._shift < 0:
                if byte & 0xF0 == PUBLISH and byte >> 1 & 3 > 1:
                    raise ValueError("the broker sent a message with QoS 2; imud requests at most QoS 1")
                self._shift = self._length = 0
                continue
            self._length |= (byte & 0x7F) << self._shift
            self._shift += 7
            if self._length > self._packet_bytes:
                raise ValueError(
                    f"expected a packet of at most {self._packet_bytes} bytes from the broker, got a longer packet"
                )
            if byte < 0x80:
                self._left, self._shift = self._length, -1
                self._unread += 1
        if self._unread > UNREAD_MAX:
            raise ValueError(f"the broker sent {UNREAD_MAX} packets and does not read the replies")


def check_websocket_buffer(connection: object) -> None:
    """Raise ValueError if paho-mqtt's buffer of an incomplete WebSocket frame exceeds WEBSOCKET_BYTES."""
    if len(getattr(connection, "_readbuffer", b"")) > WEBSOCKET_BYTES:
        raise ValueError(f"expected a WebSocket frame of at most {WEBSOCKET_BYTES} bytes, got a longer frame")


@lru_cache(1)
def _client_type() -> Any:
    """Return the class of the clients. Its import needs paho-mqtt."""
    from paho.mqtt import client as paho

    class GuardedClient(paho.Client):
        """Client of paho-mqtt that checks all received bytes."""

        guard: PacketGuard

        def _sock_recv(self, bufsize: int) -> bytes:
            data = super()._sock_recv(bufsize)
            self.guard.take(data, is_writing=self.want_write())
            check_websocket_buffer(self.socket())
            return data

    return GuardedClient


def paho_client(
    broker: Broker, access: BrokerAccess, client_id: str, owner: object = None, *, is_v5: bool, packet_bytes: int,
    session_s: int = 0, manual_ack: bool = False,
) -> Any:  # fmt: skip
    """Return an unconnected client of paho-mqtt. The client calls the methods of `owner` that CALLBACKS lists. It
    raises ValueError for a packet longer than `packet_bytes`, and for a message with QoS 2.

    The broker keeps the session for `session_s` after the end of the connection. With MQTT 3.1.1 the broker decides the
    time. Raises ValueError with the key and the path if a file of `access` is invalid.
    """
    from paho.mqtt import client as paho
    from paho.mqtt.enums import CallbackAPIVersion

    client = _client_type()(
        CallbackAPIVersion.VERSION2,
        client_id,
        clean_session=None if is_v5 else not session_s,
        protocol=paho.MQTTv5 if is_v5 else paho.MQTTv311,
        transport="websockets" if broker.websockets else "tcp",
        reconnect_on_failure=False,
        manual_ack=manual_ack,
    )
    client.guard = PacketGuard(packet_bytes)
    client.connect_timeout = CONNECT_S
    if broker.websockets:
        client.ws_set_options(path=broker.path)
    if broker.tls:
        client.tls_set_context(_tls_context(access))
    if access.user:
        client.username_pw_set(access.user, _password(access.password_file))
    for name in CALLBACKS:
        setattr(client, name, getattr(owner, f"_{name}", None))
    return client


def open_client(
    client: Any, broker: Broker, keep_alive_s: int, receive_max: int, packet_bytes: int, session_s: int = 0
) -> None:
    """Connect a client of `paho_client` and send CONNECT. Raises OSError or ValueError. With MQTT 5, the broker sends
    at most `receive_max` messages without an acknowledgement, and no packet longer than `packet_bytes`."""
    if client.protocol != MQTT_5:
        client.connect(broker.host, broker.port, keep_alive_s)
        return
    bounds = properties_of("CONNECT", ReceiveMaximum=receive_max, MaximumPacketSize=packet_bytes)
    if session_s:
        bounds.SessionExpiryInterval = session_s
    client.connect(broker.host, broker.port, keep_alive_s, clean_start=not session_s, properties=bounds)


def close_client(client: Any, *, ends_session: bool = False) -> None:
    """Send DISCONNECT and close the socket. Do nothing if the connection is already lost. With `ends_session`, the
    broker removes the session of MQTT 5."""
    with suppress(OSError, ValueError):
        if ends_session:
            client.disconnect(properties=properties_of("DISCONNECT", SessionExpiryInterval=0))
        else:
            client.disconnect()
    # paho-mqtt keeps the socket open if DISCONNECT waits behind unsent data
    if (sock := client.socket()) is not None:
        with suppress(OSError):
            sock.close()


def properties_of(packet: str, **values: object) -> Any:
    """Return properties of a packet of MQTT 5, for example of `CONNECT`."""
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    made = Properties(getattr(PacketTypes, packet))  # type: ignore[no-untyped-call]  # the library has no types here
    for name, value in values.items():
        setattr(made, name, value)
    return made


def connection_problem(error: BaseException) -> str:
    """Return the cause of an error. For a TLS error, use the message of OpenSSL about the certificate."""
    import ssl

    if isinstance(error, ssl.SSLError):
        return getattr(error, "verify_message", "") or error.reason or str(error)
    return reason_of(error)


def _password(path: str | None) -> str | None:
    if path is None:
        return None
    try:
        text = _read("password_file", path, PASSWORD_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"password_file {path}: expected text in UTF-8, got other bytes") from error
    return text.partition("\n")[0].rstrip("\r")


def _tls_context(access: BrokerAccess) -> "ssl.SSLContext":
    """Return the TLS configuration of a client. Raises ValueError with the key and the path."""
    import ssl

    ca, cert, key = access.ca_file, access.cert_file, access.key_file
    for name, path in (("ca_file", ca), ("cert_file", cert), ("key_file", key)):
        if path is not None:
            _read(name, path, PEM_BYTES)
    try:
        context = tls_context(ca)
    except ssl.SSLError as error:
        raise ValueError(f"ca_file {ca}: expected certificates (PEM), got no valid certificate") from error
    try:
        if cert is not None:
            context.load_cert_chain(cert, key, _no_passphrase)
    except ssl.SSLError as error:
        words = f"cert_file {cert}" if key is None else f"cert_file {cert}, key_file {key}"
        problem = f": {error.reason}" if error.reason else ""
        raise ValueError(f"{words}: expected a certificate and its key (PEM){problem}") from error
    return context


def _no_passphrase() -> str:
    # without this function, OpenSSL would request the passphrase on the terminal and wait
    raise ValueError("key_file: expected a key without a passphrase, got an encrypted key")


def _read(name: str, path: str, most: int) -> bytes:
    try:
        return read_regular(Path(path), most)
    except OSError as error:
        raise ValueError(f"{name} {path}: {reason_of(error)}") from error


log = logging.getLogger(__name__)

IN_FLIGHT_MAX: Final = 20  # Maximum number of messages without an acknowledgement. A broker can set a lower limit.
# Time between two checks for the end of the output, s, while imud waits for CONNACK. It is shorter than CLOSE_S of the
# sender.
LOOK_S: Final = 0.1
PACKET_BYTES: Final = 16_384  # maximum length of a packet from the broker, bytes: four times the longest request
# Maximum length of an MQTT packet, bytes (MQTT 5.0, section 2.1.4), if the broker does not set a lower limit
PACKET_BYTES_MOST: Final = 268_435_460
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

    def subscribe(self, topic: str) -> int:
        """Subscribe to a topic. Return the packet identifier. Raises BrokerError."""
        ...

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        """Send a message with QoS 1. Return its packet identifier. Raises BrokerError, and MessageRefused if the
        message is longer than the broker accepts."""
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


# Function that returns an accepted connection, with the arguments of `PahoConnection`. Raises BrokerError.
Connect = Callable[[Broker, MqttOptions, str, Will, Callable[[], bool]], BrokerConnection]


def check_extra() -> None:
    """Raise ServerError if paho-mqtt is not installed."""
    with needs_extra("mqtt", ServerError):
        importlib.import_module("paho.mqtt.client")


class PahoConnection:
    """`BrokerConnection` with paho-mqtt."""

    def __init__(
        self, broker: Broker, settings: MqttOptions, client_id: str, will: Will,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:  # fmt: skip
        """Connect and wait for CONNACK. Raises BrokerError. This method calls `is_wanted` after the socket is open and
        then every LOOK_S. If it returns False, another output may use the same client ID soon."""
        self.acknowledged: list[int] = []
        self.unclaimed: set[int] = set()
        self.in_flight_max = IN_FLIGHT_MAX
        self.received: list[Received] = []
        self.refused: list[tuple[int, str]] = []
        self._broker = broker
        self._is_v5 = settings.version == "5"
        self._answered = self._closed = self._woke = False
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
            self._client.will_set(will.topic, will.payload, qos=1, retain=True)
            self._client.on_socket_open = lambda *_: self._check_wanted(is_wanted)
            open_client(self._client, broker, settings.keep_alive_s, IN_FLIGHT_MAX, PACKET_BYTES)
            self._wait_for_answer(is_wanted)
        except BrokerError as error:
            self.close()
            raise BrokerError(f"{broker.name}: {error}") from error
        except (OSError, ValueError) as error:
            self.close()
            raise BrokerError(f"{broker.name}: {connection_problem(error)}") from error

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
            info = self._client.publish(topic, payload, qos=1, retain=retain, properties=properties)
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
            self._problem = self._problem or (LOST if self._answered else UNANSWERED)
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

    # --- callbacks of paho-mqtt, called in `_turn`
    # -----------------------------------------------------------------------

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
            if reason.value == QUOTA:  # the broker can accept the same message later
                self._problem = self._problem or f"the broker refuses messages of {topic}: {reason}"
            else:
                self.refused.append((mid, str(reason)))
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
            self.refused.append((mid, str(reasons[0])))
        else:
            self.acknowledged.append(mid)

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._problem = self._problem or f"the broker ended the connection: {reason}"


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
