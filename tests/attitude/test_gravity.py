"""Gravity check at rest: no finding for correct conventions and in motion, a cause for each error."""

import csv
from collections.abc import Callable, Iterator
from math import cos, radians, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from imud.attitude import rotation
from imud.attitude.conventions import FLU_LEVEL, RFU_ENU, DeviceAxes, EulerOrder
from imud.attitude.gravity import Contradiction, Finding, GravityCheck, nearest_axis
from imud.attitude.published import matrix_from_axes
from imud.model.sample import Quaternion, Sample, Sync, Vector3
from imud.model.units import NS_PER_S
from tests.support.files import SHARED

G = 9.80665
TICK_NS = NS_PER_S // 10
LEANING = ((30, 0), (0, 30), (25, -35))
"""Roll and pitch, degrees."""
OBLIQUE = (0.5 * G, 0.6 * G, (1 - 0.25 - 0.36) ** 0.5 * G)
FRD = DeviceAxes(order=EulerOrder.ZYX, has_north=False, z_down=True)


def zyx(roll_deg: float, pitch_deg: float, yaw_deg: float = 40.0, z_down: bool = False) -> Sample:
    """Return a sample at rest of a device with ZYX and correct attitude."""
    euler = (radians(roll_deg), radians(pitch_deg), radians(yaw_deg))
    quat = rotation.quat_from_euler_zyx(euler)
    x, y, z = rotation.matrix_times(rotation.transposed(rotation.matrix_from_quat(quat)), (0, 0, -G if z_down else G))
    return Sample(
        "bow", 1, 0, 1, Sync.ARRIVAL, 0, 0, accel_m_s2=(x, y, z), gyro_rad_s=(0, 0, 0), quat_wxyz=quat, euler_rad=euler
    )


def zxy(roll_deg: float, pitch_deg: float, yaw_deg: float = 40.0) -> Sample:
    """Return a sample at rest of a device with ZXY (312) and correct attitude."""
    euler = (radians(roll_deg), radians(pitch_deg), radians(yaw_deg))
    quat = rotation.quat_from_euler312(euler)
    accel = rotation.matrix_times(rotation.transposed(rotation.matrix_from_quat(quat)), (0, 0, G))
    return replace(zyx(0, 0), accel_m_s2=accel, quat_wxyz=quat, euler_rad=euler)


def ticks(sample: Sample, seconds: float = 5.2, start: int = 1) -> Iterator[Sample]:
    """Yield the same values ten times per second."""
    for number in range(start, start + int(seconds * 10)):
        yield replace(sample, seq=number, t_ns=number * TICK_NS)


def found(device: DeviceAxes, sample: Sample, mounting: rotation.Matrix3 | None = None) -> Finding | None:
    """Return the finding of one window at rest."""
    check = GravityCheck(device, mounting)
    assert sum(check.add(one) for one in ticks(sample)) == 1
    return check.finding


def contradiction(
    device: DeviceAxes, sample: Sample, kind: Contradiction, words: str, mounting: rotation.Matrix3 | None = None
) -> Finding:
    """Return the finding of one window at rest. Check its kind and its text."""
    finding = found(device, sample, mounting)
    assert finding is not None
    assert finding.kind is kind
    assert words in finding.message
    return finding


@given(st.floats(-179, 179), st.floats(-89, 89), st.floats(-180, 180))
def test_no_finding_in_any_attitude(roll_deg: float, pitch_deg: float, yaw_deg: float) -> None:
    assert found(FLU_LEVEL, zyx(roll_deg, pitch_deg, yaw_deg)) is None
    assert found(FRD, zyx(roll_deg, pitch_deg, yaw_deg, z_down=True)) is None
    assert found(RFU_ENU, zxy(roll_deg, pitch_deg, yaw_deg)) is None


@pytest.mark.parametrize("member", ["quat_wxyz", "euler_rad"])
@pytest.mark.parametrize(("roll", "pitch"), [(0, 0), (25, 0), (10, -30), (170, 20)])
def test_the_z_axis_points_down(member: str, roll: float, pitch: float) -> None:
    """The sample contains only one of the two attitude members."""
    one = zyx(roll, pitch, z_down=True)
    one = replace(one, quat_wxyz=None) if member == "euler_rad" else replace(one, euler_rad=None)
    finding = contradiction(FLU_LEVEL, one, Contradiction.Z_AXIS, "set frame: {z_down: true}")
    assert member in finding.message
    assert finding.angle_deg == pytest.approx(180)


def seen_as(said: Sample, true: Sample) -> Sample:
    """Return a sample with the attitude of `said` and the acceleration of `true`."""
    return replace(said, accel_m_s2=true.accel_m_s2)


def turned(sample: Sample, convert: Callable[[Vector3], Quaternion]) -> Sample:
    """Return a sample with a quaternion from its angles in another order."""
    assert sample.euler_rad is not None
    return replace(sample, quat_wxyz=convert(sample.euler_rad))


