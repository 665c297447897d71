"""Axes, angles and navigation frame of published samples, and the rotation of samples into them.

S is the attitude of the device (matrix sensor → navigation frame), M the rotation sensor → published axes, and N the
rotation of the navigation frame (declination and convention). imud rotates every sample once:

    vectors    v' = M · v               accel_m_s2, gyro_rad_s, mag_t
    attitude   S' = N · S · Mᵀ          quat_wxyz; euler_rad is computed from it

A sample with only Euler angles or only a quaternion gets both. `incli_rad`, `velocity_enu_m_s`, `heave_m` and values
without a direction stay unchanged. A rotation by quarter turns only exchanges numbers and signs: no digit is lost, and
a NaN stays in one element.

If a device sends some angles as NaN, imud publishes the values that do not depend on them: roll and pitch without yaw;
each angle if the sensor is mounted as in its manual; yaw alone if the sensor is only rotated about the vertical, as if
the body were level.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot, isfinite, nan, radians
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from imud.attitude.conventions import (
    BODY_WORDS,
    EULER_WORDS,
    RFU_ENU,
    Convention,
    DeviceAxes,
    EulerOrder,
    Heading,
    body_axes,
    navigation_axes,
    navigation_words,
)
from imud.attitude.rotation import (
    IDENTITY,
    Matrix3,
    euler312_from_quat,
    euler_zyx_from_quat,
    is_rotation,
    matrix_from_quat,
    matrix_product,
    quat_from_euler312,
    quat_from_euler_zyx,
    quat_from_matrix,
    quat_product,
    transposed,
)
from imud.model.options import Options
from imud.model.sample import Quaternion, Sample, Vector3

TO_QUAT: Final = {EulerOrder.ZXY: quat_from_euler312, EulerOrder.ZYX: quat_from_euler_zyx}
TO_EULER: Final = {EulerOrder.ZXY: euler312_from_quat, EulerOrder.ZYX: euler_zyx_from_quat}
SAME: Final = 1e-9  # maximum difference of the elements of two equal rotations


class FrameWords(msgspec.Struct, frozen=True):
    """Axes and angles of samples as readable text."""

    frame: str  # axes of vectors
    euler_convention: str
    navigation_frame: str


class Rotation:
    """Rotation of samples. Immutable."""

    def __init__(
        self,
        vectors: Matrix3,
        navigation: Matrix3,
        orders: tuple[EulerOrder, EulerOrder],
        mounting: Matrix3 = IDENTITY,
        *,
        from_angles: bool = False,
    ) -> None:
        """`vectors` is M, `navigation` is N, `orders` are the orders of the angles before and after the rotation.
        `mounting` is the part of M that rotates the body. `from_angles`: ignore the quaternion of the device."""
        self._turn = _vector_function(vectors)
        self._attitude = _quat_function(navigation, vectors)
        self._to_quat, self._to_euler = TO_QUAT[orders[0]], TO_EULER[orders[1]]
        self._keeps_body = _same(mounting, IDENTITY)
        self._keeps_level = abs(mounting[2][2] - 1.0) <= SAME
        self._from_angles = from_angles

    def sample(self, sample: Sample) -> Sample:
        """Return the rotated sample."""
        turn = self._turn
        accel, gyro, mag = sample.accel_m_s2, sample.gyro_rad_s, sample.mag_t
        quat, euler = self._turned(sample.quat_wxyz, sample.euler_rad)
        return Sample(
            sample.device, sample.seq, sample.t_ns, sample.t_err_ns, sample.sync, sample.t_rx_ns, sample.utc_ns,
            sample.t_dev_ns,
            None if accel is None else turn(accel),
            None if gyro is None else turn(gyro),
            None if mag is None else turn(mag),
            quat, euler, sample.temperature_c, sample.pressure_pa, sample.incli_rad, sample.status, sample.pps_age_ms,
            sample.edge_seq, sample.velocity_enu_m_s, sample.position, sample.heave_m, sample.gnss_utc_ns,
        )  # fmt: skip

    def samples(self, samples: Sequence[Sample]) -> list[Sample]:
        """Return the rotated samples."""
        return [self.sample(sample) for sample in samples]

    def _turned(self, quat: Quaternion | None, euler: Vector3 | None) -> tuple[Quaternion | None, Vector3 | None]:
        if quat is not None and not (self._from_angles and euler is not None):
            try:
                made = self._attitude(quat)
                return made, self._to_euler(made)
            except ValueError:  # a zero quaternion: the device does not know its attitude yet
                pass
        if euler is None:
            return None, None
        if isfinite(euler[0] + euler[1] + euler[2]):
            made = self._attitude(self._to_quat(euler))
            return made, self._to_euler(made)
        return None, self._in_part(euler)

    def _in_part(self, euler: Vector3) -> Vector3 | None:
        """Rotate angles if some are not finite; None if no angle is known without them."""
        known = tuple(map(isfinite, euler))
        filled = tuple(angle if is_known else 0.0 for angle, is_known in zip(euler, known, strict=True))
        roll, pitch, yaw = self._to_euler(self._attitude(self._to_quat((filled[0], filled[1], filled[2]))))
        if known == (True, True, False):
            return roll, pitch, nan
        if self._keeps_body:
            return roll if known[0] else nan, pitch if known[1] else nan, yaw if known[2] else nan
        if self._keeps_level and known == (False, False, True):
            return nan, nan, yaw
        return None


@dataclass(frozen=True)
class PublishedAxes:
    """Axes, angles and navigation frame of the published samples of one device. Made by `published_frame`."""

    device: DeviceAxes  # axes of the device, with the configuration applied
    mounting: Matrix3  # rotation sensor → body (FLU)
    convention: Convention | None  # None: axes and angles of the device
    declination_deg: float | None  # None: the heading of the device
    from_angles: bool = False  # whether to use the Euler angles of the device and ignore its quaternion

    @cached_property
    def rotation(self) -> Rotation | None:
        """Rotation from measurements to published samples; None without a rotation."""
        if self.convention is None and self.declination_deg is None:
            return None
        to_navigation = matrix_product(_about_up(-(self.declination_deg or 0.0)), self.device.to_z_up)
        return Rotation(
            matrix_product(self._body, self.mounting),
            matrix_product(self._navigation, to_navigation),
            (self.device.order, self._order),
            matrix_product(self.mounting, transposed(self.device.to_body)),
            from_angles=self.from_angles,
        )

    def rotation_to(self, convention: Convention) -> Rotation | None:
        """Return the rotation from published samples to the convention of a client; None without a rotation."""
        return None if convention is self.convention else self._rotations[convention]

    @cached_property
    def _rotations(self) -> dict[Convention, Rotation]:
        return {
            convention: Rotation(
                matrix_product(body_axes(convention), transposed(self._body)),
                matrix_product(navigation_axes(convention, self.device.has_north), transposed(self._navigation)),
                (self._order, EulerOrder.ZYX),
            )
            for convention in Convention
        }

    @property
    def _body(self) -> Matrix3:
        """Rotation from body axes (FLU) to published axes."""
        return transposed(self.device.to_body) if self.convention is None else body_axes(self.convention)

    @property
    def _navigation(self) -> Matrix3:
        """Rotation from the navigation frame with z up to the published navigation frame."""
        if self.convention is None:
            return transposed(self.device.to_z_up)
        return navigation_axes(self.convention, self.device.has_north)

    @property
    def _order(self) -> EulerOrder:
        return self.device.order if self.convention is None else EulerOrder.ZYX

    @property
    def yaw_sense(self) -> int:
        """Return 1 if the published yaw and the yaw of the device grow in the same sense, otherwise -1."""
        if self.convention is None:
            return 1
        return 1 if (self.convention is Convention.NED_FRD) == self.device.z_down else -1

    # --- readable text ---------------------------------------------------------------------------------------------

    def heading(self, device: Heading) -> Heading:
        """Return the reference of the published yaw for a reference of the device."""
        if self.declination_deg is None or device is Heading.RELATIVE:
            return device
        return Heading.TRUE

    def words(self, euler_convention: str, navigation_frame: str) -> FrameWords:
        """Return the description of published samples; the arguments are the texts of the driver."""
        if self.convention is None:
            return FrameWords(self.device.words, euler_convention, navigation_frame)
        return self.words_of(self.convention)

    def words_of(self, convention: Convention) -> FrameWords:
        """Return the description of samples in a convention."""
        navigation = navigation_words(convention, self.device.has_north)
        return FrameWords(BODY_WORDS[convention], EULER_WORDS[convention], navigation)


def as_sent(device: DeviceAxes = RFU_ENU) -> PublishedAxes:
    """Return the published axes of a device without the keys `frame` and `convention`."""
    return PublishedAxes(device, device.to_body, None, None)


def _about_up(angle_deg: float) -> Matrix3:
    return matrix_from_quat(quat_from_euler_zyx((0.0, 0.0, radians(angle_deg)))) if angle_deg else IDENTITY


def _vector_function(matrix: Matrix3) -> Callable[[Vector3], Vector3]:
    """Return the function v → matrix · v."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    picks = [[(column, value) for column, value in enumerate(row) if value] for row in matrix]
    # quarter turns select elements: no rounding, and a NaN stays in one element
    if all(len(pick) == 1 for pick in picks):
        ((i0, s0),), ((i1, s1),), ((i2, s2),) = picks
        return lambda v: (s0 * v[i0], s1 * v[i1], s2 * v[i2])

    def turn(v: Vector3) -> Vector3:
        x, y, z = v
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)

    return turn


