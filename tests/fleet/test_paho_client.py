"""Checks of received bytes before paho-mqtt stores them, and reasons of failed connections."""

import ssl
from types import SimpleNamespace

import pytest

from imud.fleet import paho_client as paho_client_module
from tests.fleet.test_broker import PACKET_BYTES, UNREAD_MAX, WEBSOCKET_BYTES


def test_long_packets_and_websocket_frames_are_detected_in_any_pieces() -> None:
    guard, data = paho_client_module.PacketGuard(PACKET_BYTES), b"\x32\x80\x01" + b"\x34" * 128 + b"\xd0\x00"
    for at in range(len(data)):
        guard.take(data[at : at + 1], is_writing=False)
    for _ in range(3):
        guard.take(data * 1000, is_writing=False)
    with pytest.raises(ValueError, match="does not read"):
        guard.take(b"\xc0\x00" * (UNREAD_MAX + 1), is_writing=True)
    with pytest.raises(ValueError, match="at most 10 bytes"):
        paho_client_module.PacketGuard(10).take(b"\x30\x0b", is_writing=False)
    paho_client_module.PacketGuard(10).take(b"\x30\x0a", is_writing=False)
    paho_client_module.check_websocket_buffer(SimpleNamespace(_readbuffer=bytes(WEBSOCKET_BYTES)))
    paho_client_module.check_websocket_buffer(SimpleNamespace())  # a connection without WebSocket
    with pytest.raises(ValueError, match="WebSocket frame of at most"):
        paho_client_module.check_websocket_buffer(SimpleNamespace(_readbuffer=bytes(WEBSOCKET_BYTES + 1)))


def test_problems_and_properties() -> None:
    error = ssl.SSLCertVerificationError("certificate verify failed")
    error.verify_message = "self-signed certificate"
    assert paho_client_module.connection_problem(error) == "self-signed certificate"
    assert paho_client_module.properties_of("CONNECT", ReceiveMaximum=7).ReceiveMaximum == 7
