"""Flight recorder: kept data, saved alerts, and reports.
Thread of the flight recorder: snapshots to files and clients, with failing disks and clients."""

import errno
import os
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import pytest
from msgspec.structs import replace

from imud.contracts.lines import Edge, InputOptions, LineOwner
from imud.contracts.publisher import Batch
from imud.formats import records
from imud.formats.recording import BlockEncoder, RecordingReader
from imud.formats.records import NO_DEVICE, EndRecord, Kind, SessionRecord, decode_object
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.recorder import flight as recorder_flight
from imud.publishers.recorder.client_stream import stream_pair
from imud.publishers.recorder.directory import FlightOptions, RecorderOptions, RecordingDirectory
from imud.publishers.recorder.writer import RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench, kinds_in, records_in
from tests.support.publisher_context import NoLine
from tests.support.socket_rig import sample
from tests.support.surroundings import HOSTILE_UID, needs_root

SENDS_MAX, RETRY_NS = 4, 60 * NS_PER_S


class FlightBench(RecordingBench):
    """Flight recorder with thread, time and GPIO line of the test."""

    def __init__(self, folder: Path, devices: list[str] | None = None, **flight: Any) -> None:
        super().__init__()
        self.folder = folder / "recordings"
        settings = RecorderOptions(
            directory=str(self.folder), devices=devices,
            flight=FlightOptions(**{"enabled": True, "minutes": 1, "after_s": 10, **flight}),
        )  # fmt: skip
        object.__setattr__(self.context, "watch_line", self._watch)
        directory = RecordingDirectory(self.folder, settings.keep_bytes)
        self.flight = recorder_flight.FlightRecorder(settings, self.context, directory, self.workers.start)
        self.flight.start()
        self.tick()

    def _watch(self, _settings: InputOptions, purpose: str, owner: LineOwner) -> NoLine:
        assert purpose == "flight recorder"
        assert owner is self.flight
        return NoLine()

    def tick(self, seconds: float = 0.1) -> None:
        """Advance the time in steps of at most one second, each with a tick, a round of the thread, and a record."""
        while seconds > 0:
            self.source.deliver()
            self.flight.tick(self.advance(min(seconds, 1.0)))
            self.workers[0].work()
            seconds -= 1.0
        self.flight.tick(self.clock.now_ns())

    def publish(self, device: str, *accelerations_m_s2: float) -> None:
        numbered = enumerate(accelerations_m_s2, 1)
        samples = [replace(sample(device, seq), accel_m_s2=(0.0, -a * 0.6, a * 0.8)) for seq, a in numbered]
        self.flight.publish(Batch(device, 0, samples))

    @property
    def files(self) -> Sequence[Path]:
        return sorted(self.folder.glob("*.imudrec"))

    @property
    def messages(self) -> list[str]:
        return [event.message for event in self.events]


def span_s(path: Path) -> float:
    found = records_in(path)
    begun, end = decode_object(found[0], SessionRecord), decode_object(found[-1], EndRecord)
    return float(end.t_ns - begun.t_ns) / NS_PER_S


