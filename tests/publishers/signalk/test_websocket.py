"""Frames of a WebSocket: control frames between messages, limits, masks, and the key."""

import struct

import pytest

from imud.publishers.signalk.websocket import (
    CLOSE,
    CONTROL_BYTES_MAX,
    FRAME_BYTES_MAX,
    PING,
    PONG,
    TEXT,
    ControlFrame,
    InvalidFrame,
    WebSocketReader,
    accept_of,
    encode_frame,
    new_key,
)


def frame(first: int, payload: bytes) -> bytes:
    """Return a frame of a server."""
    length = len(payload)
    if length < 126:
        return bytes((first, length)) + payload
    if length < 65_536:
        return struct.pack(">BBH", first, 126, length) + payload
    return struct.pack(">BBQ", first, 127, length) + payload


STREAM = b"".join(
    [
        frame(0x81, b"hello"), frame(0x89, b"a"), frame(0x01, b"x" * 200), frame(0x8A, b""), frame(0x00, b""),
        frame(0x80, b"y" * 70), frame(0x82, bytes(65_536)), frame(0x89, b"b" * 125), frame(0x81, b""),
        frame(0x88, b"\x03\xe8"),
    ]
)  # fmt: skip
CONTROLS = [(PING, b"a"), (PONG, b""), (PING, b"b" * CONTROL_BYTES_MAX), (CLOSE, b"\x03\xe8")]


@pytest.mark.parametrize("piece_bytes", [1, 2, 3, 11, 2048, 1 << 20])
def test_control_frames_between_messages(piece_bytes: int) -> None:
    reader = WebSocketReader()
    frames: list[ControlFrame] = []
    for start in range(0, len(STREAM), piece_bytes):
        frames += reader.feed(STREAM[start : start + piece_bytes])
        assert len(reader._rest) <= 2 + CONTROL_BYTES_MAX, "messages are not stored"
    assert frames == CONTROLS


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x81\x80", "without a mask"), (b"\xc1\x00", "without extensions"), (b"\x83\x00", "next frame"),
        (b"\x80\x00", "next frame"), (b"\x01\x00\x81\x00", "next frame"), (b"\x8b\x00", "a ping, pong or close"),
        (b"\x09\x00", "a ping, pong or close"), (b"\x89\x7e\x00\x80", "a ping, pong or close"),
        (b"\x82\x7f" + struct.pack(">Q", FRAME_BYTES_MAX + 1), "at most 65536 bytes"),
        (b"\x82\x7f" + b"\xff" * 8, "at most 65536 bytes"),
    ],
)  # fmt: skip
def test_invalid_frames(data: bytes, problem: str) -> None:
    with pytest.raises(InvalidFrame, match=problem):
        WebSocketReader().feed(data)


@pytest.mark.parametrize("length", [0, 1, 4, 125, 126, 65_535, 65_536])
def test_frames_of_the_client_are_masked(length: int) -> None:
    payload = bytes(index % 251 for index in range(length))
    expected = frame(0x81, payload)
    head_bytes = len(expected) - length
    data = encode_frame(TEXT, payload)
    assert data[:head_bytes] == bytes((0x81, expected[1] | 0x80)) + expected[2:head_bytes]
    mask = data[head_bytes : head_bytes + 4]
    masked = data[head_bytes + 4 :]
    assert bytes(byte ^ mask[index % 4] for index, byte in enumerate(masked)) == payload


def test_key_of_the_specification() -> None:
    assert accept_of("dGhlIHNhbXBsZSBub25jZQ==") == "s3pPLMBiTxaQ9kYGzzhZRbK+xOo="  # RFC 6455, section 1.3
    assert new_key() != new_key()