def _quat_function(navigation: Matrix3, vectors: Matrix3) -> Callable[[Quaternion], Quaternion]:
    """Return the function q → n ⊗ q ⊗ m*, linear in q and therefore one 4 × 4 matrix."""
    n = quat_from_matrix(navigation)
    w, x, y, z = quat_from_matrix(vectors)
    back = (w, -x, -y, -z)
    units: tuple[Quaternion, ...] = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    columns = [quat_product(quat_product(n, unit), back) for unit in units]
    (a0, b0, c0, d0), (a1, b1, c1, d1), (a2, b2, c2, d2), (a3, b3, c3, d3) = columns

    def turn(q: Quaternion) -> Quaternion:
        w, x, y, z = q
        return (
            a0 * w + a1 * x + a2 * y + a3 * z,
            b0 * w + b1 * x + b2 * y + b3 * z,
            c0 * w + c1 * x + c2 * y + c3 * z,
            d0 * w + d1 * x + d2 * y + d3 * z,
        )

    return turn


def _same(a: Matrix3, b: Matrix3) -> bool:
    return all(abs(x - y) <= SAME for row, other in zip(a, b, strict=True) for x, y in zip(row, other, strict=True))


# Unit vector of each sensor axis, by name
AXES: Final[Mapping[str, Vector3]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
BODY: Final = ("forward", "left", "up")  # directions of the body's x, y, z
LENGTH_TOLERANCE: Final = 1e-3  # maximum length error of a mounting quaternion, for values with four digits
SNAP: Final = 1e-12  # maximum distance of an element from 0 and ±1 that is rounded: the cosine of 90° is 6e-17


def matrix_from_axes(x: str, y: str, z: str) -> Matrix3:
    """Return the rotation sensor → body from the sensor axes that point forward, left and up (names of AXES). Raises
    ValueError for two names of one axis and for left-handed axes (a mirror image)."""
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
            f"expected right-handed axes, got a mirror image (x: {x}, y: {y}, z: {z}); check "
            f"the signs: with these x and y, z is {opposite}"
        )
    return matrix


