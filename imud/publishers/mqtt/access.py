"""How a client of a broker is made: transport, TLS, user. The output and the readers of a fleet share it."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from imud.errors import reason_of
from imud.files import read_regular
from imud.publishers.mqtt.settings import Broker

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
PASSWORD_BYTES: Final = 65_535
"""Of a password (MQTT 5.0, section 3.1.3.6)."""


class BrokerError(Exception):
    """A broker cannot be reached, or ended the connection. Example: connection refused."""


class BrokerAccess(Protocol):
    """Who connects, and which certificates count; `MqttSettings` has all of it."""

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


def paho_client(
    broker: Broker, access: BrokerAccess, client_id: str, *, is_v5: bool, keeps_session: bool = False,
    manual_ack: bool = False,
) -> Any:  # fmt: skip
    """A client of paho-mqtt that has not connected yet. Raises ValueError for files, which names them.

    `keeps_session` is for MQTT 3.1.1; with 5 the connection says it.
    """
    from paho.mqtt import client as paho
    from paho.mqtt.enums import CallbackAPIVersion

    client = paho.Client(
        CallbackAPIVersion.VERSION2,
        client_id,
        clean_session=None if is_v5 else not keeps_session,
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
    return client


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