def test_an_acceleration_above_the_limit_is_saved_with_the_data_before_and_after(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path, acceleration_m_s2=50)
    bench.tick(150)
    bench.publish("bow", 49.9, 9.8, float("nan"))
    kept_s = []
    for _ in range(20):
        bench.tick(1)
        kept_s.append(bench.flight.status().kept_ns / NS_PER_S)
    assert 60 <= min(kept_s) < max(kept_s) <= 66  # a segment is at least 5 s long
    assert bench.files == []
    bench.publish("bow", 9.8, 51.5, 60.0)
    bench.tick(9)
    assert bench.files == []
    bench.tick(3)
    (file,) = bench.files
    assert file.name.endswith("-000000-snapshot.imudrec")
    begun = decode_object(records_in(file)[0], SessionRecord)
    assert file.name.startswith(f"{datetime.fromtimestamp(begun.utc_ns // NS_PER_S, UTC):%Y%m%dT%H%M%SZ}-")
    assert 69 <= span_s(file) <= 79  # 60 s before, 10 s after, and up to one segment of 5 s
    found = records_in(file)
    assert decode_object(found[-1], EndRecord).reason == "|a| of bow was 51.5 m/s²"
    kinds = [one.kind for one in found]
    assert kinds[:4] == [Kind.SESSION, Kind.CALL, Kind.DEVICE, Kind.DEVICE]
    assert (kinds[-3:], kinds.count(Kind.SESSION)) == ([Kind.CHECK, Kind.CHECK, Kind.END], 1)
    (status,) = [source() for source in bench.context.outputs.flights]
    assert 60 <= status.kept_ns / NS_PER_S <= 79
    assert status.kept_bytes >= file.stat().st_size // 2
    (event,) = bench.events
    assert (event.kind, event.device) == (EventKind.RECORDER, "bow")
    assert event.message == f"saved {file}: |a| of bow was 51.5 m/s²"
    assert event.detail == {"file": str(file), "bytes": file.stat().st_size}
    bench.flight.close()
    assert bench.source.listening == []
    assert not bench.context.outputs.snapshots
    assert not bench.context.outputs.flights
    bench.flight.event(Event(1, "bow", EventKind.DOWN, ""))
    bench.flight.tick(0)
    assert bench.flight._gate.pending is None


def test_a_missing_recorded_device_and_an_active_line_are_alerts(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path, devices=["bow"], after_s=0)
    for device, kind in (("mast", EventKind.DOWN), ("bow", EventKind.UP), ("bow", EventKind.LOSS)):
        bench.flight.event(Event(1, device, kind, ""))
    bench.publish("bow", 1e6)  # without a limit of acceleration
    bench.tick(2)
    assert bench.files == []
    bench.flight.event(Event(1, "bow", EventKind.RULE, "rule lean: tilt 11 °", {"active": True}))
    bench.tick(12)
    assert bench.files == []
    bench.flight.event(Event(1, "bow", EventKind.DOWN, "the adapter was pulled out"))
    bench.tick(2)
    (file,) = bench.files
    assert bench.messages == [f"saved {file}: bow is lost: the adapter was pulled out"]
    assert Kind.EVENT in [one.kind for one in records_in(file)]
    bench.flight.close()
    ignoring = FlightBench(tmp_path / "b", device_lost=False, after_s=0)
    ignoring.flight.event(Event(1, "bow", EventKind.DOWN, ""))
    ignoring.tick(2)
    assert ignoring.files == []
    ignoring.flight.close()
    bench = FlightBench(tmp_path / "c", line=InputOptions(line="GPIO5"), after_s=0)
    bench.flight.on_edges("", [Edge(1, False, 1)])
    bench.tick(2)
    assert bench.files == []
    bench.flight.on_edges("", [Edge(1, True, 2), Edge(2, False, 3)])
    bench.tick(2)
    (file,) = bench.files
    bench.flight.on_line_report("", "no line GPIO5")
    assert bench.messages == [
        f"saved {file}: the line of the flight recorder became active", "flight recorder: GPIO line: no line GPIO5"
    ]  # fmt: skip
    bench.flight.close()


def test_a_storm_of_alerts_does_not_fill_the_disk(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path, acceleration_m_s2=1, after_s=1, per_hour=3)
    for _ in range(100):
        bench.publish("bow", 9.8, 9.8)
        bench.tick(1)
    assert len(bench.files) == 3
    words = "no snapshot of an alert: |a| of bow was 9.8 m/s²; the limit of 3 per hour"
    assert sum(words in message for message in bench.messages) == 1
    with patch.object(bench.flight._feed, "note_losses", return_value=7):
        bench.flight.tick(bench.clock.now_ns())
    assert bench.messages[4:] == ["flight recorder: the host is too slow: 7 records were dropped"]
    status = bench.flight.status()
    assert (status.saved, status.failed, status.sent) == (3, 0, 0)
    assert status.disk_bytes == sum(file.stat().st_size for file in bench.files)
    assert status.left_out >= 90
    bench.flight.close()


