"""Every driver: options and settings as in the tables of the documents, counters and rates as in the manuals."""

import pytest

from imud.contracts.driver import SAMPLE_COUNTER, PolledDriver, StreamDriver
from imud.contracts.setting import Effect
from imud.drivers import DRIVERS
from imud.model.units import NS_PER_MS, NS_PER_US
from tests.support.documented import accepts, check_schema, check_values, rows

every_driver = pytest.mark.parametrize("name", DRIVERS)


@every_driver
def test_options_accept_the_documented_values(name: str) -> None:
    check_schema(f"Options of driver `{name}`", DRIVERS[name].settings)


@every_driver
def test_settings_accept_the_documented_values(name: str) -> None:
    table = DRIVERS[name].device_settings
    found = rows("settings.md", f"`{name}`")
    assert bool(found) == (table is not None and bool(table.table))
    for row in found:
        assert table is not None
        setting, in_force = table.table[row.name], row.cells[0]
        check_values(row, setting.type)
        assert (setting.write is None) == (in_force == "read only"), row.name
        assert (setting.effect is Effect.AFTER_RESTART) == ("after save and restart" in in_force), row.name
        assert setting.readable == ("not readable" not in in_force), row.name
        assert setting.connection == ("last" in in_force), row.name


def test_alarm_angles_are_within_half_a_turn() -> None:
    """A roll angle is between -180° and 180° (section 9.1), so an alarm outside this range could not occur."""
    table = DRIVERS["hipnuc-uart"].device_settings
    assert table is not None
    for low, high, is_valid in ((-180, 180, True), (-181, 180, False), (-180, 181, False)):
        alarm = {"x": {"min_deg": low, "max_deg": high}}
        assert accepts(table.table["alarm"].type, alarm) == is_valid


COUNTERS = {
    "hipnuc-uart": (NS_PER_MS, 1 << 32, 8192),  # 3.3.1: system_time is uint32 in ms, pps_sync_stamp rolls over at 8192
    "hipnuc-modbus": (NS_PER_MS, 1 << 32, 0),  # the registers of the system time, as the serial port
    "imu61x-uart": (NS_PER_US, 1 << 32, 0),  # table 4: timer is uint32 in µs
    "imu61x-can": (SAMPLE_COUNTER, 1 << 16, 0),  # table 33 and note 1: INDEX has 16 bits and counts frames
}
"""Tick, modulus of the counter, and modulus of the PPS time stamp, for the protocols with a counter."""


@every_driver
def test_counters_have_the_width_of_the_manual(name: str) -> None:
    driver = DRIVERS[name]
    found = driver.tick_ns, driver.tick_modulus, driver.stamp_modulus
    assert found == COUNTERS.get(name, (SAMPLE_COUNTER, 2, 0))


@pytest.mark.parametrize(
    ("name", "rates"),
    [
        # 2.2.3, and 230400 of 3.7
        ("hipnuc-uart", {9600, 115_200, 230_400, 256_000, 460_800, 921_600}),
        ("imu61x-uart", {115_200, 230_400, 460_800, 921_600, 1_500_000}),  # table 9
    ],
)
@pytest.mark.manual("A 1.1 rates")
def test_detection_tries_the_rates_of_the_manual(name: str, rates: set[int]) -> None:
    driver = DRIVERS[name]
    assert isinstance(driver, StreamDriver)
    assert driver.baud_rates[0] == 115_200  # factory value of both families
    assert sorted(driver.baud_rates) == sorted(rates)


@pytest.mark.parametrize(
    ("name", "targets"),
    [
        ("imu61x-i2c", (0x18, 0x19, 0x1A, 0x1B)),  # table 12
        ("imu61x-spi", (0, 3)),  # rising edge: mode 0 (idle low, table 15) or mode 3
        ("hipnuc-modbus", (80, *range(1, 80), *range(81, 248))),  # factory address, then all addresses of Modbus
    ],
)
def test_detection_tries_the_addresses_of_the_manual(name: str, targets: tuple[int, ...]) -> None:
    driver = DRIVERS[name]
    assert isinstance(driver, PolledDriver)
    assert driver.targets == targets
