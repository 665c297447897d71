"""Samples in body axes and in both conventions, compared with values computed by hand, and invariants of rotations.
Rotation sensor → body for each key, compared with values computed by hand."""

from contextlib import suppress
from itertools import product
from math import cos, hypot, isnan, nan, pi, radians, sin, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from imud.attitude import published as attitude_published
from imud.attitude import rotation as attitude_rotation
from imud.attitude.conventions import FLU_LEVEL, RFU_ENU, Convention, DeviceAxes, EulerOrder, Heading
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes, as_sent, levelling, published_frame
from imud.attitude.rotation import IDENTITY, Matrix3, is_rotation, matrix_from_quat, matrix_times, quat_from_euler_zyx
from imud.model.sample import Quaternion, Sample, Sync, Vector3

G = 9.8
HALF = sqrt(0.5)
ENU, NED = Convention.ENU_FLU, Convention.NED_FRD


def sample(
    accel: Vector3 | None = None, euler_deg: Vector3 | None = None, quat: Quaternion | None = None,
    gyro: Vector3 | None = None, mag: Vector3 | None = None,
) -> Sample:  # fmt: skip
    euler = None if euler_deg is None else (radians(euler_deg[0]), radians(euler_deg[1]), radians(euler_deg[2]))
    times = (7, 100, 2, Sync.EDGE, 101, 102, 103)
    return Sample("bow", *times, accel, gyro, mag, quat, euler, 20.5, 1e5, (0.1, 0.2), 5, 6, 8)


def frame(
    settings: FrameOptions | None = None, convention: Convention | None = None, declination_deg: float | None = None,
    device: DeviceAxes = FLU_LEVEL,
) -> attitude_published.PublishedAxes:  # fmt: skip
    return published_frame(settings, convention, declination_deg, device)


def turned(one: Sample, published: attitude_published.PublishedAxes) -> Sample:
    assert published.rotation is not None
    return published.rotation.samples([one])[0]


def degrees_of(euler: Vector3 | None) -> Vector3:
    assert euler is not None
    return (euler[0] * 180 / pi, euler[1] * 180 / pi, euler[2] * 180 / pi)


def same_rotation(a: Quaternion | None, b: Quaternion) -> bool:
    """Return whether two quaternions are the same rotation: q and -q are."""
    assert a is not None
    return abs(abs(sum(x * y for x, y in zip(a, b, strict=True))) - 1.0) < 1e-12


# --- no rotation ------------------------------------------------------------------------------------------------------


def test_without_rotation_values_are_unchanged() -> None:
    assert frame(device=RFU_ENU).rotation is None
    assert as_sent(FLU_LEVEL).rotation is None
    assert frame(convention=NED).rotation_to(NED) is None
    after = turned(sample((1, 2, 3), (10, 20, 30)), frame(convention=NED))
    before = sample()
    for name in Sample.__struct_fields__:
        if name not in ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad"):
            assert getattr(after, name) == getattr(before, name), name
    assert (after.gyro_rad_s, after.mag_t) == (None, None), "what is absent stays absent"


# --- conventions, from a HiPNUC device: x right, y forward, z up; ENU; pitch about x, roll about y --------------------

LEVEL_NORTH = sample((0, 0, G), (0, 0, 0), (1, 0, 0, 0), gyro=(0.1, 0.2, 0.3), mag=(0, 30e-6, -20e-6))
"""The device rotates to the front (x right, down at the front by 0.1 …). The field points north and down."""


