"""Blocks of recordings: golden bytes, every truncation, every damaged byte, foreign bytes between blocks."""

import io
import struct
import zlib
from random import Random
from types import SimpleNamespace

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import recording, records
from imud.formats.records import EndRecord, Kind, SessionRecord
from imud.model.errors import ImudError

PLAIN_MAX, BLOCK_BYTES = 4_194_304, 262_144
RECORD_BYTES_MAX = PLAIN_MAX - BLOCK_BYTES
GOLDEN_HEAD = b"\x89imudREC" + b"\0" + b"\0\0\0" + b"\0\0\0\0" + b"\3\0\0\0" + b"\3\0\0\0"
GOLDEN = GOLDEN_HEAD + zlib.crc32(GOLDEN_HEAD + b"abc").to_bytes(4, "little") + b"abc"
"""A stored block, written by hand from the description of the format."""


def blocks_of(data: bytes) -> tuple[list[bytes], recording.BlockReader]:
    reader = recording.BlockReader(io.BytesIO(data))
    return [block.content for block in reader], reader


def some_blocks(count: int, seed: int = 1) -> list[tuple[bytes, bytes]]:
    random, encoder = Random(seed), recording.BlockEncoder()
    contents = [random.randbytes(random.randrange(1, 40)) * random.randrange(1, 30) for _ in range(count)]
    return [(content, encoder.encode(content)) for content in contents]


def test_the_golden_block_is_read_and_written_and_one_that_compresses_is_a_zstandard_frame() -> None:
    assert recording.BlockEncoder().encode(b"abc") == GOLDEN
    found, reader = blocks_of(GOLDEN)
    assert found == [b"abc"]
    assert (reader.bytes_bad, reader.bytes_cut, reader.blocks_missing) == (0, 0, 0)
    assert recording.is_recording(GOLDEN)
    with pytest.raises(ImudError, match=r"a\.csv is not a recording of imud: expected"):
        recording.check_begin(b"t_ns,accel", "a.csv")
    block = recording.BlockEncoder().encode(b"abcd" * 1000)
    assert block[8] == 1
    assert zstandard.ZstdDecompressor().decompress(block[recording.HEAD.size :]) == b"abcd" * 1000
    assert blocks_of(block)[0] == [b"abcd" * 1000]


def test_after_a_cut_at_any_byte_all_whole_blocks_are_read() -> None:
    made = some_blocks(6)
    data = b"".join(block for _, block in made)
    for end in range(len(data) + 1):
        whole, at = [], 0
        for content, block in made:
            at += len(block)
            if at <= end:
                whole.append(content)
        found, reader = blocks_of(data[:end])
        assert found == whole
        assert reader.bytes_bad == 0
        assert sum(len(block) for content, block in made[: len(whole)]) + reader.bytes_cut == end


def test_a_damaged_byte_costs_its_own_block_only() -> None:
    made = some_blocks(4)
    data = b"".join(block for _, block in made)
    for place in range(len(data)):
        damaged = data[:place] + bytes([data[place] ^ 0x40]) + data[place + 1 :]
        begins = [sum(len(block) for _, block in made[:i]) for i in range(len(made))]
        hit = max(i for i, begin in enumerate(begins) if begin <= place)
        found, reader = blocks_of(damaged)
        assert found == [content for i, (content, _) in enumerate(made) if i != hit]
        assert reader.bytes_bad + reader.bytes_cut == len(made[hit][1])
        assert reader.blocks_missing == (hit != len(made) - 1)


@given(st.lists(st.binary(max_size=60), max_size=6), st.integers(0, 1000))
def test_foreign_bytes_between_blocks_are_passed_over(foreign: list[bytes], seed: int) -> None:
    made = some_blocks(len(foreign), seed)
    data = b"".join(junk.replace(recording.MAGIC, b"") + block for junk, (_, block) in zip(foreign, made, strict=True))
    assert blocks_of(data)[0] == [content for content, _ in made]


@given(st.binary(max_size=400))
def test_no_bytes_raise(data: bytes) -> None:
    found, reader = blocks_of(recording.MAGIC + data)
    assert not found
    assert reader.bytes_bad + reader.bytes_cut == len(data) + len(recording.MAGIC)


