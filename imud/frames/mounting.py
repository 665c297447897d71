"""The mounting: the fixed rotation from the sensor's axes to the body's, x forward, y left, z up (FLU).

It is given in one of three ways, and refused where it is none (a mirror image, axes that are not at right angles):

    axes         which axis of the sensor each axis of the body is: x: y says that the sensor's y axis points forward
    Euler        the sensor is turned from the body's axes by yaw about z, then pitch about y, then roll about x (ZYX,
                 right-handed about the FLU axes): v_body = Rz(yaw) · Ry(pitch) · Rx(roll) · v_sensor
    quaternion   v_body = C(q) · v_sensor, scalar first

Errors of the mounting are taken away behind it: roll and pitch as imud shows them while the body is level, and what is
to be added to the heading.
"""

from collections.abc import Mapping
from math import hypot, radians
from typing import Final

from imud.attitude import (
    IDENTITY,
    Matrix3,
    is_rotation,
    matrix_from_quat,
    matrix_product,
    quat_from_euler_zyx,
)
from imud.frames.conventions import Convention
from imud.sample import Quaternion, Vector3

AXES: Final[Mapping[str, Vector3]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
"""An axis of the sensor by its name, as a unit vector."""
BODY: Final = ("forward", "left", "up")
"""Meaning of the body's x, y, z."""
LENGTH_TOLERANCE: Final = 1e-3
"""Of a quaternion written with four digits."""
SNAP: Final = 1e-12
"""Elements this near to 0 and ±1 are meant to be these: the cosine of 90° is 6e-17."""


def matrix_from_axes(x: str, y: str, z: str) -> Matrix3:
    """Return the rotation sensor → body by which axis of the sensor points forward, left, up: names of AXES.

    Raises ValueError where two are along one axis, and where they are left-handed (a mirror image).
    """
    names = (x, y, z)
    for number, name in enumerate(names):
        for before in range(number):
            if name.strip("-") == names[before].strip("-"):
                raise ValueError(
                    f"expected three different axes of the sensor, got {names[before]} {BODY[before]} and {name} "
                    f"{BODY[number]}"
                )
    matrix = (AXES[x], AXES[y], AXES[z])
    if not is_rotation(matrix):
        opposite = z.strip("-") if z.startswith("-") else f"-{z}"
        raise ValueError(
            f"expected right-handed axes, got a mirror image (x: {x}, y: {y}, z: {z}), which no mounting makes; look "
            f"at the signs: with these x and y, z is {opposite}"
        )
    return matrix


def matrix_from_angles(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Matrix3:
    """Return the rotation sensor → body of a sensor that is turned so (ZYX, right-handed about the FLU axes)."""
    quat = quat_from_euler_zyx((radians(roll_deg), radians(pitch_deg), radians(yaw_deg)))
    return snapped(matrix_from_quat(quat))


def matrix_from_mounting_quat(quat_wxyz: Quaternion) -> Matrix3:
    """Return the rotation sensor → body of a quaternion. Raises ValueError where its length is not 1."""
    length = hypot(*quat_wxyz)
    if not abs(length - 1.0) <= LENGTH_TOLERANCE:
        raise ValueError(f"expected a quaternion of length 1 (scalar first), got one of length {length:.6g}")
    return snapped(matrix_from_quat(quat_wxyz))


def levelling(convention: Convention, roll_deg: float, pitch_deg: float, heading_deg: float) -> Matrix3:
    """Return the rotation of the body's axes (FLU) that takes away errors of the mounting.

    `roll_deg` and `pitch_deg` are read while the body is level, in the convention that is published; `heading_deg` is
    added to the heading (clockwise from above).
    """
    if not (roll_deg or pitch_deg or heading_deg):
        return IDENTITY
    up = pitch_deg if convention is Convention.ENU_FLU else -pitch_deg
    return matrix_from_angles(roll_deg, up, heading_deg)


def mounted(mounting: Matrix3, level: Matrix3) -> Matrix3:
    """Return the whole rotation sensor → body."""
    return snapped(matrix_product(level, mounting))


def snapped(matrix: Matrix3) -> Matrix3:
    """Replace elements that are 0 or ±1 but for rounding."""
    first, second, third = (tuple(_snapped(value) for value in row) for row in matrix)
    return (_vector(first), _vector(second), _vector(third))


def _snapped(value: float) -> float:
    near = float(round(value))
    return near + 0.0 if abs(value - near) <= SNAP else value


def _vector(row: tuple[float, ...]) -> Vector3:
    x, y, z = row
    return (x, y, z)
