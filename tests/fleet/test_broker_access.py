"""Clients of paho-mqtt and the description of their errors."""

import ssl
import subprocess
from pathlib import Path

import msgspec
import pytest

from imud.fleet.broker import connection_problem, paho_client, properties_of
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
    client = paho_client(BROKER, settings, "one", is_v5=True, manual_ack=True)
    assert (client.username, client.password) == ("reader", "first line")
    secret.write_bytes(b"\xff\n")
    with pytest.raises(ValueError, match=f"^password_file {secret}: expected text in UTF-8"):
        paho_client(BROKER, settings, "one", is_v5=True)


@pytest.mark.parametrize("name", ["password_file", "ca_file", "cert_file", "key_file"])
def test_a_file_that_cannot_be_read_is_named_with_its_key(tmp_path: Path, authority: Authority, name: str) -> None:
    path = tmp_path / "absent"
    settings = msgspec.structs.replace(of_tls(authority), **{name: str(path)})
    with pytest.raises(ValueError, match=f"^{name} {path}: No such file or directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True)
    path.mkdir()
    with pytest.raises(ValueError, match=f"^{name} {path}: Is a directory$"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True)


@pytest.mark.parametrize("name", ["ca_file", "cert_file", "key_file"])
def test_an_invalid_certificate_or_key_file_is_named(tmp_path: Path, authority: Authority, name: str) -> None:
    path = tmp_path / "garbage"
    path.write_text("no certificate\n")
    settings = msgspec.structs.replace(of_tls(authority), **{name: str(path)})
    with pytest.raises(ValueError, match=rf"{name} {path}.*: expected .* \(PEM\)"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True)


def test_a_key_with_a_passphrase_is_rejected_without_a_prompt(tmp_path: Path, authority: Authority) -> None:
    locked = tmp_path / "locked.key"
    words = ["openssl", "rsa", "-aes256", "-passout", "pass:x", "-in", authority["gateway.key"], "-out", str(locked)]
    subprocess.run(words, check=True, capture_output=True)
    settings = msgspec.structs.replace(of_tls(authority), key_file=str(locked))
    with pytest.raises(ValueError, match=r"^key_file: expected a key without a passphrase"):
        paho_client(TLS_BROKER, settings, "one", is_v5=True)


def test_problems_and_properties() -> None:
    error = ssl.SSLCertVerificationError("certificate verify failed")
    error.verify_message = "self-signed certificate"
    assert connection_problem(error) == "self-signed certificate"
    assert properties_of("CONNECT", ReceiveMaximum=7).ReceiveMaximum == 7
