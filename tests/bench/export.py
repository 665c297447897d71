"""Size and CPU time of `imud export`: `python -m tests.bench.export`.

Simulated devices with noise and motion fill a capture with time stamps. A process exports the capture to each format.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from imud.model.units import NS_PER_S
from imud.sim import SIMULATORS
from imud.sim.sensor import SimulatorOptions
from tests.support.files import CaptureWriter
from tests.support.results import ProgramRun, Row, Table, add_json, printed

RATES_HZ: Final[Mapping[str, float]] = {"hipnuc-uart": 500.0, "imu61x-uart": 400.0}
SECONDS: Final = 60  # virtual time of a capture
FORMATS: Final = {"CSV": ["--to", "csv"], "MCAP, ROS 2 messages": ["--to", "mcap", "--schema", "ros2"]}
BEGIN_NS: Final = 1000 * NS_PER_S
STEP_NS: Final = NS_PER_S // 10


def write_capture(path: Path, driver: str, rate_hz: float, seconds: int) -> int:
    """Write the frames of a simulated device. Return the number of samples."""
    module, samples = SIMULATORS[driver].make(SimulatorOptions(rate_hz=rate_hz), BEGIN_NS), 0
    with path.open("wb") as file:
        capture = CaptureWriter(file, driver=driver, baud=module.baud)
        for now_ns in range(BEGIN_NS, BEGIN_NS + seconds * NS_PER_S, STEP_NS):
            for burst in module.advance(now_ns):
                capture.write(burst.data, burst.due_ns)
                samples += burst.sample_ns is not None
    return samples


def cpu_s(*words: str) -> float:
    """Return the CPU time of an `imud` process, s. Raises CalledProcessError if it fails."""
    before = os.times()
    subprocess.run([sys.executable, "-m", "imud", *words], check=True, stderr=subprocess.DEVNULL)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def table(seconds: int) -> Iterator[Row]:
    with tempfile.TemporaryDirectory(prefix="imud-export-") as name:
        for driver, rate_hz in RATES_HZ.items():
            capture, output = Path(name, "capture"), Path(name, "output")
            samples = write_capture(capture, driver, rate_hz, seconds)
            for title, words in FORMATS.items():
                used_s = cpu_s("export", str(capture), "--driver", driver, "-o", str(output), "--force", *words)
                yield {
                    "driver": driver, "rate, Hz": rate_hz, "samples": samples, "format": title,
                    "bytes per sample": output.stat().st_size / samples,
                    "MB per hour": output.stat().st_size / samples * rate_hz * 3600 / 1e6,
                    "CPU time per sample, µs": used_s * 1e6 / samples,
                }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.export")
    add_json(parser)
    args, program_run, rows = parser.parse_args(), ProgramRun(), list[Row]()
    for row in table(SECONDS):
        rows.append(row)
        print(printed(row), flush=True)
    program_run.save(args.json, [Table("", rows)])


if __name__ == "__main__":
    main()
