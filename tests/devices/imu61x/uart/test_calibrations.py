"""The calibrations of an IMU61x on the simulated one."""

import pytest

from imud.contracts.action import Target
from imud.contracts.control.calibration import Kept
from imud.devices.imu61x.uart.calibrations import CALIBRATIONS
from imud.sim.imu61x.uart import Imu61xHardware
from imud.sim.physics.motion import Still
from tests.support.simulated_modules import Imu61xBench

TARGET = Target(None, 115200)


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_it_runs_to_its_end_and_is_saved(kind: str) -> None:
    calibration = CALIBRATIONS[kind]
    bench = Imu61xBench(hardware=Imu61xHardware(motion=Still()))
    bench.run(calibration.begin(TARGET))
    if calibration.kept is Kept.BY_SAVE:
        assert calibration.save is not None
        bench.run(calibration.save(TARGET))