ENU_TURN, NED_TURN = (HALF, 0.0, 0.0, HALF), (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("convention", "accel", "gyro", "mag", "euler", "quat"),
    [
        # its y axis is the front, its x axis points right; the front is 90° counter-clockwise from east
        (ENU, (0, 0, G), (0.2, -0.1, 0.3), (30e-6, 0, -20e-6), (0, 0, 90), ENU_TURN),
        (NED, (0, 0, -G), (0.2, 0.1, -0.3), (30e-6, 0, 20e-6), (0, 0, 0), NED_TURN),
    ],
)
def test_a_hipnuc_module_in_both_conventions(
    convention: Convention, accel: Vector3, gyro: Vector3, mag: Vector3, euler: Vector3, quat: Quaternion
) -> None:
    made = turned(LEVEL_NORTH, frame(convention=convention, device=RFU_ENU))
    assert (made.accel_m_s2, made.gyro_rad_s, made.mag_t) == (accel, gyro, mag)
    assert degrees_of(made.euler_rad) == pytest.approx(euler, abs=1e-12)
    assert same_rotation(made.quat_wxyz, quat)


@pytest.mark.parametrize(("convention", "expected"), [(ENU, (10, -30, 0)), (NED, (10, 30, 90))])
@pytest.mark.parametrize("members", ["euler", "quat", "both"])
def test_bow_east_nose_up_right_side_down(convention: Convention, expected: Vector3, members: str) -> None:
    """As a HiPNUC device sends it: yaw -90° (east), pitch +30° (nose up), roll +10° (right side down)."""
    euler = (radians(10), radians(30), radians(-90))
    quat = attitude_rotation.quat_from_euler312(euler)
    up = (-cos(radians(30)) * sin(radians(10)), sin(radians(30)), cos(radians(30)) * cos(radians(10)))
    one = replace(
        sample((up[0] * G, up[1] * G, up[2] * G)),
        euler_rad=None if members == "quat" else euler,
        quat_wxyz=None if members == "euler" else quat,
    )
    made = turned(one, frame(convention=convention, device=RFU_ENU))
    assert degrees_of(made.euler_rad) == pytest.approx(expected, abs=1e-9)
    assert made.quat_wxyz is not None
    assert degrees_of(attitude_rotation.euler_zyx_from_quat(made.quat_wxyz)) == pytest.approx(expected, abs=1e-9)
    back_side_up = -up[0] * G if convention is ENU else up[0] * G
    assert made.accel_m_s2 == pytest.approx((up[1] * G, back_side_up, up[2] * G if convention is ENU else -up[2] * G))


def test_axes_of_a_device_without_north_and_with_another_order_of_angles() -> None:
    """The device has no north: at power-on yaw is 0 in both conventions. Left is + in one convention and - in the
    other.
    """
    one = sample((0, 0, G), (10, 20, 30))
    assert degrees_of(turned(one, frame(convention=ENU)).euler_rad) == pytest.approx((10, 20, 30))
    assert degrees_of(turned(one, frame(convention=NED)).euler_rad) == pytest.approx((10, -20, -30))
    # The device sends pitch 30° about its x axis, y forward. imud does not use its quaternion.
    one = replace(sample((0, G * SIN30, G * COS30), (0, 30, 0)), quat_wxyz=quat_from_euler_zyx((0, radians(30), 0)))
    made = turned(one, frame(FrameOptions(euler_order=EulerOrder.ZXY)))
    assert made.accel_m_s2 == pytest.approx((G * SIN30, 0, G * COS30)), "its y axis is the front, nose up"
    assert degrees_of(made.euler_rad)[:2] == pytest.approx((0, -30), abs=1e-9)
    assert matrix_from_quat(made.quat_wxyz or (0, 0, 0, 0))[2] == pytest.approx((SIN30, 0, COS30))


# --- mountings of a sensor with FLU axes ------------------------------------------------------------------------------

SIN30, COS30 = sin(radians(30)), cos(radians(30))
TURNS = [
    # name; the three keys; values of the sensor: accel, gyro, (roll, pitch, yaw); motion of the body
    (
        "upside down", ("x", "-y", "-z"), (180, 0, 0), (0, 1, 0, 0),
        # the body is level, its front at 20°, and it rotates to the left
        (0, 0, -G), (0, 0, -0.5), (180, 0, 20), (0, 0, G), (0, 0, 0.5), (0, 0, 20),
    ),
    (
        "on its right side", ("x", "-z", "y"), (90, 0, 0), (HALF, HALF, 0, 0),
        (0, G, 0), (0, 0.5, 0), (90, 0, 20), (0, 0, G), (0, 0, 0.5), (0, 0, 20),
    ),
    (
        "turned 90° to the left", ("-y", "x", "z"), (0, 0, 90), (HALF, 0, 0, HALF),
        # the nose of the body is 30° up, its front at 20°, and it rotates to the left about its vertical
        (0, -G * SIN30, G * COS30), (0, 0, 0.5), (-30, 0, 110), (G * SIN30, 0, G * COS30), (0, 0, 0.5), (0, -30, 20),
    ),
]  # fmt: skip


