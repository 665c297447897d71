"""Units of data sheets compared with values by hand, and the format of numbers."""

import pytest

from imud.analysis.quantities import ACCEL, GYRO, QUANTITIES, figure_text


def unit_of(sensor: str, key: str, place: int = 0) -> float:
    quantities = GYRO if sensor == "gyro" else ACCEL
    return next(one for one in quantities if one.key == key).units[place].factor


def test_units_and_digits() -> None:
    # 1 deg/√h = 1 deg / 60 √s: 2.9088821e-4 rad/√s
    assert 2.9088821e-4 * unit_of("gyro", "random_walk") == pytest.approx(1.0, rel=1e-7)
    # 1 deg/h = π / 180 / 3600: 4.8481368e-6 rad/s
    assert 4.8481368e-6 * unit_of("gyro", "bias_instability") == pytest.approx(1.0, rel=1e-7)
    # 1 deg/h/√h = 4.8481368e-6 / 60
    assert 8.0802280e-8 * unit_of("gyro", "rate_random_walk") == pytest.approx(1.0, rel=1e-7)
    # 1 deg/h/h = 4.8481368e-6 / 3600
    assert 1.3467047e-9 * unit_of("gyro", "rate_ramp") == pytest.approx(1.0, rel=1e-7)
    assert 0.017453293 * unit_of("gyro", "noise_density") == pytest.approx(1.0, rel=1e-7)
    assert unit_of("accel", "random_walk") / 60 == pytest.approx(1.0), "1 m/s/√h = 1 m/s / 60 √s"
    assert 9.80665e-6 * unit_of("accel", "random_walk", 1) == pytest.approx(1.0)
    assert 9.80665e-3 * unit_of("accel", "bias_instability") == pytest.approx(1.0)
    assert 9.80665e-6 * unit_of("accel", "noise_density") == pytest.approx(1.0)
    assert 9.80665e-3 / 60 * unit_of("accel", "rate_random_walk") == pytest.approx(1.0)
    gyro, accel = ([one.key for one in QUANTITIES[name]] for name in QUANTITIES)
    assert gyro == accel
    values = (0.0, 0.34321, 12345.6, 1e-5, -9.81, 2e7)
    assert [figure_text(value) for value in values] == ["0", "0.343", "12346", "1.00e-5", "-9.81", "2.00e7"]
