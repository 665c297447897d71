"""Cost of a recording: CPU time of the daemon with and without it. Also checks the replay.

The load with and without a recording alternates, and the rows show the best round. Other programs must be idle. The CPU
time of the daemon includes the threads of the recorder. Then a daemon records ten minutes of a simulated device in
motion at 1 kHz as fast as possible. All members of all samples must be equal in the replay.
"""

import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec

from imud import config
from imud.contracts.publisher import Batch
from imud.daemon import Daemon
from imud.formats.recording import RecordingReader
from imud.host import event_loop
from imud.model.event import Event
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.player import Player
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings, Output
from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_most
from tests.support.files import CaptureWriter

RATIO_LIMIT = 1.15  # goal: CPU with / without a recording
REPLAY_SECONDS = 600
REPLAY_QUICK_SECONDS = 30

BEGIN_NS: Final = 86_400 * NS_PER_S  # a device that runs for a day
BAUD: Final = 921_600


def write_capture(seconds: int, path: Path) -> None:
    """Write a capture of the simulated device. The simulated port delivers each burst up to 0.25 ms late."""
    random = Random(1)
    module = HipnucModule(BEGIN_NS, ModuleSettings(baud=BAUD, hi91=Output(period_ms=1)), HipnucHardware())
    with path.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=BAUD)
        for second in range(seconds):
            for burst in module.advance(BEGIN_NS + (second + 1) * NS_PER_S):
                if burst.data:
                    writer.write(burst.data, burst.due_ns + random.randrange(NS_PER_MS // 4))


def record(seconds: int, folder: Path, **more: Any) -> Path:
    """Record the device with a daemon. Return the path of the recording. `more`: further arguments of the daemon."""
    capture, recordings = folder / "capture", folder / "recordings"
    write_capture(seconds, capture)
    text = f"""
recorder: {{enabled: true, directory: {recordings}, file_mb: 1000}}
socket: {{enabled: false}}
shm: {{enabled: false}}
metrics: {{enabled: false}}
devices:
  bow: {{driver: hipnuc-uart, replay: {{path: {capture}, speed: maximum}}}}
"""
    # speed `maximum`: the daemon reads the capture without pauses
    event_loop.run(Daemon(config.parse(text, "imud.yaml"), until_finished=True, **more).run())
    capture.unlink()
    (made,) = recordings.glob("*.imudrec")
    return made


def rows(*, quick: bool = False) -> Iterator[Row]:
    yield from cpu_rows(rounds=1 if quick else 3, seconds=2.0 if quick else 6.0)
    yield from replay_rows(REPLAY_QUICK_SECONDS if quick else REPLAY_SECONDS)


def cpu_rows(rounds: int, seconds: float) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        without = Load(seconds=seconds)
        pairs = [(run(without), run(replace(without, record_to=str(Path(folder))))) for _ in range(rounds)]
    plain = min((a for a, _ in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    recorded = min((b for _, b in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    yield Row("1 kHz, 1 client: CPU per sample, not recorded", plain.cpu_us_per_sample, "us")
    yield Row("1 kHz, 1 client: CPU per sample, recorded", recorded.cpu_us_per_sample, "us")
    ratio = recorded.cpu_us_per_sample / plain.cpu_us_per_sample
    yield at_most("1 kHz, 1 client: CPU ratio", ratio, "x", RATIO_LIMIT)
    yield at_most("1 kHz, 1 client: samples lost, recorded", float(max(b.lost for _, b in pairs)), "samples", 0)


class Digest:
    """Publisher that counts the samples and computes a digest of all their members."""

    def __init__(self) -> None:
        self.count = 0
        self.sha256 = hashlib.sha256()

    def publish(self, batch: Batch) -> None:
        self.count += len(batch.samples)
        for sample in batch.samples:
            self.sha256.update(msgspec.msgpack.encode(sample))

    def start(self) -> None: ...
    def add_device(self, name: str, device_id: int) -> None: ...
    def remove_device(self, name: str) -> None: ...
    def event(self, event: Event) -> None: ...
    def tick(self, now_ns: int) -> None: ...
    def close(self) -> None: ...


def replay_rows(seconds: int) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as name:
        live, again = Digest(), Digest()
        file = record(seconds, Path(name), extra={"live": live})
        player = Player(again.publish)
        with file.open("rb") as opened:
            reader = RecordingReader(opened, file.name)
            player.play(reader)
        (device,) = player.devices.values()
        same = live.count == again.count and live.sha256.digest() == again.sha256.digest()
        yield Row(f"{seconds} s at 1 kHz: samples", float(live.count), "samples")
        yield at_most(f"{seconds} s at 1 kHz: records dropped", float(player.lost), "records", 0)
        yield Row(f"{seconds} s at 1 kHz: checks", float(device.checks), "checks")
        yield at_most(f"{seconds} s at 1 kHz: checks that differ", float(len(device.differences)), "checks", 0)
        yield at_most(f"{seconds} s at 1 kHz: 0 if every member of every sample is equal", float(not same), "", 0)
        yield Row(f"{seconds} s at 1 kHz: bytes on the disk per sample", file.stat().st_size / live.count, "bytes")
