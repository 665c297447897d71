"""Messages of gateways from a broker: each payload is a message or an error, and the ledger balances."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import zstandard

from imud.fleet.accounts import FleetLedger
from imud.fleet.messages import (
    MAGIC,
    SLOTS_MAX,
    VERSION,
    DropCause,
    FleetMessage,
    Interval,
    Measures,
    MessageKind,
    Stream,
    boot_text,
    decode_message,
    encode_message,
    parse_topic,
    topic_of,
)
from imud.formats.slot import SLOT_BYTES, encode_slots
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from tests.fuzz.target import Target

PLAIN: Final = b"\0"
"""First byte of an input: the rest is one payload."""
PACKED: Final = b"\1"
"""First byte of an input whose rest is header and slots. The target compresses them, because a mutation of compressed
data fails early."""
SEVERAL: Final = b"\2"
"""First byte of an input with several payloads as JSON, one per line. The ledger processes them in order."""


def names() -> Sequence[str]:
    return ["message", "topic"]


def make(name: str) -> Target:
    if name == "topic":
        return Target(run_topic, topic_seeds)
    return Target(run_message, message_seeds)


def run_message(data: bytes) -> None:
    """Decode and count the payloads. The accounts of all streams balance after each payload."""
    kind, rest = data[:1], data[1:]
    if kind == PACKED:
        header, _, slots = rest.partition(b"\n")
        head = MAGIC + bytes([VERSION, 0]) + (len(header) & 0xFFFF).to_bytes(2, "little")
        payloads = [head + header + zstandard.compress(slots)]
    else:
        payloads = rest.split(b"\n") if kind == SEVERAL else [rest]
    ledger = FleetLedger(from_begin=bool(rest[:1] < b"\x80"))
    for payload in payloads:
        try:
            message = decode_message(payload)
        except ValueError:
            continue
        assert len(message.samples) <= max(SLOTS_MAX, len(payload))
        fresh = ledger.take(message, Stream.SAMPLES)
        if fresh is not None:
            with suppress(ValueError):  # the device name cannot be encoded in UTF-8, but JSON can contain it
                assert decode_message(encode_message(fresh)).last == fresh.last
        for counts in ledger.counts.values():
            assert counts.balance == 0
            assert counts.missing >= 0
            assert counts.duplicates >= 0


def run_topic(data: bytes) -> None:
    """The topic made from the parts of a topic is equal to the topic."""
    topic = data.decode("utf-8", "replace")
    parts = parse_topic(topic)
    if parts is not None:
        assert topic_of(parts.site, parts.gateway, parts.device, parts.leaf) == topic


def _message(kind: MessageKind, first: int, last: int, **more: object) -> FleetMessage:
    return FleetMessage(
        v=VERSION, gateway="gw", boot=boot_text(255), device="bow", kind=kind, begin=1, first=first, last=last,
        count=last - first + 1, utc_ns=9, **more,  # type: ignore[arg-type]
    )  # fmt: skip


def message_seeds() -> list[bytes]:
    samples = [
        Sample("bow", seq, 1000 * seq, 5, Sync.EDGE, 1000 * seq + 9, 77_000 + seq, accel_m_s2=(0.1, -0.2, 9.8))
        for seq in (5, 6, 7)
    ]
    measures = {"accel_m_s2": Measures((0.1, 0.2, 9.8), (0.0, 0.0, 9.7), (0.2, 0.3, 9.9), (0.1, 0.2, 9.8))}
    interval = Interval(5, 7, 3, 1000, 3000, 77_000, 79_000, 5, Sync.EDGE, measures, 3)
    messages = [
        _message(MessageKind.SAMPLES, 5, 7, samples=samples),
        _message(MessageKind.INTERVALS, 5, 7, intervals=[interval]),
        _message(MessageKind.EVENTS, 1, 1, events=[Event(3, "bow", EventKind.UP, "up")]),
        _message(MessageKind.DROPPED, 8, 90, cause=DropCause.SPACE),
    ]
    slots = b"".join(encode_slots(samples, 0))
    assert len(slots) == len(samples) * SLOT_BYTES
    row = [(1, 3), (4, 6), (9, 10), (5, 12), (4, 6), (20, 30), (13, 19)]
    rows = b"\n".join(encode_message(_message(MessageKind.DROPPED, *pair, cause=DropCause.AGE)) for pair in row)
    return [
        *(PLAIN + encode_message(message) for message in messages),
        PACKED + encode_message(_message(MessageKind.SLOTS, 5, 7)) + b"\n" + slots, PLAIN + MAGIC, SEVERAL + rows,
    ]  # fmt: skip


def topic_seeds() -> list[bytes]:
    good = [topic_of("site", "gw", "", "state"), topic_of("site", "gw", "bow", "samples")]
    return [*(topic.encode() for topic in good), b"imud/a/b/c/d/e", b"imud/+/#", b"$SYS/x", b"imud/a/b\n/state"]
