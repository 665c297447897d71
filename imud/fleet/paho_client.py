"""Clients of paho-mqtt: a check of all received bytes, credentials, and the deadline of a connection.

The gateway uses a client in a thread, the reader of a fleet uses a client in an event loop.
"""

import socket
import threading
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from imud.fleet.settings import Broker, MqttOptions
from imud.host.files import read_regular_file
from imud.host.network import tls_context
from imud.model.errors import reason_of

if TYPE_CHECKING:
    import ssl

CONNECT_S: Final = 4.0  # Time limit for each of TCP, TLS and CONNACK, s. Satellite links take 2 s.
# Maximum time of a connection, from the name resolution to CONNACK, s: three times CONNECT_S
CONNECTION_S: Final = 12.0
# Maximum length of a file of certificates, bytes. The file with all authorities of Debian has 0.2 MB.
PEM_BYTES: Final = 4 << 20
MQTT_5: Final = 5  # value of `MQTTv5` in paho-mqtt: protocol version in CONNECT (MQTT 5.0, section 3.1.2.2)
PASSWORD_BYTES: Final = 65_535  # maximum length of a password, bytes (MQTT 5.0, section 3.1.3.6)


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


class ConnectDeadline:
    """Deadline of a connection. At the deadline, a thread ends the connection of the client.

    The library has a time limit for each read: a broker that sends one byte before each limit would hold its caller.
    """

    def __init__(self, client: Any, seconds: float) -> None:
        self.is_over = False
        self._client = client
        self._seconds = seconds
        self._timer = threading.Timer(seconds, self.end)
        self._timer.daemon = True
        self._timer.start()

    @property
    def problem(self) -> str:
        """Return the reason for the end of the connection; empty before the deadline."""
        return f"no complete reply to the connection within {self._seconds:g} s" if self.is_over else ""

    def end(self) -> None:
        """End the connection, and the connection that a running call opens later."""
        self.is_over = True
        self._client.end_connection()

    def close(self) -> None:
        """Remove the deadline. A second call does nothing."""
        self._timer.cancel()
        self._client.keep_connection()


@lru_cache(1)
def _client_type() -> Any:
    """Return the class of the clients. Its import needs paho-mqtt."""
    from paho.mqtt import client as paho

    class GuardedClient(paho.Client):
        """Client of paho-mqtt that checks all received bytes."""

        guard: PacketGuard
        is_ended = False
        # Copy of the descriptor of the TCP connection until CONNACK: TLS and WebSocket hide the original socket
        tcp_copy: socket.socket | None = None

        def _create_socket_connection(self) -> socket.socket:
            sock = super()._create_socket_connection()
            self.keep_connection()
            self.tcp_copy = sock.dup()
            if self.is_ended:
                self.end_connection()
            return sock

        def end_connection(self) -> None:
            """End the TCP connection. All reads and writes then return. From any thread."""
            self.is_ended = True
            tcp_copy = self.tcp_copy
            if tcp_copy is not None:
                with suppress(OSError):
                    tcp_copy.shutdown(socket.SHUT_RDWR)

        def keep_connection(self) -> None:
            """Close the copy of the descriptor."""
            tcp_copy, self.tcp_copy = self.tcp_copy, None
            if tcp_copy is not None:
                tcp_copy.close()

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
        text = _read("password_file", path, PASSWORD_BYTES + len("\r\n")).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"password_file {path}: expected text in UTF-8, got other bytes") from error
    return text.partition("\n")[0].rstrip("\r")


def _tls_context(access: BrokerAccess) -> "ssl.SSLContext":
    """Return the TLS configuration of a client. Raises ValueError with the key and the path."""
    import ssl

    from imud.host.certificates import EncryptedKey, load_client_certificate

    ca, cert, key = access.ca_file, access.cert_file, access.key_file
    for name, path in (("ca_file", ca), ("cert_file", cert), ("key_file", key)):
        if path is not None:
            _read(name, path, PEM_BYTES)
    try:
        context = tls_context(ca)
    except ssl.SSLError as error:
        raise ValueError(f"ca_file {ca}: expected certificates (PEM), got no valid certificate") from error
    if cert is not None:
        try:
            load_client_certificate(context, cert, key)
        except EncryptedKey:
            raise ValueError("key_file: expected a key without a passphrase, got an encrypted key") from None
        except ValueError as error:
            place = f"cert_file {cert}" if key is None else f"cert_file {cert}, key_file {key}"
            raise ValueError(f"{place}: expected a certificate and its key (PEM), got: {error}") from error
    return context


def _read(name: str, path: str, most: int) -> bytes:
    try:
        return read_regular_file(Path(path), most)
    except OSError as error:
        raise ValueError(f"{name} {path}: {reason_of(error)}") from error