@pytest.mark.parametrize("way", ["axes", "euler", "quat"])
@pytest.mark.parametrize("members", ["euler", "quat", "both"])
@pytest.mark.parametrize("case", TURNS, ids=[case[0] for case in TURNS])
def test_a_mounting_is_taken_away(
    case: tuple[str, tuple[str, str, str], Vector3, Quaternion, Vector3, Vector3, Vector3, Vector3, Vector3, Vector3],
    way: str,
    members: str,
) -> None:
    _, (x, y, z), (roll, pitch, yaw), quat, accel, gyro, said, body_accel, body_gyro, body_euler = case
    given_as = {
        "axes": FrameOptions(axes=MountingAxes(x=x, y=y, z=z)),  # type: ignore[arg-type]  # names of axes
        "euler": FrameOptions(euler=MountingAngles(roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw)),
        "quat": FrameOptions(quat_wxyz=list(quat)),
    }[way]
    one = sample(accel, said if members != "quat" else None, gyro=gyro, mag=gyro)
    if members != "euler":
        one = replace(one, quat_wxyz=quat_from_euler_zyx((radians(said[0]), radians(said[1]), radians(said[2]))))
    made = turned(one, frame(given_as))
    assert made.accel_m_s2 == pytest.approx(body_accel)
    assert made.gyro_rad_s == pytest.approx(body_gyro)
    assert made.mag_t == pytest.approx(body_gyro)
    assert degrees_of(made.euler_rad) == pytest.approx(body_euler, abs=1e-9)
    rolled, pitched, yawed = body_euler
    wanted = quat_from_euler_zyx((radians(rolled), radians(pitched), radians(yawed)))
    assert same_rotation(made.quat_wxyz, wanted)


def test_devices_in_different_mountings_report_the_same_attitude() -> None:
    """A body with two devices of different axes and mountings: both report the attitude of the body."""
    attitude = quat_from_euler_zyx((0.2, -0.4, 2.0))
    matrix = matrix_from_quat(attitude)
    up = matrix[2]
    body_accel = (up[0] * G, up[1] * G, up[2] * G)
    for given_frame in (FrameOptions(euler=MountingAngles(roll_deg=33, pitch_deg=-50, yaw_deg=170)), FrameOptions()):
        for device in (RFU_ENU, FLU_LEVEL):
            mounting = frame(given_frame, ENU, device=device).mounting
            quat = attitude_rotation.quat_from_matrix(attitude_rotation.matrix_product(matrix, mounting))
            one = replace(sample(matrix_times(attitude_rotation.transposed(mounting), body_accel)), quat_wxyz=quat)
            made = turned(one, frame(given_frame, ENU, device=device))
            assert made.accel_m_s2 == pytest.approx(body_accel)
            assert same_rotation(made.quat_wxyz, attitude)


# --- level, heading, declination --------------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", [ENU, NED])
def test_roll_and_pitch_that_were_read_level_are_taken_away(convention: Convention) -> None:
    """The published roll and pitch become zero if they are written into the keys. The heading does not change."""
    one = sample((0, 0, G), (2, -3, 40))
    shown = degrees_of(turned(one, frame(convention=convention)).euler_rad)
    settings = FrameOptions(level_roll_deg=shown[0], level_pitch_deg=shown[1])
    assert degrees_of(turned(one, frame(settings, convention)).euler_rad) == pytest.approx((0, 0, shown[2]), abs=1e-9)


