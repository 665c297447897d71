"""The filter action of the drivers on I2C and SPI, with the simulated device."""

from collections.abc import Callable, Mapping

import msgspec
import pytest

from imud.contracts.command import Target
from imud.contracts.driver import PolledDriver
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import values_of
from imud.drivers.imu61x.i2c import DRIVER as I2C
from imud.drivers.imu61x.registers import RegisterOptions
from imud.drivers.imu61x.spi import DRIVER as SPI
from imud.drivers.imu61x.spi import SpiDeviceOptions
from imud.model.errors import BadArgument, DeviceRefused
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.support.old_spellings import script_of
from tests.support.simulated_modules import over_i2c, over_spi


class Wires:
    """One device on both buses."""

    def __init__(self) -> None:
        self.device = Imu61xRegisters(lambda: 0)
        self.transfers = 0

    def act(self, driver: PolledDriver, settings: RegisterOptions, **given: object) -> object:
        return run_transfer_script(script_of(driver, Target(settings, 0), "filter", given), self.over(driver))

    def over(self, driver: PolledDriver) -> Callable[[Transfer], bytes]:
        """Make transfers on the bus of the driver."""

        def transfer(one: Transfer) -> bytes:
            self.transfers += 1
            return (over_i2c if driver is I2C else over_spi)(self.device, one)

        return transfer


BUSES = [(I2C, RegisterOptions()), (SPI, SpiDeviceOptions())]


@pytest.mark.parametrize(("driver", "settings"), BUSES)
def test_filters_are_set_and_answered(driver: PolledDriver, settings: RegisterOptions) -> None:
    wires = Wires()
    wires.act(driver, settings, accel_filter=4)
    assert wires.device.filter == 0x4B
    wires.act(driver, settings, gyro_filter=0)
    assert wires.device.filter == 0x40


@pytest.mark.parametrize("driver", [I2C, SPI])
def test_configured_filters_stay(driver: PolledDriver) -> None:
    """The daemon writes the options again, so another value would last at most ten seconds."""
    settings = driver.settings(gyro_filter=3)
    wires = Wires()
    with pytest.raises(
        BadArgument, match=r"gyro_filter: expected 5 Hz \(code 3\) from `options.gyro_filter`, got 10 Hz"
    ):
        wires.act(driver, settings, gyro_filter=4)  # type: ignore[arg-type]  # the driver's own settings
    assert wires.transfers == 0
    wires.act(driver, settings, gyro_filter=3, accel_filter=4)  # type: ignore[arg-type]  # the same
    assert wires.device.filter == 0x43
    settings = msgspec.convert({"gyro_filter": "5 Hz"}, driver.settings)
    wires = Wires()
    wires.act(driver, settings, gyro_filter=3, accel_filter="average 16")  # type: ignore[arg-type]  # the driver's own
    assert wires.device.filter == 0xD3


@pytest.mark.parametrize("code", [-1, 16, "48 Hz", "47", 1.5])
def test_filters_that_there_are_not_are_answered_with_the_table(code: object) -> None:
    names = r'one of "0\.2 Hz", "1 Hz", "2 Hz", .*"47 Hz", "average 4", "average 16", .* or a whole number from 0 to 15'
    with pytest.raises(BadArgument, match=f"accel_filter.*{names}"):
        script_of(I2C, Target(RegisterOptions(), 0), "filter", {"accel_filter": code})


def read_table(wires: Wires, driver: PolledDriver, target: Target) -> Mapping[str, object]:
    assert driver.device_settings is not None
    return values_of(run_transfer_script(driver.device_settings.read(target, None), wires.over(driver)))


@pytest.mark.parametrize(("driver", "settings"), BUSES)
def test_each_filter_is_a_setting_of_its_own(driver: PolledDriver, settings: RegisterOptions) -> None:
    wires, target = Wires(), Target(settings, 0)
    table = driver.device_settings
    assert table is not None
    before = read_table(wires, driver, target)
    assert (before["accel_filter"], before["gyro_filter"]) == ("47 Hz", "47 Hz")
    assert (table.save, table.restart) == (None, None)
    for name, value, control in (("accel_filter", "10 Hz", 0x4B), ("gyro_filter", 3, 0x43)):
        one = table.table[name]
        assert one.write is not None
        run_transfer_script(one.write(target, value), wires.over(driver))
        assert wires.device.filter == control
        assert one.agrees(value, read_table(wires, driver, target)[name])
    assert not table.table["gyro_filter"].agrees("10 Hz", "5 Hz")
    wires = Wires()
    wires.device.filter, wires.device.extended = 0x12, 1
    found = read_table(wires, driver, Target(settings, 0))
    assert found == {"accel_filter": "1 Hz", "gyro_filter": "2 Hz"} | ({"burst": "extended"} if driver is SPI else {})
    assert (wires.device.filter, wires.device.extended, wires.device.window) == (0x12, 1, 0)


@pytest.mark.parametrize("driver", [I2C, SPI])
def test_a_setting_that_options_fix_otherwise_is_refused_and_one_that_is_not_taken_too(driver: PolledDriver) -> None:
    wires, table = Wires(), driver.device_settings
    assert table is not None
    write = table.table["gyro_filter"].write
    assert write is not None
    fixed = Target(msgspec.convert({"gyro_filter": "5 Hz"}, driver.settings), 0)
    with pytest.raises(BadArgument, match=r"options\.gyro_filter"):
        run_transfer_script(write(fixed, "10 Hz"), wires.over(driver))
    with pytest.raises(BadArgument, match=r"gyro_filter: expected 5 Hz .*`options\.gyro_filter`.* got 10 Hz"):
        table.check(fixed, {"gyro_filter": "10 Hz"})
    table.check(fixed, {"gyro_filter": 3, "accel_filter": "10 Hz"})
    table.check(Target(driver.settings(), 0), {"gyro_filter": "10 Hz"})
    wires.device.faults.ignores_writes = True
    with pytest.raises(DeviceRefused, match="FILTER_CTRL: expected 0xb4 after the write, got 0xbb"):
        run_transfer_script(write(Target(driver.settings(), 0), "10 Hz"), wires.over(driver))
