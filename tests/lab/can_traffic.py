"""Simulated devices on one CAN bus in a process of their own, and the comparison of samples with the true motion."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import sqrt
from typing import Final

import msgspec

from imud.contracts.driver import CanDriver
from imud.drivers import DRIVERS
from imud.model.sample import Sample, Vector3
from imud.sim.physics import Truth
from tests.lab.can_player import LOOP_S, Phased

GYRO_RAD_S: Final = 0.004  # tolerance of rotation rates
ACCEL_M_S2: Final = 0.02  # tolerance of accelerations
ANGLE_RAD: Final = 0.002
"""Tolerance of angles, rad: some counts of the coarsest protocol, less than the motion in 10 ms."""
BEGIN_S: Final = 1.0
LATE_SAMPLES: Final = 12
"""Maximum delay of the first sample after a stall of the guest, samples."""


@dataclass(frozen=True)
class Module:
    driver: str
    node: int

    @property
    def name(self) -> str:
        return f"{self.driver}-{self.node}"

    def config(self, interface: str) -> dict[str, object]:
        driver = DRIVERS[self.driver]
        assert isinstance(driver, CanDriver)
        options = msgspec.to_builtins(driver.node_settings(self.node))
        return {"driver": self.driver, "options": options, "identify": False, "socketcan": {"interface": interface}}


def fleet() -> list[Module]:
    """Return four CANopen nodes, four J1939 nodes and one IMU61x."""
    names = ("hipnuc-canopen", "hipnuc-j1939")
    return [*(Module(name, node) for name in names for node in (8, 9, 10, 11)), Module("imu61x-can", 101)]


class Traffic:
    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.pid = process.pid

    def begin(self) -> int:
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()
        return self._read()

    def end(self) -> int:
        assert self._process.stdin is not None
        self._process.stdin.close()
        return self._read()

    def _read(self) -> int:
        assert self._process.stdout is not None
        return int(self._process.stdout.readline())


@contextmanager
def traffic(interface: str, modules: Sequence[Module], rate_hz: float, seconds: float) -> Iterator[Traffic]:
    """Run all devices in one process with the priority of a real bus, so that no other process of imud delays it."""
    argv = ["chrt", "-f", "10", sys.executable, "-m", "tests.lab.can_player", interface, str(rate_hz), str(seconds)]
    argv += [f"{module.driver}:{module.node}" for module in modules]
    pipe = subprocess.PIPE
    with subprocess.Popen(argv, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        try:
            yield Traffic(process)
        finally:
            process.kill()


class Against:
    """Comparison of the samples of one device with its true motion, each sample at its own time."""

    def __init__(self, number: int, first: Sample, rate_hz: float, begin_ns: int) -> None:
        """Find the time of the first sample, at or before its time stamp, with the smallest deviation from the truth.
        `number` is the number of the device, `begin_ns` the start of the run."""
        self._motion = Phased(number)
        self._rate_hz = rate_hz
        self._seq = first.seq
        latest = int((first.t_ns - begin_ns) * rate_hz / 1e9)
        self._first = min(
            range(latest, latest - LATE_SAMPLES, -1), key=lambda n: self._worst(first, self._instant_s(n))
        )

    def is_true(self, sample: Sample) -> bool:
        """Return whether every value of the sample matches the time of its sequence number."""
        return self._worst(sample, self._instant_s(self._first + sample.seq - self._seq)) <= 1

    def _instant_s(self, number: int) -> float:
        """Return the time of a sample since the start of the motion, in device time, s."""
        return BEGIN_S + number / self._rate_hz % LOOP_S

    def _worst(self, sample: Sample, t_s: float) -> float:
        """Return the largest deviation from the truth at an instant, in units of the permitted deviation."""
        truth = self._motion.at(t_s)
        return max(
            _distance(sample.gyro_rad_s, truth.gyro_rad_s) / GYRO_RAD_S,
            _distance(sample.accel_m_s2, truth.accel_m_s2) / ACCEL_M_S2,
            _turn(sample, truth) / ANGLE_RAD,
        )


def _distance(a: Vector3 | None, b: Vector3) -> float:
    if a is None:  # the bus went down before the frame with this value
        return 0.0
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def _turn(sample: Sample, truth: Truth) -> float:
    """Return the angle between two attitudes, rad."""
    if sample.quat_wxyz is None:
        return 0.0
    near, far = (
        sqrt(sum((x - sign * y) ** 2 for x, y in zip(sample.quat_wxyz, truth.quat_wxyz, strict=True)))
        for sign in (1, -1)
    )
    return 2 * min(near, far)