def test_a_pending_alert_is_saved_when_imud_stops_and_the_memory_is_freed(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path, acceleration_m_s2=50, directory=str(tmp_path / "flight"))
    bench.tick(12)
    assert [path.stat().st_mode & 0o777 for path in (tmp_path / "flight").iterdir()][:2] == [0o640] * 2
    bench.publish("bow", 51.5)
    bench.flight.close()
    (file,) = bench.files
    assert bench.messages == [f"saved {file}: |a| of bow was 51.5 m/s²"]
    assert 11 <= span_s(file) <= 13
    assert list((tmp_path / "flight").iterdir()) == []
    bench.flight.close()


def test_data_of_a_killed_imud_is_saved_at_the_next_start(tmp_path: Path) -> None:
    killed = FlightBench(tmp_path, directory=str(tmp_path / "flight"))
    killed.tick(12)
    newest = max((tmp_path / "flight").iterdir())
    os.truncate(newest, newest.stat().st_size - 1)
    bench = FlightBench(tmp_path, directory=str(tmp_path / "flight"))
    (file,) = bench.files
    assert file.name.endswith("-000000-snapshot.imudrec")
    with file.open("rb") as opened:
        reader = RecordingReader(opened, "")
        found = list(reader)
    assert [problem[:30] for problem in reader.problems] == ["the file has no regular end: i"]
    assert sum(one.kind == Kind.DATA for one in found) >= 10
    assert bench.messages == [f"saved {file}: data of an imud process that was killed"]
    bench.flight.close()
    killed.flight.close()


def test_a_client_receives_the_present_data(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path)
    bench.tick(30)
    ours, theirs = stream_pair()
    assert 29 < bench.context.outputs.snapshots[0](ours) < 31
    bench.workers[0].work()
    with theirs, theirs.makefile("rb") as file:
        reader = RecordingReader(file, "")
        kinds = [one.kind for one in reader]
    assert (reader.problems, kinds[0], kinds[-1]) == ([], Kind.SESSION, Kind.END)
    assert kinds.count(Kind.DATA) >= 28
    pairs = [stream_pair() for _ in range(SENDS_MAX + 1)]
    for ours, _ in pairs[:-1]:
        bench.flight.snapshot(ours)
    with pytest.raises(ServerError, match="the limit of 4 clients with a snapshot"):
        bench.flight.snapshot(pairs[-1][0])
    bench.flight.close()
    for pair in pairs:
        for sock in pair:
            sock.close()


@needs_root
@pytest.mark.parametrize(
    "untrusted", ["owner", "owner with sticky bit", "0777", "0770", "link", "parent", "group", "file of another user"]
)
def test_a_directory_that_another_user_can_change(tmp_path: Path, untrusted: str) -> None:
    """imud rescues and removes no file there, keeps the data in memory, and uses the directory again later."""
    parent, folder = tmp_path / "parent", tmp_path / "parent" / "flight"
    killed = FlightBench(tmp_path, directory=str(folder))
    killed.tick(12)
    forged = folder / "20260101T000000Z-00000001-000000.imudrec"
    forged.touch()
    os.truncate(forged, 200_000_000)  # above the limit of the directory: imud would remove the other files
    left = sorted(folder.iterdir())
    match untrusted:
        case "link":
            folder.rename(tmp_path / "elsewhere")
            folder.symlink_to(tmp_path / "elsewhere")
            os.chown(folder, HOSTILE_UID, HOSTILE_UID, follow_symlinks=False)
        case "parent":
            os.chown(parent, HOSTILE_UID, HOSTILE_UID)
        case "group":
            parent.chmod(0o775)
            os.chown(parent, 0, HOSTILE_UID)
        case "file of another user":
            os.chown(forged, HOSTILE_UID, HOSTILE_UID)
            folder.chmod(0o1777)
        case "0777" | "0770":
            folder.chmod(int(untrusted, 8))
        case _:
            folder.chmod(0o1777 if "sticky" in untrusted else 0o755)
            os.chown(folder, HOSTILE_UID, HOSTILE_UID)
    bench = FlightBench(tmp_path, directory=str(folder))
    bench.tick(12)
    if untrusted == "file of another user":  # only the other files are segments
        assert forged.stat().st_size == 200_000_000
        (file,) = bench.files
        assert bench.messages == [f"saved {file}: data of an imud process that was killed"]
        bench.flight.close()
        killed.flight.close()
        return
    assert (sorted(folder.iterdir()), bench.files) == (left, [])
    assert bench.flight.status().kept_ns > 0
    (message,) = bench.messages
    assert message.startswith(f"flight recorder: {parent}")
    assert message.endswith("; it keeps the data in memory")
    for path in (folder, parent):
        os.chown(path, 0, 0, follow_symlinks=False)
    folder.chmod(0o750)
    bench.tick(12)
    assert bench.messages[1:] == [f"flight recorder: it uses {folder} again"]
    assert len(list(folder.iterdir())) > len(left)
    bench.flight.close()
    killed.flight.close()


