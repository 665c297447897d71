"""Output `recorder`: only the enabled recorders run.
Continuous recorder: consecutive files, reported losses and full disks, new and removed devices."""

import os
import shutil
from pathlib import Path
from unittest.mock import Mock, patch

import pytest

from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind, LostRecord
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.recorder import publisher as module
from imud.publishers.recorder.directory import FlightOptions, RecorderOptions, RecordingDirectory
from imud.publishers.recorder.publisher import PUBLISHER, Recorder
from imud.publishers.recorder.writer import RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench, records_in
from tests.support.socket_rig import batch


def test_both_write_to_one_directory_and_one_alone_does_not_start_the_other(tmp_path: Path) -> None:
    bench = RecordingBench()
    flight = FlightOptions(enabled=True, acceleration_m_s2=1, after_s=0)
    for enabled in (True, False):
        settings = RecorderOptions(enabled=enabled, directory=str(tmp_path / str(enabled)), flight=flight)
        made = PUBLISHER.make(settings, bench.context)
        made.start()
        outputs = bench.context.outputs
        assert (len(outputs.recorders), len(outputs.flights)) == (enabled, 1)
        made.add_device("bow", 7)
        made.tick(bench.advance(0.1))
        assert made.event is not None
        made.event(Event(1, "bow", EventKind.UP, "up"))
        made.remove_device("bow")
        made.tick(bench.advance(0.1))  # the device exists again, with another description
        assert made.publish is not None
        made.publish(batch("bow"))
        made.close()
        made.close()
        made.tick(bench.advance(0.1))
    files = [(tmp_path / str(one)).glob("*.imudrec") for one in (True, False)]
    ends = [sorted(file.name.split("-", 2)[2] for file in each) for each in files]
    for file in tmp_path.rglob("*.imudrec"):
        kinds = [(record.kind, record.device) for record in records_in(file)]
        assert ([device for kind, device in kinds if kind == Kind.EVENT], kinds.count((Kind.DEVICE, 0))) == ([7], 2)
    assert ends == [["000000-snapshot.imudrec", "000000.imudrec"], ["000000-snapshot.imudrec"]]


def test_a_failed_start_leaves_no_recorder_running(tmp_path: Path) -> None:
    bench = RecordingBench()
    (tmp_path / "file").write_bytes(b"")
    flight = FlightOptions(enabled=True, directory=str(tmp_path / "file" / "no"))
    made = PUBLISHER.make(RecorderOptions(enabled=True, directory=str(tmp_path / "a"), flight=flight), bench.context)
    with pytest.raises(ServerError, match=r"file/no: Not a directory; .*; set .* or recorder\.flight\.directory"):
        made.start()
    assert (bench.context.outputs.recorders, bench.context.outputs.snapshots) == ([], [])
    assert not PUBLISHER.wanted(RecorderOptions())
    assert PUBLISHER.wanted(RecorderOptions(enabled=True))
    assert PUBLISHER.wanted(RecorderOptions(flight=FlightOptions(enabled=True)))


RETRY_NS, CHECK_NS = 60 * NS_PER_S, NS_PER_S


class RecorderBench(RecordingBench):
    def __init__(self, folder: Path, **settings: object) -> None:
        super().__init__()
        self.folder = folder / "recordings"
        made = RecorderOptions(directory=str(self.folder), **settings)  # type: ignore[arg-type]  # options by name
        directory = RecordingDirectory(self.folder, made.keep_bytes)
        self.recorder = Recorder(made, self.context, directory, self.workers.start)
        self.recorder.start()

    def tick(self, seconds: float = 0.1, *, work: bool = True) -> None:
        self.recorder.tick(self.advance(seconds))
        if work:
            self.workers[-1].work()

    def kinds(self, number: int = 0) -> list[int]:
        return [record.kind for record in self.read(number)]

    def read(self, number: int = 0) -> list[records.Record]:
        path = sorted(self.folder.glob("*.imudrec"))[number]
        with path.open("rb") as file:
            return list(RecordingReader(file, path.name))


def test_a_file_starts_with_session_host_and_devices_and_has_an_end_record(tmp_path: Path) -> None:
    bench = RecorderBench(tmp_path)
    bench.tick()
    bench.source.deliver()
    bench.recorder.close()
    checks = [Kind.CHECK, Kind.CHECK]
    assert bench.kinds() == [
        Kind.SESSION, Kind.CALL, Kind.DEVICE, Kind.DEVICE, *checks, Kind.DATA, *checks, Kind.END
    ]  # fmt: skip
    assert (bench.source.listening, bench.context.outputs.recorders) == ([], [])


def test_only_the_selected_devices_are_recorded_including_new_devices(tmp_path: Path) -> None:
    bench = RecorderBench(tmp_path, devices=["mast", "keel"])
    bench.tick()
    bench.source.present.append("keel")
    bench.tick()
    bench.recorder.remove_device("mast")  # the device restarted
    bench.tick()
    bench.recorder.close()
    assert [one.device for one in bench.read() if one.kind == Kind.DEVICE] == [1, 2, 1]


