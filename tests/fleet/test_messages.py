"""Payloads of JSON and slots: encoding and decoding, and rejected payloads."""

import copy
import functools
import json
import math
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import msgspec
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from imud.fleet import messages as fleet_messages
from imud.fleet.messages import FleetMessage, MessageKind, Stream, decode_message, encode_message, encode_slots_message
from imud.formats.slot import encode_slots
from imud.model.event import Event, EventKind
from imud.model.sample import Position, Sample, Sync

NUMBER_MOST, SLOTS_MAX = 1 << 62, 500


def made(seq: int) -> Sample:
    return Sample(
        "bow", seq, 1000 * seq, 5, Sync.EDGE, 1000 * seq + 9, 77_000 + seq, accel_m_s2=(0.1, -0.2, 9.8), status=3
    )


def message(kind: MessageKind, first: int = 5, last: int = 7, **more: object) -> FleetMessage:
    return FleetMessage(
        v=fleet_messages.VERSION, gateway="gw", boot=fleet_messages.boot_text(255), device="bow", kind=kind, begin=1,
        first=first, last=last, count=last - first + 1, utc_ns=9, **more,  # type: ignore[arg-type]
    )  # fmt: skip


def test_the_header_is_as_documented() -> None:
    payload = encode_message(message(MessageKind.EVENTS, 1, 1, events=[Event(3, "bow", EventKind.UP, "up")]))
    assert json.loads(payload) == {
        "v": 1, "gateway": "gw", "boot": "00000000000000ff", "device": "bow", "kind": "events", "begin": 1,
        "first": 1, "last": 1, "count": 1, "utc_ns": 9,
        "events": [{"t_ns": 3, "device": "bow", "kind": "up", "message": "up"}],
    }  # fmt: skip
    bad = msgspec.structs.replace(
        made(5), gyro_rad_s=(0.0, math.nan, 0.0), temperature_c=math.inf, position=Position(0.0, math.nan)
    )
    payload = encode_message(message(MessageKind.SAMPLES, samples=[bad]))
    assert b"null" not in payload
    assert (decode_message(payload).samples, fleet_messages.finite(made(5))) == ([made(5)], made(5))


@pytest.mark.parametrize("place", [None, Position(0.5, 0.25, 6.0, 7, 8)])
@pytest.mark.parametrize("as_slots", [False, True])
def test_samples_survive_encoding_and_decoding(as_slots: bool, place: Position | None) -> None:
    samples = [made(5), msgspec.structs.replace(made(6), position=place, heave_m=0.5), made(7)]
    if as_slots:
        payload = encode_slots_message(message(MessageKind.SLOTS), encode_slots(samples, 0))
        size = struct.unpack_from("<4sBBH", payload)[3]
        version, slot_bytes = (1, 256) if place is None else (2, 320)  # version 1 as from an older imud
        slots = b"".join(slot[:slot_bytes] for slot in encode_slots(samples, 0))
        assert (payload[4], zstandard.ZstdDecompressor().decompress(payload[8 + size :])) == (version, slots)
        assert json.loads(payload[8 : 8 + size])["last"] == fleet_messages.check_payload(payload).last == 7
    else:
        payload = encode_message(message(MessageKind.SAMPLES, samples=samples))
    assert decode_message(payload).samples == samples


def forged(slots: bytes, version: int = 2, padding: int = 0) -> bytes:
    head = msgspec.json.encode(message(MessageKind.SLOTS)) + b" " * padding
    return struct.pack("<4sBBH", fleet_messages.MAGIC, version, 0, len(head)) + head + zstandard.compress(slots)


SLOT = encode_slots([made(5)], 0)[0]


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"{}", b"IMUB", b"null", forged(bytes(320 * (SLOTS_MAX + 1))), forged(SLOT, version=3),
        forged(SLOT, padding=4096), b'{"deep":' + b"[" * 100_000,
        encode_message(message(MessageKind.SAMPLES)).replace(b'"v":1', b'"v":2'),
        encode_message(message(MessageKind.SAMPLES, 8, 7)),
        encode_message(message(MessageKind.SAMPLES)).replace(b'"begin":1', b'"begin":0'),
        encode_slots_message(message(MessageKind.SLOTS), [bytes(319) + b"\1"]),
        encode_slots_message(message(MessageKind.SLOTS), [bytes(100)]),
    ],
)  # fmt: skip
def test_invalid_payloads_raise_an_error_with_the_cause(payload: bytes) -> None:
    with pytest.raises(ValueError, match="expected"):
        decode_message(payload)
    for boot in ("", "a b", "x" * 65, "1\n"):
        with pytest.raises(ValueError, match="expected a boot of"):
            decode_message(encode_message(msgspec.structs.replace(message(MessageKind.SAMPLES), boot=boot)))