def test_heading_offset_declination_and_reference_of_the_heading() -> None:
    one = sample((0, 0, G), (0, 0, -40), mag=(1.0, 0.0, 0.0))
    settings = FrameOptions(heading_offset_deg=15)
    assert degrees_of(turned(one, frame(settings, NED)).euler_rad)[2] == pytest.approx(40 + 15)
    assert degrees_of(turned(one, frame(settings, ENU)).euler_rad)[2] == pytest.approx(-40 - 15)
    # the sensor points 15° to the left of the front: its forward direction is left of the body's front
    assert turned(one, frame(settings, ENU)).mag_t == pytest.approx((cos(radians(15)), sin(radians(15)), 0.0))
    # Magnetic heading 90°, magnetic north 5° east of true north: true heading 95°.
    one = sample((1, 2, 3), (10, 20, -90), mag=(1, 2, 3))
    assert degrees_of(turned(one, frame(None, NED, 5.0, RFU_ENU)).euler_rad) == pytest.approx((10, 20, 95))
    own = turned(one, frame(None, None, 5.0, RFU_ENU))
    assert degrees_of(own.euler_rad) == pytest.approx((10, 20, -95)), "in the device's own convention"
    assert own.quat_wxyz is not None
    assert degrees_of(attitude_rotation.euler312_from_quat(own.quat_wxyz)) == pytest.approx((10, 20, -95))
    assert (own.accel_m_s2, own.mag_t) == ((1, 2, 3), (1, 2, 3))
    true = frame(None, None, 5.0, RFU_ENU)
    assert true.heading(Heading.MAGNETIC) is Heading.TRUE
    assert true.heading(Heading.UNKNOWN) is Heading.TRUE, "the configuration says that it is magnetic"
    assert true.heading(Heading.RELATIVE) is Heading.RELATIVE
    assert frame().heading(Heading.MAGNETIC) is Heading.MAGNETIC


# --- axes of the device -----------------------------------------------------------------------------------------------


UPSIDE_DOWN = MountingAxes(x="y", y="x", z="-z")
Z_DOWN = sample((0.5, 0.25, -G), (10, 20, 30), gyro=(1, 2, 3))
"""Sample of a device with axes front, right, down and with angles as in aviation."""


@pytest.mark.parametrize(
    ("one", "published", "accel", "gyro", "euler"),
    [
        # as published by the vendor's driver
        (Z_DOWN, frame(FrameOptions(z_down=True)), (0.5, -0.25, G), (1, -2, -3), (10, -20, -30)),
        (Z_DOWN, frame(FrameOptions(z_down=True), NED), (0.5, 0.25, -G), (1, 2, 3), (10, 20, 30)),
        # rotated 90° to the left in the body: its x axis points left, its y axis (right of x) to the front. The body is
        # level, its front at 20° to the left. `axes` names device axes, z down.
        (
            sample((0, 0, -G), (0, 0, -110), gyro=(1, 2, 3)), frame(FrameOptions(z_down=True, axes=UPSIDE_DOWN)),
            (0, 0, G), (2, 1, -3), (0, 0, 20),
        ),
        # a HiPNUC device upside down: its y axis points forward, its x axis left, its z axis down
        (
            sample((0, 0, -G), (180, 0, 0), gyro=(0.1, 0.2, 0.3)),
            frame(FrameOptions(axes=UPSIDE_DOWN), NED, device=RFU_ENU), (0, 0, -G), (0.2, -0.1, 0.3), (0, 0, 0),
        ),
    ],
)  # fmt: skip
def test_a_device_with_z_down(
    one: Sample, published: attitude_published.PublishedAxes, accel: Vector3, gyro: Vector3, euler: Vector3
) -> None:
    made = turned(one, published)
    assert (made.accel_m_s2, made.gyro_rad_s) == (accel, gyro)
    assert degrees_of(made.euler_rad) == pytest.approx(euler, abs=1e-9)


# --- partial angles ---------------------------------------------------------------------------------------------------


