"""Cost of recording: CPU of the daemon with and without, and what a sample takes on the disk.

The same load in turns, the best round of each: other programs share the machine. Threads of the recorder are part of
the daemon's CPU. `size` records simulated modules that move, because a module at rest is compressed better.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from time import thread_time_ns

from imud.formats.recording import records
from imud.formats.recording.file import BlockGatherer
from imud.sim.hipnuc.uart.settings import HipnucHardware, ModuleSettings, Output
from imud.sim.hipnuc.uart.simulator import HipnucModule
from imud.units import NS_PER_MS, NS_PER_S
from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_most

RATIO_LIMIT = 1.15
SIZE_SECONDS = 60
BEGIN_NS = 86_400 * NS_PER_S


def rows(*, quick: bool = False) -> Iterator[Row]:
    """All figures."""
    yield from size_rows()
    yield from cpu_rows(rounds=1 if quick else 3, seconds=2.0 if quick else 6.0)


def size_rows() -> Iterator[Row]:
    """Bytes per sample of a module that moves, at the rates that the daemon's blocks have: one a second."""
    for rate_hz in (100, 1000):
        random, module = (
            Random(1),
            HipnucModule(
                BEGIN_NS, ModuleSettings(baud=921_600, hi91=Output(period_ms=1000 // rate_hz)), HipnucHardware()
            ),
        )
        gatherer, stored, plain, samples, spent_ns = BlockGatherer(), 0, 0, 0, 0
        for second in range(SIZE_SECONDS):
            made: list[bytes] = []
            for burst in module.advance(BEGIN_NS + (second + 1) * NS_PER_S):
                if burst.data:
                    late_ns = random.randrange(NS_PER_MS // 4)
                    made.append(records.encode_data(0, burst.data, BEGIN_NS + len(made) * NS_PER_MS + late_ns, -1))
            begin_ns = thread_time_ns()
            stored += sum(len(gatherer.add(one)) for one in made) + len(gatherer.finish())
            spent_ns += thread_time_ns() - begin_ns
            plain += sum(map(len, made))
            samples += len(made)
        yield Row(f"HI91 at {rate_hz} Hz: bytes on the disk per sample", stored / samples, "bytes")
        yield Row(f"HI91 at {rate_hz} Hz: bytes of records per sample", plain / samples, "bytes")
        yield Row(f"HI91 at {rate_hz} Hz: CPU of blocks per sample", spent_ns / samples / 1000, "us")


def cpu_rows(rounds: int, seconds: float) -> Iterator[Row]:
    """CPU of the daemon per sample at 1 kHz with a client, with and without recording."""
    with tempfile.TemporaryDirectory() as folder:
        without = Load(seconds=seconds)
        pairs = [(run(without), run(replace(without, record_to=str(Path(folder))))) for _ in range(rounds)]
    plain = min((a for a, _ in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    recorded = min((b for _, b in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    yield Row("1 kHz, 1 client: CPU per sample, nothing recorded", plain.cpu_us_per_sample, "us")
    yield Row("1 kHz, 1 client: CPU per sample, recorded", recorded.cpu_us_per_sample, "us")
    ratio = recorded.cpu_us_per_sample / plain.cpu_us_per_sample
    yield at_most("1 kHz, 1 client: CPU ratio", ratio, "x", RATIO_LIMIT)
    yield at_most("1 kHz, 1 client: samples lost, recorded", float(max(b.lost for _, b in pairs)), "samples", 0)


if __name__ == "__main__":
    for row in rows(quick="--quick" in sys.argv):
        print(f"{row.name:64} {row.value:12.3f} {row.unit:6} {row.reach} {row.reached}")
