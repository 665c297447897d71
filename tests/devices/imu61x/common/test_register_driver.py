"""The filter action that the drivers on I2C and SPI share, against the simulated device."""

import pytest

from imud.contracts.action import Target
from imud.contracts.polling import PolledDriver, Transfer, run_transfer_script
from imud.devices.imu61x.common.register_driver import RegisterSettings
from imud.devices.imu61x.i2c.driver import DRIVER as I2C
from imud.devices.imu61x.spi.driver import DRIVER as SPI
from imud.devices.imu61x.spi.session import SpiDeviceSettings
from imud.errors import BadArgument
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.support.simulated_modules import over_i2c, over_spi


class Wires:
    """One device that hangs on both buses."""

    def __init__(self) -> None:
        self.device = Imu61xRegisters(lambda: 0)
        self.transfers = 0

    def act(self, driver: PolledDriver, settings: RegisterSettings, **given: object) -> object:
        action = driver.actions["filter"]

        def transfer(one: Transfer) -> bytes:
            self.transfers += 1
            return (over_i2c if driver is I2C else over_spi)(self.device, one)

        return run_transfer_script(action.script(Target(settings, 0), action.arguments(given)), transfer)


BUSES = [(I2C, RegisterSettings()), (SPI, SpiDeviceSettings())]


@pytest.mark.parametrize(("driver", "settings"), BUSES)
def test_filters_are_set_and_answered(driver: PolledDriver, settings: RegisterSettings) -> None:
    wires = Wires()
    answer = wires.act(driver, settings, accel_filter=4)
    assert wires.device.filter == 0x4B
    assert isinstance(answer, dict)
    assert (answer["accel_filter"], answer["gyro_filter"]) == ("10 Hz", "47 Hz")
    wires.act(driver, settings, gyro_filter=0)
    assert wires.device.filter == 0x40


@pytest.mark.parametrize(("driver", "settings"), BUSES)
def test_nothing_given_writes_nothing(driver: PolledDriver, settings: RegisterSettings) -> None:
    wires = Wires()
    wires.act(driver, settings)
    assert wires.transfers == 1


@pytest.mark.parametrize("driver", [I2C, SPI])
def test_what_the_configuration_says_stays(driver: PolledDriver) -> None:
    """The daemon sets it up again as the options say, so another value would not last ten seconds."""
    settings = driver.settings(gyro_filter=3)
    wires = Wires()
    with pytest.raises(BadArgument, match=r"gyro_filter: expected 3, which `options.gyro_filter` says, got 4"):
        wires.act(driver, settings, gyro_filter=4)  # type: ignore[arg-type]  # the driver's own settings
    assert wires.transfers == 0
    wires.act(driver, settings, gyro_filter=3, accel_filter=4)  # type: ignore[arg-type]  # the same
    assert wires.device.filter == 0x43


@pytest.mark.parametrize("code", [-1, 16, "47 Hz", 1.5])
def test_codes_that_there_are_not(code: object) -> None:
    with pytest.raises(BadArgument, match="accel_filter"):
        I2C.actions["filter"].arguments({"accel_filter": code})