def known(euler: Vector3 | None) -> tuple[object, ...]:
    """Return angles in degrees, None for NaN."""
    return tuple(None if isnan(one) else pytest.approx(one, abs=1e-9) for one in degrees_of(euler))


@pytest.mark.parametrize(
    ("said", "settings", "expected"),
    [
        ((nan, nan, -90), None, (None, None, 90)),  # a compass sends only the heading
        ((10, nan, nan), None, (10, None, None)),
        ((10, 30, nan), None, (10, 30, None)),
        ((10, 30, nan), FrameOptions(axes=MountingAxes(x="y", y="x", z="-z")), (-170, 30, None)),  # upside down
        ((nan, nan, -90), FrameOptions(axes=MountingAxes(x="-x", y="-y", z="z")), (None, None, 0)),  # back to front
        ((nan, nan, -90), FrameOptions(axes=MountingAxes(x="y", y="x", z="-z")), None),  # the tilt decides
        ((10, nan, nan), FrameOptions(axes=MountingAxes(x="-x", y="-y", z="z")), None),
    ],
)  # fmt: skip
def test_angles_in_part(said: Vector3, settings: FrameOptions | None, expected: tuple[float | None, ...]) -> None:
    """Samples of a device with x right, y forward, published in ned-frd."""
    made = turned(sample(euler_deg=said), frame(settings, NED, device=RFU_ENU))
    assert made.quat_wxyz is None
    assert made.euler_rad is None if expected is None else known(made.euler_rad) == expected


def test_the_quaternion_has_priority_unless_it_is_zero_and_nan_stays_one_element() -> None:
    made = turned(sample(euler_deg=(0, 0, 30), quat=(HALF, 0, 0, HALF)), frame(convention=ENU))
    assert degrees_of(made.euler_rad) == pytest.approx((0, 0, 90))
    made = turned(sample(euler_deg=(0, 0, 30), quat=(0, 0, 0, 0)), frame(convention=ENU))
    assert degrees_of(made.euler_rad) == pytest.approx((0, 0, 30))
    assert turned(sample(quat=(0, 0, 0, 0)), frame(convention=ENU)).quat_wxyz is None
    for_client = frame(convention=NED).rotation_to(ENU)
    assert for_client is not None
    made = for_client.sample(sample(euler_deg=(0, 0, 30), quat=(HALF, 0, 0, HALF)))
    assert made.quat_wxyz == for_client.sample(sample(quat=(HALF, 0, 0, HALF))).quat_wxyz
    made = turned(sample(gyro=(nan, 2, 3)), frame(FrameOptions(axes=MountingAxes(x="y", y="-x", z="z"))))
    assert made.gyro_rad_s is not None
    assert (made.gyro_rad_s[0], made.gyro_rad_s[2]) == (2, 3)
    assert isnan(made.gyro_rad_s[1])


# --- invariants -------------------------------------------------------------------------------------------------------

VECTORS = st.tuples(*[st.floats(-50, 50)] * 3)
QUATS = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: hypot(*q) > 0.1).map(attitude_rotation.quat_normalized)
MOUNTINGS = st.builds(
    FrameOptions,
    euler=st.builds(
        MountingAngles, roll_deg=st.floats(-180, 180), pitch_deg=st.floats(-90, 90), yaw_deg=st.floats(-180, 180)
    ),
    z_down=st.booleans(), level_roll_deg=st.floats(-45, 45), level_pitch_deg=st.floats(-45, 45),
    heading_offset_deg=st.floats(-180, 180),
)  # fmt: skip
DEVICES = st.sampled_from([RFU_ENU, FLU_LEVEL])
FRAMES = st.builds(
    published_frame, st.none() | MOUNTINGS, st.sampled_from([ENU, NED]), st.none() | st.floats(-30, 30), DEVICES
)


