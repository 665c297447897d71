"""Kills recorders at random moments. All written blocks must be complete, and their replay must be equal to the run.

`python -m tests.bench.recorder_kills [WRITERS [DAEMONS]]`, default 100 and 10. All kills use SIGKILL:

- Writers: a process with the recorder's thread, which receives records as fast as it accepts them. Most kills occur
  during a write. The records in the file must be the first records, complete and without a gap.
- Daemons: the kill is 0.2 to 3 s after the start of the file. No byte of a file may be damaged and no block may be
  missing. One block at the end may be incomplete. The replay must have the time stamps, time stamp errors and ledgers
  of the run at every check. The output contains the time between the last recorded sample and the kill.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from itertools import count
from pathlib import Path
from random import Random

from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind
from imud.host.threads import BusThread
from imud.model.errors import ImudError
from imud.publishers.recorder.writer import RecordingWriter, RecordQueue
from imud.recording.player import Player
from tests.support.files import CaptureWriter, hi91

RATE_HZ = 1000
SECONDS = 5  # length of the replayed capture


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


def new_files(folder: Path, before: set[Path], least_bytes: int) -> list[Path]:
    found = (one for one in (folder / "recordings").glob("*.imudrec") if one not in before)
    return [one for one in found if one.stat().st_size >= least_bytes]


def run_and_kill(folder: Path, after_s: float, least_bytes: int = 1) -> tuple[Path, int]:
    """Start a daemon and kill it `after_s` after its file has reached `least_bytes`.

    Return the file, and the time of the kill, CLOCK_MONOTONIC, ns.
    """
    before = set((folder / "recordings").glob("*.imudrec"))
    daemon = subprocess.Popen(
        [sys.executable, "-m", "imud", "run", "--config", str(configured(folder))], stderr=subprocess.DEVNULL
    )
    try:
        end_s = time.monotonic() + 60
        while not (new := new_files(folder, before, least_bytes)):
            assert daemon.poll() is None, f"expected a running daemon, got exit status {daemon.returncode}"
            assert time.monotonic() < end_s, "expected a recording within 60 s, got no file"
            time.sleep(0.01)
        time.sleep(after_s)
        daemon.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
    finally:
        daemon.kill()
        daemon.wait()
    return new[0], killed_ns


def look_at(file: Path, killed_ns: int) -> tuple[int, float]:
    player = Player(lambda _batch: None)
    newest_ns = 0
    with file.open("rb") as opened:
        reader = RecordingReader(opened, file.name)
        for record in reader:
            player.play([record])
            if record.kind == Kind.DATA:
                newest_ns = records.decode_data(record.body).t_rx_ns
    assert (reader.blocks.bytes_bad, reader.blocks.blocks_missing, reader.records_unreadable) == (0, 0, 0), file
    assert reader.stored_bytes + reader.blocks.bytes_cut == file.stat().st_size
    devices = list(player.devices.values())
    assert all(not device.differences for device in devices), devices[0].differences[:1]
    return sum(device.ledger.samples for device in devices), (killed_ns - newest_ns) / 1e9


def write_for_ever(file: Path) -> None:
    queue = RecordQueue[Path]()
    writer = RecordingWriter(queue, time.monotonic_ns, BusThread)
    queue.mark(file)
    for number in count():
        queue.put(records.encode_data(0, number.to_bytes(8, "little") * 10, number, -1))
        # do not fill the queue, because a full queue drops records
        while not queue.is_easy:
            time.sleep(0.001)
        assert not writer.problem, writer.problem


def kill_writer(file: Path, after_s: float) -> tuple[int, bool]:
    """Kill a writer `after_s` after its start. Return the number of records, and whether a block is incomplete."""
    child = os.fork()
    if not child:
        try:
            write_for_ever(file)
        finally:
            os._exit(1)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL, status
    if not file.exists() or not file.stat().st_size:
        return 0, False
    with file.open("rb") as opened:
        reader = RecordingReader(opened, file.name)
        try:
            numbers = [records.decode_data(record.body).t_rx_ns for record in reader]
        except ImudError:  # the first block is incomplete
            numbers = []
    # the time stamp of each record is its number
    assert numbers == list(range(len(numbers)))
    assert (reader.blocks.bytes_bad, reader.records_unreadable) == (0, 0)
    assert reader.stored_bytes + reader.blocks.bytes_cut == file.stat().st_size
    size = file.stat().st_size
    file.unlink()
    return len(numbers), reader.stored_bytes < size


def kill_writers(kills: int) -> None:
    random, left, cut = Random(2), 0, 0
    with tempfile.TemporaryDirectory() as name:
        for number in range(kills):
            found, was_cut = kill_writer(Path(name) / str(number), random.uniform(0.0, 1.0))
            left, cut = left + found, cut + was_cut
    print(f"{kills} writers killed, {cut} of them during a block: {left} records remain, complete and without a gap")


def main() -> int:
    kill_writers(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
    daemons = int(sys.argv[2]) if len(sys.argv) > 2 else 10
    if daemons:
        kill_daemons(daemons)
    return 0


def kill_daemons(kills: int) -> None:
    random, samples, missing = Random(1), 0, list[float]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        capture(folder / "capture")
        for _ in range(kills):
            found, missing_s = look_at(*run_and_kill(folder, random.uniform(0.2, 3.0)))
            samples += found
            missing += [missing_s] if found else []
    print(
        f"{kills} daemons killed, {samples} samples in the files, equal in the replay; last sample before the kill: "
        f"mean {sum(missing) / len(missing):.2f} s, maximum {max(missing):.2f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
