"""Axes of conventions and devices, compared with drawings: directions of front, left and up."""

from dataclasses import replace

import pytest

from imud.attitude import conventions
from imud.attitude.conventions import FLU_LEVEL, FLU_NWU, RFU_ENU, Convention, DeviceAxes, EulerOrder, navigation_axes
from imud.attitude.rotation import is_rotation, matrix_times
from imud.drivers import DRIVERS
from imud.model.sample import Vector3

FRONT_LEFT_UP: tuple[Vector3, Vector3, Vector3] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def test_axes_and_words_of_conventions_and_of_frames_with_z_down() -> None:
    assert [matrix_times(conventions.body_axes(Convention.ENU_FLU), v) for v in FRONT_LEFT_UP] == list(FRONT_LEFT_UP)
    assert matrix_times(conventions.body_axes(Convention.NED_FRD), (1, 2, 3)) == (1, -2, -3), "front, right, down"
    # At yaw 0, the x axis (ZYX) or the y axis (ZXY) of the sensor is parallel to the same axis of the frame.
    assert matrix_times(DeviceAxes(order=EulerOrder.ZYX, z_down=True).to_z_up, (1, 2, 3)) == (1, -2, -3)
    assert matrix_times(DeviceAxes(order=EulerOrder.ZXY, z_down=True).to_z_up, (1, 2, 3)) == (-1, 2, -3)
    assert matrix_times(RFU_ENU.to_z_up, (1, 2, 3)) == (1, 2, 3)
    assert FLU_LEVEL.with_order(None) == FLU_LEVEL
    assert FLU_LEVEL.with_order(EulerOrder.ZXY).to_body == RFU_ENU.to_body
    assert not FLU_LEVEL.with_order(EulerOrder.ZXY).has_north
    assert RFU_ENU.words == "sensor: x right, y forward, z up, right-handed"
    assert FLU_LEVEL.words == "sensor: x forward, y left, z up, right-handed"
    assert [conventions.navigation_words(one, True) for one in Convention] == ["ENU", "NED"]
    assert conventions.navigation_words(Convention.NED_FRD, False).startswith("level, Z down")


def test_navigation_axes() -> None:
    east, north, up = 1.0, 2.0, 3.0
    assert matrix_times(navigation_axes(Convention.ENU_FLU, True), (east, north, up)) == (east, north, up)
    assert matrix_times(navigation_axes(Convention.NED_FRD, True), (east, north, up)) == (north, east, -up)
    # without north, the x axis stays unchanged
    assert matrix_times(navigation_axes(Convention.ENU_FLU, False), (1, 2, 3)) == (1, 2, 3)
    assert matrix_times(navigation_axes(Convention.NED_FRD, False), (1, 2, 3)) == (1, -2, -3)
    assert is_rotation(conventions.ENU_TO_NED)
    # North, west, up: the x axis is north, the y axis is west.
    north, west, up = 1.0, 2.0, 3.0
    assert matrix_times(FLU_NWU.to_z_up, (north, west, up)) == (-west, north, up)
    ned = replace(FLU_NWU, z_down=True)  # north, east, down
    assert matrix_times(ned.to_z_up, (north, -west, -up)) == (-west, north, up)
    assert [matrix_times(FLU_NWU.to_body, v) for v in FRONT_LEFT_UP] == list(FRONT_LEFT_UP)


@pytest.mark.parametrize(
    ("axes", "front", "left", "up"),
    [
        (RFU_ENU, (0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # x right, y forward, z up
        (FLU_LEVEL, (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        (DeviceAxes(order=EulerOrder.ZYX, z_down=True), (1, 0, 0), (0, -1, 0), (0, 0, -1)),  # front, right, down
        (DeviceAxes(order=EulerOrder.ZXY, z_down=True), (0, 1, 0), (1, 0, 0), (0, 0, -1)),  # left, front, down
    ],
)
def test_front_left_and_up_in_the_axes_of_a_device(
    axes: DeviceAxes, front: Vector3, left: Vector3, up: Vector3
) -> None:
    assert [matrix_times(axes.to_body, v) for v in (front, left, up)] == list(FRONT_LEFT_UP)
    assert is_rotation(axes.to_body)


@pytest.mark.parametrize("name", DRIVERS)
def test_the_axes_of_a_driver_match_its_description(name: str) -> None:
    driver = DRIVERS[name]
    assert (driver.axes.order is EulerOrder.ZXY) == ("312" in driver.euler_convention)
    assert (driver.axes.order is EulerOrder.ZYX) == ("ZYX" in driver.euler_convention)
    assert driver.axes.has_north == (driver.navigation_frame == "ENU")
    assert not driver.axes.z_down
