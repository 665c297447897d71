"""Connections to a real mosquitto: both versions, TLS with certificates, passwords, WebSocket, refusals."""

import os
import shutil
import subprocess
import threading
from pathlib import Path

import msgspec
import pytest

from imud.fleet.broker import BrokerError, MessageRefused, PahoConnection, Will
from imud.fleet.settings import MqttOptions, broker_of
from tests.fleet.authority import Authority
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, running_broker
from tests.support.surroundings import free_port

pytestmark = [pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO), pytest.mark.live]
WILL = Will("imud/s/g/state", b'{"online":false}')


def connect(url: str, **settings: object) -> PahoConnection:
    broker = broker_of(url)
    assert broker is not None
    return PahoConnection(broker, msgspec.convert(settings, MqttOptions), "gateway", WILL)


def send(connection: PahoConnection, payload: bytes = b"{}", topic: str = "imud/s/g/state") -> None:
    number = connection.publish(topic, payload, "application/json", retain=False)
    for _ in range(1000):
        if number in connection.acknowledged:
            return
        connection.wait(1.0)
    raise AssertionError(connection.acknowledged)


def wait_for_the_end(connection: PahoConnection) -> None:
    """Wait until the connection is lost. Raises BrokerError."""
    for _ in range(60):
        connection.wait(1.0)


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_message_is_acknowledged_and_the_will_is_published(tmp_path: Path, version: str) -> None:
    with running_broker(tmp_path / "broker") as broker:
        collector = Collector(broker.port)
        connection = connect(f"mqtt://127.0.0.1:{broker.port}", version=version)
        send(connection, b'{"a":1}')
        collector.wait_for(lambda: bool(collector.messages))
        taken = connect(f"mqtt://127.0.0.1:{broker.port}")  # same client ID: the broker ends the first connection
        collector.wait_for(lambda: len(collector.messages) == 2)
        assert collector.messages == [("imud/s/g/state", b'{"a":1}'), (WILL.topic, WILL.payload)]
        with pytest.raises(BrokerError, match=r"taken over|lost"):
            wait_for_the_end(connection)
        for one in (connection, connection, taken, collector):
            one.close()


# paho-mqtt 2.2 leaves the socket of a failed TLS handshake to the garbage collector
LEFT_OPEN = "ignore::pytest.PytestUnraisableExceptionWarning"


@pytest.mark.filterwarnings(LEFT_OPEN)
def test_a_stopped_broker_is_detected_and_a_missing_broker_is_named(tmp_path: Path) -> None:
    with running_broker(tmp_path / "broker") as broker:
        url = f"mqtt://127.0.0.1:{broker.port}"
        with pytest.raises(BrokerError, match=r"mqtts://127.0.0.1"):
            connect(f"mqtts://127.0.0.1:{broker.port}")
        connection = connect(url)
        broker.stop()
        with pytest.raises(BrokerError, match=r"lost|ended|reset"):
            wait_for_the_end(connection)
        connection.close()
        with pytest.raises(BrokerError, match=rf"{url}: Connection refused"):
            connect(url)


def test_the_wake_up_descriptor_is_not_closed_during_ring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_broker(tmp_path / "broker") as broker:
        connection = connect(f"mqtt://127.0.0.1:{broker.port}")
        closing = threading.Thread(target=connection.close)
        write = os.eventfd_write

        def write_late(bell: int, value: int) -> None:
            closing.start()
            closing.join(0.1)  # it runs until it waits for the lock
            write(bell, value)

        monkeypatch.setattr(os, "eventfd_write", write_late)
        connection.ring()
        closing.join()
        monkeypatch.undo()
        connection.ring()  # nothing happens: the descriptor may belong to another file


