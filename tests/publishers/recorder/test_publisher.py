"""Output `recorder`: only the enabled recorders run."""

from pathlib import Path

import pytest

from imud.formats.records import Kind
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.publishers.recorder.directory import FlightOptions, RecorderOptions
from imud.publishers.recorder.publisher import PUBLISHER
from tests.publishers.recorder.recording_bench import RecordingBench, kinds_in
from tests.support.socket_rig import batch


def test_files_are_written(tmp_path: Path) -> None:
    bench = RecordingBench()
    made = PUBLISHER.make(RecorderOptions(enabled=True, directory=str(tmp_path / "a")), bench.context)
    made.start()
    made.add_device("bow", 0)
    made.tick(bench.advance(0.1))
    made.event(Event(1, "bow", EventKind.UP, "up"))
    made.close()
    (file,) = (tmp_path / "a").glob("*.imudrec")
    assert {Kind.SESSION, Kind.DEVICE, Kind.EVENT, Kind.END} <= set(kinds_in(file))


def test_both_write_to_one_directory_and_one_alone_does_not_start_the_other(tmp_path: Path) -> None:
    bench = RecordingBench()
    flight = FlightOptions(enabled=True, acceleration_m_s2=1, after_s=0)
    for enabled in (True, False):
        settings = RecorderOptions(enabled=enabled, directory=str(tmp_path / str(enabled)), flight=flight)
        made = PUBLISHER.make(settings, bench.context)
        made.start()
        outputs = bench.context.outputs
        assert (len(outputs.recorders), len(outputs.flights)) == (enabled, 1)
        made.add_device("imu0", 0)
        made.tick(bench.advance(0.1))
        assert made.publish is not None
        made.publish(batch("imu0"))
        made.remove_device("imu0")
        made.close()
        made.close()
    ends = [
        sorted(file.name.split("-", 2)[2] for file in (tmp_path / str(one)).glob("*.imudrec")) for one in (True, False)
    ]
    assert ends == [["000000-snapshot.imudrec", "000000.imudrec"], ["000000-snapshot.imudrec"]]


def test_the_output_is_enabled_for_either_recorder() -> None:
    assert not PUBLISHER.wanted(RecorderOptions())
    assert PUBLISHER.wanted(RecorderOptions(enabled=True))
    assert PUBLISHER.wanted(RecorderOptions(flight=FlightOptions(enabled=True)))


def test_a_failed_start_leaves_no_recorder_running(tmp_path: Path) -> None:
    bench = RecordingBench()
    (tmp_path / "file").write_bytes(b"")
    flight = FlightOptions(enabled=True, directory=str(tmp_path / "file" / "no"))
    made = PUBLISHER.make(RecorderOptions(enabled=True, directory=str(tmp_path / "a"), flight=flight), bench.context)
    with pytest.raises(ServerError):
        made.start()
    assert (bench.context.outputs.recorders, bench.context.outputs.snapshots) == ([], [])
