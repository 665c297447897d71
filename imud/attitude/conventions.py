"""Conventions of axes and angles: conventions of devices, and conventions of published samples.

    name       body axes                     navigation frame         Euler angles
    enu-flu    x forward, y left, z up       east, north, up          ZYX; yaw 0 east, counter-clockwise   (REP-103)
    ned-frd    x forward, y right, z down    north, east, down        ZYX; yaw 0 north, clockwise          (aerospace)

A device has its own axes and its own order of angles. If its heading does not refer to north, its navigation frame is
level and its x axis is the direction of heading 0. Then enu-flu keeps this x axis, and ned-frd rotates the frame by
180° about it.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from imud.attitude.rotation import IDENTITY, Matrix3, matrix_product

FLIP_X: Final[Matrix3] = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))  # half a turn about x: FLU ↔ FRD
FLIP_Y: Final[Matrix3] = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))  # half a turn about y
ENU_TO_NED: Final[Matrix3] = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
RFU_TO_FLU: Final[Matrix3] = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
NWU_TO_ENU: Final[Matrix3] = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
LFD_TO_FLU: Final[Matrix3] = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))  # LFD: x left, y forward, z down


class Convention(StrEnum):
    """Conventions of published samples."""

    ENU_FLU = "enu-flu"  # body x forward, y left, z up; navigation frame east, north, up (REP-103)
    NED_FRD = "ned-frd"  # body x forward, y right, z down; navigation frame north, east, down


class EulerOrder(StrEnum):
    """Orders of Euler angles. The first rotation is always yaw about Z."""

    ZXY = "zxy"  # pitch about X, then roll about Y (312)
    ZYX = "zyx"  # pitch about Y, then roll about X (321)


class Heading(StrEnum):
    """References of yaw."""

    MAGNETIC = "magnetic"
    TRUE = "true"
    RELATIVE = "relative"  # direction of the device at power-on or at its last heading reset
    UNKNOWN = "unknown"  # the device did not report its reference


class AttitudeSource(StrEnum):
    """Sources of `quat_wxyz` and `euler_rad`."""

    DEVICE = "device"
    HOST = "host"  # imud computes them from the angular rate and the acceleration


# Bit of `status` that imud sets while its attitude filter has not settled. Devices without an attitude do not use it.
UNSETTLED_BIT: Final = 30
UNSETTLED_WORDS: Final = "attitude filter of the host has not settled"
HOST_NAVIGATION_WORDS: Final = "level, Z up; X where the yaw was 0 at the start of the filter on the host"


def is_settled(status: int | None) -> bool:
    """Return whether the attitude of a sample with this `status` is usable; always True for attitudes of devices."""
    return status is None or not status >> UNSETTLED_BIT & 1


@dataclass(frozen=True, slots=True)
class DeviceAxes:
    """Axes and angles that a device sends."""

    order: EulerOrder = EulerOrder.ZXY  # Order of the angles. It also selects the forward axis: y with ZXY, x with ZYX.
    # Whether the navigation frame has a north axis with any north reference. Otherwise it is level with z up.
    has_north: bool = True
    z_down: bool = False  # whether the z axes of the device and of its navigation frame point down
    # Whether the x axis of the navigation frame is north (NWU). Otherwise it is east, or the direction of heading 0.
    x_north: bool = False

    def with_order(self, order: EulerOrder | None) -> "DeviceAxes":
        """Return the axes with another order of angles; None keeps the order."""
        return self if order is None else replace(self, order=order)

    @property
    def to_body(self) -> Matrix3:
        """Rotation from sensor axes to body axes (FLU) of a device that is mounted as in its manual."""
        if self.order is EulerOrder.ZXY:
            return LFD_TO_FLU if self.z_down else RFU_TO_FLU
        return FLIP_X if self.z_down else IDENTITY

    @property
    def to_z_up(self) -> Matrix3:
        """Rotation from the device's navigation frame to the frame with z up and the same horizontal reference."""
        up = IDENTITY
        if self.z_down:
            up = FLIP_Y if self.order is EulerOrder.ZXY else FLIP_X
        return matrix_product(NWU_TO_ENU, up) if self.x_north else up

    @property
    def words(self) -> str:
        """Sensor axes as readable text."""
        forward = "x right, y forward" if self.order is EulerOrder.ZXY else "x forward, y left"
        return f"sensor: {forward}, z up, right-handed"


# HiPNUC devices: x right, y forward, z up; navigation frame ENU; ZXY (manual V1.5.9, chapter 9)
RFU_ENU: Final = DeviceAxes()
# HiPNUC devices of newer firmware with COORD 4: x forward, y left, z up; navigation frame NWU; ZYX
FLU_NWU: Final = DeviceAxes(order=EulerOrder.ZYX, x_north=True)
# Forsense IMU61x, assumed: x forward, y left, z up; level navigation frame; ZYX. The manual states no axes.
FLU_LEVEL: Final = DeviceAxes(order=EulerOrder.ZYX, has_north=False)


def body_axes(convention: Convention) -> Matrix3:
    """Return the rotation from FLU to the body axes of a convention."""
    return IDENTITY if convention is Convention.ENU_FLU else FLIP_X


def navigation_axes(convention: Convention, has_north: bool) -> Matrix3:
    """Return the rotation from a navigation frame with z up to the navigation frame of a convention."""
    if convention is Convention.ENU_FLU:
        return IDENTITY
    return ENU_TO_NED if has_north else FLIP_X


BODY_WORDS: Final = {
    Convention.ENU_FLU: "body: x forward, y left, z up (FLU)",
    Convention.NED_FRD: "body: x forward, y right, z down (FRD)",
}
EULER_WORDS: Final = {
    Convention.ENU_FLU: "ZYX: yaw about Z, then pitch about Y, then roll about X; yaw counter-clockwise from above",
    Convention.NED_FRD: "ZYX: yaw about Z, then pitch about Y, then roll about X; yaw clockwise from above",
}


def navigation_words(convention: Convention, has_north: bool) -> str:
    """Return a readable name of the navigation frame of a convention."""
    down = convention is Convention.NED_FRD
    if has_north:
        return "NED" if down else "ENU"
    return f"level, Z {'down' if down else 'up'}; X where the device's heading is 0"
