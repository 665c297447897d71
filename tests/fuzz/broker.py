"""Data from an MQTT broker: for any data, the connection continues, refuses a message, or ends with a BrokerError."""

import socket
from collections.abc import Sequence
from contextlib import closing, suppress
from threading import Thread
from typing import Final

from imud.fleet.broker import BrokerError, MessageRefused, PahoConnection, Will, check_extra
from imud.fleet.settings import MqttOptions, broker_of
from tests.fuzz.target import Target, check_printable

WAITS: Final = 8
"""Number of `wait` calls, more than the packets of an input of `BYTES_MAX` need."""
BYTES_MAX: Final = 256
LIMIT_S: Final = 60.0  # maximum time of a wait
SETTINGS: Final = (MqttOptions(site="site", version="3.1.1"), MqttOptions(site="site", version="5"))


def names() -> Sequence[str]:
    return ["broker"]


def make(_name: str) -> Target:
    """Make a connection to a broker that sends the input. Import the library here, so that it is also instrumented."""
    check_extra()
    return Target(run, seeds, bytes_max=BYTES_MAX)


def run(data: bytes) -> None:
    """The lowest bit of the first byte selects the version of MQTT; the broker sends the other bytes."""
    settings = SETTINGS[data[0] & 1 if data else 0]
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = Thread(target=_serve, args=(listener, data[1:]), name="hostile broker")
        thread.start()
        try:
            broker = broker_of(f"mqtt://127.0.0.1:{listener.getsockname()[1]}")
            assert broker is not None
            connection = PahoConnection(broker, settings, "gateway", Will("state", b"{}"))
            with closing(connection):
                connection.publish("topic", b"{}", "application/json", retain=False)
                for _ in range(WAITS):
                    connection.wait(LIMIT_S)
                    assert all(1 <= number <= 0xFFFF for number in connection.acknowledged)
        except (BrokerError, MessageRefused) as error:
            check_printable(str(error))
        finally:
            thread.join(LIMIT_S)


def _serve(listener: socket.socket, data: bytes) -> None:
    listener.settimeout(LIMIT_S)
    with suppress(OSError), listener.accept()[0] as connection:
        connection.settimeout(LIMIT_S)
        if connection.recv(4096):
            connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(4096):
            pass


def seeds() -> list[bytes]:
    accepted = {0: bytes.fromhex("20020000"), 1: bytes.fromhex("2003000000")}
    packets = [
        bytes.fromhex("40020001"),  # PUBACK
        bytes.fromhex("40040001 8700"),  # PUBACK: not authorized
        bytes.fromhex("40040001 0000 40020001"),  # two packets
        bytes.fromhex("3005 0001 74 00 62"),  # PUBLISH, QoS 0
        bytes.fromhex("3208 0001 74 0001 00 6263"),  # PUBLISH, QoS 1
        bytes.fromhex("3408 0001 74 0001 00 6263"),  # PUBLISH, QoS 2
        bytes.fromhex("50020001"),  # PUBREC
        bytes.fromhex("62020001"),  # PUBREL
        bytes.fromhex("70020001"),  # PUBCOMP
        bytes.fromhex("90040001 0000"),  # SUBACK
        bytes.fromhex("b0040001 0000"),  # UNSUBACK
        bytes.fromhex("d000"),  # PINGRESP
        bytes.fromhex("e0028b00"),  # DISCONNECT: server shutting down
        bytes.fromhex("f0020000"),  # AUTH
        bytes.fromhex("10020000"),  # CONNECT, which only clients send
        bytes.fromhex("ffffffff7f00"),  # the maximum length
    ]
    tails = [b"".join((bytes([version]), answer, packet)) for version, answer in accepted.items() for packet in packets]
    limits = bytes.fromhex("01 200b 0000 08 21 0005 27 00000100")  # receive maximum, maximum packet size
    return [*tails, limits, bytes.fromhex("00 20020005"), bytes.fromhex("01 2003008700"), b"\x00", b"\x01"]