ORDER, SIGN = Contradiction.ORDER, Contradiction.SIGN


@pytest.mark.parametrize(
    ("device", "sample", "kind", "words"),
    [
        (FRD, zyx(10, 5), Contradiction.Z_AXIS, "remove z_down from frame"),
        (FRD, zyx(11, 0), Contradiction.Z_AXIS, "up is (+0.00, +0.19, +0.98) of the sensor"),
        (
            FLU_LEVEL, zyx(0, 0, z_down=True), Contradiction.Z_AXIS,
            "at rest, up is -z of the sensor by the acceleration, but +z by quat_wxyz, 180° apart: the z axis points "
            "in the opposite direction; set frame: {z_down: true} (docs/frames.md)",
        ),
        # a device with ZXY that is configured as ZYX, and the reverse
        *((FLU_LEVEL, turned(zxy(*at), rotation.quat_from_euler_zyx), ORDER, "{euler_order: zxy}") for at in LEANING),
        *((RFU_ENU, turned(zyx(*at), rotation.quat_from_euler312), ORDER, "{euler_order: zyx}") for at in LEANING),
        *(
            (device, seen_as(make(30 * roll, 40 * pitch), make(30, 40)), SIGN, f"{angles} the opposite sign")
            for device, make in ((FLU_LEVEL, zyx), (RFU_ENU, zxy))
            for roll, pitch, angles in ((-1, 1, "roll has"), (1, -1, "pitch has"), (-1, -1, "roll and pitch have"))
        ),
        (FLU_LEVEL, seen_as(zyx(20, 60), zyx(60, 20)), ORDER, "roll and pitch are exchanged"),
        (FLU_LEVEL, replace(zyx(0, 0), accel_m_s2=OBLIQUE), Contradiction.ATTITUDE, "(+0.50, +0.60, +0.62)"),
        # the quaternion is correct, the angles are wrong
        (FLU_LEVEL, replace(zyx(0, 0), euler_rad=(radians(30), 0.0, 0.0)), Contradiction.ATTITUDE, " by euler_rad, "),
    ],
)  # fmt: skip
def test_a_contradiction_has_its_cause(device: DeviceAxes, sample: Sample, kind: Contradiction, words: str) -> None:
    contradiction(device, sample, kind, words)


# --- the mounting -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axes", "sample", "side"),
    [
        (("x", "y", "z"), zyx(180, 0), "bottom"),  # upside down, and the configuration has no mounting
        (("x", "-y", "-z"), zyx(0, 0), "bottom"),  # configured upside down, mounted upright
        (("x", "-z", "y"), zyx(-90, 0), "bottom"),  # mounted on the other side than configured
        (("x", "y", "z"), zyx(90, 0), "left"),
        (("x", "y", "z"), zyx(0, -90), "front"),
        (("-y", "x", "z"), zyx(0, 90), "right"),  # the x axis points down and is configured as left
    ],
)
def test_a_body_that_is_not_level(axes: tuple[str, str, str], sample: Sample, side: str) -> None:
    words = f"and the {side} of the body"
    finding = contradiction(FLU_LEVEL, sample, Contradiction.MOUNTING, words, matrix_from_axes(*axes))
    assert f"axes needs z: {nearest_axis(sample.accel_m_s2 or (0, 0, 0))};" in finding.message
    assert found(FLU_LEVEL, sample) is None, "without a mounting nothing is known of a body"


@pytest.mark.parametrize(
    ("axes", "sample"),
    [
        (("x", "-y", "-z"), zyx(180, 0)), (("x", "-z", "y"), zyx(90, 0)), (("z", "y", "-x"), zyx(0, 90)),
        (("-y", "x", "z"), zyx(30, 20)), (("x", "y", "z"), zyx(40, 0)),
    ],
)  # fmt: skip
def test_a_right_mounting(axes: tuple[str, str, str], sample: Sample) -> None:
    """Also on a slope of 40°."""
    assert found(FLU_LEVEL, sample, matrix_from_axes(*axes)) is None


def test_a_mounting_between_two_axes_names_no_axis() -> None:
    tilted = replace(zyx(0, 0), accel_m_s2=(0, -0.6 * G, -0.8 * G), quat_wxyz=None, euler_rad=None)
    straight = matrix_from_axes("x", "y", "z")
    contradiction(FLU_LEVEL, tilted, Contradiction.MOUNTING, "up is the sensor's -z axis", straight)
    between = replace(tilted, accel_m_s2=(0.57735 * G, -0.57735 * G, -0.57735 * G))
    contradiction(FLU_LEVEL, between, Contradiction.MOUNTING, "correct the mounting", straight)


# --- rest and motion --------------------------------------------------------------------------------------------------

WRONG = zyx(0, 0, z_down=True)


def judged(samples: Iterator[Sample]) -> int:
    check = GravityCheck(FLU_LEVEL)
    return sum(check.add(one) for one in samples)


