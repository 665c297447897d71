"""Limits of the values that a device sends. A value outside is not a measurement.

A damaged device or a hostile frame with a correct check value can send any 32-bit float. No inertial sensor measures
131,072 g, °/s or µT, or a temperature outside -128 … 150 °C. VALUE_LIMIT is a power of two: the high byte of a float
shows whether the value is inside, so that one call checks all values of many frames, also an air pressure in Pa. An
angle beyond a full turn is not an angle. A quaternion is a rotation only if its length is 1.
"""

from collections.abc import Sequence
from typing import Final, TypeVar

from imud.model.sample import Quaternion, Vector3
from imud.model.units import RAD_PER_DEG

VALUE_LIMIT: Final = 131_072.0  # magnitude that no value reaches, in g, °/s, µT or Pa
TEMPERATURE_LIMITS_C: Final = (-128.0, 150.0)  # a measured temperature is above the first value, up to the second, °C
TURN_DEG: Final = 360.001  # no angle reaches this magnitude: a full turn with its rounding
TURN_RAD: Final = TURN_DEG * RAD_PER_DEG
# Squared length of three angles, degrees, below which no angle is beyond a full turn: one comparison in a fast path
TURN_SQUARE: Final = 360.0**2
# Limits of the squared length of a rotation: 0.98² and 1.02². Rounding to 16 bits changes the length by 1e-4.
QUAT_SQUARE_MIN, QUAT_SQUARE_MAX = 0.9604, 1.0404

# High bytes of little-endian 32-bit floats inside the limits. The high byte is the sign and the
# upper seven bits of the exponent: 131,072 is 0x48000000, ±128 is 0x43000000 and 0xC3000000.
VALUE_HIGH_BYTES: Final = bytes(byte for byte in range(256) if byte & 0x7F < 0x48)
TEMPERATURE_HIGH_BYTES: Final = bytes([*range(0x43), *range(0x80, 0xC3)])


def values_possible(high_bytes: bytes | bytearray) -> bool:
    """Return whether all floats with these high bytes are inside VALUE_LIMIT. NaN and infinity are outside."""
    # for less than about 30 bytes, `not high_bytes.strip(VALUE_HIGH_BYTES)` is faster
    return not high_bytes.translate(None, VALUE_HIGH_BYTES)


def temperatures_possible(high_bytes: bytes | bytearray) -> bool:
    """Return whether all temperatures with these high bytes are inside ±128 °C. `possible_temperature_c` decides the
    other temperatures."""
    return not high_bytes.translate(None, TEMPERATURE_HIGH_BYTES)


def is_possible(values: Sequence[float]) -> bool:
    """Return whether all values are inside VALUE_LIMIT. NaN and infinity are outside."""
    return all(-VALUE_LIMIT < value < VALUE_LIMIT for value in values)


def scaled(values: Sequence[float], factor: float, limit: float = VALUE_LIMIT) -> Vector3 | None:
    """Return three values times `factor`; None if the magnitude of one is not below `limit`."""
    x, y, z = values
    # `is_possible` without a call, which costs as much as the rest of a frame
    if -limit < x < limit and -limit < y < limit and -limit < z < limit:
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
