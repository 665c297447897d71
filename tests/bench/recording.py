"""Cost of a recording: CPU time of the daemon with and without it, and bytes per sample. Also checks the replay.

`python -m tests.bench.recording [--quick] [size] [cpu] [replay]`; without a name, all three run.

`cpu` alternates between the load with and without a recording. The rows show the best round. Other programs must be
idle. The CPU time of the daemon includes the threads of the recorder. `size` records simulated devices in motion,
because a recording of a device at rest compresses better. `replay` records ten minutes of such a device at 1 kHz as
fast as possible. All members of all samples must be equal in the replay. Together with the other parts, `replay`
records half a minute.
"""

import hashlib
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from time import thread_time_ns

import msgspec

from imud.contracts.publisher import Batch
from imud.formats import records
from imud.formats.recording import BlockGatherer, RecordingReader
from imud.model.event import Event
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.player import Player
from tests.bench.captures import BEGIN_NS, Source, hi91_module, record
from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_most

RATIO_LIMIT = 1.15  # goal: CPU with / without a recording
SIZE_SECONDS = 60
REPLAY_SECONDS = 600
REPLAY_QUICK_SECONDS = 30
HI91_1_KHZ = Source("hipnuc-uart", 1000, lambda: hi91_module(1000))


def rows(*, quick: bool = False) -> Iterator[Row]:
    yield from size_rows()
    yield from cpu_rows(rounds=1 if quick else 3, seconds=2.0 if quick else 6.0)
    yield from replay_rows(REPLAY_QUICK_SECONDS)


def chosen_rows(words: list[str]) -> Iterator[Row]:
    quick = "--quick" in words
    if not {"size", "cpu", "replay"} & set(words):
        yield from rows(quick=quick)
    if "size" in words:
        yield from size_rows()
    if "cpu" in words:
        yield from cpu_rows(rounds=1 if quick else 3, seconds=2.0 if quick else 6.0)
    if "replay" in words:
        yield from replay_rows(REPLAY_QUICK_SECONDS if quick else REPLAY_SECONDS)


def size_rows() -> Iterator[Row]:
    """Yield the bytes per sample of a device in motion. The daemon writes one block per second."""
    for rate_hz in (100, 1000):
        random, module = Random(1), hi91_module(rate_hz)
        gatherer, stored, plain, samples, spent_ns = BlockGatherer(), 0, 0, 0, 0
        for second in range(SIZE_SECONDS):
            made: list[bytes] = []
            for burst in module.advance(BEGIN_NS + (second + 1) * NS_PER_S):
                if burst.data:
                    late_ns = random.randrange(NS_PER_MS // 4)
                    made.append(records.encode_data(0, burst.data, BEGIN_NS + len(made) * NS_PER_MS + late_ns, -1))
            begin_ns = thread_time_ns()
            # finish the block after each second, like the daemon
            stored += sum(len(gatherer.add(one)) for one in made) + len(gatherer.finish())
            spent_ns += thread_time_ns() - begin_ns
            plain += sum(map(len, made))
            samples += len(made)
        yield Row(f"HI91 at {rate_hz} Hz: bytes on the disk per sample", stored / samples, "bytes")
        yield Row(f"HI91 at {rate_hz} Hz: bytes of records per sample", plain / samples, "bytes")
        yield Row(f"HI91 at {rate_hz} Hz: CPU of blocks per sample", spent_ns / samples / 1000, "us")


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


if __name__ == "__main__":
    for row in chosen_rows(sys.argv[1:]):
        print(row, flush=True)
