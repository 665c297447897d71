"""How a client of a broker is made, and how its errors are described."""

import ssl
from pathlib import Path

import pytest

from imud.publishers.mqtt.access import connection_problem, paho_client, properties_of
from imud.publishers.mqtt.settings import Broker, MqttSettings

BROKER = Broker("127.0.0.1", 1883, tls=False, websockets=False, path="/mqtt")


def test_user_and_the_first_line_of_the_password_file_are_taken(tmp_path: Path) -> None:
    secret = tmp_path / "password"
    secret.write_text("first line\r\nsecond\n")
    settings = MqttSettings(user="reader", password_file=str(secret))
    client = paho_client(BROKER, settings, "one", is_v5=True, manual_ack=True)
    assert (client.username, client.password) == ("reader", "first line")


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    path = str(tmp_path / "absent")
    with pytest.raises(OSError, match="absent") as caught:
        paho_client(BROKER, MqttSettings(user="reader", password_file=path), "one", is_v5=True)
    assert connection_problem(caught.value).startswith(f"{path}: ")


def test_an_error_of_tls_says_what_is_wrong_with_a_certificate() -> None:
    error = ssl.SSLCertVerificationError("certificate verify failed")
    error.verify_message = "self-signed certificate"
    assert connection_problem(error) == "self-signed certificate"


def test_properties_have_the_values_that_are_given() -> None:
    assert properties_of("CONNECT", ReceiveMaximum=7).ReceiveMaximum == 7
