"""The true values follow physics: rates are derivatives, gravity points down, axes have the signs of the manual."""

from math import asin, degrees, hypot, pi, radians, sin

import pytest

from imud.attitude.rotation import euler312_from_quat, matrix_from_quat
from imud.model.sample import Quaternion, Vector3
from imud.sim.physics import FIELD_ENU_T, GRAVITY_M_S2, MOTIONS, PA_PER_M, SEA_LEVEL_PA, Sine, Still, Swing, swing

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
    motion, h = swing(), 1e-4
    step = times(inverse(motion.at(t_s - h).quat_wxyz), motion.at(t_s + h).quat_wxyz)
    numeric = tuple(2 * part / (2 * h) for part in step[1:])
    assert motion.at(t_s).gyro_rad_s == pytest.approx(numeric, abs=1e-6)
    assert hypot(*numeric) > 0.05
    truth = swing().at(t_s)
    assert into_enu(truth.quat_wxyz, truth.mag_t) == pytest.approx(FIELD_ENU_T, abs=1e-18)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("t_s", TIMES_S)
def test_euler_angles_and_quaternion_agree(name: str, t_s: float) -> None:
    truth = MOTIONS[name](GRAVITY_M_S2).at(t_s)
    roll, pitch, yaw = euler312_from_quat(truth.quat_wxyz)
    assert hypot(*truth.quat_wxyz) == pytest.approx(1.0, abs=1e-12)
    assert (roll, pitch, yaw) == pytest.approx(truth.euler_rad, abs=1e-12)


@pytest.mark.parametrize("t_s", TIMES_S)
def test_specific_force_is_acceleration_less_gravity(t_s: float) -> None:
    up = Sine(0.3, 0.5, 0.2)
    motion = Swing(roll=(Sine(0.4, 0.3),), yaw=(Sine(1.0, 0.2),), position_enu=((), (Sine(0.1, 1.0),), (up,)))
    h, height = 1e-4, [0.3 * sin(2 * pi * 0.5 * t + 0.2) for t in (t_s - 1e-4, t_s, t_s + 1e-4)]
    truth = motion.at(t_s)
    east, north, vertical = into_enu(truth.quat_wxyz, truth.accel_m_s2)
    assert east == pytest.approx(0.0, abs=1e-12)
    assert north == pytest.approx(-0.1 * (2 * pi) ** 2 * sin(2 * pi * t_s), abs=1e-9)
    assert vertical == pytest.approx(GRAVITY_M_S2 + (height[0] - 2 * height[1] + height[2]) / h**2, abs=1e-4)
    assert truth.pressure_pa == pytest.approx(SEA_LEVEL_PA + PA_PER_M * height[1], abs=1e-6)


@pytest.mark.parametrize("gravity_m_s2", [9.8, 9.80665, 9.7803])
def test_at_rest_the_force_is_gravity_and_nothing_turns(gravity_m_s2: float) -> None:
    still = Still(0.2, -0.3, 2.0, gravity_m_s2=gravity_m_s2)
    truth = still.at(3.0)
    assert hypot(*truth.accel_m_s2) == pytest.approx(gravity_m_s2, abs=1e-12)
    assert truth.gyro_rad_s == (0.0, 0.0, 0.0)
    assert truth.euler_rad == pytest.approx((0.2, -0.3, 2.0))
    assert still.at(0.0)[:5] == truth[:5]
    assert still.at(0.0).temperature_c != truth.temperature_c


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "force"),
    [(0, 0, (0.0, 0.0, 1.0)), (0, 30, (0.0, 0.5, 0.75**0.5)), (30, 0, (-0.5, 0.0, 0.75**0.5))],
)
def test_axes_have_the_signs_of_chapter_9(roll_deg: float, pitch_deg: float, force: Vector3) -> None:
    # pitch about x lifts y, the forward axis; roll about y lowers x, the right-hand axis
    truth = Still(radians(roll_deg), radians(pitch_deg), 0.7, gravity_m_s2=1.0).at(0.0)
    assert truth.accel_m_s2 == pytest.approx(force, abs=1e-12)


def test_yaw_is_counter_clockwise_and_pitch_below_ninety_degrees() -> None:
    truth = Still(0.0, 0.0, radians(90), field_enu_t=(0.0, 1.0, 0.0)).at(0.0)
    assert truth.mag_t == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)  # facing west, north is on the right
    motion = swing()
    first = motion.at(1.25)
    motion.at(7.0)
    assert motion.at(1.25) == first
    with pytest.raises(ValueError, match="90°"):
        Swing(pitch=(Sine(1.0, 0.1), Sine(0.6, 0.2)))
    assert max(abs(degrees(asin(sin(swing().at(t / 10).euler_rad[1])))) for t in range(600)) < 30