def test_a_failed_segment_is_reported_once_and_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    bench = FlightBench(tmp_path, directory=str(folder))
    folder.rename(tmp_path / "elsewhere")
    bench.tick(12)
    assert bench.messages == ["flight recorder: cannot record: No such file or directory"]
    ours, theirs = stream_pair()
    with ours, theirs, pytest.raises(ServerError, match="the flight recorder has no data: No such file"):
        bench.flight.snapshot(ours)
    bench.flight.event(Event(1, "bow", EventKind.DOWN, "pulled out"))
    bench.tick(11)
    event = bench.events.pop()
    assert re.fullmatch(
        rf"cannot save the snapshot {bench.folder}/\S+-000000-snapshot\.imudrec: nothing was kept; "
        "alert: bow is lost: pulled out", event.message,
    )  # fmt: skip
    assert (event.device, bench.flight.status().saved, bench.flight.status().failed) == ("bow", 0, 1)
    folder.mkdir()
    bench.tick(RETRY_NS / NS_PER_S)
    assert bench.messages[1:] == ["flight recorder: recording again after: No such file or directory"]
    bench.tick(5)
    assert len(list(folder.iterdir())) >= 1
    bench.flight.close()


def test_invalid_options_are_rejected_and_an_error_of_the_thread_ends_the_daemon(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(ServerError, match="flight recorder"):
        FlightBench(tmp_path, directory=str(tmp_path / "a" / "b"))
    assert records.VERSION == 1
    bench = FlightBench(tmp_path)
    bench.workers[0].failed(ZeroDivisionError("a mistake"))
    with pytest.raises(ZeroDivisionError):
        bench.flight.tick(0)
    bench.flight.close()


HOUR_NS, AFTER_NS = 3600 * NS_PER_S, 30 * NS_PER_S


def alert(t_ns: int, reason: str = "a blow") -> recorder_flight.Alert:
    return recorder_flight.Alert(t_ns, "bow", reason)


def test_alerts_are_due_once_and_limited_per_hour() -> None:
    gate = recorder_flight.AlertGate(AFTER_NS, 6)
    assert gate.take_due(0) is None
    assert gate.add(alert(5))
    assert gate.add(alert(6, "another"))
    assert gate.take_due(5 + AFTER_NS - 1) is None
    assert gate.take_due(5 + AFTER_NS) == alert(5)
    assert gate.take_due(5 + AFTER_NS) is None
    assert gate.left_out == 0
    gate.add(alert(7))
    assert gate.take_due(8, at_once=True) == alert(7)  # at the end of imud
    gate = recorder_flight.AlertGate(0, 2)
    for t_ns in (0, 10):
        assert gate.add(alert(t_ns))
        assert gate.take_due(t_ns) is not None
    assert [gate.add(alert(t_ns)) for t_ns in (20, 21, HOUR_NS - 1)] == [False, True, True]
    assert gate.take_due(HOUR_NS) is None
    assert gate.left_out == 3
    assert gate.add(alert(HOUR_NS))
    assert gate.take_due(HOUR_NS) == alert(HOUR_NS)
    assert gate.add(alert(HOUR_NS + 9)) is False


SEGMENTS_MAX = 64
END = records.encode_object(Kind.END, NO_DEVICE, EndRecord(9, 9, "a blow"))


def session(number: int) -> bytes:
    return records.encode_object(Kind.SESSION, NO_DEVICE, SessionRecord(1, "", "", "", 7, number, number, number))


class RingBench:
    """Ring with one data block per segment, in addition to the session record."""

    def __init__(self, bytes_max: int = 1 << 20, folder: Path | None = None) -> None:
        self.ring = recorder_flight.SegmentRing(bytes_max)
        self.folder = folder
        self.count = 0

    def add(self, size: int = 50, drop_before_ns: int = -1) -> None:
        path = self.folder / f"{self.count:03d}" if self.folder is not None else None
        self.ring.begin(recorder_flight.SegmentBegin(self.count, session(self.count), path, drop_before_ns))
        encoder = BlockEncoder()
        self.ring.append(encoder.encode(session(self.count)))
        self.ring.append(encoder.encode(records.encode_data(self.count, os.urandom(size), 1, -1)))
        self.count += 1


def read(reader: recorder_flight.SegmentReader) -> list[records.Record]:
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
    assert (records.decode_object(found[0], SessionRecord).number, devices(found)) == (0, [0, 1, 2])
    bench.ring.clear()
    assert (bench.ring.bytes, bench.ring.oldest_ns) == (0, 0)
    bench = RingBench()
    for _ in range(5):
        bench.add()
    bench.add(drop_before_ns=3)  # segment 2 ends at 3, when segment 3 starts
    assert (devices(read(bench.ring.reader(END))), bench.ring.oldest_ns) == ([3, 4, 5], 3)
    bench.ring.clear()


def test_the_oldest_segments_are_dropped_but_never_the_newest() -> None:
    bench = RingBench(bytes_max=10_000)
    for _ in range(10):
        bench.add(2_000)
        assert bench.ring.bytes <= 10_000
    assert devices(read(bench.ring.reader(END))) == [6, 7, 8, 9]
    bench.add(20_000)
    assert devices(read(bench.ring.reader(END))) == [10]
    bench.ring.clear()
    small = RingBench()
    for _ in range(SEGMENTS_MAX + 2):
        small.add(10)
    assert devices(read(small.ring.reader(END))) == list(range(2, SEGMENTS_MAX + 2))
    small.ring.clear()
    ring = recorder_flight.SegmentRing(200)
    for t_ns, size, kept in ((1, 100, 100), (2, 100, 200), (3, 1, 101)):
        ring.begin(recorder_flight.SegmentBegin(t_ns, b"", None, -1))
        ring.append(bytes(size))
        assert ring.bytes == kept
    ring.clear()


def test_a_failed_reader_closes_its_descriptors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = RingBench(folder=tmp_path)
    for _ in range(2):
        bench.add()
    with pytest.raises(FileNotFoundError):
        recorder_flight.left_behind([*tmp_path.iterdir(), tmp_path / "none"])
    made, dup = list[int](), os.dup

    def dup_once(descriptor: int) -> int:
        if made:
            raise OSError(errno.EMFILE, "Too many open files")
        made.append(dup(descriptor))
        return made[-1]

    monkeypatch.setattr(os, "dup", dup_once)
    with pytest.raises(OSError, match="Too many open files"):
        bench.ring.reader(END)
    bench.ring.clear()


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
    bench.ring.clear()


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
    bench.ring.clear()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "killed").mkdir()
    bench = RingBench(folder=tmp_path / "killed")
    for _ in range(3):
        bench.add()
    files = sorted((tmp_path / "killed").iterdir())
    with files[2].open("r+b") as opened:
        opened.truncate(files[2].stat().st_size - 1)
    found = read(recorder_flight.left_behind(files))
    assert [one.kind for one in found] == [Kind.SESSION, Kind.DATA, Kind.DATA]
    files[1].write_bytes(b"something else" * 10)
    assert devices(read(recorder_flight.left_behind(files))) == [0]
    bench.ring.clear()


