"""The true values follow physics: rates are derivatives, gravity points down, axes have the signs of the manual.
Rotations of axes, level and heading, compared with rotation matrices.
Noise has the declared strength, depends on its seed, and does not change the attitude."""

from math import asin, degrees, hypot, pi, radians, sin
from statistics import correlation, fmean, pstdev

import pytest

from imud.attitude.rotation import euler312_from_quat, matrix_from_quat, quat_from_euler312, quat_product
from imud.model.sample import Quaternion, Vector3
from imud.sim import physics

TIMES_S = [0.0, 1.9, 1000.25]


def times(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return a ⊗ b with vector algebra, independent of the code in imud."""
    (aw, *u), (bw, *v) = a, b
    cross = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    x, y, z = (aw * v[i] + bw * u[i] + cross[i] for i in range(3))
    return (aw * bw - sum(i * j for i, j in zip(u, v, strict=True)), x, y, z)


def inverse(q: Quaternion) -> Quaternion:
    w, x, y, z = q
    return (w, -x, -y, -z)


def into_enu(q: Quaternion, v: Vector3) -> Vector3:
    x, y, z = (sum(c * value for c, value in zip(row, v, strict=True)) for row in matrix_from_quat(q))
    return (x, y, z)


@pytest.mark.parametrize("t_s", TIMES_S)
def test_angular_rate_is_the_derivative_of_the_attitude(t_s: float) -> None:
    motion, h = physics.swing(), 1e-4
    step = times(inverse(motion.at(t_s - h).quat_wxyz), motion.at(t_s + h).quat_wxyz)
    numeric = tuple(2 * part / (2 * h) for part in step[1:])
    assert motion.at(t_s).gyro_rad_s == pytest.approx(numeric, abs=1e-6)
    assert hypot(*numeric) > 0.05
    truth = physics.swing().at(t_s)
    assert into_enu(truth.quat_wxyz, truth.mag_t) == pytest.approx(physics.FIELD_ENU_T, abs=1e-18)


@pytest.mark.parametrize("name", physics.MOTIONS)
@pytest.mark.parametrize("t_s", TIMES_S)
def test_euler_angles_and_quaternion_agree(name: str, t_s: float) -> None:
    truth = physics.MOTIONS[name](physics.GRAVITY_M_S2).at(t_s)
    roll, pitch, yaw = euler312_from_quat(truth.quat_wxyz)
    assert hypot(*truth.quat_wxyz) == pytest.approx(1.0, abs=1e-12)
    assert (roll, pitch, yaw) == pytest.approx(truth.euler_rad, abs=1e-12)


@pytest.mark.parametrize("t_s", TIMES_S)
def test_specific_force_is_acceleration_less_gravity(t_s: float) -> None:
    up = physics.Sine(0.3, 0.5, 0.2)
    motion = physics.Swing(
        roll=(physics.Sine(0.4, 0.3),),
        yaw=(physics.Sine(1.0, 0.2),),
        position_enu=((), (physics.Sine(0.1, 1.0),), (up,)),
    )
    h, height = 1e-4, [0.3 * sin(2 * pi * 0.5 * t + 0.2) for t in (t_s - 1e-4, t_s, t_s + 1e-4)]
    truth = motion.at(t_s)
    east, north, vertical = into_enu(truth.quat_wxyz, truth.accel_m_s2)
    assert east == pytest.approx(0.0, abs=1e-12)
    assert north == pytest.approx(-0.1 * (2 * pi) ** 2 * sin(2 * pi * t_s), abs=1e-9)
    assert vertical == pytest.approx(physics.GRAVITY_M_S2 + (height[0] - 2 * height[1] + height[2]) / h**2, abs=1e-4)
    assert truth.pressure_pa == pytest.approx(physics.SEA_LEVEL_PA + physics.PA_PER_M * height[1], abs=1e-6)


@pytest.mark.parametrize("gravity_m_s2", [9.8, 9.80665, 9.7803])
def test_at_rest_the_force_is_gravity_and_nothing_turns(gravity_m_s2: float) -> None:
    still = physics.Still(0.2, -0.3, 2.0, gravity_m_s2=gravity_m_s2)
    truth = still.at(3.0)
    assert hypot(*truth.accel_m_s2) == pytest.approx(gravity_m_s2, abs=1e-12)
    assert truth.gyro_rad_s == (0.0, 0.0, 0.0)
    assert truth.euler_rad == pytest.approx((0.2, -0.3, 2.0))
    assert still.at(0.0)[:5] == truth[:5]
    assert still.at(0.0).temperature_c != truth.temperature_c


def test_axes_and_yaw_have_the_signs_of_chapter_9_and_pitch_is_below_ninety_degrees() -> None:
    truth = physics.Still(0.0, 0.0, radians(90), field_enu_t=(0.0, 1.0, 0.0)).at(0.0)
    assert truth.mag_t == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)  # facing west, north is on the right
    motion = physics.swing()
    first = motion.at(1.25)
    motion.at(7.0)
    assert motion.at(1.25) == first
    with pytest.raises(ValueError, match="90°"):
        physics.Swing(pitch=(physics.Sine(1.0, 0.1), physics.Sine(0.6, 0.2)))
    assert max(abs(degrees(asin(sin(physics.swing().at(t / 10).euler_rad[1])))) for t in range(600)) < 30
    for roll_deg, pitch_deg, force in (
        (0, 0, (0.0, 0.0, 1.0)), (0, 30, (0.0, 0.5, 0.75**0.5)), (30, 0, (-0.5, 0.0, 0.75**0.5)),
    ):  # fmt: skip
        # pitch about x lifts y, the forward axis; roll about y lowers x, the right-hand axis
        truth = physics.Still(radians(roll_deg), radians(pitch_deg), 0.7, gravity_m_s2=1.0).at(0.0)
        assert truth.accel_m_s2 == pytest.approx(force, abs=1e-12)


A = quat_from_euler312((0.3, -0.5, 2.0))
B = quat_from_euler312((-1.0, 0.2, -0.7))


def test_products_and_rotations_agree_with_matrices() -> None:
    a, b, ab = matrix_from_quat(A), matrix_from_quat(B), matrix_from_quat(quat_product(A, B))
    for i in range(3):
        for j in range(3):
            assert ab[i][j] == pytest.approx(sum(a[i][k] * b[k][j] for k in range(3)), abs=1e-12)
    v, matrix = (1.0, -2.0, 0.5), matrix_from_quat(A)
    expected = [sum(matrix[k][i] * v[k] for k in range(3)) for i in range(3)]
    assert physics.turned_back(A, v) == pytest.approx(expected, abs=1e-12)
    truth = physics.swing().at(1.0)
    assert not physics.MountingRotation().active
    assert physics.MountingRotation().turned(truth) is truth
    rows = [[round(value, 3) for value in row] for row in matrix]
    q = physics.frame_of(((*rows[0],), (*rows[1],), (*rows[2],)))  # type: ignore[arg-type]  # three numbers each
    assert q == pytest.approx(A, abs=2e-3)
    assert sum(part * part for part in q) == pytest.approx(1.0, abs=1e-12)


def test_heading_turns_about_the_vertical_and_level_keeps_yaw() -> None:
    truth = physics.Still(0.2, 0.1, 0.5).at(0.0)
    turned = physics.MountingRotation(yaw_rad=radians(90)).turned(truth)
    assert turned.euler_rad == pytest.approx((0.2, 0.1, 0.5 + pi / 2), abs=1e-12)
    assert turned.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-12)
    assert turned.mag_t == pytest.approx(truth.mag_t, abs=1e-18)
    truth = physics.Still(0.05, 0.02, 0.5).at(0.0)
    level = physics.level_of(truth.quat_wxyz)
    assert physics.MountingRotation(level=level).turned(truth).accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-12)
    with_accel = physics.MountingRotation(level=level, level_accel=True).turned(truth)
    assert with_accel.accel_m_s2 == pytest.approx((0.0, 0.0, 9.8), abs=1e-12)
    assert (with_accel.gyro_rad_s, physics.UPRIGHT) == (truth.gyro_rad_s, (1.0, 0.0, 0.0, 0.0))
    for upside_down in (False, True):
        roll, pitch, yaw = euler312_from_quat(quat_product(A, physics.level_of(A, upside_down)))
        assert abs(roll) == pytest.approx(pi if upside_down else 0.0, abs=1e-12)
        assert pitch == pytest.approx(0.0, abs=1e-12)
        assert yaw == pytest.approx(2.0, abs=1e-12)


TRUTH = physics.Still().at(0.0)


def test_white_noise_has_the_stated_spread() -> None:
    levels = physics.NoiseLevels(accel_m_s2=0.1, gyro_rad_s=0.2, mag_t=0.3, pressure_pa=4.0)
    noise = physics.Noise(7, levels)
    read = [noise.add(TRUTH, 0.0) for _ in range(2000)]
    for axis in range(3):
        assert pstdev(r.accel_m_s2[axis] for r in read) == pytest.approx(0.1, rel=0.06)
        assert pstdev(r.gyro_rad_s[axis] for r in read) == pytest.approx(0.2, rel=0.06)
        assert pstdev(r.mag_t[axis] for r in read) == pytest.approx(0.3, rel=0.06)
    assert pstdev(r.pressure_pa for r in read) == pytest.approx(4.0, rel=0.06)


def test_noise_is_white_around_truth_plus_bias() -> None:
    noise = physics.Noise(5)
    read, bias = [noise.add(TRUTH, 42.0) for _ in range(2000)], noise.bias(42.0)[1]
    for axis in range(3):
        mean = fmean(r.gyro_rad_s[axis] for r in read)
        assert mean == pytest.approx(TRUTH.gyro_rad_s[axis] + bias[axis], abs=5e-5)
    x, y, *_ = ([r.accel_m_s2[axis] for r in read] for axis in range(3))
    for a, b in ((x[1:], x[:-1]), (x, y), (x[1:], y[:-1])):
        assert abs(correlation(a, b)) < 0.09  # 4 sigma of 2000 samples


def test_bias_wanders_slowly_within_its_bounds() -> None:
    levels = physics.NoiseLevels()
    noise = physics.Noise(3, levels)
    biases = [noise.bias(t) for t in range(0, 700, 7)]
    for part, bound in enumerate((levels.accel_bias_m_s2, levels.gyro_bias_rad_s, levels.mag_bias_t)):
        for axis in range(3):
            values = [bias[part][axis] for bias in biases]
            assert 0.9 * bound < max(map(abs, values)) <= bound
    near, far = noise.bias(100.0)[0][0], noise.bias(100.01)[0][0]
    assert 0 < abs(near - far) < 1e-5


def test_the_seed_decides_and_the_attitude_stays_true() -> None:
    def run(seed: int) -> list[float]:
        noise = physics.Noise(seed)
        return [noise.add(TRUTH, n / 100).mag_t[1] for n in range(20)]

    assert run(1) == run(1)
    assert run(1) != run(2)
    read = physics.Noise(1).add(TRUTH, 1.0)
    assert read[3:6] == TRUTH[3:6]
    assert hypot(*read.accel_m_s2) != hypot(*TRUTH.accel_m_s2)
    assert fmean(physics.NORMAL) == pytest.approx(0.0, abs=1e-12)
    assert pstdev(physics.NORMAL) == pytest.approx(1.0, abs=1e-3)
