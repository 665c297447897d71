"""Limits of the values that a device sends. A value outside is not a measurement.

A damaged device or a hostile frame with a correct check value can send any 32-bit float. The limits are above the
ranges in the manuals: the widest field of an acceleration and of an angular rate is CANopen with ±32.77 g and ±3277 °/s
(manual B, section 5.1; most sensors have ±16 g and ±2000 °/s), the widest field of a magnetic field is HI92 with ±1000
µT (section 3.3.2). No sensor measures a temperature outside -128 … 150 °C. An angle beyond a full turn is not an angle.
A quaternion is a rotation only if its length is 1.
"""

from collections.abc import Sequence
from typing import Final, TypeVar

from imud.model.sample import Quaternion, Vector3
from imud.model.units import RAD_PER_DEG

# Magnitudes that no sensor reaches
ACCEL_LIMIT_G: Final = 40.0
GYRO_LIMIT_DEG_S: Final = 4000.0
MAG_LIMIT_UT: Final = 4000.0
VELOCITY_LIMIT_M_S: Final = 1000.0
HEIGHT_LIMIT_M: Final = 100_000.0
HEAVE_LIMIT_M: Final = 100.0
TEMPERATURE_LIMITS_C: Final = (-128.0, 150.0)  # a measured temperature is above the first value, up to the second, °C
TURN_DEG: Final = 360.001  # no angle reaches this magnitude: a full turn with its rounding
TURN_RAD: Final = TURN_DEG * RAD_PER_DEG
# Limits of the squared length of a rotation: 0.98² and 1.02². Rounding to 16 bits changes the length by 1e-4.
QUAT_SQUARE_MIN, QUAT_SQUARE_MAX = 0.9604, 1.0404


def are_within(values: Sequence[float], limit: float) -> bool:
    """Return whether the magnitude of all values is below `limit`. NaN is outside."""
    return all(-limit < value < limit for value in values)


def scaled(values: Sequence[float], factor: float, limit: float) -> Vector3 | None:
    """Return three values times `factor`; None if the magnitude of one is not below `limit`."""
    x, y, z = values
    # `are_within` without a call, which costs as much as the rest of a frame. The first sum is the usual case: if it is
    # below the square of the limit, every value is below the limit.
    if x * x + y * y + z * z < limit * limit or (-limit < x < limit and -limit < y < limit and -limit < z < limit):
        return (x * factor, y * factor, z * factor)
    return None


def possible_temperature_c(temperature_c: float) -> float | None:
    """Return a temperature, °C; None if it is not possible."""
    low_c, high_c = TEMPERATURE_LIMITS_C
    return temperature_c if low_c < temperature_c <= high_c else None


_Angles = TypeVar("_Angles", bound=tuple[float, ...])


def possible_angles(angles_rad: _Angles) -> _Angles | None:
    """Return finite angles, rad; None if one is beyond a full turn."""
    return angles_rad if max(map(abs, angles_rad)) < TURN_RAD else None


def possible_quaternion(w: float, x: float, y: float, z: float) -> Quaternion | None:
    """Return a quaternion; None if its length shows that it is not a rotation."""
    return (w, x, y, z) if QUAT_SQUARE_MIN < w * w + x * x + y * y + z * z < QUAT_SQUARE_MAX else None
