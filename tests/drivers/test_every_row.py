"""Every driver, from its row in DRIVERS: the row, its examples, its calibrations and its data sheet are complete.
Options and settings are as in the tables of the documents, counters and rates as in the manuals."""

import pytest

from imud.contracts import driver as contract
from imud.contracts.command import Calibration, Handling, Kept, Risk
from imud.contracts.driver import PolledDriver, StreamDriver
from imud.contracts.setting import Effect
from imud.drivers import DRIVERS
from imud.model.units import NS_PER_MS, NS_PER_US, RAD_PER_DEG
from tests.support.documented import accepts, check_schema, check_values, rows

every_driver = pytest.mark.parametrize("name", DRIVERS)


@every_driver
def test_rows_have_their_name_and_a_data_sheet(name: str) -> None:
    assert DRIVERS[name].name == name
    sheet = DRIVERS[name].data_sheet
    assert "manual" in sheet.document
    assert "no noise figures" in sheet.document
    assert not sheet.models
    assert sheet.figures_of("HI14") is None


@every_driver
def test_verbs_that_restart_change_or_save(name: str) -> None:
    verbs = DRIVERS[name].verbs
    restarting = {"restart", "factory_reset", "nmt"}
    assert {verb for verb, one in verbs.items() if one.restarts} == restarting & set(verbs)
    saving = {"save", "factory_reset"} if name == "imu61x-uart" else {"save"}
    assert {verb for verb, one in verbs.items() if one.saves} == saving & set(verbs)
    calibrating = {"calibrate_gyro", "calibrate_installation"}
    changing = {"wake", "level", "reset_attitude", "zero", "start_streaming", "stop_streaming"} | calibrating
    assert {verb for verb, one in verbs.items() if one.changes and not one.restarts} == changing & set(verbs)
    assert {verb for verb, one in verbs.items() if one.risk is Risk.RESET} == {"factory_reset"} & set(verbs)


FLAGS = ("connection", "saves", "bus_rate", "unreadable", "after restart", "read only")
FLAGGED = {
    "hipnuc-uart": ("baud", "baud", "", "output_enabled", "mounting coordinates", "magnetometer_bias"),
    "hipnuc-modbus": ("baud address", "", "baud", "mounting", "mounting baud", ""),
    "hipnuc-canopen": ("bit_rate node", "", "bit_rate", "", "bit_rate node", ""),
    "hipnuc-j1939": ("bit_rate address", "", "bit_rate", "", "bit_rate address", ""),
    "imu61x-uart": ("baud", "", "", "", "", "gyro_offset_deg_s installation_angles_deg"),
}


@pytest.mark.parametrize("name", FLAGGED)
def test_settings_that_need_more_than_a_write(name: str) -> None:
    device_settings = DRIVERS[name].device_settings
    assert device_settings is not None
    found: dict[str, list[str]] = {flag: [] for flag in FLAGS}
    for setting, one in device_settings.table.items():
        has = one.connection, one.saves, one.bus_rate, not one.readable, one.effect is Effect.AFTER_RESTART
        for flag, is_set in zip(FLAGS, (*has, one.write is None), strict=True):
            found[flag] += [setting] * is_set
    assert tuple(map(" ".join, found.values())) == FLAGGED[name]


EVERY = [
    pytest.param(driver.name, kind, one, id=f"{driver.name} {kind}")
    for driver in DRIVERS.values()
    for kind, one in driver.calibrations.items()
]


