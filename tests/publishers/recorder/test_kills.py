"""Recording daemons that are killed at random moments: the written data is complete and can be replayed."""

import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

import pytest

from imud.formats.recording import RecordingReader
from imud.recording.player import Player
from tests.support.files import CaptureWriter, hi91

RATE_HZ = 1000
SECONDS = 5  # length of the replayed capture
AT_ONCE = 3
EARLY, LATE = 2, 3  # number of daemons killed after the first block, which has no samples, and after written samples
WITH_SAMPLES_BYTES = 40_000  # size that exceeds the start of a file, bytes
LATEST_S = 1.2  # maximum time until the next block, s


def capture(file: Path) -> None:
    with file.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=921600)
        for number in range(RATE_HZ * SECONDS):
            writer.write(hi91(number), number * 1_000_000)


def configured(folder: Path) -> Path:
    file = folder / "imud.yaml"
    file.write_text(f"""
state_dir: {folder / "state"}
recorder: {{enabled: true, directory: {folder / "recordings"}}}
socket: {{enabled: false}}
shm: {{enabled: false}}
metrics: {{enabled: false}}
devices:
  bow: {{driver: hipnuc-uart, replay: {{path: {folder / "capture"}, speed: recorded, repeat: true}}}}
""")
    return file


def killed_recording(folder: Path, after_s: float, least_bytes: int) -> Path:
    """Start a daemon, kill it `after_s` after its file has reached `least_bytes`, and return the file."""
    daemon = subprocess.Popen(
        [sys.executable, "-m", "imud", "run", "--config", str(configured(folder))], stderr=subprocess.DEVNULL
    )
    try:
        end_s = time.monotonic() + 60
        while not (new := [one for one in folder.glob("recordings/*.imudrec") if one.stat().st_size >= least_bytes]):
            assert daemon.poll() is None, f"expected a running daemon, got exit status {daemon.returncode}"
            assert time.monotonic() < end_s, "expected a recording within 60 s, got no file"
            time.sleep(0.01)
        time.sleep(after_s)
        daemon.send_signal(signal.SIGKILL)
    finally:
        daemon.kill()
        daemon.wait()
    return new[0]


def samples_of(file: Path) -> int:
    """Replay a file and check that only its last block is incomplete. Return the number of samples."""
    player = Player(lambda _batch: None)
    with file.open("rb") as opened:
        reader = RecordingReader(opened, file.name)
        player.play(reader)
    assert (reader.blocks.bytes_bad, reader.blocks.blocks_missing, reader.records_unreadable) == (0, 0, 0), file
    assert reader.stored_bytes + reader.blocks.bytes_cut == file.stat().st_size
    devices = list(player.devices.values())
    assert all(not device.differences for device in devices), devices[0].differences[:1]
    return sum(device.ledger.samples for device in devices)


@pytest.mark.live
def test_all_blocks_of_killed_daemons_are_complete_and_replay(tmp_path: Path) -> None:
    random = Random(4)
    kills = [(random.uniform(0, LATEST_S), 1 if n < EARLY else WITH_SAMPLES_BYTES) for n in range(EARLY + LATE)]
    capture(tmp_path / "capture")

    def killed(number: int) -> int:
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "capture").hardlink_to(tmp_path / "capture")
        return samples_of(killed_recording(folder, *kills[number]))

    with ThreadPoolExecutor(AT_ONCE) as pool:
        samples = list(pool.map(killed, range(len(kills))))
    print(samples)
    assert all(samples[EARLY:])
