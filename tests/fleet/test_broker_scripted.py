"""Packets that a real broker sends rarely, from a scripted broker: refusals, DISCONNECT, limits, silence."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import msgspec
import pytest

from imud.fleet.broker import BrokerError, MessageRefused, PahoConnection, ReaderAccess, Will
from imud.fleet.reader import ReaderConnection
from imud.fleet.settings import Broker, MqttOptions, broker_of
from tests.support.daemon_process import LIMIT_S

pytestmark = pytest.mark.live

# MQTT 5.0, sections 3.2 CONNACK, 3.9 SUBACK, 3.14 DISCONNECT, 3.3 PUBLISH with QoS 0
CONNACK = bytes.fromhex("20 03 00 00 00")
NOT_AUTHORIZED = bytes.fromhex("20 03 00 87 00")
TWO_AT_A_TIME = bytes.fromhex("20 06 00 00 03 21 00 02")  # Receive Maximum 2
AT_MOST_100_BYTES = bytes.fromhex("20 08 00 00 05 27 00 00 00 64")  # Maximum Packet Size 100
SUBACK, NO_SUBACK = bytes.fromhex("90 04 00 01 00 01"), bytes.fromhex("90 04 00 01 00 87")
SHUTTING_DOWN = bytes.fromhex("e0 02 8b 00")
QOS_0 = bytes.fromhex("30 05 00 01 74 00 78")


@contextmanager
def scripted(*replies: bytes) -> Iterator[Broker]:
    """Serve one client: send one reply after each packet of the client, then wait for its end."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        sock, _ = listener.accept()
        sock.settimeout(LIMIT_S)
        with sock, suppress(OSError):
            for reply in replies:
                sock.recv(1 << 16)
                sock.sendall(reply)
            while replies[-1] and sock.recv(1 << 16):
                pass

    broker = broker_of(f"mqtt://127.0.0.1:{listener.getsockname()[1]}")
    assert broker is not None
    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield broker
    finally:
        thread.join(LIMIT_S)
        listener.close()


def gateway(broker: Broker) -> PahoConnection:
    return PahoConnection(broker, MqttOptions(user="without-password"), "gateway", Will("imud/s/g/state", b"{}"))


async def reader(broker: Broker) -> ReaderConnection:
    return await ReaderConnection.open(broker, ReaderAccess(), "reader", ["imud/#"], 0)


@pytest.mark.parametrize(
    ("replies", "words"),
    [
        ((NOT_AUTHORIZED,), "the broker refuses the connection: Not authorized"),
        ((CONNACK, NO_SUBACK), "the broker refuses a subscription: Not authorized"),
        ((CONNACK, SUBACK + SHUTTING_DOWN), "the broker ended the connection: Server shutting down"),
        ((b"",), "closed the connection without a reply"),
    ],
)
def test_a_reader_names_the_refusal_of_a_broker(replies: tuple[bytes, ...], words: str) -> None:
    async def run(broker: Broker) -> None:
        with closing(await reader(broker)) as connection:
            while await connection.next(LIMIT_S) is not None:
                pass

    with scripted(*replies) as broker, pytest.raises(BrokerError, match=words):
        asyncio.run(run(broker))


def test_a_reader_counts_messages_that_cannot_be_acknowledged() -> None:
    async def run(broker: Broker) -> None:
        with closing(await reader(broker)) as connection:
            while not connection.refused:
                assert await connection.next(0.01) is None
            assert (connection.refused, connection.waiting) == (1, 0)

    with scripted(CONNACK, SUBACK + QOS_0) as broker:
        asyncio.run(run(broker))


def test_a_reader_waits_a_limited_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReaderConnection._until, "__defaults__", (0.01,))
    with scripted(b"\x20") as broker, pytest.raises(BrokerError, match="no answer within"):
        asyncio.run(reader(broker))


def test_a_gateway_names_the_refusal_of_a_broker(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with scripted(NOT_AUTHORIZED) as broker, pytest.raises(BrokerError, match="refuses the connection: Not authorized"):
        gateway(broker)
    with scripted(b"") as broker, pytest.raises(BrokerError, match=broker.name):
        gateway(broker)
    ended = pytest.raises(BrokerError, match="the broker ended the connection: Server shutting down")
    with scripted(CONNACK + SHUTTING_DOWN) as broker, ended, closing(gateway(broker)) as connection:
        connection.wait(LIMIT_S)
    with scripted(CONNACK, NO_SUBACK) as broker, closing(gateway(broker)) as connection:
        connection.subscribe("imud/+")
        connection.wait(LIMIT_S)
    assert "the broker refuses to send requests: Not authorized" in caplog.text
    monkeypatch.setattr("imud.fleet.broker.LOOK_S", 0.01)
    monkeypatch.setattr("imud.fleet.broker.CONNECT_S", 0.02)
    with scripted(b"\x20") as broker, pytest.raises(BrokerError, match="no answer within"):
        gateway(broker)


def test_a_gateway_keeps_the_limits_of_the_broker() -> None:
    with scripted(TWO_AT_A_TIME) as broker, closing(gateway(broker)) as connection:
        assert connection.in_flight_max == 2
        with pytest.raises(BrokerError, match="the output ends"):
            PahoConnection(broker, msgspec.convert({}, MqttOptions), "gateway", Will("t", b""), lambda: False)
    too_long = pytest.raises(MessageRefused, match="at most 100 bytes, got a message of t with 100")
    with scripted(AT_MOST_100_BYTES) as broker, too_long, closing(gateway(broker)) as connection:
        connection.publish("t", bytes(100), "", retain=False)
