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
from pathlib import Path
from random import random
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

from imud.fleet.settings import Broker, MqttOptions
from imud.host.files import read_regular
from imud.model.errors import ServerError, reason_of
from imud.model.units import NS_PER_S

if TYPE_CHECKING:
    import ssl

CONNECT_S: Final = 4.0
"""TCP, TLS and the broker's answer take so long each at most; satellite links take 2 s."""
LOST: Final = "the connection was lost"
UNANSWERED: Final = (
    "the broker ended the connection without an answer: look at its log, and whether its port expects TLS and a "
    "certificate of the client"
)
REFUSED: Final = 0x80
"""Reason codes of MQTT 5 from here on are refusals (section 2.4)."""
PEM_BYTES: Final = 4 << 20
"""Of a file of certificates: Debian's with all authorities has 0.2 MB."""
MQTT_5: Final = 5
"""Value of `MQTTv5` of paho-mqtt, the version of the protocol in CONNECT (MQTT 5.0, section 3.1.2.2)."""
PASSWORD_BYTES: Final = 65_535
"""Of a password (MQTT 5.0, section 3.1.3.6)."""


class BrokerError(Exception):
    """A broker cannot be reached, or ended the connection. Example: connection refused."""


class BrokerAccess(Protocol):
    """Who connects, and which certificates count; `MqttOptions` has all of it."""

    @property
    def user(self) -> str:
        """Name for the broker; empty for none."""
        ...

    @property
    def password_file(self) -> str | None:
        """File that has the password in its first line; None for none."""
        ...

    @property
    def ca_file(self) -> str | None:
        """Certificates (PEM) that the broker's is to be signed by; None for those that the system trusts."""
        ...

    @property
    def cert_file(self) -> str | None:
        """Certificate (PEM) of the client; None for none."""
        ...

    @property
    def key_file(self) -> str | None:
        """Its key (PEM); None where the certificate's file has it."""
        ...


CALLBACKS: Final = ("on_connect", "on_disconnect", "on_message", "on_publish", "on_subscribe")
"""Names of the callbacks of paho-mqtt. An owner of a client has a method `_on_connect`, …, if it needs one."""


def paho_client(
    broker: Broker, access: BrokerAccess, client_id: str, owner: object = None, *, is_v5: bool, session_s: int = 0,
    manual_ack: bool = False,
) -> Any:  # fmt: skip
    """Return a client of paho-mqtt without a connection. It calls the methods of `owner` that CALLBACKS names.

    The broker keeps the session for `session_s` after the connection ended. With MQTT 3.1.1 the broker decides how
    long. Raises ValueError, which names the key and the file, if a file of `access` cannot be used.
    """
    from paho.mqtt import client as paho
    from paho.mqtt.enums import CallbackAPIVersion

    client = paho.Client(
        CallbackAPIVersion.VERSION2,
        client_id,
        clean_session=None if is_v5 else not session_s,
        protocol=paho.MQTTv5 if is_v5 else paho.MQTTv311,
        transport="websockets" if broker.websockets else "tcp",
        reconnect_on_failure=False,
        manual_ack=manual_ack,
    )
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
    """Connect a client of `paho_client` and send CONNECT. Raises OSError or ValueError.

    With MQTT 5 the broker sends at most `receive_max` messages without an acknowledgement, and no packet longer than
    `packet_bytes`.
    """
    if client.protocol != MQTT_5:
        client.connect(broker.host, broker.port, keep_alive_s)
        return
    bounds = properties_of("CONNECT", ReceiveMaximum=receive_max, MaximumPacketSize=packet_bytes)
    if session_s:
        bounds.SessionExpiryInterval = session_s
    client.connect(broker.host, broker.port, keep_alive_s, clean_start=not session_s, properties=bounds)


def close_client(client: Any) -> None:
    """Send DISCONNECT and close the socket. Do nothing if the connection is already lost."""
    with suppress(OSError, ValueError):
        client.disconnect()
        # paho-mqtt keeps the socket open if DISCONNECT waits behind unsent data
        if (sock := client.socket()) is not None:
            sock.close()


def properties_of(packet: str, **values: object) -> Any:
    """Properties of a packet of MQTT 5, for example of `CONNECT`."""
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    made = Properties(getattr(PacketTypes, packet))  # type: ignore[no-untyped-call]  # the library has no types here
    for name, value in values.items():
        setattr(made, name, value)
    return made