@given(FRAMES, VECTORS, VECTORS, VECTORS, QUATS)
def test_lengths_and_the_direction_of_gravity_are_kept(
    published: attitude_published.PublishedAxes, accel: Vector3, gyro: Vector3, mag: Vector3, quat: Quaternion
) -> None:
    """Angles between vectors, and between a vector and the vertical, are equal before and after a rotation."""
    one = Sample("bow", 1, 1, 1, Sync.ARRIVAL, 1, 1, accel_m_s2=accel, gyro_rad_s=gyro, mag_t=mag, quat_wxyz=quat)
    made = turned(one, published)
    assert made.quat_wxyz is not None
    assert made.euler_rad is not None
    vectors = [one for one in (made.accel_m_s2, made.gyro_rad_s, made.mag_t) if one is not None]
    for before, after in zip((accel, gyro, mag), vectors, strict=True):
        assert hypot(*after) == pytest.approx(hypot(*before), abs=1e-9)
        up = matrix_times(matrix_from_quat(quat), before)[2] * (-1 if published.device.z_down else 1)
        up_after = matrix_times(matrix_from_quat(made.quat_wxyz), after)[2] * (-1 if published.convention is NED else 1)
        assert up_after == pytest.approx(up, abs=1e-9)
    assert _triple(*vectors) == pytest.approx(_triple(accel, gyro, mag), abs=1e-6), "no mirror image"
    assert hypot(*made.quat_wxyz) == pytest.approx(1.0)
    assert same_rotation(quat_from_euler_zyx(made.euler_rad), made.quat_wxyz)


def _triple(a: Vector3, b: Vector3, c: Vector3) -> float:
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


@given(st.none() | MOUNTINGS, DEVICES, VECTORS, QUATS)
def test_a_requested_convention_equals_a_configured_convention(
    settings: FrameOptions | None, device: DeviceAxes, accel: Vector3, quat: Quaternion
) -> None:
    """Publish in one convention and request the other, and back. Levelling angles refer to one convention."""
    if settings is not None:
        settings = replace(settings, level_pitch_deg=0.0)
    one = Sample("bow", 1, 1, 1, Sync.ARRIVAL, 1, 1, accel_m_s2=accel, quat_wxyz=quat)
    frames = {convention: frame(settings, convention, device=device) for convention in Convention}
    direct = {convention: turned(one, published) for convention, published in frames.items()}
    for asked, configured in ((ENU, NED), (NED, ENU)):
        rotation = frames[configured].rotation_to(asked)
        assert rotation is not None
        made = rotation.sample(direct[configured])
        assert made.accel_m_s2 == pytest.approx(direct[asked].accel_m_s2, abs=1e-9)
        assert made.quat_wxyz
        assert direct[asked].quat_wxyz
        assert same_rotation(made.quat_wxyz, direct[asked].quat_wxyz or (0, 0, 0, 0))
        back = frames[asked].rotation_to(configured)
        assert back is not None
        again = back.sample(made)
        assert again.accel_m_s2 == pytest.approx(direct[configured].accel_m_s2, abs=1e-9)
        assert same_rotation(again.quat_wxyz, direct[configured].quat_wxyz or (0, 0, 0, 0))


@given(st.sampled_from([ENU, NED]), st.none() | st.floats(-30, 30), DEVICES, VECTORS, QUATS)
def test_a_client_of_a_device_without_convention(
    asked: Convention, declination_deg: float | None, device: DeviceAxes, accel: Vector3, quat: Quaternion
) -> None:
    one = Sample("bow", 1, 1, 1, Sync.ARRIVAL, 1, 1, accel_m_s2=accel, quat_wxyz=quat)
    plain = frame(None, None, declination_deg, device)
    published = one if plain.rotation is None else plain.rotation.sample(one)
    rotation = plain.rotation_to(asked)
    assert rotation is not None
    made, wanted = rotation.sample(published), turned(one, frame(None, asked, declination_deg, device))
    assert made.accel_m_s2 == pytest.approx(wanted.accel_m_s2, abs=1e-9)
    assert same_rotation(made.quat_wxyz, wanted.quat_wxyz or (0, 0, 0, 0))