def valid_crc(stored: bytes, plain: int, method: int = 1) -> bytes:
    """Return a block with these fields and a correct CRC."""
    head = recording.HEAD.pack(recording.MAGIC, method, 0, plain, len(stored), 0)[:-4]
    return head + struct.pack("<I", zlib.crc32(stored, zlib.crc32(head))) + stored


FRAME = zstandard.compress(b"abcd" * 1000)
DAMAGED = {
    "no Zstandard frame": valid_crc(b"x" * 40, 4000), "a frame that is cut": valid_crc(FRAME[:-3], 4000),
    "a frame with damaged data": valid_crc(FRAME[:-4] + b"\xff\xff\xff\xff", 4000),
    "a frame with a byte too much": valid_crc(FRAME, 3999), "a frame with a byte too few": valid_crc(FRAME, 4001),
    "a frame without its size": valid_crc(zstandard.ZstdCompressor(write_content_size=False).compress(b"a" * 99), 99),
    "a frame of 64 MB": valid_crc(zstandard.compress(bytes(64 << 20)), 1 << 16),
    "a content that is too large": valid_crc(Random(1).randbytes(1 << 17), PLAIN_MAX + 1),
    "a frame as large as its content": valid_crc(FRAME, len(FRAME)), "another method": valid_crc(b"abc", 3, method=2),
    "stored bytes of another size": valid_crc(b"abc", 4, method=0),
}  # fmt: skip
"""Blocks with a correct CRC and invalid content, from another program or a defect."""


@pytest.mark.parametrize("block", DAMAGED.values(), ids=DAMAGED)
def test_a_block_with_a_valid_crc_and_damaged_content_costs_only_itself(block: bytes) -> None:
    found, reader = blocks_of(GOLDEN + block + GOLDEN)
    assert (found, reader.bytes_bad, reader.first_bad) == ([b"abc"] * 2, len(block), len(GOLDEN))
    found, reader = blocks_of(block)
    assert (found, reader.bytes_bad + reader.bytes_cut) == ([], len(block))


def test_limits_of_a_block() -> None:
    assert blocks_of(recording.BlockEncoder().encode(bytes(PLAIN_MAX)))[0] == [bytes(PLAIN_MAX)]
    with pytest.raises(ValueError, match="at most"):
        recording.BlockEncoder().encode(b"\0" * (PLAIN_MAX + 1))
    zeros = bytes(6000)
    assert blocks_of(recording.BlockEncoder().encode(zeros))[0] == [zeros]
    bomb = zstandard.ZstdCompressor().compress(zeros)
    found, reader = blocks_of(valid_crc(bomb, len(zeros)))
    assert not found
    assert 256 < len(zeros) / len(bomb) < 512
    assert reader.bytes_bad == recording.HEAD.size + len(bomb)


def test_a_block_with_another_number_is_whole() -> None:
    encoder = recording.BlockEncoder()
    blocks = [encoder.encode(content) for content in (b"a", b"b" * 1000)]
    data = recording.renumbered(blocks[1], 0) + recording.renumbered(blocks[0], 1)
    found = list(recording.BlockReader(io.BytesIO(data)))
    assert [(block.number, block.content) for block in found] == [(0, b"b" * 1000), (1, b"a")]
    assert recording.renumbered(blocks[1], 1) == blocks[1]


