"""Connections to a real mosquitto: both versions, TLS with certificates, passwords, WebSocket, refusals.
Clients of paho-mqtt with a scripted broker: refusals, limits, hostile packets; errors of files; pauses."""

import asyncio
import gc
import os
import random
import select
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest

from imud.fleet import paho_client as paho_client_module
from imud.fleet.broker import (
    BROKER_LIMITS,
    RIGHTS,
    BrokerError,
    BrokerTurn,
    MessageRefused,
    PahoConnection,
    RetainRefused,
    Will,
)
from imud.fleet.connection import ReaderConnection
from imud.fleet.paho_client import paho_client
from imud.fleet.settings import Broker, MqttOptions, broker_of
from imud.model.work_budget import WorkBudget
from tests.fleet.authority import Authority
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, running_broker
from tests.support.daemon_process import LIMIT_S
from tests.support.leaks import open_descriptors
from tests.support.surroundings import free_port

FIRST_S, PACKET_BYTES, RECEIVED_MAX = 4.0, 16_384, 100
STABLE_NS, UNREAD_MAX, WEBSOCKET_BYTES = 30_000_000_000, 10_000, 1 << 24

pytestmark = [pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO), pytest.mark.live]
WILL = Will("imud/s/g/state", b'{"online":false}')


@pytest.fixture(autouse=True)
def _no_garbage() -> Iterator[None]:
    """Close the sockets that paho-mqtt leaves to the garbage collector, before another test counts descriptors."""
    yield
    gc.collect()


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
        before, connection = open_descriptors(), connect(f"mqtt://127.0.0.1:{broker.port}")
        closing, write = threading.Thread(target=connection.close), os.eventfd_write

        def write_late(bell: int, value: int) -> None:
            closing.start()
            closing.join(0.1)  # it runs until it waits for the lock
            write(bell, value)

        monkeypatch.setattr(os, "eventfd_write", write_late)
        connection.ring()
        closing.join()
        monkeypatch.undo()
        connection.ring()  # nothing happens: the descriptor may belong to another file
        assert open_descriptors() == before


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
        assert connection.refused == [(number, f"Not authorized{RIGHTS}")]
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
def test_websockets_without_and_with_tls(tmp_path: Path, authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
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
            monkeypatch.setenv("SSL_CERT_FILE", authority["ca.pem"])  # the certificates of the host
            connect(f"wss://127.0.0.1:{tls_port}", **own).close()
    except AssertionError as error:
        if "Websockets support not available" in str(error):
            pytest.skip("this mosquitto has no websockets")
        raise


# MQTT 5.0, sections 3.2 CONNACK, 3.9 SUBACK, 3.14 DISCONNECT, 3.3 PUBLISH with QoS 0
CONNACK = bytes.fromhex("20 03 00 00 00")
NOT_AUTHORIZED = bytes.fromhex("20 03 00 87 00")
TWO_AT_A_TIME = bytes.fromhex("20 06 00 00 03 21 00 02")  # Receive Maximum 2
AT_MOST_100_BYTES = bytes.fromhex("20 08 00 00 05 27 00 00 00 64")  # Maximum Packet Size 100
SUBACK, NO_SUBACK = bytes.fromhex("90 04 00 01 00 01"), bytes.fromhex("90 04 00 01 00 87")
OTHER_SUBACK, EMPTY_SUBACK = bytes.fromhex("90 04 00 02 00 01"), bytes.fromhex("90 03 00 01 00")
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
    return await ReaderConnection.open(broker, paho_client_module.ReaderAccess(), "reader", ["imud/#"], 0)


@pytest.mark.parametrize(
    ("replies", "words"),
    [
        ((NOT_AUTHORIZED,), "the broker refuses the connection: Not authorized"),
        ((CONNACK, NO_SUBACK), "the broker refuses a subscription: Not authorized"),
        ((CONNACK, SUBACK + SHUTTING_DOWN), "the broker ended the connection: Server shutting down"),
        ((CONNACK, EMPTY_SUBACK), "expected 1 reason codes for subscriptions from the broker, got 0"),
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


def test_a_reader_counts_refused_messages_and_waits_a_limited_time(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run(broker: Broker) -> None:
        with closing(await reader(broker)) as connection:
            while not connection.refused:
                assert await connection.next(0.01) is None
            assert (connection.refused, connection.waiting) == (1, 0)

    with scripted(CONNACK, SUBACK + QOS_0) as broker:
        asyncio.run(run(broker))
    monkeypatch.setattr(ReaderConnection._until, "__defaults__", (0.01,))
    with scripted(b"\x20") as broker, pytest.raises(BrokerError, match="no answer within"):
        asyncio.run(reader(broker))


def test_a_gateway_names_the_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = pytest.raises(BrokerError, match="refuses the connection: Not authorized")
    with scripted(NOT_AUTHORIZED) as broker, refused:
        gateway(broker)
    with scripted(b"") as broker, pytest.raises(BrokerError, match=broker.name):
        gateway(broker)
    ended = pytest.raises(BrokerError, match="the broker ended the connection: Server shutting down")
    with scripted(CONNACK + SHUTTING_DOWN) as broker, ended, closing(gateway(broker)) as connection:
        connection.wait(LIMIT_S)
    for reply, acknowledged, refusals in ((SUBACK, [1], []), (NO_SUBACK, [], [(1, f"Not authorized{RIGHTS}")])):
        with scripted(CONNACK, reply) as broker, closing(gateway(broker)) as connection:
            assert connection.subscribe("imud/+") == 1
            connection.wait(LIMIT_S)
            assert (connection.acknowledged, connection.refused) == (acknowledged, refusals)
    for reply, words in ((OTHER_SUBACK, "a subscription that imud did not request"), (EMPTY_SUBACK, "1 reason code")):
        with scripted(CONNACK, reply) as broker, closing(gateway(broker)) as connection:
            connection.subscribe("imud/+")
            with pytest.raises(BrokerError, match=words):
                connection.wait(LIMIT_S)
            assert connection.acknowledged == []
    monkeypatch.setattr("imud.fleet.broker.LOOK_S", 0.01)
    monkeypatch.setattr("imud.fleet.broker.CONNECT_S", 0.02)
    with scripted(b"\x20") as broker, pytest.raises(BrokerError, match="no answer within"):
        gateway(broker)


def test_a_gateway_keeps_the_limits_of_the_broker(monkeypatch: pytest.MonkeyPatch) -> None:
    poll = Mock(**{"poll.return_value": []})
    with scripted(TWO_AT_A_TIME) as broker, closing(gateway(broker)) as connection:
        assert connection.in_flight_max == 2
        with monkeypatch.context() as patch:
            patch.setattr(select, "poll", lambda: poll)
            connection.wait(0.25)
        poll.poll.assert_called_once_with(250.0)  # ms
        with pytest.raises(BrokerError, match="the output ends"):
            PahoConnection(broker, msgspec.convert({}, MqttOptions), "gateway", Will("t", b""), lambda: False)
    too_long = pytest.raises(MessageRefused, match="at most 100 bytes, got a message of t with 100")
    with scripted(AT_MOST_100_BYTES) as broker, too_long, closing(gateway(broker)) as connection:
        connection.publish("t", bytes(100), "", retain=False)


BROKER = Broker("127.0.0.1", 1883, tls=False, websockets=False, path="/mqtt")
TLS_BROKER = BROKER._replace(tls=True)


def of_tls(authority: Authority) -> MqttOptions:
    return MqttOptions(
        user="reader", ca_file=authority["ca.pem"], cert_file=authority["gateway.pem"],
        key_file=authority["gateway.key"],
    )  # fmt: skip


def test_password_files_and_keys_with_a_passphrase(tmp_path: Path, authority: Authority) -> None:
    secret = tmp_path / "password"
    secret.write_text("first line\r\nsecond\n")
    settings = MqttOptions(user="reader", password_file=str(secret))
    client = paho_client(BROKER, settings, "one", is_v5=True, packet_bytes=99, manual_ack=True)
    assert (client.username, client.password) == ("reader", "first line")
    secret.write_bytes(b"\xff\n")
    with pytest.raises(ValueError, match=f"^password_file {secret}: expected text in UTF-8"):
        paho_client(BROKER, settings, "one", is_v5=True, packet_bytes=99)
    locked = tmp_path / "locked.key"
    words = ["openssl", "rsa", "-aes256", "-passout", "pass:x", "-in", authority["gateway.key"], "-out", str(locked)]
    subprocess.run(words, check=True, capture_output=True)
    settings = msgspec.structs.replace(of_tls(authority), key_file=str(locked))
    with pytest.raises(ValueError, match=r"^key_file: expected a key without a passphrase"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)


@pytest.mark.parametrize("name", ["password_file", "ca_file", "cert_file", "key_file"])
def test_a_file_that_cannot_be_used_is_named_with_its_key(tmp_path: Path, authority: Authority, name: str) -> None:
    path = tmp_path / "absent"
    settings = msgspec.structs.replace(of_tls(authority), **{name: str(path)})
    with pytest.raises(ValueError, match=f"^{name} {path}: No such file or directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)
    path.mkdir()
    with pytest.raises(ValueError, match=f"^{name} {path}: Is a directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)
    path.rmdir()
    os.mkfifo(path)
    with pytest.raises(ValueError, match=f"^{name} {path}: is a FIFO, expected a regular file$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)
    if name != "password_file":
        path.unlink()
        path.write_text("no certificate\n")
        with pytest.raises(ValueError, match=rf"{name} {path}.*: expected .* \(PEM\)"):
            paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)


TOPIC = b"\x00\x01t"


def use_gateway(broker: Broker) -> None:
    with closing(PahoConnection(broker, MqttOptions(), "me", Will("t", b""))) as connection:
        while True:
            connection.wait(60.0)


def use_reader(broker: Broker) -> None:
    async def read() -> None:
        with closing(await ReaderConnection.open(broker, MqttOptions(), "me", ["t"], 0)) as connection:
            await connection.next()

    asyncio.run(read())


HOSTILE = {
    "message with QoS 2": CONNACK + b"\x34\x07" + TOPIC + b"\x00\x01\x00x",
    "at most": CONNACK + b"\x30\xff\xff\xff\x7f" + TOPIC + bytes(1000),
    "a longer packet": b"\x20\xff\xff\xff\x7f\x00\x00" + bytes(1000),
}


@pytest.mark.parametrize("use", [use_gateway, use_reader])
@pytest.mark.parametrize("words", HOSTILE)
def test_packets_that_could_fill_the_memory_end_the_connection(words: str, use: Callable[[Broker], None]) -> None:
    with scripted(HOSTILE[words]) as broker, pytest.raises(BrokerError, match=words):
        use(broker)


@pytest.mark.parametrize("head", [b"", CONNACK])
def test_messages_that_imud_did_not_request_end_the_connection(head: bytes) -> None:
    message = b"\x30\x05" + TOPIC + b"\x00x"
    data = head + message * (RECEIVED_MAX + 1)
    with scripted(data) as broker, pytest.raises(BrokerError, match="message that imud did not request"):
        use_gateway(broker)


A, B = (Broker(name, 1883, False, False, "") for name in "ab")


def test_pauses_double_up_to_the_maximum_and_brokers_take_turns() -> None:
    turn = BrokerTurn([A], 60.0, lambda: 1.0)
    assert [turn.failed(0) for _ in range(6)] == [4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    for _ in range(1100):  # 2.0 to the power of this number exceeds a float
        assert turn.failed(0) == 60.0
    draw = random.Random(25).random
    pauses = [BrokerTurn([A], 60.0, draw).failed(0) for _ in range(500)]
    in_second = [sum(second <= pause < second + 1 for pause in pauses) for second in range(4)]
    assert sum(in_second) == 500
    assert max(in_second) < 170
    turn = BrokerTurn([A, B], 60.0, lambda: 1.0)
    seen, pauses = [], []
    for _ in range(4):
        seen.append(turn.broker)
        pauses.append(turn.failed(0))
    assert (seen, pauses) == ([A, B, A, B], [4.0, 4.0, 8.0, 8.0])
    turn = BrokerTurn([A, B], 60.0, lambda: 1.0)
    turn.failed(0)
    assert turn.broker == B
    turn.connected(0)
    turn.failed(STABLE_NS)
    assert turn.broker == B
    turn.failed(STABLE_NS)
    assert turn.broker == A


@pytest.mark.parametrize(("held_ns", "pause_s"), [(STABLE_NS, FIRST_S), (STABLE_NS - 1, 32.0)])
def test_only_a_stable_connection_resets_the_pause(held_ns: int, pause_s: float) -> None:
    turn = BrokerTurn([A], 60.0, lambda: 1.0)
    for _ in range(3):
        turn.failed(0)
    turn.connected(0)
    assert turn.failed(held_ns) == pause_s


RETAIN_NOT_SUPPORTED = b"\x20\x03\x00\x9a\x00"
WITHOUT_RETAIN = b"\x20\x05\x00\x00\x02\x25\x00"


def test_refused_will_is_recognized() -> None:
    with scripted(RETAIN_NOT_SUPPORTED) as broker, pytest.raises(RetainRefused, match="Retain not supported"):
        gateway(broker)
    with scripted(WITHOUT_RETAIN) as broker:
        connection = PahoConnection(broker, MqttOptions(), "gateway", None)
        assert not connection.has_retain
        connection.close()
    with scripted(WITHOUT_RETAIN) as broker, closing(gateway(broker)) as connection:
        assert not connection.has_retain, "a broker can accept the will and permit no retained messages"


def test_old_version_names_retained_messages() -> None:
    with (
        scripted(b"") as broker,
        pytest.raises(BrokerError, match="permits retained messages and a retained last will"),
    ):
        PahoConnection(broker, MqttOptions(version="3.1.1"), "gateway", Will("t", b""))


class EndingDeadline(paho_client_module.ConnectDeadline):
    """Deadline that ends when the test requests it, without a timer."""

    def __init__(self, client: object, seconds: float) -> None:
        super().__init__(client, 1e6)
        self._seconds = seconds
        deadlines.append(self)


deadlines: list[EndingDeadline] = []


# paho-mqtt leaves the socket of a failed handshake to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("scheme", ["mqtt", "mqtts", "ws"])
def test_endless_connection_ends_at_the_deadline(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The broker accepts the connection and never completes CONNACK, TLS or the WebSocket."""
    monkeypatch.setattr("imud.fleet.broker.ConnectDeadline", EndingDeadline)
    deadlines.clear()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def drip() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                if scheme != "mqtt":
                    connection.sendall(b"\x16" if scheme == "mqtts" else b"HTTP/1.1 101 S")
                connection.recv(1)
                deadlines[0].end()
                while connection.recv(4096):
                    pass

        thread = threading.Thread(target=drip)
        thread.start()
        broker = broker_of(f"{scheme}://127.0.0.1:{listener.getsockname()[1]}")
        assert broker is not None
        with pytest.raises(BrokerError, match="no complete reply to the connection within 12 s"):
            gateway(broker)
        thread.join(LIMIT_S)
    assert not thread.is_alive()


def test_flood_of_packets_is_read_within_the_budget() -> None:
    """PINGRESP packets without end: each read costs 1 ms of CPU time."""
    cpu_ns = [0]

    def cpu() -> int:
        cpu_ns[0] += 1_000_000
        return cpu_ns[0]

    with scripted(CONNACK, b"\xd0\x00" * 5000) as broker, closing(gateway(broker)) as connection:
        reads: list[int] = []
        budget = WorkBudget(BROKER_LIMITS, cpu)
        connection.budget = budget
        connection.subscribe("imud/+")
        for _ in range(400):
            budget.start_turn(0)
            before = budget.refused
            connection.wait(1.0)
            reads.append(budget.refused == before)
            if budget.refused > 5:
                break
    assert budget.refused > 5
    assert sum(reads) <= 4 * 200, "at most 200 ms per second"