ANY = st.floats(allow_nan=True, allow_infinity=True)
ANY3 = st.none() | st.tuples(ANY, ANY, ANY)


@given(FRAMES, ANY3, ANY3, st.none() | st.tuples(ANY, ANY, ANY, ANY))
def test_no_value_of_a_device_raises(
    published: attitude_published.PublishedAxes, vector: Vector3 | None, euler: Vector3 | None, quat: Quaternion | None
) -> None:
    one = Sample(
        "bow", 1, 1, 1, Sync.ARRIVAL, 1, 1, accel_m_s2=vector, gyro_rad_s=vector, quat_wxyz=quat, euler_rad=euler
    )
    made = turned(one, published)
    assert (made.accel_m_s2 is None) == (vector is None)
    assert made.quat_wxyz is None or made.euler_rad is not None, "a quaternion never without its angles"


# --- readable text ----------------------------------------------------------------------------------------------------


def test_description_of_published_samples() -> None:
    own = as_sent(RFU_ENU).words("312", "ENU")
    assert (own.frame, own.euler_convention, own.navigation_frame) == (RFU_ENU.words, "312", "ENU")
    down = frame(FrameOptions(), NED, device=RFU_ENU).words("312", "ENU")
    assert "x forward, y right, z down" in down.frame
    assert down.navigation_frame == "NED"
    assert "clockwise" in down.euler_convention
    assert frame(FrameOptions()).convention is ENU, "with frame, enu-flu unless the file says otherwise"


C30, S30 = cos(radians(30)), sin(radians(30))

SENSOR: Vector3 = (1.0, 2.0, 3.0)
"""Vector in sensor axes. A drawing of the mounting gives its direction in the body."""
KEYS = [
    # name, x y z by axes, roll pitch yaw in degrees, quaternion, the vector in the body
    ("as the body", ("x", "y", "z"), (0, 0, 0), (1, 0, 0, 0), (1, 2, 3)),
    ("upside down about x", ("x", "-y", "-z"), (180, 0, 0), (0, 1, 0, 0), (1, -2, -3)),
    ("upside down about y", ("-x", "y", "-z"), (0, 180, 0), (0, 0, 1, 0), (-1, 2, -3)),
    ("turned 90° to the left", ("-y", "x", "z"), (0, 0, 90), (HALF, 0, 0, HALF), (-2, 1, 3)),
    ("turned 90° to the right", ("y", "-x", "z"), (0, 0, -90), (HALF, 0, 0, -HALF), (2, -1, 3)),
    ("turned back to front", ("-x", "-y", "z"), (0, 0, 180), (0, 0, 0, 1), (-1, -2, 3)),
    ("on its right side: its y axis points up", ("x", "-z", "y"), (90, 0, 0), (HALF, HALF, 0, 0), (1, -3, 2)),
    ("on its left side: its y axis points down", ("x", "z", "-y"), (-90, 0, 0), (HALF, -HALF, 0, 0), (1, 3, -2)),
    ("upright: its x axis points down", ("z", "y", "-x"), (0, 90, 0), (HALF, 0, HALF, 0), (3, 2, -1)),
    ("upright: its x axis points up", ("-z", "y", "x"), (0, -90, 0), (HALF, 0, -HALF, 0), (-3, 2, 1)),
    # first 90° to the left about z, then 90° about the new x axis of the sensor: x points left, y up
    ("on its side and turned", ("z", "x", "y"), (90, 0, 90), (0.5, 0.5, 0.5, 0.5), (3, 1, 2)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "axes", "angles", "quat", "body"), KEYS, ids=[row[0] for row in KEYS])
def test_the_three_ways_agree_with_the_drawing(
    name: str, axes: tuple[str, str, str], angles: Vector3, quat: tuple[float, float, float, float], body: Vector3
) -> None:
    by_axes = attitude_published.matrix_from_axes(*axes)
    assert matrix_times(by_axes, SENSOR) == body, name
    assert attitude_published.matrix_from_angles(*angles) == by_axes, "without a rounding error of the cosine of 90°"
    assert attitude_published.matrix_from_mounting_quat(quat) == by_axes


