"""Attitude: the manual's example, known rotations, round trips, pitch ±90°, and a recording."""

import csv
import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.attitude import rotation
from imud.model.sample import Quaternion, Vector3
from tests.support.files import SHARED

RECORDING = SHARED / "data" / "hi91-static-100hz.csv"
HALF = math.sqrt(0.5)

component = st.floats(-1, 1)
quats = (
    st.tuples(component, component, component, component)
    .filter(lambda q: math.hypot(*q) > 1e-3)
    .map(rotation.quat_normalized)
)
steep = st.one_of(st.floats(-math.pi / 2, math.pi / 2), st.sampled_from([math.pi / 2, -math.pi / 2]))
angles = st.floats(-math.pi, math.pi)


def degrees(euler_rad: Vector3) -> Vector3:
    roll, pitch, yaw = map(math.degrees, euler_rad)
    return (roll, pitch, yaw)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the rotation from a to b, rad. The sine keeps its digits near zero."""
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    sign = math.copysign(1.0, dot)
    return 4 * math.asin(min(1.0, math.dist(a, [sign * x for x in b]) / 2))


@pytest.mark.manual("B 9.1 angles of a quaternion")
def test_manual_example() -> None:
    """Section 3.5: the quaternion gives 13.0519° / 12.1885° / -122.477°."""
    euler = degrees(rotation.euler312_from_quat((-0.485922, -0.14982, 0.0380868, 0.860223)))
    assert euler == pytest.approx((13.0519, 12.1885, -122.4771), abs=2e-4)


@pytest.mark.parametrize(
    ("quat", "euler_deg"),
    [
        ((1.0, 0.0, 0.0, 0.0), (0, 0, 0)),
        ((HALF, 0.0, 0.0, HALF), (0, 0, 90)),  # about Z: yaw, counter-clockwise positive
        ((HALF, HALF, 0.0, 0.0), (0, 90, 0)),  # about X: pitch
        ((HALF, 0.0, HALF, 0.0), (90, 0, 0)),  # about Y: roll
        ((HALF, -HALF, 0.0, 0.0), (0, -90, 0)),
        ((5.0, 0.0, 0.0, 0.0), (0, 0, 0)),  # length does not matter
    ],
)
def test_turns_about_one_axis(quat: Quaternion, euler_deg: Vector3) -> None:
    assert degrees(rotation.euler312_from_quat(quat)) == pytest.approx(euler_deg, abs=1e-6)


@pytest.mark.manual("B 9.2 matrix of a quaternion")
def test_the_matrix_turns_body_to_navigation() -> None:
    """A body that is rotated left by 90° has its x axis (before: east) pointing north."""
    left, up = rotation.matrix_from_quat((HALF, 0.0, 0.0, HALF)), rotation.matrix_from_euler312((0, math.pi / 2, 0))
    assert rotation.matrix_times(left, (1, 0, 0)) == pytest.approx((0, 1, 0), abs=1e-15)
    assert rotation.matrix_times(up, (0, 1, 0)) == pytest.approx((0, 0, 1), abs=1e-15)


@given(quats)
def test_quaternion_to_matrix_or_euler_and_back(quat: Quaternion) -> None:
    matrix = rotation.matrix_from_quat(quat)
    assert rotation.is_rotation(matrix, 1e-12)
    back = rotation.quat_from_matrix(matrix)
    assert back[0] >= 0
    assert angle_between(quat, back) < 1e-7
    assert angle_between(quat, rotation.quat_from_euler312(rotation.euler312_from_quat(quat))) < 1e-7
    assert rotation.quat_from_matrix(((-1, 0, 0), (0, -1, 0), (0, 0, 1))) == (0, 0, 0, 1)


@given(angles, steep, angles)
def test_euler_to_quaternion_and_back_is_the_same_rotation(roll: float, pitch: float, yaw: float) -> None:
    """At pitch ±90°, the angles are not unique; the rotation is."""
    quat = rotation.quat_from_euler312((roll, pitch, yaw))
    assert math.hypot(*quat) == pytest.approx(1)
    euler = rotation.euler312_from_quat(quat)
    assert angle_between(quat, rotation.quat_from_euler312(euler)) < 1e-7
    if abs(pitch) < 1.5:
        is_half_turn = math.pi - max(abs(roll), abs(yaw)) < 1e-9
        assert is_half_turn or euler == pytest.approx((roll, pitch, yaw), abs=1e-9)


@given(st.floats(-3, 3), st.floats(-0.5, 0.5), st.floats(-3, 3))
@pytest.mark.manual("B 9.1 angles of a quaternion")
def test_the_manual_formula_gives_the_same(roll: float, pitch: float, yaw: float) -> None:
    """Section 9.1 as printed, away from its singularities."""
    q0, q1, q2, q3 = rotation.quat_from_euler312((roll, pitch, yaw))
    printed = (
        -math.atan2(2 * (q1 * q3 - q0 * q2), q0**2 - q1**2 - q2**2 + q3**2),
        math.asin(2 * (q0 * q1 + q2 * q3)),
        -math.atan2(2 * (q1 * q2 - q0 * q3), q0**2 - q1**2 + q2**2 - q3**2),
    )
    assert printed == pytest.approx((roll, pitch, yaw), abs=1e-9)
    assert rotation.euler312_from_quat((q0, q1, q2, q3)) == pytest.approx(printed, abs=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_straight_up_and_down_all_of_the_turn_is_yaw(sign: int) -> None:
    up = sign * math.pi / 2
    for found, yaw in (
        (rotation.euler312_from_quat(rotation.quat_from_euler312((0.3, up, 0.5))), 0.5 + sign * 0.3),
        (rotation.euler_zyx_from_quat(rotation.quat_from_euler_zyx((0.3, up, 1.0))), 1.0 - sign * 0.3),
    ):
        assert found[0] == 0
        assert found[1:] == pytest.approx((up, yaw), abs=1e-7)
    limit = rotation.GIMBAL_COS_PITCH  # cosine of the pitch from which the roll is known
    rolls = (
        rotation.euler312_from_matrix(((0.6, 0.8, 0.0), (0.8, -0.6, 0.0), (-limit, sign, 0.0)))[0],
        rotation.euler_zyx_from_matrix(((0.0, -0.6, 0.8), (0.0, 0.8, 0.6), (-sign, limit, 0.0)))[0],
        rotation.euler_zyx_from_quat((1.0, limit, sign, 0.0))[0],
    )
    assert rolls == pytest.approx((math.pi / 2,) * 3, abs=1e-7)


@pytest.mark.parametrize("convert", [rotation.euler312_from_quat, rotation.euler_zyx_from_quat])
@pytest.mark.parametrize("quat", [(0.0,) * 4, (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)])
def test_quaternions_without_direction_are_refused(quat: Quaternion, convert: Callable[[Quaternion], Vector3]) -> None:
    with pytest.raises(ValueError, match="expected a length above zero"):
        convert(quat)


@pytest.mark.parametrize(
    "matrix",
    [
        ((1, 0, 0), (0, 1, 0), (0, 0, -1)), ((1, 0, 0), (0, 2, 0), (0, 0, 1)), ((1, 0, 0), (1, 0, 0), (0, 0, 1)),
        ((math.nan, 0, 0), (0, 1, 0), (0, 0, 1)), ((1, 0, 0), (0, 1 + 8e-7, 0), (0, 0, 1)),
    ],
)  # fmt: skip
def test_other_matrices_are_rejected(matrix: rotation.Matrix3) -> None:
    assert not rotation.is_rotation(matrix)
    with pytest.raises(ValueError, match="orthonormal"):
        rotation.quat_from_matrix(matrix)


@pytest.mark.skipif(not RECORDING.exists(), reason=f"the recording is not at {RECORDING}; set IMUD_SHARED")
def test_recording_of_a_module_at_rest() -> None:
    """1,000 rows: the quaternion gives the angles that the device computed."""
    with RECORDING.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    worst_deg = 0.0
    for row in rows:
        quat = (float(row["quat_w"]), float(row["quat_x"]), float(row["quat_y"]), float(row["quat_z"]))
        euler = degrees(rotation.euler312_from_quat(quat))
        sent = (float(row["roll"]), float(row["pitch"]), float(row["yaw"]))
        worst_deg = max(worst_deg, *(abs(a - b) for a, b in zip(euler, sent, strict=True)))
    assert worst_deg < 1.2e-4


@pytest.mark.parametrize(
    ("euler_deg", "quat"),
    [
        ((90, 0, 0), (HALF, HALF, 0, 0)),  # roll is about X here
        ((0, 90, 0), (HALF, 0, HALF, 0)),  # pitch about Y
        ((0, 0, 90), (HALF, 0, 0, HALF)),
        ((90, 0, 90), (0.5, 0.5, 0.5, 0.5)),  # Rz(90°) · Rx(90°): x → y → z → x
    ],
)
def test_zyx_turns_about_the_axes(euler_deg: Vector3, quat: Quaternion) -> None:
    roll, pitch, yaw = map(math.radians, euler_deg)
    assert rotation.quat_from_euler_zyx((roll, pitch, yaw)) == pytest.approx(quat, abs=1e-15)


@given(roll=angles, pitch=st.floats(-1.57, 1.57), yaw=angles)
def test_zyx_is_the_product_of_its_turns(roll: float, pitch: float, yaw: float) -> None:
    """Compare with the same rotations as 312 rotations about one axis each, multiplied as matrices."""
    about_z, about_y, about_x = (
        rotation.matrix_from_euler312(one) for one in ((0, 0, yaw), (pitch, 0, 0), (0, roll, 0))
    )
    wanted = rotation.matrix_product(rotation.matrix_product(about_z, about_y), about_x)
    found = rotation.matrix_from_quat(rotation.quat_from_euler_zyx((roll, pitch, yaw)))
    for row, other in zip(found, wanted, strict=True):
        assert row == pytest.approx(other, abs=1e-12)


@given(roll=angles, pitch=st.floats(-1.5, 1.5), yaw=angles)
def test_round_trip_of_zyx_angles(roll: float, pitch: float, yaw: float) -> None:
    found = rotation.euler_zyx_from_matrix(rotation.matrix_from_quat(rotation.quat_from_euler_zyx((roll, pitch, yaw))))
    for value, wanted in zip(found, (roll, pitch, yaw), strict=True):
        assert math.remainder(value - wanted, 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(angles, steep, angles, st.sampled_from([1e-170, 1e-3, 1.0, -2.0, 1e170]))
def test_zyx_angles_of_a_quaternion_of_any_length_equal_the_angles_of_its_matrix(
    roll: float, pitch: float, yaw: float, length: float
) -> None:
    """The square can overflow or underflow."""
    w, x, y, z = rotation.quat_from_euler_zyx((roll, pitch, yaw))
    quat = (w * length, x * length, y * length, z * length)
    found, wanted = rotation.euler_zyx_from_quat(quat), rotation.euler_zyx_from_matrix(rotation.matrix_from_quat(quat))
    assert found[1] == pytest.approx(wanted[1], abs=1e-12)
    for euler in (found, wanted):
        pairs = zip(rotation.quat_from_euler_zyx(euler), (w, x, y, z), strict=True)
        assert abs(sum(a * b for a, b in pairs)) == pytest.approx(1, abs=1e-12)
