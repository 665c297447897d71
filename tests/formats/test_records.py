"""Records of recordings: round trip of each kind, layouts by hand, and errors for invalid records."""

import re
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import records
from imud.formats.can import CanFrame
from imud.formats.records import Kind, Record
from imud.model.errors import ImudError
from tests.support.documented import DOCS

DECODERS: dict[Kind, Callable[[bytes], Any]] = {
    Kind.DATA: records.decode_data, Kind.FRAMES: records.decode_frames, Kind.READINGS: records.decode_readings,
    Kind.EDGES: records.decode_edges, Kind.CLOCKS: records.decode_clocks, Kind.LOST: records.decode_lost,
}  # fmt: skip


def only(data: bytes) -> Record:
    (record,) = records.records_of(data)
    return record


def test_a_data_record_by_hand_and_round_trip_of_objects() -> None:
    data = records.encode_data(3, b"\x5a\xa5", 258, -1)
    assert data == b"\x05\x03\x00\x13\x00\x00\x00" + struct.pack("<qq", 258, -1) + b"\0\x5a\xa5"
    record = only(data)
    assert (record.kind, record.device) == (Kind.DATA, 3)
    assert records.decode_data(record.body) == (258, -1, b"\x5a\xa5")
    call = records.CallRecord("clock", "link_changed", [], {"byte_ns": 86_806, "hold_ns": 0})
    record = only(records.encode_object(Kind.CALL, 1, call))
    assert records.decode_object(record, records.CallRecord) == call
    with pytest.raises(ImudError, match="cannot read a record of kind 9"):
        records.decode_object(record._replace(body=b"\xc1"), records.CallRecord)
    with pytest.raises(ImudError, match="expected a ledger with "):
        records.decode_object(only(records.encode_object(Kind.CHECK, 1, CHECK)), records.CheckRecord)


FRAMES = [
    CanFrame(0x188, False, b"\1\2\3", 10), CanFrame(0x0CFF3408, True, b"", 11, True),
    CanFrame(0x7FF, False, bytes(64), 12),
]  # fmt: skip
READINGS = [records.ReadingRecord(0, 5, 9, 0, b"\1" * 300), records.ReadingRecord(1, 10, 12, 2, "bus é".encode())]
CLOCKS, LOST = records.ClocksRecord(1, -2, 3, 4, 5, 6), records.LostRecord(1, 2, -3)
CHECK = {"t_ns": 1, "seq": 2, "sample_t_ns": 3, "sample_t_err_ns": 4, "ledger": {}}


@pytest.mark.parametrize(
    ("kind", "data", "value"),
    [
        (Kind.FRAMES, records.encode_frames(0, FRAMES), FRAMES), (Kind.CLOCKS, records.encode_clocks(CLOCKS), CLOCKS),
        (Kind.READINGS, records.encode_readings(7, READINGS), READINGS), (Kind.LOST, records.encode_lost(LOST), LOST),
    ],
)  # fmt: skip
def test_round_trip_of_records(kind: Kind, data: bytes, value: object) -> None:
    assert only(data).kind == kind
    assert DECODERS[kind](only(data).body) == value


def int64(*values: int) -> str:
    return b"".join(value.to_bytes(8, "little", signed=True) for value in values).hex()


FD_FRAME = CanFrame(0x188, False, bytes(64), 9)
GOLDEN = [
    (
        records.encode_frames(258, [CanFrame(0x0CFF3408, True, b"\xab\xcd", 10, True), FD_FRAME]),
        "06 0201 5e000000" + int64(10) + "0834ff0c 03 02 abcd" + int64(9) + "88010000 00 40" + "00" * 64,
    ),
    (
        records.encode_readings(1, [records.ReadingRecord(3, 5, 9, 2, b"no")]),
        "07 0100 18000000" + int64(5, 9) + "03 02 02000000 6e6f",
    ),
    (records.encode_edges(0, "alarm", [(-5, True, 258)]), "08 0000 12000000 04" + int64(-5) + "01" + int64(258)),
    (records.encode_clocks(CLOCKS), "04 ffff 2c000000" + int64(1, -2, 3, 4, 5) + "06000000"),
    (records.encode_lost(LOST), "0b ffff 18000000" + int64(1, 2, -3)),
]  # fmt: skip
"""Records written by hand from the tables of docs/recording.md."""


def test_records_have_the_documented_bytes() -> None:
    for data, expected in GOLDEN:
        assert data == bytes.fromhex(expected)
    table = (DOCS / "recording.md").read_text().partition("| kind | record |")[2]
    documented = re.findall(r"^\| (\d+) \| (\w+) \|", table, re.MULTILINE)
    assert [(str(kind.value), kind.name.lower()) for kind in Kind] == documented


@pytest.mark.parametrize("line", records.LINES)
def test_round_trip_of_edges(line: str) -> None:
    edges = [records.EdgeRecord(-5, True, 1), records.EdgeRecord(1 << 60, False, 1 << 40)]
    assert records.decode_edges(only(records.encode_edges(0, line, edges)).body) == (line, edges)


def test_records_follow_one_another_and_a_cut_one_is_an_error() -> None:
    data = records.encode_data(0, b"a", 1, -1) + records.encode(Kind.EVENT, 2, msgspec.msgpack.encode({}))
    assert [record.kind for record in records.records_of(data)] == [Kind.DATA, Kind.EVENT]
    for end in range(1, len(data)):
        if end != len(records.encode_data(0, b"a", 1, -1)):
            with pytest.raises(ImudError):
                list(records.records_of(data[:end]))


@given(st.sampled_from(sorted(DECODERS)), st.binary(max_size=80))
def test_no_body_raises_anything_but_an_imud_error(kind: Kind, body: bytes) -> None:
    with suppress(ImudError):
        DECODERS[kind](body)
