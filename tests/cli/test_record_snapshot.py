"""Snapshots of the flight recorder replay like the live run, from the middle of the run."""

from pathlib import Path

import msgspec
import pytest

from imud.publishers.recorder import flight
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import FRAMES, run_recorded, stamped_capture
from tests.support.daemon_process import running_daemon, wait_until


@pytest.mark.live
@pytest.mark.parametrize("place", ["memory", "directory"])
def test_a_snapshot_whose_begin_is_gone_replays_as_the_daemon_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli, place: str
) -> None:
    monkeypatch.setattr(flight, "SEGMENT_NS_MIN", 300_000_000)
    monkeypatch.setattr(flight, "MEGABYTE", 28_000)  # the run makes 39,000: the recorder removes the oldest segments
    directory = f"directory: {tmp_path / 'flight'}, " if place == "directory" else ""
    recorder = f"flight: {{enabled: true, {directory}memory_mb: 1, minutes: 0.1, acceleration_m_s2: 5}}"
    _, collector, (file,) = run_recorded(tmp_path, recorder=recorder, speed="recorded", can_frames=FRAMES)
    printed = cli("replay", "--json", file)
    assert printed.err.count("equal to the live run") == 2
    assert "0 of 0 checks" not in printed.err
    for name in ("bow", "mast"):
        live = [msgspec.json.encode(one).decode() for one in collector.samples if one.device == name]
        again = [line for line in printed.out.splitlines() if f'"device":"{name}"' in line]
        assert 20 < len(again) < len(live)
        assert again == live[len(live) - len(again) :]
    assert "integrity  complete" in cli("info", file).out


@pytest.mark.live
def test_a_client_saves_the_last_minutes(tmp_path: Path, cli: Cli) -> None:
    capture = str(stamped_capture(tmp_path / "capture"))
    played = {"driver": "hipnuc-uart", "replay": {"path": capture, "speed": "recorded", "repeat": True}}
    recorder = {"directory": str(tmp_path / "recordings"), "flight": {"enabled": True}}
    file = tmp_path / "snapshot.imudrec"
    with running_daemon(tmp_path, {"bow": played}, recorder=recorder) as daemon:
        wait_until(lambda: daemon.wait_for("bow", "running").newest_seq > 150, "150 samples")
        assert "samples of 1 device" in cli("record", "--socket", daemon.socket, "--snapshot", file).err
    printed = cli("replay", "--json", file)
    assert len(printed.out.splitlines()) > 150
    assert "equal to the live run" in printed.err
    assert list((tmp_path / "recordings").glob("*.imudrec")) == []
