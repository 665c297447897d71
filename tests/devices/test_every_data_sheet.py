"""What manuals state of noise, resolution and filters, for every driver."""

import pytest

from imud.contracts.sensors.data_sheet import DataSheet, ModelFigures, SensorFigures
from imud.devices import DRIVERS
from imud.units import RAD_PER_DEG


@pytest.mark.parametrize("name", sorted(DRIVERS))
def test_every_driver_names_its_manual_and_says_that_it_has_no_noise(name: str) -> None:
    sheet = DRIVERS[name].data_sheet
    assert "manual" in sheet.document
    assert "no figure of noise" in sheet.document
    assert not sheet.models
    assert sheet.figures_of("HI14") is None


@pytest.mark.parametrize(
    ("name", "gyro", "accel"),
    [
        ("hipnuc-modbus", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8),
        ("hipnuc-j1939", 0.061035 * RAD_PER_DEG, 0.00048828 * 9.8),
        ("hipnuc-canopen", 0.1 * RAD_PER_DEG, 0.001 * 9.8),
        ("hipnuc-uart", None, None),
        ("imu61x-spi", None, None),
    ],
)
def test_steps_on_the_wire(name: str, gyro: float | None, accel: float | None) -> None:
    sheet = DRIVERS[name].data_sheet
    assert sheet.gyro_step_rad_s == (None if gyro is None else pytest.approx(gyro))
    assert sheet.accel_step_m_s2 == (None if accel is None else pytest.approx(accel))


def test_filters_of_an_imu61x_and_of_hipnuc() -> None:
    for name in (name for name in DRIVERS if name.startswith("imu61x")):
        words = DRIVERS[name].data_sheet.filter_words
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "gyro") == "low-pass 10 Hz"
        assert words({"gyro_filter": "10 Hz", "accel_filter": "average 16"}, "accel") == "low-pass average 16"
        assert words({}, "accel") == "low-pass 47 Hz as delivered; it was not read back"
    assert DRIVERS["hipnuc-uart"].data_sheet.filter_words({}, "gyro") == ""


def test_the_longest_begin_of_a_name_counts() -> None:
    family, model = ModelFigures(source="a"), ModelFigures(gyro=SensorFigures(random_walk=1e-4), source="b")
    sheet = DataSheet(models={"HI": family, "HI14": model})
    assert sheet.figures_of("HI14R2N") is model
    assert sheet.figures_of("HI12") is family
    assert sheet.figures_of("CH100") is None
