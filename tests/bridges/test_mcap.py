"""MCAP files, read by the readers of the library `mcap`, which check CRCs and indexes."""

import struct
import threading
import zlib
from collections.abc import Sequence
from io import BytesIO
from random import Random
from typing import Any

import pytest
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Message, SummaryOffset
from mcap.stream_reader import StreamReader

from imud.bridges.channel import MessageChannel, MessageSchema
from imud.bridges.mcap import McapFile

CHUNK_BYTES = 1 << 20

SCHEMA = MessageSchema("a.B", "jsonschema", b'{"type":"object"}')
FIRST: MessageChannel[bytes] = MessageChannel("/first", SCHEMA, "json", bytes)
SECOND: MessageChannel[bytes] = MessageChannel("/second", MessageSchema("c.D", "jsonschema", b"{}"), "json", bytes)


def written(out: BytesIO, count: int = 20_000, size: int = 200) -> list[tuple[str, int, bytes]]:
    """Write a file with two channels, the second from the middle. Return the expected messages."""
    file = McapFile(out, "ros2", "imud test", {"source": "a.imudrec"})
    first, second, messages = file.add_channel(FIRST), None, []
    for number in range(count):
        data = number.to_bytes(4, "little") * (size // 4)
        first.add(1000 + number, data)
        messages.append(("/first", 1000 + number, data))
        if number >= count // 2 and number % 10 == 0:
            second = second or file.add_channel(SECOND)
            second.add(1000 + number, b"{}")
            messages.append(("/second", 1000 + number, b"{}"))
    file.finish()
    return messages


def read(reader: Any) -> list[tuple[str, int, bytes]]:
    return [
        (channel.topic, message.log_time, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]


@pytest.fixture(scope="module")
def whole() -> tuple[BytesIO, list[tuple[str, int, bytes]]]:
    out = BytesIO()
    return out, written(out)


Whole = tuple[BytesIO, list[tuple[str, int, bytes]]]


def test_a_file_is_read_back_by_order_index_and_summary(whole: Whole) -> None:
    out, messages = whole
    out.seek(0)
    assert read(SeekingReader(out, validate_crcs=True)) == messages
    out.seek(0)
    assert read(NonSeekingReader(out, validate_crcs=True)) == messages
    out, messages = whole
    out.seek(0)
    reader = SeekingReader(out)
    found = [
        message.log_time
        for _, _, message in reader.iter_messages(topics=["/second"], starting_at=12_000, ending_before=13_000)
    ]
    assert found == [t_ns for name, t_ns, _ in messages if name == "/second" and 12_000 <= t_ns < 13_000]
    assert len(found) == 100
    out, messages = whole
    out.seek(0)
    reader = SeekingReader(out)
    summary = reader.get_summary()
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.message_count == len(messages)
    assert statistics.channel_message_counts == {1: 20_000, 2: 1000}
    assert (statistics.message_start_time, statistics.message_end_time) == (1000, 20_999)
    assert statistics.chunk_count == len(summary.chunk_indexes) > 3
    assert [(number, one.id, one.name) for number, one in summary.schemas.items()] == [(1, 1, "a.B"), (2, 2, "c.D")]
    assert reader.get_header().profile == "ros2"
    assert [(one.name, one.metadata) for one in reader.iter_metadata()] == [("imud", {"source": "a.imudrec"})]
    out, _ = whole
    out.seek(0)
    chunks = [one for one in StreamReader(out, emit_chunks=True).records if isinstance(one, Chunk)]
    assert all(chunk.compression == "zstd" for chunk in chunks)
    assert max(chunk.uncompressed_size for chunk in chunks) < CHUNK_BYTES + 1000
    assert out.getbuffer().nbytes < sum(chunk.uncompressed_size for chunk in chunks) / 2


def test_a_file_that_was_cut_has_its_chunks_before_the_cut(whole: Whole) -> None:
    out, messages = whole
    cut = BytesIO(out.getvalue()[: out.getbuffer().nbytes // 2])
    found: list[int] = []
    records = StreamReader(cut, validate_crcs=True).records
    with pytest.raises((McapError, struct.error)):
        found.extend(record.log_time for record in records if isinstance(record, Message))
    assert found == [t_ns for _, t_ns, _ in messages[: len(found)]]
    assert len(found) > len(messages) // 4


def test_times_out_of_range_and_no_messages() -> None:
    out = BytesIO()
    file = McapFile(out, "", "imud", {})
    channel = file.add_channel(FIRST)
    for t_ns in (-5, 1 << 70, 7):
        channel.add(t_ns, b"x")
    file.finish()
    out.seek(0)
    messages = [message for _, _, message in SeekingReader(out).iter_messages(log_time_order=False)]
    assert [(one.sequence, one.log_time) for one in messages] == [(0, 0), (1, (1 << 64) - 1), (2, 7)]
    out = BytesIO()
    McapFile(out, "", "imud", {}).finish()
    out.seek(0)
    summary = SeekingReader(out, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert (summary.statistics.message_count, summary.statistics.chunk_count) == (0, 0)


def test_an_error_of_the_disk_comes_out_and_closing_ends_the_thread() -> None:
    class Full(BytesIO):
        def write(self, _data: Any) -> int:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        written(Full())
    before = set(threading.enumerate())
    file = McapFile(BytesIO(), "", "imud", {})
    file.add_channel(FIRST).add(1, bytes(CHUNK_BYTES + 1))
    assert set(threading.enumerate()) - before
    file.close()
    file.close()
    assert not set(threading.enumerate()) - before
    written(BytesIO(), 1)
    assert not set(threading.enumerate()) - before


def test_the_records_of_a_file_and_their_places() -> None:
    out = BytesIO()
    messages, data = written(out, 20), out.getvalue()
    records: list[Any] = list(StreamReader(BytesIO(data), emit_chunks=True).records)
    assert [type(record).__name__ for record in records] == [
        "Header", "Metadata", "Chunk", "MessageIndex", "MessageIndex", "DataEnd", "Schema", "Schema", "Channel",
        "Channel", "Statistics", "ChunkIndex", "MetadataIndex", *5 * ["SummaryOffset"], "Footer",
    ]  # fmt: skip
    chunk, *indexes = records[2:5]
    content = zstandard.decompress(chunk.data)
    places = {at: t_ns for index in indexes for t_ns, at in index.records}
    assert [places[at] for at in sorted(places)] == [t_ns for _, t_ns, _ in messages]
    assert {content[at] for at in places} == {Opcode.MESSAGE}
    footer, offsets = records[-1], [record for record in records if isinstance(record, SummaryOffset)]
    assert [data[one.group_start] for one in offsets] == [one.group_opcode for one in offsets]
    assert data[footer.summary_offset_start] == Opcode.SUMMARY_OFFSET
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -12])


def in_runs(sizes: Sequence[int], times_ns: Sequence[int], length: int) -> tuple[bytes, bytes]:
    """Write the same messages to two channels: one by one, and in runs."""
    files = []
    for one_by_one in (True, False):
        out = BytesIO()
        file = McapFile(out, "", "imud test", {})
        channels = [file.add_channel(FIRST), file.add_channel(SECOND)]
        for at in range(0, len(sizes), length):
            times = times_ns[at : at + length]
            messages = [bytes([size & 0xFF]) * size for size in sizes[at : at + length]]
            for channel in channels:
                if one_by_one:
                    for t_ns, data in zip(times, messages, strict=True):
                        channel.add(t_ns, data)
                else:
                    channel.add_run(times, messages)
        file.finish()
        files.append(out.getvalue())
    return files[0], files[1]


@pytest.mark.parametrize("length", [1, 7, 64])
def test_runs_are_written_as_one_message_after_the_other(length: int) -> None:
    """Chunks end inside runs, and one message fills a chunk exactly."""
    random = Random(length)
    sizes = [random.choice((0, 17, 300, 5000)) for _ in range(1500)]
    sizes[500] = CHUNK_BYTES - 31
    one_by_one, runs = in_runs(sizes, [10**18 + number for number in range(len(sizes))], length)
    assert runs == one_by_one
    summary = SeekingReader(BytesIO(runs)).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 4


def test_times_that_cannot_be_said_are_clipped_in_runs_too() -> None:
    times_ns = [5, -1, 4, 1 << 64, 7, 8]
    one_by_one, runs = in_runs([3] * 6, times_ns, 3)
    assert runs == one_by_one
    found = [t_ns for _, t_ns, _ in read(SeekingReader(BytesIO(runs)))]
    assert sorted(set(found)) == [0, 4, 5, 7, 8, (1 << 64) - 1]
