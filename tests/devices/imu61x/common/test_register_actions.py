"""Named actions of an IMU61x on a polled bus, on the simulated one."""

from collections.abc import Callable

import pytest

from imud.contracts.action import Target
from imud.contracts.polling import PolledDriver, Transfer, run_transfer_script
from imud.devices.imu61x.common.registers import RegisterSettings
from imud.devices.imu61x.i2c import codec as i2c
from imud.devices.imu61x.spi import codec as spi
from imud.errors import BadArgument
from imud.sim.imu61x.registers import Imu61xRegisters

I2C: PolledDriver = i2c.DRIVER
SPI: PolledDriver = spi.DRIVER


class Wires:
    """One device that hangs on both buses."""

    def __init__(self) -> None:
        self.device = Imu61xRegisters(lambda: 0)
        self.transfers = 0

    def act(self, driver: PolledDriver, settings: RegisterSettings, **given: object) -> object:
        action = driver.actions["filter"]
        transfer: Callable[[Transfer], bytes] = self._i2c if driver is I2C else self._spi
        return run_transfer_script(action.script(Target(settings, 0), action.arguments(given)), transfer)

    def _i2c(self, one: Transfer) -> bytes:
        self.transfers += 1
        return self.device.i2c([*one.sends, one.read_bytes] if one.read_bytes else [*one.sends])

    def _spi(self, one: Transfer) -> bytes:
        self.transfers += 1
        return b"".join(self.device.spi(one.sends))


BUSES = [(I2C, RegisterSettings()), (SPI, spi.SpiDeviceSettings())]


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
