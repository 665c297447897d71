"""Duration of `imud export` for one hour of samples at 400 Hz, in each format.

`make bench ARGS=export`; the short form exports two minutes and checks no goal.

The recordings are from a simulated IMU61x at 400 Hz and a simulated HI91 device at 500 Hz. Both have the same number of
samples; HI91 samples have more fields. A daemon replays and records them as fast as possible, with the time stamps of
one hour. The part runs the command itself. CPU is the sum of the user and system time of all its processes. Other
programs on the host affect this sum less than the duration. If both cores are idle, the duration is the relevant
figure.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from typing import Final

from imud.sim.imu61x.uart import Imu61xModule, Imu61xSettings
from tests.bench.captures import BAUD, BEGIN_NS, Source, hi91_module, record
from tests.bench.rows import Row, at_most

SECONDS: Final = 3600  # recording of one hour
QUICK_SECONDS: Final = 120
RATE_HZ: Final = 400
LIMIT_S: Final = 20.0  # goal for one hour at 400 Hz
FORMATS: Final = {
    "CSV": ("--to", "csv"),
    "MCAP, JSON": ("--to", "mcap", "--schema", "json"),
    "MCAP, ROS 2": ("--to", "mcap", "--schema", "ros2"),
}

SOURCES: Final = {
    "IMU61X": Source(
        "imu61x-uart", RATE_HZ, lambda: Imu61xModule(BEGIN_NS, Imu61xSettings(baud=BAUD, rate_hz=RATE_HZ))
    ),
    "HI91": Source("hipnuc-uart", 500, lambda: hi91_module(500)),
}


def rows(*, quick: bool = False) -> Iterator[Row]:
    samples = (QUICK_SECONDS if quick else SECONDS) * RATE_HZ
    with tempfile.TemporaryDirectory() as scratch:
        for name, source in SOURCES.items():
            recording = record(source, samples // source.rate_hz, Path(scratch))
            yield from export_rows(name, recording, samples, Path(scratch), None if quick else LIMIT_S)


def export_rows(name: str, recording: Path, samples: int, folder: Path, limit_s: float | None) -> Iterator[Row]:
    yield Row(f"{name}: recording", recording.stat().st_size / 1e6, "MB")
    for words, options in FORMATS.items():
        out, begin_s = folder / "out", monotonic()
        argv = [sys.executable, "-m", "imud", "export", str(recording), *options, "-o", str(out)]
        process = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        said = process.stderr.read()
        # wait4 includes the CPU time of the worker processes of the export
        _, status, used = os.wait4(process.pid, 0)
        spent_s = monotonic() - begin_s
        process.returncode = os.waitstatus_to_exitcode(status)
        process.stderr.close()
        # the last paragraph of the progress output starts with the number of samples
        exported = int(said.rsplit("\n\n", 1)[-1].split()[0])
        # a recording may contain up to 1 % fewer samples
        if process.returncode or abs(exported - samples) > samples // 100:
            raise SystemExit(f"{name}, {words}: expected {samples} samples, status {process.returncode}:\n{said}")
        what = f"{name}, {words}: time for {exported} samples"
        yield Row(what, spent_s, "s") if limit_s is None else at_most(what, spent_s, "s", limit_s)
        yield Row(f"{name}, {words}: CPU", used.ru_utime + used.ru_stime, "s")
        yield Row(f"{name}, {words}: file", out.stat().st_size / 1e6, "MB")
        out.unlink()
