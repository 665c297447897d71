"""The magnetometer calibration that a simulated device runs without a command."""

from math import pi

import pytest

from imud.model.sample import Vector3
from imud.model.units import NS_PER_S
from imud.sim.hipnuc.uart_settings import CALIBRATED, NOT_CALIBRATED, HipnucHardware, ModuleSettings, SelfCalibration
from imud.sim.physics import tumble
from tests.support.simulated_modules import HipnucUartBench

HARD_IRON_T: Vector3 = (14.14e-6, -2.08e-6, -8.75e-6)
ZERO: Vector3 = (0.0, 0.0, 0.0)


@pytest.mark.manual("B 8.1.3 in the background", "B 8.2 EN_MCAL")
def test_one_turn_about_each_axis_is_enough() -> None:
    magnetometer = SelfCalibration(HARD_IRON_T, ZERO)
    assert magnetometer.measured((1e-6, 2e-6, 3e-6)) == pytest.approx((15.14e-6, -0.08e-6, -5.75e-6))
    for axis in range(3):
        assert magnetometer.found_t == ZERO
        assert (magnetometer.state, magnetometer.progress) == (NOT_CALIBRATED, 0.0)
        x, y, z = (pi / 2 if number == axis else 0.0 for number in range(3))
        for second in range(6):
            magnetometer.sample((axis * 6 + second) * NS_PER_S, (x, y, z))
    assert magnetometer.found_t == HARD_IRON_T
    assert (magnetometer.state, magnetometer.progress) == (CALIBRATED, 1.0)
    assert magnetometer.measured((1e-6, 2e-6, 3e-6)) == pytest.approx((1e-6, 2e-6, 3e-6))

    hardware = HipnucHardware(motion=tumble(), hard_iron_t=HARD_IRON_T)
    bench = HipnucUartBench(ModuleSettings(att_mode=1), hardware)
    assert "MB=0.00, 0.00, 0.00" in bench.ask("LOG MAGCONFIG")
    bench.wait(60_000)
    assert "MB=14.14, -2.08, -8.75" in bench.ask("LOG MAGCONFIG")
    bench.reboot()
    assert "MB=14.14, -2.08, -8.75" in bench.ask("LOG MAGCONFIG")  # the device has saved it without a command
    for settings in (ModuleSettings(att_mode=0), ModuleSettings(att_mode=1, mag_calibration=False)):
        bench = HipnucUartBench(settings, HipnucHardware(motion=tumble(), hard_iron_t=HARD_IRON_T))
        bench.wait(30_000)
        assert "MB=0.00, 0.00, 0.00" in bench.ask("LOG MAGCONFIG")
