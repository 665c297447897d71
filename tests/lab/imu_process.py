"""A simulated device as a process behind a pty. Its pins are lines of a gpio-sim chip."""

import csv
import os
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.lab.gpio_chip import GpioChip

LIMIT_S = 150.0
SETTLE_MS = 12.0
"""Time for an edge, ms. The lab's kernel reports simulated edges at its timer ticks, every 4 ms."""


class Pulse(NamedTuple):
    sample_ns: int
    """Time of the measurement, ns."""
    late_ns: int
    """Delay of the process of the device, ns."""


class Imu(NamedTuple):
    process: "subprocess.Popen[str]"
    folder: Path

    def truth(self) -> dict[int, int]:
        with (self.folder / "truth.csv").open(encoding="ascii") as file:
            rows = csv.DictReader(line for line in file if not line.startswith("#"))
            return {int(row["device_ms"]): int(row["sample_ns"]) for row in rows}

    def pulses(self, pin: str) -> list[Pulse]:
        with (self.folder / "pins.csv").open(encoding="ascii") as file:
            rows = [row for row in csv.DictReader(file) if row["pin"] == pin and row["level"] == "1"]
        return [Pulse(int(row["sample_ns"]), int(row["step_ns"]) - int(row["due_ns"])) for row in rows]

    def stop(self) -> None:
        self.process.communicate(timeout=LIMIT_S)


def tty(folder: Path) -> Path:
    return folder / "imu"


@contextmanager
def running_imu(folder: Path, chip: GpioChip, pins: Mapping[str, str], *more: str) -> Iterator[Imu]:
    lines = ",".join(f"{pin}={chip.pull(line)}" for pin, line in pins.items())
    command = [
        sys.executable, "-m", "imud.sim", "--boot", "0", "--path", str(tty(folder)), "--truth",
        str(folder / "truth.csv"), "--pins", lines, "--pin-truth", str(folder / "pins.csv"),
        "--pin-settle", str(SETTLE_MS), *more,
    ]  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline().strip() == str(tty(folder))
            yield Imu(process, folder)
        finally:
            if process.poll() is None:
                process.communicate(timeout=LIMIT_S)


def tell(folder: Path, *commands: str) -> None:
    fd = os.open(tty(folder), os.O_RDWR | os.O_NOCTTY)
    try:
        for command in commands:
            os.write(fd, command.encode() + b"\r\n")
            heard = b""
            while b"OK\r\n" not in heard:
                assert select.select([fd], [], [], LIMIT_S)[0], f"{command}: no answer"
                heard += os.read(fd, 4096)
    finally:
        os.close(fd)
