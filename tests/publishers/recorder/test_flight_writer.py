"""Thread of the flight recorder: snapshots to files and clients, with failing disks and clients."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from imud.formats import records
from imud.formats.records import NO_DEVICE, EndRecord, Kind, SessionRecord
from imud.publishers.recorder.client_stream import stream_pair
from imud.publishers.recorder.directory import RecordingDirectory
from imud.publishers.recorder.flight import FlightWriter, Mark, Rescue, Save, SegmentBegin, SegmentRing, Send
from imud.publishers.recorder.writer import RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench, kinds_in, records_in

LINGER_NS = 10_000_000_000

END = records.encode_object(Kind.END, NO_DEVICE, EndRecord(9, 9, "a blow"))
SESSION = records.encode_object(Kind.SESSION, NO_DEVICE, SessionRecord(1, "", "", "", 7, 0, 1, 1))


class FlightWriterBench(RecordingBench):
    def __init__(self, folder: Path, keep_bytes: int = 1 << 30) -> None:
        super().__init__()
        self.folder = folder / "recordings"
        self.queue = RecordQueue[Mark]()
        self.ring = SegmentRing(1 << 30)
        directory = RecordingDirectory(self.folder, keep_bytes)
        self.writer = FlightWriter(self.queue, self.ring, directory, self.clock.now_ns, self.workers.start)

    def begin(self, path: Path | None = None) -> None:
        self.queue.mark(SegmentBegin(self.advance(1), SESSION, path, 0))

    def put(self, number: int, size: int = 50) -> None:
        self.queue.put(records.encode_data(number, os.urandom(size), 1, -1))

    def work(self) -> int:
        return self.workers[0].work()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[FlightWriterBench]:
    made = FlightWriterBench(tmp_path)
    yield made
    made.writer.close()


def test_a_snapshot_contains_all_earlier_records_and_no_later_record(
    bench: FlightWriterBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, synced = bench.folder / "a", list[int]()
    monkeypatch.setattr(os, "fdatasync", synced.append)
    bench.begin()
    bench.put(0)
    bench.begin()
    bench.put(1)
    bench.queue.mark(Save(path, END))
    bench.put(2)
    bench.work()
    (saved,) = bench.writer.saved
    assert (saved.path, saved.bytes, saved.problem) == (path, path.stat().st_size, "")
    assert len(synced) == 1  # the file is on the disk before the report
    assert [(one.kind, one.device) for one in records_in(path)] == [
        (Kind.SESSION, NO_DEVICE), (Kind.DATA, 0), (Kind.DATA, 1), (Kind.END, NO_DEVICE)
    ]  # fmt: skip
    bench.queue.mark(Save(bench.folder / "b", END))
    bench.work()
    assert [one.device for one in records_in(bench.folder / "b") if one.kind == Kind.DATA] == [0, 1, 2]


def test_a_slow_client_does_not_delay_other_clients(bench: FlightWriterBench, tmp_path: Path) -> None:
    ours, theirs = stream_pair()
    bench.begin()
    for number in range(40):
        bench.put(number, 200_000)
    bench.queue.mark(Send(ours, END))
    assert bench.work() < LINGER_NS
    assert bench.writer.sends_ended == 0
    bench.queue.mark(Save(bench.folder / "a", END))
    bench.begin()
    got, theirs_file = tmp_path / "got", theirs.makefile("rb")
    theirs.setblocking(False)
    with got.open("wb") as out:
        while not bench.writer.sends_ended:
            bench.work()
            while piece := theirs_file.read(1 << 20):
                out.write(piece)
        while piece := theirs_file.read(1 << 20):
            out.write(piece)
    assert got.read_bytes() == (bench.folder / "a").read_bytes()
    assert kinds_in(got).count(Kind.DATA) == 40
    theirs_file.close()
    theirs.close()


def test_clients_without_progress_are_disconnected(bench: FlightWriterBench) -> None:
    bench.begin()
    for number in range(40):
        bench.put(number, 200_000)
    gone, silent = stream_pair(), stream_pair()
    gone[1].close()
    bench.queue.mark(Send(gone[0], END))
    bench.queue.mark(Send(silent[0], END))
    bench.work()
    assert bench.writer.sends_ended == 1
    bench.advance(LINGER_NS / 1e9)
    bench.work()
    assert bench.writer.sends_ended == 2
    silent[1].close()


def test_a_client_reads_end_of_file_without_descriptors_and_when_imud_stops(
    bench: FlightWriterBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.begin()
    for number in range(40):
        bench.put(number, 200_000)
    stopped, refused = stream_pair(), stream_pair()
    for _, theirs in (stopped, refused):
        theirs.setblocking(False)
    bench.queue.mark(Send(stopped[0], END))
    bench.work()
    monkeypatch.setattr(bench.ring, "reader", lambda _ending: os.open("/none", os.O_RDONLY))
    bench.queue.mark(Send(refused[0], END))
    bench.work()
    assert refused[1].recv(1) == b""
    assert bench.writer.sends_ended == 1
    bench.writer.close()
    while stopped[1].recv(1 << 20):
        pass
    stopped[1].close()
    refused[1].close()


def test_a_full_disk_leaves_no_incomplete_snapshot(bench: FlightWriterBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.begin()
    bench.put(0)
    bench.work()
    write = os.write

    def full(descriptor: int, data: bytes) -> int:
        if "recordings" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(28, "No space left on device")
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", full)
    bench.queue.mark(Save(bench.folder / "a", END))
    bench.work()
    assert [saved.problem for saved in bench.writer.saved] == ["No space left on device"]
    assert list(bench.folder.glob("*.imudrec")) == []
    assert bench.writer.problem == ""
    monkeypatch.undo()
    bench.queue.mark(Save(bench.folder / "b", END))
    bench.work()
    assert bench.writer.saved[1].problem == ""


def test_after_a_failed_segment_nothing_is_saved_until_the_next_segment(
    bench: FlightWriterBench, tmp_path: Path
) -> None:
    bench.begin(tmp_path / "no" / "folder")
    bench.put(0)
    bench.queue.mark(Save(bench.folder / "a", END))
    bench.work()
    assert bench.writer.problem == "No such file or directory"
    assert [saved.problem for saved in bench.writer.saved] == ["nothing was kept"]
    assert list(bench.folder.glob("*.imudrec")) == []
    bench.begin()
    bench.put(1)
    bench.queue.mark(Save(bench.folder / "b", END))
    bench.work()
    assert bench.writer.problem == ""
    assert kinds_in(bench.folder / "b") == [Kind.SESSION, Kind.DATA, Kind.END]


def test_snapshots_stay_below_the_limit(tmp_path: Path) -> None:
    bench = FlightWriterBench(tmp_path, keep_bytes=100_000)
    for number in range(5):
        bench.begin()
        bench.put(number, 30_000)
        path = bench.folder / f"20251121T09314{number}Z-000000ab-00000{number}-snapshot.imudrec"
        bench.ring.clear()
        bench.queue.mark(Save(path, END))
        bench.work()
        assert sum(file.stat().st_size for file in bench.folder.glob("*.imudrec")) <= 100_000
    assert len(list(bench.folder.glob("*.imudrec"))) == 3 - 1 + 1
    bench.writer.close()


def test_data_of_a_killed_process_is_saved_and_removed_or_kept(
    bench: FlightWriterBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / "000", tmp_path / "001"]
    for number, file in enumerate(files):
        bench.begin(file)
        bench.put(number)
    bench.work()
    bench.folder.mkdir()
    (bench.folder / "a").write_bytes(b"taken")
    bench.queue.mark(Rescue(bench.folder / "a", files))
    bench.work()
    assert bench.writer.saved[0].problem == "File exists"
    assert all(file.exists() for file in files)
    bench.queue.mark(Rescue(bench.folder / "b", files))
    bench.work()
    assert bench.writer.saved[1].problem == ""
    assert not any(file.exists() for file in files)
    assert (bench.folder / "b").stat().st_size > 100
