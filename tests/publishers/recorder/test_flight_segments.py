"""Ring of segments: limits of time and size, and complete recordings."""

import errno
import os
from io import BytesIO
from pathlib import Path

import pytest

from imud.formats import records
from imud.formats.recording import BlockEncoder, RecordingReader
from imud.formats.records import NO_DEVICE, EndRecord, Kind, SessionRecord
from imud.publishers.recorder.flight import SegmentBegin, SegmentReader, SegmentRing, left_behind

SEGMENTS_MAX = 64

END = records.encode_object(Kind.END, NO_DEVICE, EndRecord(9, 9, "a blow"))


def session(number: int) -> bytes:
    return records.encode_object(Kind.SESSION, NO_DEVICE, SessionRecord(1, "", "", "", 7, number, number, number))


class RingBench:
    """Ring with one data block per segment, in addition to the session record."""

    def __init__(self, bytes_max: int = 1 << 20, folder: Path | None = None) -> None:
        self.ring = SegmentRing(bytes_max)
        self.folder = folder
        self.count = 0

    def add(self, size: int = 50, drop_before_ns: int = -1) -> None:
        path = self.folder / f"{self.count:03d}" if self.folder is not None else None
        self.ring.begin(SegmentBegin(self.count, session(self.count), path, drop_before_ns))
        encoder = BlockEncoder()
        self.ring.append(encoder.encode(session(self.count)))
        self.ring.append(encoder.encode(records.encode_data(self.count, os.urandom(size), 1, -1)))
        self.count += 1

    def close(self) -> None:
        self.ring.clear()


def read(reader: SegmentReader) -> list[records.Record]:
    data = b""
    while block := reader.next_block():
        data += block
    reader.close()
    found = RecordingReader(BytesIO(data), "read")
    kept = list(found)
    assert not found.is_damaged
    return kept


def devices(kept: list[records.Record]) -> list[int]:
    return [one.device for one in kept if one.kind == Kind.DATA]


def test_a_snapshot_has_one_session_record_and_an_end_record() -> None:
    bench = RingBench()
    for _ in range(3):
        bench.add()
    found = read(bench.ring.reader(END))
    assert [one.kind for one in found] == [Kind.SESSION, Kind.DATA, Kind.DATA, Kind.DATA, Kind.END]
    assert records.decode_object(found[0], SessionRecord).number == 0
    assert devices(found) == [0, 1, 2]
    bench.close()
    assert (bench.ring.bytes, bench.ring.oldest_ns) == (0, 0)


def test_segments_before_the_kept_time_are_dropped() -> None:
    bench = RingBench()
    for _ in range(5):
        bench.add()
    bench.add(drop_before_ns=3)  # segment 2 ends at 3, when segment 3 starts
    assert devices(read(bench.ring.reader(END))) == [3, 4, 5]
    assert bench.ring.oldest_ns == 3
    bench.close()


def test_the_oldest_segments_are_dropped_but_never_the_newest() -> None:
    bench = RingBench(bytes_max=10_000)
    for _ in range(10):
        bench.add(2_000)
        assert bench.ring.bytes <= 10_000
    assert devices(read(bench.ring.reader(END))) == [6, 7, 8, 9]
    bench.add(20_000)
    assert devices(read(bench.ring.reader(END))) == [10]
    bench.close()
    small = RingBench()
    for _ in range(SEGMENTS_MAX + 2):
        small.add(10)
    assert devices(read(small.ring.reader(END))) == list(range(2, SEGMENTS_MAX + 2))
    small.close()
    ring = SegmentRing(200)
    for t_ns, size, kept in ((1, 100, 100), (2, 100, 200), (3, 1, 101)):
        ring.begin(SegmentBegin(t_ns, b"", None, -1))
        ring.append(bytes(size))
        assert ring.bytes == kept
    ring.clear()


def test_a_failed_reader_closes_its_descriptors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = RingBench(folder=tmp_path)
    for _ in range(2):
        bench.add()
    with pytest.raises(FileNotFoundError):
        left_behind([*tmp_path.iterdir(), tmp_path / "none"])
    made, dup = list[int](), os.dup

    def dup_once(descriptor: int) -> int:
        if made:
            raise OSError(errno.EMFILE, "Too many open files")
        made.append(dup(descriptor))
        return made[-1]

    monkeypatch.setattr(os, "dup", dup_once)
    with pytest.raises(OSError, match="Too many open files"):
        bench.ring.reader(END)
    bench.close()


def test_a_reader_stays_valid_after_segments_are_dropped() -> None:
    bench = RingBench()
    for _ in range(3):
        bench.add()
    reader = bench.ring.reader(END)
    reader.next_block()
    bench.add()
    bench.ring.clear()
    data = b""
    while block := reader.next_block():
        data += block
    assert [one.device for one in RecordingReader(BytesIO(data), "") if one.kind == Kind.DATA] == [0, 1, 2]
    bench.close()


def test_segment_files_are_complete_recordings_and_are_removed(tmp_path: Path) -> None:
    bench = RingBench(folder=tmp_path)
    for _ in range(3):
        bench.add()
    bench.add(drop_before_ns=2)
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["002", "003"]
    for file in files:
        with file.open("rb") as opened:
            assert [one.kind for one in RecordingReader(opened, "")] == [Kind.SESSION, Kind.DATA]
    assert devices(read(bench.ring.reader(END))) == [2, 3]
    bench.close()
    assert list(tmp_path.iterdir()) == []


def test_complete_blocks_of_a_killed_process_are_read(tmp_path: Path) -> None:
    bench = RingBench(folder=tmp_path)
    for _ in range(3):
        bench.add()
    files = sorted(tmp_path.iterdir())
    with files[2].open("r+b") as file:
        file.truncate(files[2].stat().st_size - 1)
    found = read(left_behind(files))
    assert [one.kind for one in found] == [Kind.SESSION, Kind.DATA, Kind.DATA]
    files[1].write_bytes(b"something else" * 10)
    assert devices(read(left_behind(files))) == [0]
    bench.close()


def test_a_full_file_system_drops_the_oldest_segments_and_then_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = RingBench(folder=tmp_path)
    for _ in range(4):
        bench.add()
    write, room = os.write, [len(list(tmp_path.iterdir()))]

    def write_where_there_is_room(descriptor: int, data: bytes) -> int:
        if len(list(tmp_path.iterdir())) >= room[0]:
            return write(descriptor, data[:5])  # a partial write, as on a full disk
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", write_where_there_is_room)
    bench.add()
    assert devices(read(bench.ring.reader(END))) == [2, 3, 4]
    room[0] = 0
    with pytest.raises(OSError, match="No space left") as raised:
        bench.add()
    assert raised.value.errno == errno.ENOSPC
    bench.close()
