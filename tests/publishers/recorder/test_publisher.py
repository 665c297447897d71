"""The output `recorder`: what its settings ask for runs, and nothing else."""

from pathlib import Path

from imud.event import Event, EventKind
from imud.formats.recording.records import Kind
from imud.publishers.recorder.publisher import PUBLISHER
from imud.publishers.recorder.settings import RecorderSettings
from tests.publishers.recorder.recording_bench import RecordingBench, kinds_in


def test_files_are_written(tmp_path: Path) -> None:
    bench = RecordingBench()
    made = PUBLISHER.make(RecorderSettings(enabled=True, directory=str(tmp_path / "a")), bench.context)
    made.start()
    made.add_device("bow", 0)
    made.tick(bench.advance(0.1))
    made.event(Event(1, "bow", EventKind.UP, "up"))
    made.close()
    (file,) = (tmp_path / "a").iterdir()
    assert {Kind.SESSION, Kind.DEVICE, Kind.EVENT, Kind.END} <= set(kinds_in(file))
