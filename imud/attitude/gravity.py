"""Comparison of gravity with the attitude at rest. It finds wrong conventions and wrong mountings.

The acceleration of a device at rest points up. The attitude also gives the direction of up. If both directions differ
for some seconds, the configured axes or the configured order of angles is wrong. This comparison does not detect a
rotation of vectors and attitude together (mounting). But the z axis of a level body points up.

Rest is an angular rate near zero and an acceleration near g for WINDOW_NS without a break. A slow rotation or a long
linear acceleration may count as rest. The limits of the angles are larger than the resulting error. All directions are
in sensor axes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from math import acos, asin, atan2, cos, degrees, hypot, inf, isfinite, sin
from typing import Final

from imud.attitude.conventions import DeviceAxes, EulerOrder
from imud.attitude.published import AXES
from imud.attitude.rotation import Matrix3, dot, matrix_times, quat_normalized
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S, STANDARD_GRAVITY_M_S2

WINDOW_NS: Final = 5 * NS_PER_S  # duration of rest before an evaluation, ns
BREAK_NS: Final = 2 * NS_PER_S  # maximum time between two samples of one window, ns
SAMPLES_MIN: Final = 5
REST_RAD_S: Final = 0.05  # maximum angular rate at rest, rad/s: 2.9 °/s, above the bias of an uncalibrated gyroscope
# Maximum difference between the acceleration and g at rest, m/s². The error of an uncalibrated accelerometer is 2 %. A
# sideways acceleration within the limit rotates the direction by up to 14°.
REST_M_S2: Final = 0.03 * STANDARD_GRAVITY_M_S2
CONTRADICTION_DEG: Final = 20.0
LEVEL_DEG: Final = 45.0  # maximum tilt of a level body, degrees: a ship heels, a vehicle is on a slope
EXPLAINED_DEG: Final = 10.0  # maximum remaining angle of a possible cause, degrees


class Contradiction(StrEnum):
    """Kinds of contradictions to gravity."""

    Z_AXIS = "z-axis"  # the z axis points in the opposite direction
    ORDER = "euler-order"  # the angles rotate about other axes
    SIGN = "sign"  # an angle has the opposite sign
    ATTITUDE = "attitude"  # the attitude is wrong without a simple cause
    MOUNTING = "mounting"  # the body is not level with the configured mounting


@dataclass(frozen=True, slots=True)
class Finding:
    """Contradiction with its explanation."""

    kind: Contradiction
    message: str  # observation and next step
    angle_deg: float  # angle between the two directions of up


class GravityCheck:
    """Check of samples at rest. `add` is cheap; a few samples per second are enough. One thread."""

    def __init__(self, device: DeviceAxes, mounting: Matrix3 | None = None) -> None:
        """`mounting`: rotation sensor → body (FLU) of a body that is level at rest; None: no check of the mounting."""
        # Result of the newest window at rest; None if there is no contradiction or no window
        self.finding: Finding | None = None
        self._device = device
        self._mounting = mounting
        self._seq = 0
        self._window: list[Sample] = []  # samples at rest, without a break

    def add(self, sample: Sample) -> bool:
        """Add a sample. Return whether it completed a window, so that `finding` is new."""
        accel, gyro = sample.accel_m_s2, sample.gyro_rad_s
        if sample.seq == self._seq or accel is None or gyro is None:
            return False
        self._seq = sample.seq
        window = self._window
        at_rest = hypot(*gyro) <= REST_RAD_S and abs(hypot(*accel) - STANDARD_GRAVITY_M_S2) <= REST_M_S2
        if window and (not at_rest or sample.t_ns - window[-1].t_ns > BREAK_NS):
            window.clear()
        if not at_rest:
            return False
        window.append(sample)
        if sample.t_ns - window[0].t_ns < WINDOW_NS or len(window) < SAMPLES_MIN:
            return False
        self.finding = self._judge()
        window.clear()
        return True

    def _judge(self) -> Finding | None:
        """Compare the mean acceleration with the attitude in the middle of the window, also in a slow rotation."""
        window = self._window
        accelerations = [sample.accel_m_s2 for sample in window if sample.accel_m_s2 is not None]
        x, y, z = map(sum, zip(*accelerations, strict=True))
        gravity = _unit((x, y, z))
        for name, up in _directions(self._device, window[len(window) // 2]):
            if _angle_deg(gravity, up) > CONTRADICTION_DEG:
                return _explained(self._device, name, gravity, up)
        if self._mounting is not None and matrix_times(self._mounting, gravity)[2] < cos_deg(LEVEL_DEG):
            return _not_level(self._mounting, gravity)
        return None


def cos_deg(angle_deg: float) -> float:
    return cos(angle_deg / degrees(1.0))


def _directions(device: DeviceAxes, sample: Sample) -> Iterator[tuple[str, Vector3]]:
    """Yield the direction of up in sensor axes for each attitude member of the sample."""
    quat, euler = sample.quat_wxyz, sample.euler_rad
    if quat is not None and 0.0 < hypot(*quat) < inf:
        w, x, y, z = quat_normalized(quat)
        # third row of the matrix sensor → navigation frame: its z axis in sensor axes
        yield "quat_wxyz", _signed(device, (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z))
    if euler is not None and isfinite(euler[0] + euler[1]):
        yield "euler_rad", _up_by_angles(device, euler[0], euler[1])


def _up_by_angles(device: DeviceAxes, roll: float, pitch: float) -> Vector3:
    """Return the direction of up of a device with these angles. `_angles` is the inverse function."""
    if device.order is EulerOrder.ZXY:
        return _signed(device, (-sin(roll) * cos(pitch), sin(pitch), cos(roll) * cos(pitch)))
    return _signed(device, (-sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)))


def _signed(device: DeviceAxes, z_axis: Vector3) -> Vector3:
    """Return the direction of up from the direction of the navigation frame's z axis."""
    x, y, z = z_axis
    return (-x, -y, -z) if device.z_down else z_axis


