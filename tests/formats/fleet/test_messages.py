"""Payloads: JSON and slots come back as they went, and nothing else does."""

import json
import math
import struct
from contextlib import suppress

import msgspec
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from imud.event import Event, EventKind
from imud.formats.fleet.messages import (
    MAGIC,
    SLOTS_MAX,
    VERSION,
    FleetMessage,
    MessageKind,
    boot_text,
    decode_message,
    encode_message,
    encode_slots_message,
    finite,
)
from imud.formats.slot import encode_slots
from imud.sample import Sample, Sync


def made(seq: int) -> Sample:
    return Sample(
        "bow", seq, 1000 * seq, 5, Sync.EDGE, 1000 * seq + 9, 77_000 + seq, accel_m_s2=(0.1, -0.2, 9.8), status=3
    )


def message(kind: MessageKind, first: int = 5, last: int = 7, **more: object) -> FleetMessage:
    return FleetMessage(
        v=VERSION, gateway="gw", boot=boot_text(255), device="bow", kind=kind, begin=1, first=first, last=last,
        count=last - first + 1, utc_ns=9, **more,  # type: ignore[arg-type]
    )  # fmt: skip


def test_the_header_is_what_the_document_says() -> None:
    payload = encode_message(message(MessageKind.EVENTS, 1, 1, events=[Event(3, "bow", EventKind.UP, "up")]))
    assert json.loads(payload) == {
        "v": 1, "gateway": "gw", "boot": "00000000000000ff", "device": "bow", "kind": "events", "begin": 1,
        "first": 1, "last": 1, "count": 1, "utc_ns": 9,
        "events": [{"t_ns": 3, "device": "bow", "kind": "up", "message": "up"}],
    }  # fmt: skip


@pytest.mark.parametrize("as_slots", [False, True])
def test_samples_come_back_as_they_went(as_slots: bool) -> None:
    samples = [made(seq) for seq in (5, 6, 7)]
    if as_slots:
        payload = encode_slots_message(message(MessageKind.SLOTS), encode_slots(samples, 0))
        size = struct.unpack_from("<4sBBH", payload)[3]
        assert zstandard.ZstdDecompressor().decompress(payload[8 + size :]) == b"".join(encode_slots(samples, 0))
        assert json.loads(payload[8 : 8 + size])["last"] == 7
    else:
        payload = encode_message(message(MessageKind.SAMPLES, samples=samples))
    assert decode_message(payload).samples == samples


def test_values_that_json_does_not_have_are_left_out() -> None:
    bad = msgspec.structs.replace(made(5), gyro_rad_s=(0.0, math.nan, 0.0), temperature_c=math.inf)
    payload = encode_message(message(MessageKind.SAMPLES, samples=[bad]))
    assert b"null" not in payload
    assert decode_message(payload).samples == [made(5)]
    assert finite(made(5)) == made(5)


def bomb() -> bytes:
    """Slots whose frame says that it is far larger than any message."""
    head = msgspec.json.encode(message(MessageKind.SLOTS))
    return struct.pack("<4sBBH", MAGIC, 1, 0, len(head)) + head + zstandard.compress(bytes(256 * (SLOTS_MAX + 1)))


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"{}", b"IMUB", b"null", bomb(),
        encode_message(message(MessageKind.SAMPLES)).replace(b'"v":1', b'"v":2'),
        encode_message(message(MessageKind.SAMPLES, 8, 7)),
        encode_message(message(MessageKind.SAMPLES)).replace(b'"begin":1', b'"begin":0'),
        encode_slots_message(message(MessageKind.SLOTS), [bytes(256)]),
        encode_slots_message(message(MessageKind.SLOTS), [bytes(100)]),
    ],
)  # fmt: skip
def test_anything_else_is_an_error_with_a_reason(payload: bytes) -> None:
    with pytest.raises(ValueError, match="expected"):
        decode_message(payload)


@given(st.binary(max_size=200), st.integers(0, 400))
def test_damaged_bytes_raise_nothing_else(noise: bytes, at: int) -> None:
    payload = encode_slots_message(message(MessageKind.SLOTS), encode_slots([made(5)], 0))
    for one in (noise, MAGIC + noise, payload[:at] + noise + payload[at + len(noise) :]):
        with suppress(ValueError):
            decode_message(one)
