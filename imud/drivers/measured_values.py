"""Check of the values of a measurement from a driver of another package: types, lengths and ranges.

The drivers of imud decode fixed layouts and limit the values themselves (`value_limits.py`).
"""

from collections.abc import Callable
from math import isfinite
from typing import Any, Final

import msgspec

from imud.drivers.value_limits import (
    ACCEL_LIMIT_G,
    GYRO_LIMIT_DEG_S,
    HEAVE_LIMIT_M,
    HEIGHT_LIMIT_M,
    MAG_LIMIT_UT,
    TEMPERATURE_LIMITS_C,
    TURN_RAD,
    VELOCITY_LIMIT_M_S,
    are_within,
    possible_quaternion,
)
from imud.model.sample import Measurement, Position
from imud.model.units import RAD_PER_DEG, STANDARD_GRAVITY_M_S2, T_PER_UT

SIZE_MAX: Final = 1 << 20  # maximum length of a frame and of the bytes after it in one read
U32_MAX: Final = 0xFFFF_FFFF  # `status` and `pps_age_ms` have 32 bits in all outputs
TIME_MAX: Final = 1 << 62  # times in ns; arithmetic with them stays within 64 bits
COUNT_MAX: Final = 254  # `quality` and `satellites` of a position: 255 means absent in a slot
PRESSURE_LIMIT_PA: Final = 1e6  # ten times the pressure at sea level


class WrongMeasurement(Exception):
    """Value of a wrong type, length or range."""


# Number of values of each vector, and the limit of their magnitude
_VECTORS: Final[dict[str, tuple[int, float]]] = {
    "accel_m_s2": (3, ACCEL_LIMIT_G * STANDARD_GRAVITY_M_S2),
    "gyro_rad_s": (3, GYRO_LIMIT_DEG_S * RAD_PER_DEG),
    "mag_t": (3, MAG_LIMIT_UT * T_PER_UT),
    "quat_wxyz": (4, 2.0),
    "euler_rad": (3, TURN_RAD),
    "incli_rad": (2, TURN_RAD),
    "velocity_enu_m_s": (3, VELOCITY_LIMIT_M_S),
}
_LOW_C, _HIGH_C = TEMPERATURE_LIMITS_C
# Whether a finite number is possible
_NUMBERS: Final[dict[str, Callable[[float], bool]]] = {
    "temperature_c": lambda value: _LOW_C < value <= _HIGH_C,
    "pressure_pa": lambda value: 0 <= value < PRESSURE_LIMIT_PA,
    "heave_m": lambda value: are_within((value,), HEAVE_LIMIT_M),
}
# Minimum and maximum of each integer; None: it may be absent
_INTEGERS: Final[dict[str, tuple[int, int, bool]]] = {
    "size_bytes": (0, SIZE_MAX, False),
    "trailing_bytes": (0, SIZE_MAX, False),
    "status": (0, U32_MAX, True),
    "pps_age_ms": (0, U32_MAX, True),
    "t_first_ns": (0, TIME_MAX, True),
    "gnss_utc_ns": (-TIME_MAX, TIME_MAX, True),
}


def checked_measurement(measurement: Measurement, tick_modulus: int) -> tuple[Measurement, bool]:
    """Return a measurement with valid values, and whether it had impossible values: NaN, infinity, or values beyond the
    limits. Such a value is absent in the result. Raises WrongMeasurement for a wrong type, length or integer."""
    for name, (low, high, may_be_absent) in _INTEGERS.items():
        _check_integer(name, getattr(measurement, name), low, high, may_be_absent)
    _check_integer("dev_ticks", measurement.dev_ticks, 0, tick_modulus - 1, True)

    changes: dict[str, Any] = {}
    for name, (length, limit) in _VECTORS.items():
        value = getattr(measurement, name)
        if value is not None:
            vector = _vector(name, value, length, limit)
            if vector is not value:
                changes[name] = vector
    for name, is_possible in _NUMBERS.items():
        value = getattr(measurement, name)
        if value is not None:
            number = _number(name, value)
            is_valid = isfinite(number) and is_possible(number)
            if not is_valid or number is not value:
                changes[name] = number if is_valid else None
    if measurement.position is not None:
        position = _position(measurement.position)
        if position is not measurement.position:
            changes["position"] = position

    if not changes:
        return measurement, False
    return msgspec.structs.replace(measurement, **changes), None in changes.values()


def _check_integer(name: str, value: object, low: int, high: int, may_be_absent: bool) -> None:
    if value is None and may_be_absent:
        return
    # the type first: a subclass of int can compare as it likes
    if type(value) is not int or not low <= value <= high:
        raise WrongMeasurement(f"{name}: expected an integer from {low} to {high}, got {_shown(value)}")


def _number(name: str, value: object) -> float:
    if type(value) is float:
        return value
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except BaseException as error:
            raise WrongMeasurement(f"{name}: expected a number, got {_shown(value)}") from error
    raise WrongMeasurement(f"{name}: expected a number, got {_shown(value)}")


def _vector(name: str, value: object, length: int, limit: float) -> tuple[float, ...] | None:
    """Return a vector of floats; None if a value is not finite or not possible."""
    if type(value) is not tuple or len(value) != length:
        raise WrongMeasurement(f"{name}: expected a tuple of {length} numbers, got {_shown(value)}")
    vector = value
    if not all(type(part) is float for part in value):
        vector = tuple(_number(name, part) for part in value)
    if not are_within(vector, limit):
        return None
    if name == "quat_wxyz" and possible_quaternion(*vector) is None:
        return None
    return vector


def _position(position: object) -> Position | None:
    """Return a position; None if an angle is not possible."""
    if type(position) is not Position:
        raise WrongMeasurement(f"position: expected a Position, got {_shown(position)}")
    angles = _number("latitude_rad", position.latitude_rad), _number("longitude_rad", position.longitude_rad)
    height = None if position.height_m is None else _number("height_m", position.height_m)
    _check_integer("quality", position.quality, 0, COUNT_MAX, True)
    _check_integer("satellites", position.satellites, 0, COUNT_MAX, True)
    if not are_within(angles, TURN_RAD) or (height is not None and not are_within((height,), HEIGHT_LIMIT_M)):
        return None
    if (*angles, height) == (position.latitude_rad, position.longitude_rad, position.height_m):
        return position
    return Position(*angles, height, position.quality, position.satellites)


def _shown(value: object) -> str:
    try:
        return repr(value)[:120]
    except BaseException:  # noqa: BLE001 - foreign code can raise any exception
        return f"a {type(value).__name__} that cannot be printed"