def test_angles_of_30_degrees_and_every_choice_of_axes_are_rotations() -> None:
    """30° to the left: the x axis of the sensor points to the front and, with half its length, to the left."""
    matrix = attitude_published.matrix_from_angles(0, 0, 30)
    assert matrix_times(matrix, (1, 0, 0)) == pytest.approx((C30, S30, 0))
    assert matrix_times(attitude_published.matrix_from_angles(0, 30, 0), (1, 0, 0)) == pytest.approx((C30, 0, -S30))
    assert matrix_times(attitude_published.matrix_from_angles(30, 0, 0), (0, 1, 0)) == pytest.approx((0, C30, S30))
    # yaw first: the x axis of the sensor is pitched in its new direction, to the left
    assert matrix_times(attitude_published.matrix_from_angles(0, 30, 90), (1, 0, 0)) == pytest.approx((0, C30, -S30))
    matrices = []
    for axes in product(attitude_published.AXES, repeat=3):
        with suppress(ValueError):
            matrices.append(attitude_published.matrix_from_axes(*axes))
    assert all(is_rotation(matrix) for matrix in matrices)
    assert len(matrices) == 24, "of 216; a cube can be laid down in 24 ways"


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        (("y", "x", "z"), r"right-handed .* mirror image .*with these x and y, z is -z$"),
        (("x", "-z", "-y"), r"z is y$"),
        (("x", "-x", "z"), r"three different axes of the sensor, got x forward and -x left"),
    ],
)
def test_impossible_axes_are_rejected(axes: tuple[str, str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        attitude_published.matrix_from_axes(*axes)


@pytest.mark.parametrize(
    "quat", [(1.0, 1.0, 0.0, 0.0), (1.0011, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 0.0)]
)
def test_an_invalid_quaternion_is_rejected(quat: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="of length 1"):
        attitude_published.matrix_from_mounting_quat(quat)
    for near in ((0.7071, 0.7071, 0.0, 0.0), (1.0009, 0.0, 0.0, 0.0), (0.9991, 0.0, 0.0, 0.0)):
        assert is_rotation(attitude_published.matrix_from_mounting_quat(near)), "three digits are enough"


def test_levelling_and_heading_offset_subtract_the_published_angles_behind_the_mounting() -> None:
    """A sensor with 10° nose-down error: its x axis is the x axis of the body, rotated back up."""
    level = levelling(Convention.ENU_FLU, 0.0, 10.0, 0.0)
    ten = radians(10)
    gravity_in_sensor = (-sin(ten), 0.0, cos(ten))  # nose down: up has a component to the back
    assert matrix_times(level, gravity_in_sensor) == pytest.approx((0, 0, 1))
    # in ned-frd, nose down is negative
    assert levelling(Convention.NED_FRD, 0.0, -10.0, 0.0) == level
    left_up = levelling(Convention.NED_FRD, 10.0, 0.0, 0.0)
    assert matrix_times(left_up, (0.0, sin(ten), cos(ten))) == pytest.approx((0, 0, 1))
    # The x axis points 90° to the left of the front: imud adds 90° to the heading.
    assert levelling(Convention.ENU_FLU, 0.0, 0.0, 90.0) == attitude_published.matrix_from_axes("-y", "x", "z")
    assert levelling(Convention.NED_FRD, 0.0, 0.0, 90.0) == attitude_published.matrix_from_axes("-y", "x", "z")
    upside_down: Matrix3 = attitude_published.matrix_from_axes("x", "-y", "-z")
    assert attitude_published.mounted(upside_down, IDENTITY) == upside_down
    whole = attitude_published.mounted(upside_down, levelling(Convention.ENU_FLU, 0.0, 0.0, 90.0))
    assert matrix_times(whole, (1, 0, 0)) == (0, 1, 0), "first upside down, then to the left"
    assert matrix_times(whole, (0, 1, 0)) == (1, 0, 0)