def test_refused_messages_are_named(tmp_path: Path) -> None:
    rights = tmp_path / "rights"
    rights.write_text("topic write imud/s/g/state\n")
    lines = ("allow_anonymous true", "max_packet_size 2000", f"acl_file {rights}")
    with running_broker(tmp_path / "broker", *lines) as broker:
        connection = connect(f"mqtt://127.0.0.1:{broker.port}")
        send(connection, bytes(1700))
        with pytest.raises(MessageRefused, match=r"at most 2000 bytes, .* imud/s/g/state with 2000: raise"):
            send(connection, bytes(2000))
        number = connection.publish("imud/s/g/events", b"{}", "application/json", retain=False)
        while not connection.refused:
            connection.wait(1.0)
        assert connection.refused == [(number, "Not authorized")]
        connection.close()


def test_user_and_password(tmp_path: Path) -> None:
    program = shutil.which("mosquitto_passwd")
    if program is None:
        pytest.skip("mosquitto_passwd is not installed")
    subprocess.run([program, "-b", "-c", tmp_path / "users", "gate", "secret"], check=True)
    with running_broker(tmp_path / "broker", "allow_anonymous false", f"password_file {tmp_path}/users") as broker:
        url = f"mqtt://127.0.0.1:{broker.port}"
        (tmp_path / "good").write_text("secret\n")
        (tmp_path / "bad").write_text("guess\n")
        connection = connect(url, user="gate", password_file=str(tmp_path / "good"))
        send(connection)
        connection.close()
        with pytest.raises(BrokerError, match=r"refuses the connection: Not authorized"):
            connect(url, user="gate", password_file=str(tmp_path / "bad"))
        with pytest.raises(BrokerError, match=r"refuses the connection"):
            connect(url, version="3.1.1")
        with pytest.raises(BrokerError, match=r"none: No such file or directory"):
            connect(url, user="gate", password_file=str(tmp_path / "none"))


# --- TLS --------------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings(LEFT_OPEN)
def test_tls_with_certificates_of_both_sides(tmp_path: Path, authority: Authority) -> None:
    port = free_port()
    with running_broker(tmp_path / "broker", *authority.listener(port)):
        own = {"cert_file": authority["gateway.pem"], "key_file": authority["gateway.key"]}
        connection = connect(f"mqtts://127.0.0.1:{port}", ca_file=authority["ca.pem"], **own)
        send(connection, b"x" * 200_000)
        connection.close()
        with pytest.raises(BrokerError, match=r"(?i)self[- ]signed certificate"):
            connect(f"mqtts://127.0.0.1:{port}", **own)
        with pytest.raises(BrokerError):
            connect(f"mqtts://127.0.0.1:{port}", ca_file=authority["ca.pem"])
        with pytest.raises(BrokerError, match=r"(?i)hostname mismatch|not valid for"):
            connect(f"mqtts://localhost:{port}", ca_file=authority["ca.pem"], **own)
        with pytest.raises(
            BrokerError, match="without a reply; check the log of the broker, and whether the port requires TLS"
        ):
            connect(f"mqtt://127.0.0.1:{port}")


@pytest.mark.filterwarnings(LEFT_OPEN)
def test_websockets_without_and_with_tls(tmp_path: Path, authority: Authority) -> None:
    port, tls_port = free_port(), free_port()
    first, *others = authority.listener(tls_port)
    lines = ("per_listener_settings true", f"listener {port} 127.0.0.1", "protocol websockets", "allow_anonymous true")
    try:
        with running_broker(tmp_path / "broker", *lines, first, "protocol websockets", *others):
            own = {"cert_file": authority["gateway.pem"], "key_file": authority["gateway.key"]}
            plain = connect(f"ws://127.0.0.1:{port}")
            send(plain)
            plain.close()
            connection = connect(f"wss://127.0.0.1:{tls_port}", ca_file=authority["ca.pem"], **own)
            send(connection, b"x" * 200_000)
            connection.close()
            with pytest.raises(BrokerError, match=r"(?i)self[- ]signed certificate"):
                connect(f"wss://127.0.0.1:{tls_port}", **own)
    except AssertionError as error:
        if "Websockets support not available" in str(error):
            pytest.skip("this mosquitto has no websockets")
        raise
