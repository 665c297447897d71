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

import msgspec

from imud.contracts.publisher import Batch
from imud.formats.recording import RecordingReader
from imud.model.event import Event
from imud.recording.player import Player
from tests.bench.captures import Source, hi91_module, record
from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_most

RATIO_LIMIT = 1.15  # goal: CPU with / without a recording
REPLAY_SECONDS = 600
REPLAY_QUICK_SECONDS = 30
HI91_1_KHZ = Source("hipnuc-uart", 1000, lambda: hi91_module(1000))


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
        file = record(HI91_1_KHZ, seconds, Path(name), extra={"live": live})
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