def test_a_new_file_starts_by_size_or_time_with_all_states(tmp_path: Path) -> None:
    bench = RecorderBench(tmp_path, file_mb=1, file_minutes=2)
    bench.tick()
    bench.source.deliver(1_100_000)
    bench.tick(1.1)
    bench.tick(1.1)
    bench.tick(121)
    with patch.object(RecordingDirectory, "make_room", side_effect=OSError(5, "Input/output error")):
        bench.tick(121)
    assert bench.events[0].message == f"cannot record to {bench.folder}: Input/output error; the other outputs continue"
    bench.recorder.close()
    assert len(list(bench.folder.glob("*.imudrec"))) == 4
    for number in range(3):
        found = bench.kinds(number)
        assert ([found[0], found[-1]], found.count(Kind.DEVICE)) == ([Kind.SESSION, Kind.END], 2)
    sessions = [records.decode_object(bench.read(n)[0], records.SessionRecord) for n in range(3)]
    assert [one.number for one in sessions] == [0, 1, 2]


def test_clock_readings_are_within_a_file(tmp_path: Path) -> None:
    bench = RecorderBench(tmp_path, file_minutes=1)
    bench.tick()

    def record_reading() -> None:
        for put in bench.source.listening:
            put(records.encode_clocks(records.ClocksRecord(1, 1, 1, 1, 1, 0)))

    bench.on_clocks_read = record_reading
    bench.tick(59.9)
    bench.recorder.close()
    assert len(list(bench.folder.glob("*.imudrec"))) == 2
    for number in range(2):
        found = bench.kinds(number)
        assert Kind.CLOCKS in found
        assert [found[0], found[-1]] == [Kind.SESSION, Kind.END]


def test_a_file_contains_the_losses_and_then_the_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RecordQueue", {Path: lambda: RecordQueue[Path](2000)})
    bench = RecorderBench(tmp_path)
    bench.tick()
    for _ in range(100):
        bench.source.deliver()
    bench.tick(work=False)
    assert bench.recorder.status().records_dropped > 50
    bench.tick()
    assert bench.events == []
    bench.tick()
    bench.recorder.close()
    found = bench.read()
    at = [one.kind for one in found].index(Kind.LOST)
    lost = records.decode_lost(found[at].body)
    assert isinstance(lost, LostRecord)
    assert lost.records == bench.recorder.status().records_dropped
    assert [one.kind for one in found[at + 1 : at + 4]] == [Kind.CALL, Kind.DEVICE, Kind.DEVICE]
    (event,) = bench.events
    assert event.kind is EventKind.RECORDER
    assert f"{lost.records} records were dropped" in event.message


def test_a_full_disk_causes_one_event_and_recording_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with patch("imud.publishers.recorder.directory.replace_file", side_effect=OSError):
        bench = RecorderBench(tmp_path)
    bench.tick()
    assert (bench.folder / ".runs").exists()  # imud notes its run before the next file
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:10]))
    bench.source.deliver()
    for _ in range(3):
        bench.tick()
    (event,) = bench.events
    assert "No space left on device; the other outputs continue" in event.message
    assert bench.source.listening == []
    assert bench.recorder.status().problem
    monkeypatch.undo()
    shutil.rmtree(bench.folder)  # imud makes the directory again
    for blocks, events in ((499_999, 1), (500_000, 2)):
        with patch.object(os, "statvfs", return_value=Mock(f_bavail=blocks, f_frsize=2)):
            bench.tick(RETRY_NS / NS_PER_S)
        assert len(bench.events) == events
    bench.tick()
    assert "recording again" in bench.events[1].message
    bench.source.deliver()
    bench.tick(CHECK_NS / NS_PER_S)
    bench.recorder.close()
    assert Kind.DATA in bench.kinds()


def test_old_files_are_removed_for_new_files(tmp_path: Path) -> None:
    bench = RecorderBench(tmp_path, file_mb=1, keep_gb=0.002)
    bench.tick()
    for _ in range(5):
        bench.source.deliver(1_000_000)
        bench.tick(1.1)
        bench.tick(1.1)
    there = sum(path.stat().st_size for path in bench.folder.glob("*.imudrec"))
    # imud writes the end of a file after it starts the next
    assert abs(bench.recorder.status().disk_bytes - there) <= 1000
    bench.recorder.close()
    assert sum(path.stat().st_size for path in bench.folder.glob("*.imudrec")) <= 2_100_000
    assert bench.recorder.status().files_removed >= 3


def test_invalid_options_are_rejected_and_an_error_of_the_thread_ends_the_daemon(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_bytes(b"")
    with pytest.raises(ServerError, match=r"write; set recorder\.directory$"):
        RecorderBench(tmp_path)
    bench = RecorderBench(tmp_path / "valid")
    bench.workers[0].failed(ZeroDivisionError("a mistake"))
    with pytest.raises(ZeroDivisionError):
        bench.tick(work=False)