def test_a_full_file_system_drops_segments_and_then_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    bench.ring.clear()
    monkeypatch.undo()
    bench = RingBench()
    for number, oldest_ns in ((errno.EIO, 0), (errno.ENOMEM, 3), (errno.EDQUOT, 5)):
        bench.add()
        bench.add()
        with patch.object(os, "write", side_effect=OSError(number, "")), pytest.raises(OSError, match="Errno"):
            bench.ring.append(b"x")
        assert bench.ring.oldest_ns == oldest_ns, "only a file system without room drops segments"
    bench.ring.clear()


LINGER_NS = 10_000_000_000
SESSION = records.encode_object(Kind.SESSION, NO_DEVICE, SessionRecord(1, "", "", "", 7, 0, 1, 1))


class FlightWriterBench(RecordingBench):
    def __init__(self, folder: Path, keep_bytes: int = 1 << 30) -> None:
        super().__init__()
        self.folder = folder / "recordings"
        self.queue = RecordQueue[recorder_flight.Mark]()
        self.ring = recorder_flight.SegmentRing(1 << 30)
        directory = RecordingDirectory(self.folder, keep_bytes)
        self.writer = recorder_flight.FlightWriter(
            self.queue, self.ring, directory, self.clock.now_ns, self.workers.start
        )

    def begin(self, path: Path | None = None) -> None:
        self.queue.mark(recorder_flight.SegmentBegin(self.advance(1), SESSION, path, 0))

    def put(self, number: int, size: int = 50) -> None:
        self.queue.put(records.encode_data(number, os.urandom(size), 1, -1))

    def work(self) -> int:
        return self.workers[0].work()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[FlightWriterBench]:
    made = FlightWriterBench(tmp_path)
    yield made
    made.writer.close()