# --- causes -----------------------------------------------------------------------------------------------------------


def _explained(device: DeviceAxes, member: str, gravity: Vector3, up: Vector3) -> Finding:
    """Return the finding with the first cause that makes the two directions agree."""
    angle = _angle_deg(gravity, up)
    seen = (
        f"at rest, up is {axis_words(gravity)} of the sensor by the acceleration, but {axis_words(up)} by "
        f"{member}, {angle:.0f}° apart"
    )
    for kind, direction, advice in _causes(device, up):
        if _angle_deg(gravity, direction) < min(EXPLAINED_DEG, angle / 2):
            return Finding(kind, f"{seen}: {advice} (docs/frames.md)", angle)
    advice = "no single axis or sign explains it; check the mounting and axis settings of the device"
    return Finding(Contradiction.ATTITUDE, f"{seen}: {advice} (docs/frames.md)", angle)


def _causes(device: DeviceAxes, up: Vector3) -> Iterator[tuple[Contradiction, Vector3, str]]:
    """Yield possible causes: kind, resulting direction of up, next step."""
    x, y, z = up
    zxy = device.order is EulerOrder.ZXY
    change = "remove z_down from frame" if device.z_down else "set frame: {z_down: true}"
    yield Contradiction.Z_AXIS, (-x, -y, -z), f"the z axis points in the opposite direction; {change}"
    roll, pitch = _angles(device, up)
    order = EulerOrder.ZYX if zxy else EulerOrder.ZXY
    other = DeviceAxes(order=order, z_down=device.z_down)
    yield (
        Contradiction.ORDER,
        _up_by_angles(other, roll, pitch),
        f"the axes of roll and pitch are exchanged; set frame: {{euler_order: {order}}}",
    )
    by_roll, by_pitch = ((-x, y, z), (x, -y, z)) if zxy else ((x, -y, z), (-x, y, z))
    about = "no mounting has this effect; check the axis settings of the device"
    yield Contradiction.SIGN, by_roll, f"roll has the opposite sign; {about}"
    yield Contradiction.SIGN, by_pitch, f"pitch has the opposite sign; {about}"
    yield Contradiction.SIGN, (-x, -y, z), f"roll and pitch have the opposite sign; {about}"
    yield Contradiction.SIGN, (x, -y, -z), f"y and z of the acceleration have the opposite sign; {about}"
    yield Contradiction.SIGN, (-x, y, -z), f"x and z of the acceleration have the opposite sign; {about}"
    swapped = _up_by_angles(device, pitch, roll)
    yield Contradiction.ORDER, swapped, f"roll and pitch are exchanged; {about}"


def _angles(device: DeviceAxes, up: Vector3) -> tuple[float, float]:
    """Return roll and pitch of a device with this direction of up."""
    sign = -1.0 if device.z_down else 1.0
    x, y, z = (sign * value for value in up)
    if device.order is EulerOrder.ZXY:
        return atan2(-x, z), asin(max(-1.0, min(1.0, y)))
    return atan2(y, z), asin(max(-1.0, min(1.0, -x)))


def _not_level(mounting: Matrix3, gravity: Vector3) -> Finding:
    body = matrix_times(mounting, gravity)
    angle = _angle_deg(body, (0.0, 0.0, 1.0))
    near = nearest_axis(gravity)
    advice = "correct the mounting" if near is None else f"up is the sensor's {near} axis, so axes needs z: {near}"
    return Finding(
        Contradiction.MOUNTING,
        f"at rest, up is {axis_words(gravity)} of the sensor, and {_direction(body)} of the body by the key frame: if "
        f"the body is level now, {advice}; if the body is not always level at rest, set "
        "frame: {level_at_rest: false} "
        "(docs/frames.md)",
        angle,
    )


def _direction(body: Vector3) -> str:
    """Return the side of the body (FLU) nearest to a direction."""
    names = {"x": "front", "-x": "back", "y": "left", "-y": "right", "z": "top", "-z": "bottom"}
    return f"the {names[max(AXES, key=lambda name: dot(AXES[name], body))]}"


def nearest_axis(direction: Vector3) -> str | None:
    """Return the name of the axis within LEVEL_DEG of a direction; None if there is none."""
    name = max(AXES, key=lambda one: dot(AXES[one], direction))
    return name if dot(AXES[name], direction) > cos_deg(LEVEL_DEG) else None


def axis_words(direction: Vector3) -> str:
    """Return the name of the axis near a direction, otherwise its three components."""
    name = nearest_axis(direction)
    x, y, z = direction
    if name is not None and dot(AXES[name], direction) > cos_deg(EXPLAINED_DEG):
        return name if name.startswith("-") else f"+{name}"
    return f"({x:+.2f}, {y:+.2f}, {z:+.2f})"


def _unit(v: Vector3) -> Vector3:
    norm = hypot(*v) or 1.0
    return (v[0] / norm, v[1] / norm, v[2] / norm)


def _angle_deg(a: Vector3, b: Vector3) -> float:
    return degrees(acos(max(-1.0, min(1.0, dot(a, b)))))
