"""Rotations of axes, level and heading, compared with rotation matrices."""

from math import pi, radians

import pytest

from imud.attitude.rotation import euler312_from_quat, matrix_from_quat, quat_from_euler312, quat_product
from imud.sim.physics import UPRIGHT, MountingRotation, Still, frame_of, level_of, swing, turned_back

A = quat_from_euler312((0.3, -0.5, 2.0))
B = quat_from_euler312((-1.0, 0.2, -0.7))


def test_products_and_rotations_agree_with_matrices() -> None:
    a, b, ab = matrix_from_quat(A), matrix_from_quat(B), matrix_from_quat(quat_product(A, B))
    for i in range(3):
        for j in range(3):
            assert ab[i][j] == pytest.approx(sum(a[i][k] * b[k][j] for k in range(3)), abs=1e-12)

    v, matrix = (1.0, -2.0, 0.5), matrix_from_quat(A)
    expected = [sum(matrix[k][i] * v[k] for k in range(3)) for i in range(3)]
    assert turned_back(A, v) == pytest.approx(expected, abs=1e-12)

    truth = swing().at(1.0)
    assert not MountingRotation().active
    assert MountingRotation().turned(truth) is truth

    rows = [[round(value, 3) for value in row] for row in matrix]
    q = frame_of(((*rows[0],), (*rows[1],), (*rows[2],)))  # type: ignore[arg-type]  # three numbers each
    assert q == pytest.approx(A, abs=2e-3)
    assert sum(part * part for part in q) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("upside_down", [False, True])
def test_level_keeps_yaw(upside_down: bool) -> None:
    roll, pitch, yaw = euler312_from_quat(quat_product(A, level_of(A, upside_down)))
    assert abs(roll) == pytest.approx(pi if upside_down else 0.0, abs=1e-12)
    assert pitch == pytest.approx(0.0, abs=1e-12)
    assert yaw == pytest.approx(2.0, abs=1e-12)


def test_heading_turns_about_the_vertical_and_leaves_vectors() -> None:
    truth = Still(0.2, 0.1, 0.5).at(0.0)
    turned = MountingRotation(yaw_rad=radians(90)).turned(truth)
    assert turned.euler_rad == pytest.approx((0.2, 0.1, 0.5 + pi / 2), abs=1e-12)
    assert turned.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-12)
    assert turned.mag_t == pytest.approx(truth.mag_t, abs=1e-18)

    truth = Still(0.05, 0.02, 0.5).at(0.0)
    level = level_of(truth.quat_wxyz)
    assert MountingRotation(level=level).turned(truth).accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-12)
    with_accel = MountingRotation(level=level, level_accel=True).turned(truth)
    assert with_accel.accel_m_s2 == pytest.approx((0.0, 0.0, 9.8), abs=1e-12)
    assert with_accel.gyro_rad_s == truth.gyro_rad_s
    assert UPRIGHT == (1.0, 0.0, 0.0, 0.0)