def test_a_snapshot_contains_the_earlier_records(bench: FlightWriterBench, monkeypatch: pytest.MonkeyPatch) -> None:
    path, synced = bench.folder / "a", list[int]()
    monkeypatch.setattr(os, "fdatasync", synced.append)
    bench.begin()
    bench.put(0)
    bench.begin()
    bench.put(1)
    bench.queue.mark(recorder_flight.Save(path, END))
    bench.put(2)
    bench.work()
    (saved,) = bench.writer.saved
    assert (saved.path, saved.bytes, saved.problem) == (path, path.stat().st_size, "")
    assert len(synced) == 1  # the file is on the disk before the report
    assert [(one.kind, one.device) for one in records_in(path)] == [
        (Kind.SESSION, NO_DEVICE), (Kind.DATA, 0), (Kind.DATA, 1), (Kind.END, NO_DEVICE)
    ]  # fmt: skip
    bench.queue.mark(recorder_flight.Save(bench.folder / "b", END))
    bench.work()
    assert [one.device for one in records_in(bench.folder / "b") if one.kind == Kind.DATA] == [0, 1, 2]


def test_a_slow_client_does_not_delay_other_clients(bench: FlightWriterBench, tmp_path: Path) -> None:
    ours, theirs = stream_pair()
    bench.begin()
    for number in range(40):
        bench.put(number, 200_000)
    bench.queue.mark(recorder_flight.Send(ours, END))
    assert bench.work() < LINGER_NS
    assert bench.writer.sends_ended == 0
    bench.queue.mark(recorder_flight.Save(bench.folder / "a", END))
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
    bench.queue.mark(recorder_flight.Send(gone[0], END))
    bench.queue.mark(recorder_flight.Send(silent[0], END))
    bench.work()
    assert bench.writer.sends_ended == 1
    bench.advance(LINGER_NS / 1e9)
    bench.work()
    assert bench.writer.sends_ended == 2
    silent[1].close()


