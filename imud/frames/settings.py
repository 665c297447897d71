"""The settings of `frame` of a device, and what the parts of imud make of them.

The keys in the file are read by `imud.config`; the rotation is in `imud.frames.mounting`.
"""

from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.attitude import Matrix3
from imud.contracts.settings import Settings
from imud.frames.conventions import Convention, DeviceAxes, EulerOrder
from imud.frames.mounting import (
    levelling,
    matrix_from_angles,
    matrix_from_axes,
    matrix_from_mounting_quat,
    mounted,
)
from imud.frames.published import PublishedFrame

AxisName = Literal["x", "-x", "y", "-y", "z", "-z"]
Turn = Annotated[float, Meta(ge=-360, le=360)]


class MountingAxes(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The axis of the sensor that each axis of the body is."""

    x: AxisName
    """The axis of the sensor that points forward in the body."""
    y: AxisName
    """The one that points to the left."""
    z: AxisName
    """The one that points up."""


class MountingAngles(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the sensor is turned in the body, from its axes along the body's (x forward, y left, z up)."""

    roll_deg: Turn = 0.0
    """Last, about x (forward), right-handed: positive with the left side up."""
    pitch_deg: Turn = 0.0
    """Second, about y (left), right-handed: positive with the front down."""
    yaw_deg: Turn = 0.0
    """First, about z (up), right-handed: positive to the left."""


class FrameSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sensor lies in its body: one of `axes`, `euler`, `quat_wxyz`, or none: as its manual says."""

    axes: MountingAxes | None = None
    """Which axis of the sensor points forward (`x`), to the left (`y`) and up (`z`), for example x: y, y: -x, z: z."""
    euler: MountingAngles | None = None
    """How the sensor is turned in the body: `yaw_deg` about z, then `pitch_deg` about y, then `roll_deg` about x."""
    quat_wxyz: Annotated[list[float], Meta(min_length=4, max_length=4)] | None = None
    """Rotation from the sensor's axes to the body's, scalar first, of length 1."""
    z_down: bool = False
    """Whether the sensor's own z axis points down when it lies as its manual says, and its angles count so."""
    euler_order: EulerOrder | None = None
    """Order of the device's angles where it is not the driver's: zyx (x forward) or zxy (y forward)."""
    level_roll_deg: Annotated[float, Meta(ge=-45, le=45)] = 0.0
    """Roll as imud shows it, without this key, while the body is level; it is taken away."""
    level_pitch_deg: Annotated[float, Meta(ge=-45, le=45)] = 0.0
    """Pitch as imud shows it, without this key, while the body is level; it is taken away."""
    heading_offset_deg: Turn = 0.0
    """Added to the heading, clockwise from above: the sensor points so far to the left of the body's front."""
    level_at_rest: bool = True
    """Whether the body stands level within 45° when it is at rest: imud says when the mounting contradicts that."""

    @property
    def has_mounting(self) -> bool:
        """Whether the file gives a rotation, other than that of the driver or of `z_down`."""
        return self.axes is not None or self.euler is not None or self.quat_wxyz is not None


NO_FRAME: Final = FrameSettings()


def axes_of(frame: FrameSettings, device: DeviceAxes) -> DeviceAxes:
    """Return the axes and angles of a device as the configuration has them, in place of those of its driver."""
    order = device.order if frame.euler_order is None else frame.euler_order
    return DeviceAxes(order=order, has_north=device.has_north, z_down=frame.z_down)


def mounting_of(frame: FrameSettings, device: DeviceAxes) -> Matrix3:
    """Return the rotation sensor → body (FLU) that the file gives, else that of `device`. Raises ValueError."""
    if frame.axes is not None:
        return matrix_from_axes(frame.axes.x, frame.axes.y, frame.axes.z)
    if frame.euler is not None:
        return matrix_from_angles(frame.euler.roll_deg, frame.euler.pitch_deg, frame.euler.yaw_deg)
    if frame.quat_wxyz is not None:
        w, x, y, z = frame.quat_wxyz
        return matrix_from_mounting_quat((w, x, y, z))
    return device.to_body


def rotation_of(frame: FrameSettings, device: DeviceAxes, convention: Convention) -> Matrix3:
    """Return the whole rotation sensor → body (FLU), errors of the mounting taken away. Raises ValueError."""
    level = levelling(convention, frame.level_roll_deg, frame.level_pitch_deg, frame.heading_offset_deg)
    return mounted(mounting_of(frame, device), level)


def published_frame(
    frame: FrameSettings | None, convention: Convention | None, declination_deg: float | None, device: DeviceAxes
) -> PublishedFrame:
    """Return what is published of a device whose driver gives its axes as `device`. Raises ValueError."""
    if frame is None:
        return PublishedFrame(device, device.to_body, convention, declination_deg)
    wanted = convention or Convention.ENU_FLU
    own = axes_of(frame, device)
    from_angles = own.order is not device.order
    return PublishedFrame(own, rotation_of(frame, own, wanted), wanted, declination_deg, from_angles)
