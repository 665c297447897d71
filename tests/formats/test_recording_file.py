"""Recordings as files: records in blocks, and the errors of incomplete files."""

import io

import pytest

from imud.formats import records
from imud.formats.recording import BLOCK_BYTES, RECORD_BYTES_MAX, BlockGatherer, RecordingReader
from imud.formats.records import EndRecord, Kind, SessionRecord
from imud.model.errors import ImudError


def session(version: int = records.VERSION) -> bytes:
    return records.encode_object(
        Kind.SESSION, records.NO_DEVICE, SessionRecord(version, "0.1.0", "3.11", "gateway", 5, 0, 10, 20)
    )


END = records.encode_object(Kind.END, records.NO_DEVICE, EndRecord(1, 2, "stopped"))


def written(*made: bytes, each: bool = False) -> bytes:
    gatherer, parts = BlockGatherer(), list[bytes]()
    for record in made:
        parts.append(gatherer.add(record))
        if each:
            parts.append(gatherer.finish())
    return b"".join([*parts, gatherer.finish()])


def reads(count: int) -> list[bytes]:
    return [records.encode_data(0, number.to_bytes(4, "little") * 50, number, -1) for number in range(count)]


def test_round_trip_of_records_over_several_blocks() -> None:
    made = [session(), *reads(5000), END]
    reader = RecordingReader(io.BytesIO(written(*made)), "a.rec")
    found = list(reader)
    assert [records.HEAD.pack(kind, device, len(body)) + body for kind, device, body in found] == made
    assert reader.blocks_read == -(-sum(map(len, made)) // BLOCK_BYTES)
    assert reader.plain_bytes == sum(map(len, made))
    assert reader.session is not None
    assert reader.session.host == "gateway"
    assert reader.ended
    assert reader.problems == []


def test_a_file_without_an_end_is_reported() -> None:
    data = written(session(), *reads(10), END, each=True)
    reader = RecordingReader(io.BytesIO(data[:-5]), "a.rec")
    assert len(list(reader)) == 11
    assert len(reader.problems) == 2
    assert (reader.ended, reader.is_damaged) == (False, False)
    assert "incomplete" in reader.problems[0]
    assert "no regular end" in reader.problems[1]


def test_damage_and_missing_blocks_are_named() -> None:
    data = bytearray(written(session(), *reads(10), END, each=True))
    data[400] ^= 1
    reader = RecordingReader(io.BytesIO(bytes(data)), "a.rec")
    assert len(list(reader)) == 11
    assert "are damaged" in reader.problems[0]
    assert reader.problems[1] == "missing blocks according to their numbers: 1"
    assert reader.is_damaged


def test_a_block_without_records_costs_only_itself() -> None:
    reader = RecordingReader(io.BytesIO(written(session(), b"\xff" * 9, *reads(2), END, each=True)), "a.rec")
    assert len(list(reader)) == 4
    assert (reader.records_unreadable, reader.blocks_read, reader.is_damaged, reader.ended) == (1, 5, True, True)
    assert reader.problems == ["1 blocks contain no valid records; imud ignores them"]


@pytest.mark.parametrize("data", [b"", b"\x89imudREC", b"t_ns,accel\n" * 20])
def test_a_file_without_blocks_is_not_a_recording(data: bytes) -> None:
    with pytest.raises(ImudError, match="at least one complete block"):
        list(RecordingReader(io.BytesIO(data), "a.rec"))


def test_sizes_and_versions_are_limited() -> None:
    with pytest.raises(ImudError, match="records of version 1, got 9"):
        list(RecordingReader(io.BytesIO(written(session(9))), "a.rec"))
    assert RecordingReader(io.BytesIO(written(bytes(RECORD_BYTES_MAX))), "a.rec")
    gatherer, half = BlockGatherer(), bytes(BLOCK_BYTES // 2)
    assert (gatherer.add(half), gatherer.add(half)) == (b"", b""), "two halves fit into a block"
    assert gatherer.add(b"x")
    with pytest.raises(ValueError, match="at most"):
        BlockGatherer().add(bytes(RECORD_BYTES_MAX + 1))
