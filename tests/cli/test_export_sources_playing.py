"""A recording played in a second process gives the same result as in this process."""

import subprocess
import sys
from fcntl import F_GETPIPE_SZ, fcntl
from io import BytesIO, StringIO
from pathlib import Path
from unittest import mock
from unittest.mock import Mock

import pytest

from imud.attitude.conventions import Convention
from imud.bridges.channel import LossCounts, StampedEvent
from imud.cli import export_sources as playing
from imud.contracts.publisher import Batch
from imud.model.errors import ImudError
from imud.model.sample import Sample
from tests.cli.conftest import Cli, Terminal
from tests.cli.recorded_daemon import FRAMES, run_recorded
from tests.support.socket_rig import batch


class KeepingSink:
    def __init__(self) -> None:
        self.taken: list[Sample | LossCounts | StampedEvent] = []
        self.largest = 0

    def samples(self, batch: Batch) -> None:
        self.taken += batch.converted(Convention.ENU_FLU).samples
        self.largest = max(self.largest, len(batch.samples))

    def losses(self, losses: LossCounts) -> None:
        self.taken.append(losses)

    def session(self, epoch: int) -> None: ...

    def event(self, event: StampedEvent) -> None:
        self.taken.append(event)

    def finish(self) -> None: ...
    def close(self) -> None: ...


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    _, _, (made,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    return made


def test_both_ways_give_the_same_in_the_same_order(file: Path) -> None:
    for devices in [[], ["bow"]]:
        here, beside, positions = KeepingSink(), KeepingSink(), list[int]()
        with file.open("rb") as stream:
            first = playing.play_here(stream, str(file), here, devices)
        second = playing.play_beside(file, beside, devices, positions.append)
        assert (second, first[2], beside.taken) == (first, ["bow", "mast"], here.taken)
        assert len(here.taken) > FRAMES
        assert 1 < beside.largest < 2000
        assert positions == sorted(positions)
        assert 0 < positions[-1] <= file.stat().st_size


def test_a_full_message_is_written_at_once() -> None:
    pipe = BytesIO()
    sink = playing.PipeSink(pipe, lambda: 0)
    sink.samples(batch(count=playing.SAMPLES - 1))
    head_only = pipe.tell()
    sink.samples(batch(first=playing.SAMPLES))
    assert pipe.tell() > head_only
    written = pipe.tell()
    sink.finish()
    assert pipe.tell() == written


def test_the_pipe_is_as_large_as_the_kernel_allows(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    def kept(pipe: int, command: int, size: int) -> None:
        fcntl(pipe, command, size)
        sizes.append(fcntl(pipe, F_GETPIPE_SZ))

    monkeypatch.setattr(playing, "fcntl", kept)
    playing.play_beside(file, KeepingSink(), [], lambda _at: None)
    assert sizes == [1 << 20]
    monkeypatch.setattr(playing, "fcntl", Mock(side_effect=PermissionError(1, "Operation not permitted")))
    sink = KeepingSink()
    playing.play_beside(file, sink, [], lambda _at: None)
    assert len(sink.taken) > FRAMES


def test_errors_of_the_player_and_of_the_sink_come_out(tmp_path: Path, file: Path) -> None:
    (tmp_path / "a").write_bytes(b"\x89imudREC" + bytes(100))
    with pytest.raises(ImudError, match="at least one complete block"):
        playing.play_beside(tmp_path / "a", KeepingSink(), [], lambda _at: None)
    full = KeepingSink()
    with mock.patch.object(full, "samples", side_effect=ImudError("full")), pytest.raises(ImudError, match="full"):
        playing.play_beside(file, full, [], lambda _at: None)


def test_a_player_that_ends_early_is_an_error(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = playing.HEAD.pack(playing.EVENT, 4, 0)  # header of a message with four bytes of data
    player = tmp_path / "player"
    player.write_text(f"#!/bin/sh\ncat {tmp_path}/sent\n")
    player.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(player))
    for sent in (b"", whole[:-1], whole, whole + b"abc"):
        (tmp_path / "sent").write_bytes(sent)
        with pytest.raises(ImudError, match="player process ended early"):
            playing.play_beside(file, KeepingSink(), [], lambda _at: None)


def test_the_player_uses_the_tree_of_this_process(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "imud.py").write_text("raise SystemExit('another tree')")
    monkeypatch.chdir(tmp_path)
    playing.play_beside(file, KeepingSink(), [], lambda _at: None)  # not of the current directory
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(ImudError, match="player process ended early"):
        playing.play_beside(file, KeepingSink(), [], lambda _at: None)


def test_the_player_ends_quietly_when_nobody_reads(file: Path) -> None:
    argv = [sys.executable, "-m", "imud.cli.export_sources", str(file)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_the_command_writes_the_same(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    here, beside, to = tmp_path / "here", tmp_path / "beside", ("export", "--to", "csv")
    cli(*to, "-o", here, file)
    monkeypatch.setattr("imud.cli.export_sources.BESIDE_BYTES", 0)
    cli(*to, "-o", beside, file)
    assert here.read_bytes() == beside.read_bytes()
    assert here.stat().st_mode & 0o7111 == 0, "no program"
    cli.refuses("expected a device of the recording: bow, mast", *to, "--device", "stern", str(file))


def pictures(terminal: Terminal) -> list[str]:
    return [one for one in terminal.getvalue().split(playing.CLEAR) if one]


def test_a_bar_with_share_samples_and_time_and_how_often_it_is_drawn() -> None:
    terminal, now_s = Terminal(), [100.0]
    progress = playing.Progress(1000, terminal, lambda: now_s[0])
    now_s[0] = 110.0
    progress.add(playing.LOOK_SAMPLES, lambda: 250)
    progress.close()
    progress.close()
    assert pictures(terminal) == [f"[######..................]  25 %  {playing.LOOK_SAMPLES} samples, 30 s left"]
    assert terminal.getvalue().endswith(playing.CLEAR)
    assert progress.spent_s == 10.0
    terminal, now_s = Terminal(), [100.0]
    progress = playing.Progress(1000, terminal, lambda: now_s[0])
    for samples, second, expected in [(1999, 100.0, 0), (1, 100.0, 1), (2000, 100.19, 1), (2000, 100.2, 2)]:
        now_s[0] = second
        progress.add(samples, lambda: 20)
        assert len(pictures(terminal)) == expected
    assert pictures(terminal)[-1] == "[........................]   2 %  6000 samples"  # no estimate up to 2 %
    terminal, now_s = Terminal(), [0.0]
    progress = playing.Progress(1000, terminal, lambda: now_s[0])
    for step in range(100):
        now_s[0] = step * playing.EVERY_S / 10
        progress.add(playing.LOOK_SAMPLES, lambda: 0)
    assert 9 <= len(pictures(terminal)) <= 11
    assert progress.samples == 100 * playing.LOOK_SAMPLES
    out = StringIO()
    progress = playing.Progress(1000, out, lambda: 0.0)
    progress.add(10 * playing.LOOK_SAMPLES, lambda: 500)
    progress.close()
    assert (out.getvalue(), progress.samples) == ("", 10 * playing.LOOK_SAMPLES)
