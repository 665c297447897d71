"""Simulated modules on one CAN bus in a process of their own, and the truth to hold samples against."""

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
from imud.sim import CAN_SIMULATORS
from imud.sim.physics import Truth
from tests.lab.can_phase import LOOP_S, Phased

GYRO_RAD_S: Final = 0.004
ACCEL_M_S2: Final = 0.02
ANGLE_RAD: Final = 0.002
"""Some counts of the coarsest protocol, and less than the motion `swing` changes between two samples at 100 Hz."""
BEGIN_S: Final = 1.0
LATE_SAMPLES: Final = 12
"""So late may the first sample be, where the guest has stalled."""


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
        return {
            "driver": self.driver,
            "options": options,
            "identify": False,
            "socketcan": {"interface": interface},
        }


def fleet() -> list[Module]:
    """Four CANopen nodes, four J1939 nodes and one IMU61x; more IMU61x in place of what has no simulator."""
    spare = iter(range(201, 2000, 100))
    return [
        Module(driver, node) if driver in CAN_SIMULATORS and driver in DRIVERS else Module("imu61x-can", next(spare))
        for driver in ("hipnuc-canopen", "hipnuc-j1939")
        for node in (8, 9, 10, 11)
    ] + [Module("imu61x-can", 101)]


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
    """All modules in one process that nothing of ours can stall: it has the priority of a real bus."""
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
    """Holds the samples of one device against the truth of its motion, each at its own instant."""

    def __init__(self, number: int, first: Sample, rate_hz: float, begin_ns: int) -> None:
        """`number` of the module; `begin_ns` of the play. Finds the instant of the first sample, at or before its
        stamp, where the truth is nearest."""
        self._motion = Phased(number)
        self._rate_hz = rate_hz
        self._seq = first.seq
        latest = int((first.t_ns - begin_ns) * rate_hz / 1e9)
        self._first = min(
            range(latest, latest - LATE_SAMPLES, -1), key=lambda n: self._worst(first, self._instant_s(n))
        )

    def is_true(self, sample: Sample) -> bool:
        """Whether every value of the sample is of the instant that its number says."""
        return self._worst(sample, self._instant_s(self._first + sample.seq - self._seq)) <= 1

    def _instant_s(self, number: int) -> float:
        """The instant of a sample since the play began, in the module's own time."""
        return BEGIN_S + number / self._rate_hz % LOOP_S

    def _worst(self, sample: Sample, t_s: float) -> float:
        """The largest deviation from the truth at an instant, in units of what is allowed."""
        truth = self._motion.at(t_s)
        found = [
            _distance(sample.gyro_rad_s, truth.gyro_rad_s) / GYRO_RAD_S,
            _distance(sample.accel_m_s2, truth.accel_m_s2) / ACCEL_M_S2,
            _turn(sample, truth) / ANGLE_RAD,
        ]
        return max(found)


def _distance(a: Vector3 | None, b: Vector3) -> float:
    assert a is not None
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def _turn(sample: Sample, truth: Truth) -> float:
    """Angle between two attitudes, rad."""
    assert sample.quat_wxyz is not None
    near, far = (
        sqrt(sum((x - sign * y) ** 2 for x, y in zip(sample.quat_wxyz, truth.quat_wxyz, strict=True)))
        for sign in (1, -1)
    )
    return 2 * min(near, far)