def test_a_client_always_reads_end_of_file(bench: FlightWriterBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.begin()
    for number in range(40):
        bench.put(number, 200_000)
    stopped, refused = stream_pair(), stream_pair()
    for _, theirs in (stopped, refused):
        theirs.setblocking(False)
    bench.queue.mark(recorder_flight.Send(stopped[0], END))
    bench.work()
    monkeypatch.setattr(bench.ring, "reader", lambda _ending: os.open("/none", os.O_RDONLY))
    bench.queue.mark(recorder_flight.Send(refused[0], END))
    bench.work()
    assert (refused[1].recv(1), bench.writer.sends_ended) == (b"", 1)
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
    bench.queue.mark(recorder_flight.Save(bench.folder / "a", END))
    bench.work()
    assert [saved.problem for saved in bench.writer.saved] == ["No space left on device"]
    assert (list(bench.folder.glob("*.imudrec")), bench.writer.problem) == ([], "")
    monkeypatch.undo()
    bench.queue.mark(recorder_flight.Save(bench.folder / "b", END))
    bench.work()
    assert bench.writer.saved[1].problem == ""


def test_after_a_failed_segment_nothing_is_saved_until_the_next(
    bench: FlightWriterBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.begin(tmp_path / "no" / "folder")
    bench.put(0)
    bench.queue.mark(recorder_flight.Save(bench.folder / "a", END))
    bench.work()
    assert bench.writer.problem == "No such file or directory"
    assert [saved.problem for saved in bench.writer.saved] == ["nothing was kept"]
    assert list(bench.folder.glob("*.imudrec")) == []
    bench.begin()
    bench.put(1)
    bench.queue.mark(recorder_flight.Save(bench.folder / "b", END))
    bench.work()
    assert (bench.writer.problem, kinds_in(bench.folder / "b")) == ("", [Kind.SESSION, Kind.DATA, Kind.END])
    monkeypatch.setattr(os, "write", Mock(side_effect=OSError(errno.EIO, "Input/output error")))
    bench.put(2)
    bench.work()
    assert bench.writer.problem == "Input/output error"


def test_snapshots_stay_below_the_limit(tmp_path: Path) -> None:
    bench = FlightWriterBench(tmp_path, keep_bytes=100_000)
    for number in range(5):
        bench.begin()
        bench.put(number, 30_000)
        path = bench.folder / f"20251121T09314{number}Z-000000ab-00000{number}-snapshot.imudrec"
        bench.ring.clear()
        bench.queue.mark(recorder_flight.Save(path, END))
        bench.work()
        assert sum(file.stat().st_size for file in bench.folder.glob("*.imudrec")) <= 100_000
    assert len(list(bench.folder.glob("*.imudrec"))) == 3 - 1 + 1
    bench.writer.close()


def test_data_of_a_killed_process(bench: FlightWriterBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [tmp_path / "000", tmp_path / "001"]
    for number, file in enumerate(files):
        bench.begin(file)
        bench.put(number)
    bench.work()
    bench.folder.mkdir()
    (bench.folder / "a").write_bytes(b"taken")
    bench.queue.mark(recorder_flight.Rescue(bench.folder / "a", files))
    bench.work()
    assert bench.writer.saved[0].problem == "File exists"
    assert all(file.exists() for file in files)
    bench.queue.mark(recorder_flight.Rescue(bench.folder / "b", files))
    bench.work()
    assert bench.writer.saved[1].problem == ""
    assert not any(file.exists() for file in files)
    assert (bench.folder / "b").stat().st_size > 100


def test_a_rule_with_a_snapshot_is_an_alert(tmp_path: Path) -> None:
    bench = FlightBench(tmp_path)
    bench.flight.event(Event(1, "bow", EventKind.RULE, "rule lean: tilt 11 °", {"active": True, "snapshot": True}))
    bench.tick(12)
    (file,) = bench.files
    assert decode_object(records_in(file)[-1], EndRecord).reason == "rule lean: tilt 11 °"
    bench.flight.close()