def connection_problem(error: BaseException) -> str:
    """Describe an error; those of TLS in the words of the TLS library, which say what is wrong with a certificate."""
    import ssl

    if isinstance(error, ssl.SSLError):
        return getattr(error, "verify_message", "") or error.reason or str(error)
    return reason_of(error)


def _password(path: str | None) -> str | None:
    """The first line of the file. Raises ValueError."""
    if path is None:
        return None
    try:
        text = _read("password_file", path, PASSWORD_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"password_file {path}: expected text in UTF-8, got other bytes") from error
    return text.partition("\n")[0].rstrip("\r")


def _tls_context(access: BrokerAccess) -> "ssl.SSLContext":
    """What counts in a connection by TLS. Raises ValueError, which names the key and the file."""
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # asks for a certificate of the broker, and checks its name
    ca, cert, key = access.ca_file, access.cert_file, access.key_file
    for name, path in (("ca_file", ca), ("cert_file", cert), ("key_file", key)):
        if path is not None:
            _read(name, path, PEM_BYTES)
    try:
        if ca is None:
            context.load_default_certs()
        else:
            context.load_verify_locations(ca)
    except ssl.SSLError as error:
        raise ValueError(f"ca_file {ca}: expected certificates (PEM), got others or none") from error
    try:
        if cert is not None:
            context.load_cert_chain(cert, key, _no_passphrase)
    except ssl.SSLError as error:
        words = f"cert_file {cert}" if key is None else f"cert_file {cert}, key_file {key}"
        problem = f": {error.reason}" if error.reason else ""
        raise ValueError(f"{words}: expected a certificate and its key (PEM){problem}") from error
    return context


def _no_passphrase() -> str:
    """Raises ValueError; without it the TLS library asks on the terminal, and waits."""
    raise ValueError("key_file: expected a key without a passphrase, got one with it")


def _read(name: str, path: str, most: int) -> bytes:
    """A file that a key names. Raises ValueError, which says which."""
    try:
        return read_regular(Path(path), most)
    except OSError as error:
        raise ValueError(f"{name} {path}: {reason_of(error)}") from error


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


Connect = Callable[[Broker, MqttOptions, str, Will, Callable[[], bool]], BrokerConnection]
"""Function that returns a connection which the broker has accepted, for the arguments of `PahoConnection`.

Raises BrokerError if the broker cannot be used, or if the last argument returned False.
"""


def check_extra() -> None:
    """Raise ServerError where paho-mqtt is missing."""
    try:
        importlib.import_module("paho.mqtt.client")
    except ImportError as error:
        raise ServerError(EXTRA_MISSING) from error


class PahoConnection:
    """A connection by paho-mqtt. Synchronization: as `BrokerConnection`."""

    def __init__(
        self, broker: Broker, settings: MqttOptions, client_id: str, will: Will,
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
        self._client: Any = None
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._bell_lock = threading.Lock()
        """Held while the bell is rung: it is closed by another thread, and its number may then be another file's."""
        try:
            self._client = paho_client(broker, settings, client_id, self, is_v5=self._is_v5)
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
        if self._client is not None:
            close_client(self._client)
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


FIRST_S: Final = 4.0
"""Length of the first pause: 500 gateways come back at 125 a second."""
STABLE_NS: Final = 30 * NS_PER_S
"""A connection that held for so long was a good one: pauses begin anew."""


class BrokerTurn:
    """The list of brokers and its pauses. Synchronization: one thread."""

    def __init__(self, brokers: list[Broker], most_s: float, draw: Callable[[], float] = random) -> None:
        """`draw` gives numbers from 0 to below 1."""
        self._brokers = brokers
        self._most_s = most_s
        self._draw = draw
        self._at = 0
        self._failed = 0
        self._up_ns: int | None = None

    @property
    def broker(self) -> Broker:
        """The one whose turn it is."""
        return self._brokers[self._at]

    def connected(self, now_ns: int) -> None:
        """Note that the broker has accepted the connection."""
        self._up_ns = now_ns

    def failed(self, now_ns: int) -> float:
        """Note that it did not, or that the connection was lost; return how long to wait, s.

        After a loss the same broker is tried again first; after an attempt that failed, the next one.
        """
        up_ns, self._up_ns = self._up_ns, None
        if up_ns is not None and now_ns - up_ns >= STABLE_NS:
            self._failed = 0
        if up_ns is None:
            self._at = (self._at + 1) % len(self._brokers)
        length_s: float = min(self._most_s, FIRST_S * 2.0 ** min(self._failed // len(self._brokers), 16))
        self._failed += 1
        return self._draw() * length_s
