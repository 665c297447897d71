"""Every driver, from its row in DRIVERS: the row, its examples, its calibrations and its data sheet are complete."""

from collections.abc import Callable
from random import Random

import msgspec
import pytest

from imud.contracts.command import Calibration, CalibrationInfo, Handling, Kept, Risk, infos
from imud.contracts.driver import CanDriver, DataSheet, Driver, ModelFigures, PolledDriver, SensorFigures, StreamDriver
from imud.contracts.setting import Effect
from imud.drivers import DRIVERS
from imud.model.units import RAD_PER_DEG

every_driver = pytest.mark.parametrize("name", DRIVERS)


def example_of(driver: Driver) -> Callable[[Random], object]:
    """Return the maker of examples: a frame, the frames of a sample, or the bytes of a poll."""
    if isinstance(driver, StreamDriver):
        return driver.example_frame
    if isinstance(driver, CanDriver):
        return driver.example_frames
    assert isinstance(driver, PolledDriver)
    return driver.example_reading


@every_driver
def test_rows_are_complete(name: str) -> None:
    driver = DRIVERS[name]
    assert driver.name == name
    assert driver.title
    assert driver.navigation_frame
    assert driver.euler_convention
    example = example_of(DRIVERS[name])
    assert example(Random(5)) == example(Random(5)) != example(Random(6))

    described = infos(DRIVERS[name].calibrations)
    assert msgspec.json.decode(msgspec.json.encode(described), type=list[CalibrationInfo]) == described

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
    changing = {"wake", "level", "zero", "start_streaming", "stop_streaming"} | calibrating
    assert {verb for verb, one in verbs.items() if one.changes and not one.restarts} == changing & set(verbs)
    assert {verb for verb, one in verbs.items() if one.risk is Risk.RESET} == {"factory_reset"} & set(verbs)


FLAGS = ("connection", "saves", "bus_rate", "unreadable", "after restart", "read only")
FLAGGED = {
    "hipnuc-uart": ("baud", "baud", "", "output_enabled", "mounting", "coordinates magnetometer_bias"),
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


def test_calibrations_filters_and_figures_by_the_longest_begin_of_a_name() -> None:
    for name, limit_deg in (("hipnuc-modbus", 15), ("hipnuc-uart", 5)):  # sections 4.3.5 and 2.2.4
        assert f"within {limit_deg}° of level" in DRIVERS[name].calibrations["accelerometer_level"].help
    assert {name for name, driver in DRIVERS.items() if driver.calibrations} == {
        "hipnuc-uart", "hipnuc-modbus", "hipnuc-canopen", "hipnuc-j1939", "imu61x-uart",
    }  # fmt: skip

    for name in (name for name in DRIVERS if name.startswith("imu61x")):
        words = DRIVERS[name].data_sheet.filter_words
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "gyro") == "low-pass 10 Hz"
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "accel") == "low-pass average 16"
        assert words({}, "accel") == "low-pass 47 Hz (factory setting; imud has not read the filter)"
    assert DRIVERS["hipnuc-uart"].data_sheet.filter_words({}, "gyro") == ""

    family, model = ModelFigures(source="a"), ModelFigures(gyro=SensorFigures(random_walk=1e-4), source="b")
    sheet = DataSheet(models={"HI": family, "HI14": model})
    assert sheet.figures_of("HI14R2N") is model
    assert sheet.figures_of("HI12") is family
    assert sheet.figures_of("CH100") is None


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


@pytest.mark.parametrize(
    ("name", "gyro", "accel"),
    [
        ("hipnuc-modbus", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8),
        ("hipnuc-j1939", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8), ("hipnuc-canopen", 0.1 * RAD_PER_DEG, 0.001 * 9.8),
        ("hipnuc-uart", None, None), ("imu61x-spi", None, None),
    ],
)  # fmt: skip
def test_steps_on_the_wire(name: str, gyro: float | None, accel: float | None) -> None:
    sheet = DRIVERS[name].data_sheet
    assert sheet.gyro_step_rad_s == (None if gyro is None else pytest.approx(gyro))
    assert sheet.accel_step_m_s2 == (None if accel is None else pytest.approx(accel))
