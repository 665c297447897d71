"""Mounting of a module: the rotations between the axes of its chip and those of its output.

URFR (manual chapter 2.2.4) says v_before = C · v_after, so every vector is turned by Cᵀ and the attitude becomes
q ⊗ C. Levelling (ATT RST) turns the attitude once more about the body, and with RST 3 the accelerometer as well;
CONFIG YAW turns it about the vertical.
"""

from math import cos, hypot, pi, sin

from imud.attitude import Matrix3, euler312_from_quat, quat_from_euler312, quat_from_matrix, quat_product
from imud.sample import Quaternion, Vector3
from imud.sim.physics.motion import Truth

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)


class MountingRotation:
    """The rotations in force. Without any it is not `active`, and `turned` returns its argument."""

    def __init__(
        self,
        frame: Quaternion = UPRIGHT,
        level: Quaternion = UPRIGHT,
        level_accel: bool = False,
        yaw_rad: float = 0.0,
    ) -> None:
        self.active = yaw_rad != 0.0 or frame != UPRIGHT or level != UPRIGHT
        self._frame = frame
        self._accel = quat_product(frame, level) if level_accel else frame
        self._body = quat_product(frame, level)
        self._heading = (cos(yaw_rad / 2), 0.0, 0.0, sin(yaw_rad / 2))

    def turned(self, truth: Truth) -> Truth:
        """Rotate a truth from the chip's frame to that of the mounted module."""
        if not self.active:
            return truth
        quat_wxyz = quat_product(quat_product(self._heading, truth.quat_wxyz), self._body)
        return truth._replace(
            accel_m_s2=turned_back(self._accel, truth.accel_m_s2),
            gyro_rad_s=turned_back(self._frame, truth.gyro_rad_s),
            mag_t=turned_back(self._frame, truth.mag_t),
            euler_rad=euler312_from_quat(quat_wxyz),
            quat_wxyz=quat_wxyz,
        )


def frame_of(matrix: Matrix3) -> Quaternion:
    """The rotation nearest to a nearly orthonormal right-handed matrix, first row kept in direction."""
    x = _unit(matrix[0])
    z = _unit(_cross(x, matrix[1]))
    return quat_from_matrix((x, _cross(z, x), z))


def level_of(quat_wxyz: Quaternion, upside_down: bool = False) -> Quaternion:
    """The turn about the body after which roll and pitch read 0° (or 180° and 0°) and yaw what it was."""
    yaw = euler312_from_quat(quat_wxyz)[2]
    w, x, y, z = quat_wxyz
    return quat_product((w, -x, -y, -z), quat_from_euler312((pi if upside_down else 0.0, 0.0, yaw)))


def turned_back(quat_wxyz: Quaternion, vector: Vector3) -> Vector3:
    """Cᵀ · v, where C is the matrix of the unit quaternion."""
    w, x, y, z = quat_wxyz
    _, vx, vy, vz = quat_product(quat_product((w, -x, -y, -z), (0.0, *vector)), quat_wxyz)
    return vx, vy, vz


def _unit(v: Vector3) -> Vector3:
    norm = hypot(*v)
    return v[0] / norm, v[1] / norm, v[2] / norm


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