def matrix_from_angles(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Matrix3:
    """Return the rotation sensor → body for mounting angles (ZYX, right-handed about the FLU axes)."""
    quat = quat_from_euler_zyx((radians(roll_deg), radians(pitch_deg), radians(yaw_deg)))
    return snapped(matrix_from_quat(quat))


def matrix_from_mounting_quat(quat_wxyz: Quaternion) -> Matrix3:
    """Return the rotation sensor → body for a quaternion. Raises ValueError if its length is not 1."""
    length = hypot(*quat_wxyz)
    if not abs(length - 1.0) <= LENGTH_TOLERANCE:
        raise ValueError(f"expected a quaternion of length 1 (scalar first), got length {length:.6g}")
    return snapped(matrix_from_quat(quat_wxyz))


def levelling(convention: Convention, roll_deg: float, pitch_deg: float, heading_deg: float) -> Matrix3:
    """Return the rotation of the body axes (FLU) that corrects mounting errors. `roll_deg` and `pitch_deg` are the
    published angles of a level body. `heading_deg` is added to the heading, clockwise from above."""
    if not (roll_deg or pitch_deg or heading_deg):
        return IDENTITY
    up = pitch_deg if convention is Convention.ENU_FLU else -pitch_deg
    return matrix_from_angles(roll_deg, up, heading_deg)


def mounted(mounting: Matrix3, level: Matrix3) -> Matrix3:
    """Return the complete rotation sensor → body."""
    return snapped(matrix_product(level, mounting))


def snapped(matrix: Matrix3) -> Matrix3:
    """Return the matrix with elements near 0 and ±1 rounded."""
    first, second, third = (tuple(_snapped(value) for value in row) for row in matrix)
    return (_vector(first), _vector(second), _vector(third))


def _snapped(value: float) -> float:
    near = float(round(value))
    return near + 0.0 if abs(value - near) <= SNAP else value


def _vector(row: tuple[float, ...]) -> Vector3:
    x, y, z = row
    return (x, y, z)


AxisName = Literal["x", "-x", "y", "-y", "z", "-z"]
Turn = Annotated[float, Meta(ge=-360, le=360)]


class MountingAxes(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sensor axis for each body axis."""

    x: AxisName
    """Sensor axis that points forward in the body."""
    y: AxisName
    """Sensor axis that points to the left."""
    z: AxisName
    """Sensor axis that points up."""


class MountingAngles(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Rotation of the sensor in the body, from sensor axes along the body axes (x forward, y left, z up)."""

    roll_deg: Turn = 0.0
    """Third rotation, about x (forward), right-handed: positive with the left side up."""
    pitch_deg: Turn = 0.0
    """Second rotation, about y (left), right-handed: positive with the front down."""
    yaw_deg: Turn = 0.0
    """First rotation, about z (up), right-handed: positive to the left."""


class FrameOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mounting of a sensor in its body: one of `axes`, `euler`, `quat_wxyz`; otherwise as in its manual."""

    axes: MountingAxes | None = None
    """Sensor axes that point forward (`x`), to the left (`y`) and up (`z`), for example x: y, y: -x, z: z."""
    euler: MountingAngles | None = None
    """Rotation of the sensor in the body: `yaw_deg` about z, then `pitch_deg` about y, then `roll_deg` about x."""
    quat_wxyz: Annotated[list[float], Meta(min_length=4, max_length=4)] | None = None
    """Rotation from sensor axes to body axes, scalar first, of length 1."""
    z_down: bool = False
    """Whether the z axis of the sensor points down in the mounting of its manual; the angles use the same axes."""
    euler_order: EulerOrder | None = None
    """Order of the device's angles, if it differs from the driver: zyx (x forward) or zxy (y forward)."""
    level_roll_deg: Annotated[float, Meta(ge=-45, le=45)] = 0.0
    """Published roll of a level body without this key; imud subtracts it."""
    level_pitch_deg: Annotated[float, Meta(ge=-45, le=45)] = 0.0
    """Published pitch of a level body without this key; imud subtracts it."""
    heading_offset_deg: Turn = 0.0
    """Angle that imud adds to the heading, clockwise from above. Positive if the sensor points to the left of the
    body's front."""
    level_at_rest: bool = True
    """Whether the body is level within 45° at rest. Then imud reports a mounting that contradicts gravity."""


NO_FRAME: Final = FrameOptions()


def axes_of(frame: FrameOptions, device: DeviceAxes) -> DeviceAxes:
    """Return the axes and angles of a device from the configuration, otherwise from its driver."""
    order = device.order if frame.euler_order is None else frame.euler_order
    return replace(device, order=order, z_down=frame.z_down)


def mounting_of(frame: FrameOptions, device: DeviceAxes) -> Matrix3:
    """Return the rotation sensor → body (FLU) from the configuration, otherwise from `device`. Raises ValueError."""
    if frame.axes is not None:
        return matrix_from_axes(frame.axes.x, frame.axes.y, frame.axes.z)
    if frame.euler is not None:
        return matrix_from_angles(frame.euler.roll_deg, frame.euler.pitch_deg, frame.euler.yaw_deg)
    if frame.quat_wxyz is not None:
        w, x, y, z = frame.quat_wxyz
        return matrix_from_mounting_quat((w, x, y, z))
    return device.to_body


def rotation_of(frame: FrameOptions, device: DeviceAxes, convention: Convention) -> Matrix3:
    """Return the complete rotation sensor → body (FLU), with corrected mounting errors. Raises ValueError."""
    level = levelling(convention, frame.level_roll_deg, frame.level_pitch_deg, frame.heading_offset_deg)
    return mounted(mounting_of(frame, device), level)


def published_frame(
    frame: FrameOptions | None, convention: Convention | None, declination_deg: float | None, device: DeviceAxes
) -> PublishedAxes:
    """Return the published axes of a device. `device` contains the axes of its driver. Raises ValueError."""
    if frame is None:
        return PublishedAxes(device, device.to_body, convention, declination_deg)
    wanted = convention or Convention.ENU_FLU
    own = axes_of(frame, device)
    from_angles = own.order is not device.order
    return PublishedAxes(own, rotation_of(frame, own, wanted), wanted, declination_deg, from_angles)