def test_calibrations_filters_steps_on_the_wire_and_figures_by_the_longest_begin_of_a_name() -> None:
    for name, limit_deg in (("hipnuc-modbus", 15), ("hipnuc-uart", 5)):  # sections 4.3.5 and 2.2.4
        assert f"within {limit_deg}° of level" in DRIVERS[name].calibrations["accelerometer_level"].help
    assert {name for name, driver in DRIVERS.items() if driver.calibrations} == {
        "hipnuc-uart", "hipnuc-modbus", "hipnuc-canopen", "hipnuc-j1939", "hipnuc-canfd", "imu61x-uart",
    }  # fmt: skip

    for name in (name for name in DRIVERS if name.startswith("imu61x")):
        words = DRIVERS[name].data_sheet.filter_words
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "gyro") == "low-pass 10 Hz"
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "accel") == "low-pass average 16"
        assert words({}, "accel") == "low-pass 47 Hz (factory setting; imud has not read the filter)"
    assert DRIVERS["hipnuc-uart"].data_sheet.filter_words({}, "gyro") == ""

    for name, gyro, accel in (
        ("hipnuc-modbus", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8),
        ("hipnuc-j1939", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8), ("hipnuc-canopen", 0.1 * RAD_PER_DEG, 0.001 * 9.8),
        ("hipnuc-uart", None, None), ("imu61x-spi", None, None),
    ):  # fmt: skip
        sheet = DRIVERS[name].data_sheet
        assert sheet.gyro_step_rad_s == (None if gyro is None else pytest.approx(gyro))
        assert sheet.accel_step_m_s2 == (None if accel is None else pytest.approx(accel))


@pytest.mark.parametrize(("_driver", "kind", "calibration"), EVERY)
def test_calibrations_are_complete(_driver: str, kind: str, calibration: Calibration) -> None:
    assert kind.isidentifier()
    assert calibration.help[0].islower()
    assert not calibration.help.endswith(".")
    assert calibration.section
    assert calibration.instructions
    assert all(sentence.endswith(".") for sentence in calibration.instructions)
    assert (calibration.save is not None) == (calibration.kept is Kept.BY_SAVE)
    if calibration.handling is Handling.TURN:
        assert calibration.verdict is not None
        assert not calibration.expected
    assert all(expectation.limit > 0 for expectation in calibration.expected)


@every_driver
def test_settings_options_and_counters_are_as_documented(name: str) -> None:
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
    driver = DRIVERS[name]
    check_schema(f"Options of driver `{name}`", driver.settings)
    found_counters = driver.tick_ns, driver.tick_modulus, driver.stamp_modulus
    assert found_counters == COUNTERS.get(name, (contract.SAMPLE_COUNTER, 2, 0))


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
    "hipnuc-canfd": (NS_PER_MS, 1 << 32, 0),  # FF5A has uint32 in ms; imud uses the ms of the uint64 of FF5B
    "imu61x-uart": (NS_PER_US, 1 << 32, 0),  # table 4: timer is uint32 in µs
    "imu61x-can": (contract.SAMPLE_COUNTER, 1 << 16, 0),  # table 33 and note 1: INDEX has 16 bits and counts frames
}
"""Tick, modulus of the counter, and modulus of the PPS time stamp, for the protocols with a counter."""


@pytest.mark.manual("A 1.1 rates")
def test_detection_tries_the_rates_and_addresses_of_the_manual() -> None:
    for name, rates in (
        # 2.2.3, and 230400 of 3.7
        ("hipnuc-uart", {9600, 115_200, 230_400, 256_000, 460_800, 921_600}),
        ("imu61x-uart", {115_200, 230_400, 460_800, 921_600, 1_500_000}),  # table 9
    ):
        driver = DRIVERS[name]
        assert isinstance(driver, StreamDriver)
        assert driver.baud_rates[0] == 115_200  # factory value of both families
        assert sorted(driver.baud_rates) == sorted(rates)
    for name, targets in (
        ("imu61x-i2c", (0x18, 0x19, 0x1A, 0x1B)),  # table 12
        ("imu61x-spi", (0, 3)),  # rising edge: mode 0 (idle low, table 15) or mode 3
        ("hipnuc-modbus", (80, *range(1, 80), *range(81, 248))),  # factory address, then all addresses of Modbus
    ):
        driver = DRIVERS[name]
        assert isinstance(driver, PolledDriver)
        assert driver.targets == targets
