"""Attitude as quaternion, Euler angles (312 and ZYX) and rotation matrix, with conversions between them.

All functions use one convention: the rotation takes a vector from the body frame (right-handed: x right, y forward, z
up) to the navigation frame ENU (x east, y north, z up), v_n = C v_b. Quaternions are scalar first, of any length; q and
-q are the same rotation. Euler angles are (roll, pitch, yaw) in rad and rotate in the order Z → X → Y:

    C = Rz(yaw) · Rx(pitch) · Ry(roll)      yaw and roll in [-π, π], pitch in [-π/2, π/2]

Pitch is about X and roll about Y; yaw is counter-clockwise from above. Source: HiPNUC manual V1.5.9, chapter 9.

Other devices rotate in the order Z → Y → X (aerospace order, 321), with roll about X and pitch about Y:

    C = Rz(yaw) · Ry(pitch) · Rx(roll)      yaw and roll in [-π, π], pitch in [-π/2, π/2]
"""

import math
from math import cos, sin
from typing import Final

from imud.model.sample import Quaternion, Vector3

Matrix3 = tuple[Vector3, Vector3, Vector3]  # rows of a 3 × 3 matrix
IDENTITY: Final[Matrix3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

# Limit of cos(pitch) below which roll and yaw rotate about the same axis: yaw gets the complete rotation. The error is
# about cos(pitch), otherwise about 1e-16 / cos(pitch); both are 1e-8 rad at the limit.
GIMBAL_COS_PITCH: Final = 1e-8


def quat_normalized(quat_wxyz: Quaternion) -> Quaternion:
    """Return the quaternion with unit length. Raises ValueError for a zero, NaN or infinite quaternion."""
    w, x, y, z = quat_wxyz
    norm = math.hypot(w, x, y, z)
    if not 0.0 < norm < math.inf:
        raise ValueError(f"quaternion {quat_wxyz}: expected a length above zero and finite, got {norm}")
    return (w / norm, x / norm, y / norm, z / norm)


def matrix_from_quat(quat_wxyz: Quaternion) -> Matrix3:
    """Return the rotation matrix body → navigation (manual 9.2). Raises ValueError for a zero or infinite one."""
    w, x, y, z = quat_normalized(quat_wxyz)
    return (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )


def quat_from_matrix(matrix: Matrix3) -> Quaternion:
    """Return the unit quaternion of a rotation matrix, with w ≥ 0. Raises ValueError for other matrices."""
    if not is_rotation(matrix):
        raise ValueError(f"matrix {matrix}: expected orthonormal rows and determinant +1")
    (a, b, c), (d, e, f), (g, h, i) = matrix
    candidates = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    # the largest component avoids a division by a small number
    k = max(range(4), key=lambda row: candidates[row][row])
    w, x, y, z = quat_normalized(candidates[k])
    return (w, x, y, z) if w >= 0 else (-w, -x, -y, -z)


def euler312_from_matrix(matrix: Matrix3) -> Vector3:
    """Return (roll, pitch, yaw) of a rotation matrix, rad. Roll is 0 at pitch ±90°."""
    (c00, c01, _), (c10, c11, _), (c20, c21, c22) = matrix
    cos_pitch = math.hypot(c20, c22)
    # atan2, not the manual's arcsin: near ±90° arcsin loses half of the digits, and it raises above 1 by rounding
    pitch = math.atan2(c21, cos_pitch)
    if cos_pitch < GIMBAL_COS_PITCH:
        return (0.0, pitch, math.atan2(c10, c00))
    return (math.atan2(-c20, c22), pitch, math.atan2(-c01, c11))


def euler312_from_quat(quat_wxyz: Quaternion) -> Vector3:
    """Return (roll, pitch, yaw), rad (manual 9.1). Raises ValueError for a zero or infinite quaternion."""
    return euler312_from_matrix(matrix_from_quat(quat_wxyz))


def quat_from_euler312(euler_rad: Vector3) -> Quaternion:
    """Return the unit quaternion of (roll, pitch, yaw), rad: the product of the quaternions about Z, X and Y."""
    roll, pitch, yaw = euler_rad
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cy * cp * cr - sy * sp * sr,
        cy * sp * cr - sy * cp * sr,
        cy * cp * sr + sy * sp * cr,
        sy * cp * cr + cy * sp * sr,
    )


