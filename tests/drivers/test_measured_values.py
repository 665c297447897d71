"""Values of a measurement from another package: a wrong type is an error, an impossible value is absent."""

from math import inf, nan
from typing import Any

import pytest
from msgspec.structs import replace

from imud.drivers.measured_values import WrongMeasurement, checked_measurement
from imud.model.sample import Measurement, Position

GOOD = Measurement(
    10, 0, 7, accel_m_s2=(0.0, 0.0, 9.8), gyro_rad_s=(0.1, 0.0, 0.0), mag_t=(1e-5, 0.0, 0.0),
    quat_wxyz=(1.0, 0.0, 0.0, 0.0), euler_rad=(0.0, 0.1, 3.0), temperature_c=20.0, pressure_pa=101_325.0,
    incli_rad=(0.0, 0.1), status=3, pps_age_ms=5, t_first_ns=9, velocity_enu_m_s=(1.0, 2.0, 3.0),
    position=Position(0.5, 0.2, 10.0, 1, 8), heave_m=0.5, gnss_utc_ns=1,
)  # fmt: skip
BIG = 10**400


class Odd(float):
    """A number that cannot be compared."""

    def __lt__(self, _other: object) -> bool:
        raise SystemExit(0)


def test_valid_measurement_is_unchanged() -> None:
    assert checked_measurement(GOOD, 8) == (GOOD, False)
    assert checked_measurement(Measurement(1, 0, None), 8) == (Measurement(1, 0, None), False)


@pytest.mark.parametrize("name", ["accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad", "velocity_enu_m_s"])
@pytest.mark.parametrize("value", [
    ("x", None), (1.0, 2.0), (1.0, 2.0, 3.0, 4.0), [1.0, 2.0, 3.0], "123", 5, b"abc", (1.0, 2.0, None),
    (1.0, True, 0.0),    (BIG, 0.0, 0.0), (1.0, 2.0, "3"), (1j, 0.0, 0.0), {}, object(),
], ids=lambda value: type(value).__name__ + str(value)[:12])  # fmt: skip
def test_wrong_vector(name: str, value: Any) -> None:
    with pytest.raises(WrongMeasurement, match=f"^{name}: expected "):
        checked_measurement(replace(GOOD, **{name: value}), 8)


@pytest.mark.parametrize(("name", "value"), [
    ("size_bytes", None), ("size_bytes", -1), ("size_bytes", 1.5), ("trailing_bytes", "1"), ("trailing_bytes", True),
    ("dev_ticks", 8), ("dev_ticks", -1), ("dev_ticks", 1.0), ("status", 1 << 32), ("status", "x"), ("pps_age_ms", -1),
    ("t_first_ns", BIG), ("gnss_utc_ns", BIG), ("gnss_utc_ns", 0.5), ("temperature_c", "warm"), ("pressure_pa", BIG),
    ("heave_m", (1.0,)), ("temperature_c", False), ("position", (1.0, 2.0)), ("position", Position("x", 0.0)),  # type: ignore[arg-type]
    ("position", Position(0.0, 0.0, "x")), ("position", Position(0.0, 0.0, 1.0, 255)),  # type: ignore[arg-type]
    ("position", Position(0.0, 0.0, 1.0, 1, 8.5)), ("incli_rad", (1.0,)), ("quat_wxyz", (1.0, 0.0, 0.0)),  # type: ignore[arg-type]
], ids=lambda value: str(value)[:20])  # fmt: skip
def test_wrong_value(name: str, value: Any) -> None:
    with pytest.raises(WrongMeasurement, match=r"expected .*, got "):
        checked_measurement(replace(GOOD, **{name: value}), 8)


@pytest.mark.parametrize(("name", "value"), [
    ("accel_m_s2", (nan, 0.0, 0.0)), ("gyro_rad_s", (0.0, inf, 0.0)), ("mag_t", (0.0, 0.0, -inf)),
    ("accel_m_s2", (1e300, 0.0, 0.0)), ("quat_wxyz", (2.0, 0.0, 0.0, 0.0)), ("quat_wxyz", (nan, 0.0, 0.0, 0.0)),
    ("euler_rad", (7.0, 0.0, 0.0)), ("incli_rad", (nan, 0.0)), ("velocity_enu_m_s", (0.0, nan, 0.0)),
    ("temperature_c", nan), ("temperature_c", 500), ("pressure_pa", -1.0), ("heave_m", inf),
    ("position", Position(nan, 0.0)), ("position", Position(0.0, 9.0)), ("position", Position(0.0, 0.0, inf)),
], ids=lambda value: str(value)[:30])  # fmt: skip
def test_impossible_value_is_absent(name: str, value: Any) -> None:
    measurement, is_dropped = checked_measurement(replace(GOOD, **{name: value}), 8)
    assert is_dropped
    assert measurement == replace(GOOD, **{name: None})


def test_other_numbers_become_floats() -> None:
    given = replace(GOOD, accel_m_s2=(1, Odd(2.0), 3.0), temperature_c=20)
    measurement, is_dropped = checked_measurement(given, 8)
    assert not is_dropped
    assert measurement.accel_m_s2 == (1.0, 2.0, 3.0)
    assert measurement.accel_m_s2 is not None
    assert {type(value) for value in (*measurement.accel_m_s2, measurement.temperature_c)} == {float}
