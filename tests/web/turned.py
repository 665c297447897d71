"""A device with a magnetometer that rotates into all directions, in real time, for tests and pictures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic_ns
from typing import Final

from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from imud.sim.physics import Sine, Swing
from tests.support.daemon_process import RunningDaemon, running_daemon
from tests.support.pty_port import plugged

SPEED: Final = 8
"""Speed relative to a hand: all directions within a few seconds."""
HARD_IRON_T: Final = (14.14e-6, -2.08e-6, -8.75e-6)
BIAS: Final = "bias 14.14, -2.08, -8.75 µT"


@contextmanager
def turned_module(folder: Path, speed: float = SPEED) -> Iterator[RunningDaemon]:
    """A daemon with a rotating device `bow` in 9-axis mode, with iron near it."""
    motion = Swing(roll=(Sine(3.1, 0.043 * speed),), pitch=(Sine(1.4, 0.071 * speed),), yaw=(Sine(3.1, 0.037 * speed),))
    hardware = HipnucHardware(motion=motion, hard_iron_t=HARD_IRON_T)
    module = HipnucModule(monotonic_ns(), ModuleSettings(att_mode=1), hardware)
    with plugged(folder / "port", module) as path:
        devices = {"bow": {"driver": "hipnuc-uart", "uart": {"port": str(path), "baud": 115200}}}
        with running_daemon(folder, devices, python=()) as daemon:
            daemon.wait_for("bow", "running")
            yield daemon
