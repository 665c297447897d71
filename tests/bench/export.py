"""Time of `imud export` for an hour at 400 Hz, in each format.

`python -m tests.bench.export [--quick] [--keep FOLDER]`; `--quick` exports two minutes, and judges nothing.

A simulated IMU61X at 400 Hz sends to a daemon that plays and records as fast as it can, with time stamps of the hour;
a simulated HI91 module, whose samples have more fields, does so at 500 Hz for the same number of samples. Each export
is the command itself, in its own processes. CPU is that of all of them, user and system, which other programs on the
machine disturb less than the time that passes; with both cores free the time is what counts. `--keep` leaves the
recordings in a folder, and takes them from there if they are there already.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from time import monotonic
from typing import Final, NamedTuple

from imud import config
from imud.daemon import Daemon
from imud.runtime import event_loop
from imud.sim.hipnuc.uart.settings import HipnucHardware, ModuleSettings, Output
from imud.sim.hipnuc.uart.simulator import HipnucModule
from imud.sim.imu61x.settings import Imu61xSettings
from imud.sim.imu61x.uart import Imu61xModule
from imud.sim.simulator import StreamModule
from imud.units import NS_PER_MS, NS_PER_S
from tests.bench.rows import Row, at_most
from tests.support.files import CaptureWriter

SECONDS: Final = 3600
QUICK_SECONDS: Final = 120
RATE_HZ: Final = 400
LIMIT_S: Final = 20.0
"""For an hour at RATE_HZ."""
BEGIN_NS: Final = 86_400 * NS_PER_S
FORMATS: Final = {
    "CSV": ("--to", "csv"),
    "MCAP, JSON": ("--to", "mcap", "--schema", "json"),
    "MCAP, ROS 2": ("--to", "mcap", "--schema", "ros2"),
}


class Source(NamedTuple):
    """A simulated device."""

    driver: str
    baud: int
    rate_hz: int
    make: Callable[[], StreamModule]


SOURCES: Final = {
    "IMU61X": Source(
        "imu61x-uart", 921_600, RATE_HZ, lambda: Imu61xModule(BEGIN_NS, Imu61xSettings(baud=921_600, rate_hz=RATE_HZ))
    ),
    "HI91": Source(
        "hipnuc-uart", 921_600, 500,
        lambda: HipnucModule(BEGIN_NS, ModuleSettings(baud=921_600, hi91=Output(period_ms=2)), HipnucHardware()),
    ),
}  # fmt: skip


def rows(*, quick: bool = False, folder: Path | None = None) -> Iterator[Row]:
    """All figures."""
    samples = (QUICK_SECONDS if quick else SECONDS) * RATE_HZ
    with tempfile.TemporaryDirectory() as scratch:
        kept = folder or Path(scratch)
        kept.mkdir(exist_ok=True)
        for name, source in SOURCES.items():
            recording = kept / f"{source.driver}-{samples}.imudrec"
            if not recording.exists():
                record(source, samples // source.rate_hz, Path(scratch)).rename(recording)
            yield from export_rows(name, recording, samples, Path(scratch), None if quick else LIMIT_S)


def record(source: Source, seconds: int, folder: Path) -> Path:
    """Have a daemon record a module for so long by its stamps; return the file."""
    capture, recordings = folder / "capture", folder / f"{source.driver}-recordings"
    write_capture(source, seconds, capture)
    text = f"""
recorder: {{enabled: true, directory: {recordings}, file_mb: 1000}}
socket: {{enabled: false}}
shm: {{enabled: false}}
metrics: {{enabled: false}}
devices:
  bow: {{driver: {source.driver}, replay: {{path: {capture}, speed: maximum}}}}
"""
    event_loop.run(Daemon(config.parse(text, "imud.yaml"), until_finished=True).run())
    capture.unlink()
    (made,) = recordings.iterdir()
    return made


def write_capture(source: Source, seconds: int, path: Path) -> None:
    """Write what the module sends through a port that hands bytes over up to 0.25 ms late."""
    random, module = Random(1), source.make()
    with path.open("wb") as out:
        writer = CaptureWriter(out, driver=source.driver, baud=source.baud)
        for second in range(seconds):
            for burst in module.advance(BEGIN_NS + (second + 1) * NS_PER_S):
                if burst.data:
                    writer.write(burst.data, burst.due_ns + random.randrange(NS_PER_MS // 4))


def export_rows(name: str, recording: Path, samples: int, folder: Path, limit_s: float | None) -> Iterator[Row]:
    """Time and CPU of the export of one recording in each format."""
    yield Row(f"{name}: recording", recording.stat().st_size / 1e6, "MB")
    for words, options in FORMATS.items():
        out, begin_s = folder / "out", monotonic()
        argv = [sys.executable, "-m", "imud", "export", str(recording), *options, "-o", str(out)]
        process = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        spent_s = monotonic() - begin_s
        process.returncode = os.waitstatus_to_exitcode(status)
        process.stderr.close()
        exported = int(said.rsplit("\n\n", 1)[-1].split()[0])
        if process.returncode or abs(exported - samples) > samples // 100:
            raise SystemExit(f"{name}, {words}: expected {samples} samples, status {process.returncode}:\n{said}")
        what = f"{name}, {words}: time for {exported} samples"
        yield Row(what, spent_s, "s") if limit_s is None else at_most(what, spent_s, "s", limit_s)
        yield Row(f"{name}, {words}: CPU", used.ru_utime + used.ru_stime, "s")
        yield Row(f"{name}, {words}: file", out.stat().st_size / 1e6, "MB")
        out.unlink()


def main(words: list[str]) -> None:
    """Print the figures, and how busy the machine is beside them."""
    folder = Path(words[words.index("--keep") + 1]) if "--keep" in words else None
    for row in rows(quick="--quick" in words, folder=folder):
        load = f"load {os.getloadavg()[0]:.1f}"
        reached = "" if row.reached is None else row.reached
        print(f"{row.name:52} {row.value:9.2f} {row.unit:3} {row.reach:8} {reached!s:6} {load}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
