"""How a client of a broker is made: transport, TLS, user. The output and the readers of a fleet share it."""

from pathlib import Path
from typing import Any, Final, Protocol

from imud.errors import reason_of
from imud.files import read_regular
from imud.publishers.mqtt.settings import Broker

CONNECT_S: Final = 4.0
"""TCP, TLS and the broker's answer take so long each at most; satellite links take 2 s."""
REFUSED: Final = 0x80
"""Reason codes of MQTT 5 from here on are refusals (section 2.4)."""
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
    """A client of paho-mqtt that has not connected yet. Raises OSError for files, ValueError for what they contain.

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
        client.tls_set(ca_certs=access.ca_file, certfile=access.cert_file, keyfile=access.key_file)
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
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"{error.filename}: {reason_of(error)}"
    return reason_of(error)


def _password(path: str | None) -> str | None:
    """The first line of the file. Raises OSError, and ValueError for what is no text."""
    if path is None:
        return None
    text = read_regular(Path(path), PASSWORD_BYTES).decode("utf-8")
    return text.partition("\n")[0].rstrip("\r")
