"""Clients of paho-mqtt and the description of their errors."""

import asyncio
import socket
import ssl
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from imud.fleet.broker import (
    PACKET_BYTES,
    RECEIVED_MAX,
    UNREAD_MAX,
    WEBSOCKET_BYTES,
    BrokerError,
    PacketGuard,
    PahoConnection,
    Will,
    check_websocket_buffer,
    connection_problem,
    paho_client,
    properties_of,
)
from imud.fleet.reader import ReaderConnection
from imud.fleet.settings import Broker, MqttOptions
from tests.fleet.authority import Authority

BROKER = Broker("127.0.0.1", 1883, tls=False, websockets=False, path="/mqtt")
TLS_BROKER = BROKER._replace(tls=True)


def of_tls(authority: Authority) -> MqttOptions:
    return MqttOptions(
        user="reader", ca_file=authority["ca.pem"], cert_file=authority["gateway.pem"],
        key_file=authority["gateway.key"],
    )  # fmt: skip


def test_a_password_file_has_the_password_in_its_first_line(tmp_path: Path) -> None:
    secret = tmp_path / "password"
    secret.write_text("first line\r\nsecond\n")
    settings = MqttOptions(user="reader", password_file=str(secret))
    client = paho_client(BROKER, settings, "one", is_v5=True, packet_bytes=99, manual_ack=True)
    assert (client.username, client.password) == ("reader", "first line")
    secret.write_bytes(b"\xff\n")
    with pytest.raises(ValueError, match=f"^password_file {secret}: expected text in UTF-8"):
        paho_client(BROKER, settings, "one", is_v5=True, packet_bytes=99)


@pytest.mark.parametrize("name", ["password_file", "ca_file", "cert_file", "key_file"])
def test_a_file_that_cannot_be_read_is_named_with_its_key(tmp_path: Path, authority: Authority, name: str) -> None:
    path = tmp_path / "absent"
    settings = msgspec.structs.replace(of_tls(authority), **{name: str(path)})
    with pytest.raises(ValueError, match=f"^{name} {path}: No such file or directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)
    path.mkdir()
    with pytest.raises(ValueError, match=f"^{name} {path}: Is a directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)


@pytest.mark.parametrize("name", ["ca_file", "cert_file", "key_file"])
def test_an_invalid_certificate_or_key_file_is_named(tmp_path: Path, authority: Authority, name: str) -> None:
    path = tmp_path / "garbage"
    path.write_text("no certificate\n")
    settings = msgspec.structs.replace(of_tls(authority), **{name: str(path)})
    with pytest.raises(ValueError, match=rf"{name} {path}.*: expected .* \(PEM\)"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)


def test_a_key_with_a_passphrase_is_rejected_without_a_prompt(tmp_path: Path, authority: Authority) -> None:
    locked = tmp_path / "locked.key"
    words = ["openssl", "rsa", "-aes256", "-passout", "pass:x", "-in", authority["gateway.key"], "-out", str(locked)]
    subprocess.run(words, check=True, capture_output=True)
    settings = msgspec.structs.replace(of_tls(authority), key_file=str(locked))
    with pytest.raises(ValueError, match=r"^key_file: expected a key without a passphrase"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True, packet_bytes=99)


def test_problems_and_properties() -> None:
    error = ssl.SSLCertVerificationError("certificate verify failed")
    error.verify_message = "self-signed certificate"
    assert connection_problem(error) == "self-signed certificate"
    assert properties_of("CONNECT", ReceiveMaximum=7).ReceiveMaximum == 7


CONNACK = b"\x20\x03\x00\x00\x00"
TOPIC = b"\x00\x01t"


@contextmanager
def hostile_broker(data: bytes) -> Iterator[Broker]:
    """Run a broker that sends `data` after CONNECT and ignores all packets."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            sock, _ = listener.accept()
            with sock, suppress(OSError):
                sock.sendall(data)
                while sock.recv(65_536):
                    pass

        thread = threading.Thread(target=serve)
        thread.start()
        yield BROKER._replace(port=listener.getsockname()[1])
        thread.join()


def use_gateway(broker: Broker) -> None:
    """Connect as a gateway and wait for the end of the connection."""
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
    with hostile_broker(HOSTILE[words]) as broker, pytest.raises(BrokerError, match=words):
        use(broker)


@pytest.mark.parametrize("head", [b"", CONNACK])
def test_messages_that_imud_did_not_request_end_the_connection(head: bytes) -> None:
    message = b"\x30\x05" + TOPIC + b"\x00x"
    data = head + message * (RECEIVED_MAX + 1)
    with hostile_broker(data) as broker, pytest.raises(BrokerError, match="message that imud did not request"):
        use_gateway(broker)


def test_a_long_websocket_frame_ends_the_connection() -> None:
    check_websocket_buffer(SimpleNamespace(_readbuffer=bytes(WEBSOCKET_BYTES)))
    check_websocket_buffer(SimpleNamespace())  # a connection without WebSocket
    with pytest.raises(ValueError, match="WebSocket frame of at most"):
        check_websocket_buffer(SimpleNamespace(_readbuffer=bytes(WEBSOCKET_BYTES + 1)))


def test_the_guard_finds_packets_in_any_pieces() -> None:
    guard = PacketGuard(PACKET_BYTES)
    data = b"\x32\x80\x01" + b"\x34" * 128 + b"\xd0\x00"
    for at in range(len(data)):
        guard.take(data[at : at + 1], is_writing=False)
    for _ in range(3):
        guard.take(data * 1000, is_writing=False)
    with pytest.raises(ValueError, match="does not read"):
        guard.take(b"\xc0\x00" * (UNREAD_MAX + 1), is_writing=True)
    with pytest.raises(ValueError, match="at most 10 bytes"):
        PacketGuard(10).take(b"\x30\x0b", is_writing=False)
    PacketGuard(10).take(b"\x30\x0a", is_writing=False)