def test_false_heads_cost_a_limited_number_of_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each head announces 100 kB: without a limit, a reader checks 700 MB in this file of 300 kB."""
    head = recording.HEAD.pack(recording.MAGIC, 0, 0, 100_000, 100_000, 1)
    checked = 0

    def crc32(data: bytes, value: int = 0) -> int:
        nonlocal checked
        checked += len(data)
        return zlib.crc32(data, value)

    monkeypatch.setattr("imud.formats.recording.zlib", SimpleNamespace(crc32=crc32))
    good = recording.BlockEncoder().encode(b"abc" * 100)
    found, reader = blocks_of(good + head * (300_000 // len(head)) + good)
    assert found == [b"abc" * 100] * 2
    assert reader.bytes_bad == 300_000 // len(head) * len(head)
    assert checked < 68_500_000


def test_blocks_inside_a_cut_block_are_read_and_the_first_bad_byte_is_known() -> None:
    """The head of a large block before other blocks: the file ends before the end of the large block."""
    large = recording.BlockEncoder().encode(Random(1).randbytes(1000))[: recording.HEAD.size]
    found, reader = blocks_of(large + GOLDEN + b"foreign" + GOLDEN)
    assert found == [b"abc", b"abc"]
    assert (reader.bytes_bad, reader.bytes_cut, reader.first_bad) == (recording.HEAD.size + 7, 0, 0)
    assert blocks_of(GOLDEN + b"foreign" + GOLDEN)[1].first_bad == len(GOLDEN)
    assert blocks_of(GOLDEN)[1].first_bad == -1


def session(version: int = records.VERSION) -> bytes:
    made = SessionRecord(version, "0.1.0", "3.11", "gateway", 5, 0, 10, 20)
    return records.encode_object(Kind.SESSION, records.NO_DEVICE, made)


END = records.encode_object(Kind.END, records.NO_DEVICE, EndRecord(1, 2, "stopped"))


def written(*made: bytes, each: bool = False) -> bytes:
    gatherer, parts = recording.BlockGatherer(), list[bytes]()
    for record in made:
        parts.append(gatherer.add(record))
        if each:
            parts.append(gatherer.finish())
    return b"".join([*parts, gatherer.finish()])


def reads(count: int) -> list[bytes]:
    return [records.encode_data(0, number.to_bytes(4, "little") * 50, number, -1) for number in range(count)]


def test_round_trip_of_records_over_several_blocks() -> None:
    made = [session(), *reads(5000), END]
    reader = recording.RecordingReader(io.BytesIO(written(*made)), "a.rec")
    found = list(reader)
    assert [records.HEAD.pack(kind, device, len(body)) + body for kind, device, body in found] == made
    assert reader.blocks_read == -(-sum(map(len, made)) // BLOCK_BYTES)
    assert reader.plain_bytes == sum(map(len, made))
    assert reader.session is not None
    assert reader.session.host == "gateway"
    assert reader.ended
    assert reader.problems == []


def test_a_missing_end_damage_and_missing_blocks_are_reported() -> None:
    data = written(session(), *reads(10), END, each=True)
    reader = recording.RecordingReader(io.BytesIO(data[:-5]), "a.rec")
    assert len(list(reader)) == 11
    assert len(reader.problems) == 2
    assert (reader.ended, reader.is_damaged) == (False, False)
    assert "incomplete" in reader.problems[0]
    assert "no regular end" in reader.problems[1]
    damaged = bytearray(written(session(), *reads(10), END, each=True))
    damaged[400] ^= 1
    reader = recording.RecordingReader(io.BytesIO(bytes(damaged)), "a.rec")
    assert len(list(reader)) == 11
    assert "are damaged" in reader.problems[0]
    assert reader.problems[1] == "missing blocks according to their numbers: 1"
    assert reader.is_damaged
    reader = recording.RecordingReader(io.BytesIO(written(session(), b"\xff" * 9, *reads(2), END, each=True)), "a.rec")
    assert len(list(reader)) == 4
    assert (reader.records_unreadable, reader.blocks_read, reader.is_damaged, reader.ended) == (1, 5, True, True)
    assert reader.problems == ["1 blocks contain no valid records; imud ignores them"]


@pytest.mark.parametrize("data", [b"", b"\x89imudREC", b"t_ns,accel\n" * 20])
def test_a_file_without_blocks_is_not_a_recording(data: bytes) -> None:
    with pytest.raises(ImudError, match="at least one complete block"):
        list(recording.RecordingReader(io.BytesIO(data), "a.rec"))


def test_sizes_and_versions_are_limited() -> None:
    with pytest.raises(ImudError, match="records of version 1, got 9"):
        list(recording.RecordingReader(io.BytesIO(written(session(9))), "a.rec"))
    assert recording.RecordingReader(io.BytesIO(written(bytes(RECORD_BYTES_MAX))), "a.rec")
    gatherer, half = recording.BlockGatherer(), bytes(BLOCK_BYTES // 2)
    assert (gatherer.add(half), gatherer.add(half)) == (b"", b""), "two halves fit into a block"
    assert gatherer.add(b"x")
    with pytest.raises(ValueError, match="at most"):
        recording.BlockGatherer().add(bytes(RECORD_BYTES_MAX + 1))
