"""A recording of a live device compared with the samples of a client: all members of all samples, and the ledger.

`python -m tests.bench.recording_live [SECONDS]`, default 30.

The daemon records a simulated device in motion in real time at 1 kHz on a pseudo-terminal. A client on the socket
receives every sample. The client subscribes before the device exists, so it receives the first and the last sample. The
replay must have the same number of samples. The client must have received the same slots (all members, f64).
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from time import sleep

from imud.client.connection import Client, Watch
from imud.contracts.publisher import Batch
from imud.formats.recording import RecordingReader
from imud.formats.slot import SLOT_BYTES, encode_slot
from imud.model.ledger import lost
from imud.recording.player import Player
from tests.bench.rows import Row, at_least, at_most
from tests.support.daemon_process import running_daemon, wait_until

RATE_HZ = 1000
SECONDS = 30.0
START_S = 60.0  # limit for the start and the end
STILL_S = 1.0  # the device has stopped after this silence


class Receiver:
    """A client that writes the slots of all samples to a file.

    Synchronization: a thread of its own. Read the attributes only after its end.
    """

    def __init__(self, path: Path, out: Path) -> None:
        self.count = 0
        self.dropped = 0
        self._client = Client(path)
        self._client.watch(encoding="binary", latency_ms=20.0)
        self._out = out.open("wb")
        self._end = Event()
        self._thread = Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        """Wait until no more samples arrive, then close the client."""
        self._end.set()
        self._thread.join()
        self._client.close()
        self._out.close()

    def _run(self) -> None:
        while True:
            try:
                message = self._client.next_message(Watch.NAMES, STILL_S)
            except TimeoutError:
                if self._end.is_set():
                    return
                continue
            if isinstance(message, bytes):
                self._out.write(message)
                self.count += len(message) // SLOT_BYTES
            else:
                self.dropped += message["params"].get("dropped", 0)


@contextmanager
def module(port: Path) -> Iterator[None]:
    argv = [sys.executable, "-m", "imud.sim", "--rate", str(RATE_HZ), "--baud", "921600", "--path", str(port)]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline(), "cannot start the simulated device: expected its port on standard output"
            yield
        finally:
            process.communicate(timeout=START_S)


def live_run(folder: Path, seconds: float) -> tuple[Receiver, dict[str, int]]:
    """Run daemon, device and client. Return the client, and the ledger after the end of the device."""
    device = {"driver": "hipnuc-uart", "uart": {"port": str(folder / "port"), "baud": 921_600}}
    recorder = {"enabled": True, "directory": str(folder / "recordings"), "file_mb": 1000}
    more = {"log_level": "info", "metrics": {"enabled": False}, "recorder": recorder}
    with running_daemon(folder, {"bow": device}, limit_s=START_S, python=(), **more) as daemon:
        receiver = Receiver(daemon.socket, folder / "slots")
        try:
            with module(folder / "port"):
                wait_until(lambda: receiver.count, "samples", START_S)
                sleep(seconds)
        finally:
            receiver.close()
        return receiver, dict(daemon.statuses()["bow"].ledger)


def differing(file: Path, slots: Path) -> tuple[Player, int]:
    again: list[bytes] = []
    wrong = 0

    def publish(batch: Batch) -> None:
        again.extend(encode_slot(sample, batch.device_id) for sample in batch.samples)

    player = Player(publish)
    with file.open("rb") as opened, slots.open("rb") as received:
        for record in RecordingReader(opened, file.name):
            player.play([record])
            wrong += sum(slot != received.read(SLOT_BYTES) for slot in again)
            again.clear()
        # also count samples that only the client received
        wrong += sum(1 for _ in iter(lambda: received.read(SLOT_BYTES), b""))
    return player, wrong


def live_rows(seconds: float = SECONDS) -> Iterator[Row]:
    name = f"{seconds:g} s live at 1 kHz"
    with tempfile.TemporaryDirectory(prefix="imud-bench-") as made:
        folder = Path(made)
        receiver, ledger = live_run(folder, seconds)
        (file,) = (folder / "recordings").glob("*.imudrec")
        player, wrong = differing(file, folder / "slots")
        (device,) = player.devices.values()
        other = sum(device.ledger.snapshot()[key] != value for key, value in ledger.items())
        least = RATE_HZ * seconds / 2  # a busy host may lose frames before the daemon reads them
        yield at_least(f"{name}: samples", float(receiver.count), "samples", least)
        yield Row(f"{name}: samples lost before imud", float(lost(ledger)), "samples")
        yield at_most(f"{name}: samples dropped for the client", float(receiver.dropped), "samples", 0)
        yield at_most(f"{name}: samples that differ in any member", float(wrong), "samples", 0)
        yield at_most(f"{name}: counters of the ledger that differ", float(other), "", 0)
        yield Row(f"{name}: checks", float(device.checks), "checks")
        yield at_most(f"{name}: checks that differ", float(len(device.differences)), "checks", 0)
        yield at_most(f"{name}: records dropped", float(player.lost), "records", 0)
        yield Row(f"{name}: bytes on the disk per sample", file.stat().st_size / receiver.count, "bytes")


if __name__ == "__main__":
    for row in live_rows(float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS):
        print(row, flush=True)