def test_only_samples_at_rest_count() -> None:
    assert judged(ticks(WRONG, 60)) == 60 // 5 - 1, "each takes a tick more than 5 s"
    turning = (0.0, 0.06, 0.0)
    assert judged(replace(one, gyro_rad_s=turning) for one in ticks(WRONG, 60)) == 0
    driving: Vector3 = (0.0, 2.7, -G)  # 1.04 g
    assert judged(replace(one, accel_m_s2=driving) for one in ticks(WRONG, 60)) == 0
    swinging = (replace(one, gyro_rad_s=(sin(one.t_ns / 1e9), 0, 0)) for one in ticks(WRONG, 60))
    assert judged(swinging) == 0, "slow for moments only"
    biased = (replace(one, gyro_rad_s=(0.02, -0.02, 0.01), accel_m_s2=(0.1, 0.1, -9.7)) for one in ticks(WRONG))
    assert judged(biased) == 1
    samples = list(ticks(WRONG, 9.9))
    samples[49] = replace(samples[49], gyro_rad_s=(1.0, 0, 0))
    assert judged(iter(samples)) == 0, "4.9 s before it and 5 s after it"
    assert judged(ticks(WRONG, 10.3)) == 2
    assert judged(iter([*ticks(WRONG, 4), *ticks(WRONG, 4, start=80)])) == 0


def test_the_same_sample_counts_once_and_samples_without_vectors_never() -> None:
    """The watch can call the check several times between two samples."""
    check = GravityCheck(FLU_LEVEL)
    assert not any(check.add(replace(WRONG, t_ns=number * NS_PER_S)) for number in range(20))
    slow = [replace(WRONG, seq=number, t_ns=number * NS_PER_S) for number in range(7)]
    assert judged(one for one in slow for _ in range(10)) == 1
    assert judged(replace(one, gyro_rad_s=None) for one in ticks(WRONG, 20)) == 0
    assert judged(replace(one, accel_m_s2=None) for one in ticks(WRONG, 20)) == 0
    assert found(FLU_LEVEL, replace(WRONG, quat_wxyz=None, euler_rad=None)) is None
    nan, inf = float("nan"), float("inf")
    for quat in ((0.0, 0.0, 0.0, 0.0), (nan, 0.0, 0.0, 0.0), (inf, 0.0, 0.0, 0.0), (1e308, 1e308, 1e308, 1e308)):
        assert found(FLU_LEVEL, replace(WRONG, quat_wxyz=quat, euler_rad=(nan, 0.0, 0.0))) is None
    for accel in ((nan, 0.0, G), (inf, 0.0, G)):
        assert judged(replace(one, accel_m_s2=accel) for one in ticks(WRONG, 20)) == 0


def test_the_finding_ends_at_rest_without_contradiction() -> None:
    check = GravityCheck(FLU_LEVEL)
    assert any(check.add(one) for one in ticks(WRONG))
    assert check.finding is not None
    assert any(check.add(one) for one in ticks(zyx(0, 0), start=100))
    assert check.finding is None
    # 15° of difference come from acceleration and from an unsettled filter; 25° do not.
    for angle_deg, is_found in ((15, False), (25, True)):
        tilt = radians(angle_deg)
        one = replace(zyx(0, 0), accel_m_s2=(G * sin(tilt), 0, G * cos(tilt)))
        assert (found(FLU_LEVEL, one) is not None) == is_found


# --- recording of a device -------------------------------------------------------------------------------------------

RECORDING = SHARED / "data" / "hi91-static-100hz.csv"


def recorded() -> Iterator[Sample]:
    """Yield ten samples per second of a recording of a HiPNUC device."""
    with RECORDING.open() as file:
        rows = list(csv.DictReader(file))
    for number, row in enumerate(rows[::10]):
        accel, gyro = ([float(row[f"{name}_{axis}"]) for axis in "xyz"] for name in ("acc", "gyr"))
        yield replace(
            zyx(0, 0), seq=number + 1, t_ns=number * TICK_NS,
            accel_m_s2=(accel[0] * 9.8, accel[1] * 9.8, accel[2] * 9.8),
            gyro_rad_s=(radians(gyro[0]), radians(gyro[1]), radians(gyro[2])),
            euler_rad=(radians(float(row["roll"])), radians(float(row["pitch"])), radians(float(row["yaw"]))),
            quat_wxyz=(float(row["quat_w"]), float(row["quat_x"]), float(row["quat_y"]), float(row["quat_z"])),
        )  # fmt: skip


@pytest.mark.skipif(not RECORDING.exists(), reason=f"the recording {RECORDING} is not on this machine")
def test_a_real_module_agrees_with_its_driver() -> None:
    """The device is at rest, then moved by hand, then at rest again, each time for less than a window."""
    samples = list(recorded())
    assert judged(iter(samples)) == 0
    for one in (samples[0], samples[-1]):
        assert found(RFU_ENU, one) is None
        contradiction(DeviceAxes(z_down=True), one, Contradiction.Z_AXIS, "")
