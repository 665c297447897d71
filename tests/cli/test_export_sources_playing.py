"""Playing of a recording for an export: the result does not depend on the division into batches."""

from pathlib import Path

import pytest

from imud.attitude.conventions import Convention
from imud.bridges.channel import LossCounts, RecordedDiagnosis, StampedEvent
from imud.cli import export_sources as playing
from imud.contracts.publisher import Batch
from imud.model.errors import ImudError
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from tests.cli.recorded_daemon import FRAMES, run_recorded
from tests.support.socket_rig import batch, sample


class KeepingSink:
    def __init__(self) -> None:
        self.taken: list[Sample | LossCounts | StampedEvent] = []
        self.sizes: list[int] = []

    def samples(self, batch: Batch) -> None:
        self.taken += batch.converted(Convention.ENU_FLU).samples
        self.sizes.append(len(batch.samples))

    def losses(self, losses: LossCounts) -> None:
        self.taken.append(losses)

    def session(self, epoch: int) -> None: ...

    def event(self, event: StampedEvent) -> None:
        self.taken.append(event)

    def finish(self) -> None: ...
    def close(self) -> None: ...


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    _, _, (recording,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    return recording


@pytest.mark.parametrize("devices", [[], ["bow"]])
def test_batches_contain_all_samples_in_order(file: Path, monkeypatch: pytest.MonkeyPatch, devices: list[str]) -> None:
    results = []
    for size in (1, 64):
        monkeypatch.setattr(playing, "SAMPLES", size)
        sink = KeepingSink()
        with file.open("rb") as stream:
            played = playing.play_recording(stream, str(file), sink, devices)
        assert played[2] == ["bow", "mast"]
        results.append((played, sink.taken))
        assert max(sink.sizes) < 2000
    assert results[0] == results[1]
    assert len(results[0][1]) > FRAMES


def test_batches_are_joined_up_to_a_limit() -> None:
    sink = KeepingSink()
    batches = playing.BatchingSink(sink)
    for number in range(playing.SAMPLES + 5):
        batches.samples(batch(first=number + 1, count=1))
    assert sink.sizes == [playing.SAMPLES]
    batches.finish()
    assert sink.sizes == [playing.SAMPLES, 5]


def test_damaged_recording_is_an_error(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    damaged.write_bytes(b"\x89imudREC" + bytes(100))
    with damaged.open("rb") as stream, pytest.raises(ImudError, match="at least one complete block"):
        playing.play_recording(stream, str(damaged), KeepingSink(), [])


@pytest.mark.parametrize("size", [1, 7, 64, 500])
def test_diagnoses_do_not_depend_on_batches(size: int) -> None:
    """`/diagnostics` had a message each 1.28 s for batches of 64 samples at 50 Hz."""
    period_ns = NS_PER_S // 50
    samples = [sample("bow", seq, period_ns) for seq in range(500)]
    diagnosis = RecordedDiagnosis()
    times_ns: list[int] = []
    for start in range(0, len(samples), size):
        times_ns += [one.utc_ns for one in diagnosis.samples("bow", samples[start : start + size])]
    assert [time_ns - times_ns[0] for time_ns in times_ns] == [second * NS_PER_S for second in range(10)]
