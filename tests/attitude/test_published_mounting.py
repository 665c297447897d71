"""Rotation sensor → body for each key, compared with values computed by hand."""

from contextlib import suppress
from itertools import product
from math import cos, radians, sin, sqrt

import pytest

from imud.attitude.conventions import Convention
from imud.attitude.published import (
    AXES,
    levelling,
    matrix_from_angles,
    matrix_from_axes,
    matrix_from_mounting_quat,
    mounted,
)
from imud.attitude.rotation import IDENTITY, Matrix3, is_rotation, matrix_times
from imud.model.sample import Vector3

HALF = sqrt(0.5)
C30, S30 = cos(radians(30)), sin(radians(30))

SENSOR: Vector3 = (1.0, 2.0, 3.0)
"""Vector in sensor axes. A drawing of the mounting gives its direction in the body."""
MOUNTINGS = [
    # name, x y z by axes, roll pitch yaw in degrees, quaternion, the vector in the body
    ("as the body", ("x", "y", "z"), (0, 0, 0), (1, 0, 0, 0), (1, 2, 3)),
    ("upside down about x", ("x", "-y", "-z"), (180, 0, 0), (0, 1, 0, 0), (1, -2, -3)),
    ("upside down about y", ("-x", "y", "-z"), (0, 180, 0), (0, 0, 1, 0), (-1, 2, -3)),
    ("turned 90° to the left", ("-y", "x", "z"), (0, 0, 90), (HALF, 0, 0, HALF), (-2, 1, 3)),
    ("turned 90° to the right", ("y", "-x", "z"), (0, 0, -90), (HALF, 0, 0, -HALF), (2, -1, 3)),
    ("turned back to front", ("-x", "-y", "z"), (0, 0, 180), (0, 0, 0, 1), (-1, -2, 3)),
    ("on its right side: its y axis points up", ("x", "-z", "y"), (90, 0, 0), (HALF, HALF, 0, 0), (1, -3, 2)),
    ("on its left side: its y axis points down", ("x", "z", "-y"), (-90, 0, 0), (HALF, -HALF, 0, 0), (1, 3, -2)),
    ("upright: its x axis points down", ("z", "y", "-x"), (0, 90, 0), (HALF, 0, HALF, 0), (3, 2, -1)),
    ("upright: its x axis points up", ("-z", "y", "x"), (0, -90, 0), (HALF, 0, -HALF, 0), (-3, 2, 1)),
    # first 90° to the left about z, then 90° about the new x axis of the sensor: x points left, y up
    ("on its side and turned", ("z", "x", "y"), (90, 0, 90), (0.5, 0.5, 0.5, 0.5), (3, 1, 2)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "axes", "angles", "quat", "body"), MOUNTINGS, ids=[row[0] for row in MOUNTINGS])
def test_the_three_ways_agree_with_the_drawing(
    name: str, axes: tuple[str, str, str], angles: Vector3, quat: tuple[float, float, float, float], body: Vector3
) -> None:
    by_axes = matrix_from_axes(*axes)
    assert matrix_times(by_axes, SENSOR) == body, name
    assert matrix_from_angles(*angles) == by_axes, "without a rounding error of the cosine of 90°"
    assert matrix_from_mounting_quat(quat) == by_axes


def test_an_angle_of_30_degrees() -> None:
    """30° to the left: the x axis of the sensor points to the front and, with half its length, to the left."""
    matrix = matrix_from_angles(0, 0, 30)
    assert matrix_times(matrix, (1, 0, 0)) == pytest.approx((C30, S30, 0))
    nose_down = matrix_from_angles(0, 30, 0)
    assert matrix_times(nose_down, (1, 0, 0)) == pytest.approx((C30, 0, -S30))
    left_side_up = matrix_from_angles(30, 0, 0)
    assert matrix_times(left_side_up, (0, 1, 0)) == pytest.approx((0, C30, S30))
    # yaw first: the x axis of the sensor is pitched in its new direction, to the left
    assert matrix_times(matrix_from_angles(0, 30, 90), (1, 0, 0)) == pytest.approx((0, C30, -S30))


def test_every_choice_of_axes_is_a_rotation_or_is_refused() -> None:
    matrices = []
    for axes in product(AXES, repeat=3):
        with suppress(ValueError):
            matrices.append(matrix_from_axes(*axes))
    assert all(is_rotation(matrix) for matrix in matrices)
    assert len(matrices) == 24, "of 216; a cube can be laid down in 24 ways"


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        (("y", "x", "z"), r"right-handed .* mirror image .*with these x and y, z is -z$"),
        (("x", "-z", "-y"), r"z is y$"),
        (("x", "-x", "z"), r"three different axes of the sensor, got x forward and -x left"),
    ],
)
def test_impossible_axes_are_rejected(axes: tuple[str, str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        matrix_from_axes(*axes)


@pytest.mark.parametrize("quat", [(1.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 0.0)])
def test_an_invalid_quaternion_is_rejected(quat: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="of length 1"):
        matrix_from_mounting_quat(quat)
    assert is_rotation(matrix_from_mounting_quat((0.7071, 0.7071, 0.0, 0.0))), "four digits are enough"


def test_levelling_subtracts_the_published_angles() -> None:
    """A sensor with 10° nose-down error: its x axis is the x axis of the body, rotated back up."""
    level = levelling(Convention.ENU_FLU, 0.0, 10.0, 0.0)
    ten = radians(10)
    gravity_in_sensor = (-sin(ten), 0.0, cos(ten))  # nose down: up has a component to the back
    assert matrix_times(level, gravity_in_sensor) == pytest.approx((0, 0, 1))
    # in ned-frd, nose down is negative
    assert levelling(Convention.NED_FRD, 0.0, -10.0, 0.0) == level
    left_up = levelling(Convention.NED_FRD, 10.0, 0.0, 0.0)
    assert matrix_times(left_up, (0.0, sin(ten), cos(ten))) == pytest.approx((0, 0, 1))


def test_a_sensor_that_points_to_the_left_has_a_heading_offset() -> None:
    """The x axis points 90° to the left of the front: imud adds 90° to the heading."""
    assert levelling(Convention.ENU_FLU, 0.0, 0.0, 90.0) == matrix_from_axes("-y", "x", "z")
    assert levelling(Convention.NED_FRD, 0.0, 0.0, 90.0) == matrix_from_axes("-y", "x", "z")


def test_errors_are_taken_away_behind_the_mounting() -> None:
    upside_down: Matrix3 = matrix_from_axes("x", "-y", "-z")
    assert mounted(upside_down, IDENTITY) == upside_down
    whole = mounted(upside_down, levelling(Convention.ENU_FLU, 0.0, 0.0, 90.0))
    assert matrix_times(whole, (1, 0, 0)) == (0, 1, 0), "first upside down, then to the left"
    assert matrix_times(whole, (0, 1, 0)) == (1, 0, 0)