def fields(kind: MessageKind, **more: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(encode_message(message(kind, **more)))
    return found


PLACE = Position(0.5, 0.25, 6.0, 7, 8)
INTERVAL = fleet_messages.Interval(5, 7, 3, 1, 2, 3, 4, 5, Sync.EDGE, {}, 6)
CLOCK = fleet_messages.GatewayClock(1, 2, synchronised=True, error_ns=3)
FULL = (
    fields(
        MessageKind.SAMPLES,
        samples=[msgspec.structs.replace(made(5), t_dev_ns=1, pps_age_ms=2, edge_seq=3, gnss_utc_ns=4, position=PLACE)],
    ),
    fields(MessageKind.INTERVALS, intervals=[INTERVAL]),
    fields(MessageKind.EVENTS, events=[Event(3, "bow", EventKind.UP, "up")], clock=CLOCK),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    members = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, one in members:
        yield from places(one, (*path, name))
    if type(value) is int and path != ("v",):
        yield path


def put(value: Any, path: tuple[Any, ...], number: int) -> bytes:
    copied = copy.deepcopy(value)
    *above, name = path
    functools.reduce(lambda inner, step: inner[step], above, copied)[name] = number
    return msgspec.json.encode(copied) if abs(number) < 1 << 63 else json.dumps(copied).encode()


@pytest.mark.parametrize("whole", FULL, ids=lambda whole: str(whole["kind"]))
def test_numbers_that_no_database_can_store_are_rejected_in_each_field(whole: dict[str, Any]) -> None:
    for path in places(whole):
        for number in (NUMBER_MOST, -NUMBER_MOST, 1 << 63, 10**30):
            with pytest.raises(ValueError, match="expected"):
                decode_message(put(whole, path, number))
        if path[-1] not in ("begin", "first"):
            assert decode_message(put(whole, path, NUMBER_MOST - 1))
    slots = encode_slots([msgspec.structs.replace(made(5), t_ns=NUMBER_MOST, t_rx_ns=NUMBER_MOST)], 0)
    with pytest.raises(ValueError, match=r"below 2\*\*62, got a number of 63 bits"):
        decode_message(encode_slots_message(message(MessageKind.SLOTS), slots))


def test_events_have_text_without_nul_and_their_own_number() -> None:
    for text in ("\0", "a\0", "\\\\\0"):
        with pytest.raises(ValueError, match="without NUL"):
            decode_message(encode_message(message(MessageKind.EVENTS, events=[Event(3, "bow", EventKind.UP, text)])))
    for text in ("\\u0000", "\\\\u0000", "u0000", "\\\1"):
        event = Event(3, "bow", EventKind.UP, text)
        assert decode_message(encode_message(message(MessageKind.EVENTS, events=[event]))).events == [event]
    events = [Event(3, "bow", EventKind.UP, "up")] * 4
    with pytest.raises(ValueError, match="expected one event per number, got 4 events for 3 numbers"):
        decode_message(encode_message(message(MessageKind.EVENTS, events=events)))


@given(st.binary(max_size=200), st.integers(0, 400))
def test_damaged_payloads_raise_only_value_errors(noise: bytes, at: int) -> None:
    payload = encode_slots_message(message(MessageKind.SLOTS), encode_slots([made(5)], 0))
    for one in (noise, fleet_messages.MAGIC + noise, payload[:at] + noise + payload[at + len(noise) :]):
        with suppress(ValueError):
            decode_message(one)


def test_topics_are_as_documented() -> None:
    assert fleet_messages.topic_of("mill", "gw-1", "", fleet_messages.STATE) == "imud/mill/gw-1/state"
    assert fleet_messages.topic_of("mill", "gw-1", "", Stream.EVENTS) == "imud/mill/gw-1/events"
    assert fleet_messages.topic_of("mill", "gw-1", "bow", Stream.SAMPLES) == "imud/mill/gw-1/bow/samples"
    assert fleet_messages.parse_topic("imud/mill/gw-1/bow/statistics") == fleet_messages.TopicParts(
        "mill", "gw-1", "bow", "statistics"
    )
    assert fleet_messages.parse_topic("imud/mill/gw-1/state") == fleet_messages.TopicParts("mill", "gw-1", "", "state")
    for topic in ("", "imud", "imud/a/b", "imud/a/b/status", "imud/a/b/c/state", "imud/a/b/c/d/e", "other/a/b/state",
                  "imud/a//state"):  # fmt: skip
        assert fleet_messages.parse_topic(topic) is None, topic


@pytest.mark.parametrize("name", ["", "a/b", "+", "#", "$SYS", "a b", "ä", "x" * 65, "a\0", "a\n"])
def test_an_invalid_name_raises_an_error(name: str) -> None:
    for site, gateway, device in ((name, "gw", "bow"), ("site", name, "bow"), ("site", "gw", name or "a/b")):
        with pytest.raises(ValueError, match="letters, digits"):
            fleet_messages.topic_of(site, gateway, device, fleet_messages.STATUS)
    with pytest.raises(ValueError, match="of a device"):
        fleet_messages.topic_of("site", "gw", "bow", fleet_messages.STATE)
    with pytest.raises(ValueError, match="of a gateway"):
        fleet_messages.topic_of("site", "gw", "", fleet_messages.SCHEMA)