def matrix_from_euler312(euler_rad: Vector3) -> Matrix3:
    """Return the rotation matrix body → navigation of (roll, pitch, yaw), rad."""
    return matrix_from_quat(quat_from_euler312(euler_rad))


def quat_from_euler_zyx(euler_rad: Vector3) -> Quaternion:
    """Return the unit quaternion of (roll, pitch, yaw), rad, order ZYX: the product of rotations about Z, Y, X."""
    roll, pitch, yaw = euler_rad
    roll, pitch, yaw = roll / 2, pitch / 2, yaw / 2
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    cy_cp, sy_sp, cy_sp, sy_cp = cy * cp, sy * sp, cy * sp, sy * cp
    return (cy_cp * cr + sy_sp * sr, cy_cp * sr - sy_sp * cr, cy_sp * cr + sy_cp * sr, sy_cp * cr - cy_sp * sr)


def euler_zyx_from_matrix(matrix: Matrix3) -> Vector3:
    """Return (roll, pitch, yaw) of a rotation matrix, rad, order ZYX. Roll is 0 at pitch ±90°."""
    (c00, c01, _), (c10, c11, _), (c20, c21, c22) = matrix
    cos_pitch = math.hypot(c21, c22)
    pitch = math.atan2(-c20, cos_pitch)
    if cos_pitch < GIMBAL_COS_PITCH:
        return (0.0, pitch, math.atan2(-c01, c11))
    return (math.atan2(c21, c22), pitch, math.atan2(c10, c00))


def euler_zyx_from_quat(quat_wxyz: Quaternion) -> Vector3:
    """Return (roll, pitch, yaw), rad, order ZYX. Raises ValueError for a zero or infinite quaternion."""
    # called for each sample: only the necessary elements of euler_zyx_from_matrix, not divided by the squared length
    w, x, y, z = quat_wxyz
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    square = ww + xx + yy + zz
    if not 0.0 < square < math.inf:
        return euler_zyx_from_matrix(matrix_from_quat(quat_wxyz))  # overflow, underflow or no direction
    c21, c22 = 2 * (y * z + w * x), ww - xx - yy + zz
    cos_pitch = math.hypot(c21, c22)
    pitch = math.atan2(2 * (w * y - x * z), cos_pitch)
    if cos_pitch < GIMBAL_COS_PITCH * square:
        return (0.0, pitch, math.atan2(2 * (w * z - x * y), ww - xx + yy - zz))
    return (math.atan2(c21, c22), pitch, math.atan2(2 * (x * y + w * z), ww + xx - yy - zz))


def is_rotation(matrix: Matrix3, tolerance: float = 1e-6) -> bool:
    """Return whether the rows are orthonormal within `tolerance` and the determinant is +1, not -1 (a mirror image)."""
    x, y, z = matrix
    products = ((x, x, 1.0), (y, y, 1.0), (z, z, 1.0), (x, y, 0.0), (y, z, 0.0), (z, x, 0.0))
    # NaN must fail every comparison
    orthonormal = all(abs(dot(a, b) - wanted) <= tolerance for a, b, wanted in products)
    return orthonormal and dot(x, _cross(y, z)) > 0


def matrix_product(a: Matrix3, b: Matrix3) -> Matrix3:
    """Return a · b: first b, then a."""
    columns = transposed(b)
    first, second, third = (matrix_times(columns, row) for row in a)
    return (first, second, third)


def matrix_times(matrix: Matrix3, vector: Vector3) -> Vector3:
    return (dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector))


def transposed(matrix: Matrix3) -> Matrix3:
    """Return the transpose: the inverse of a rotation."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return ((a, d, g), (b, e, h), (c, f, i))


def quat_product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return a ⊗ b: first b, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def dot(a: Vector3, b: Vector3) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
