"""ROS 2 messages, read by rosbags with its own definitions, as a ROS 2 node would read them."""

import math
import struct
from typing import Any

import msgspec
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imud.attitude.conventions import UNSETTLED_BIT, Convention
from imud.bridges import channel as bridge
from imud.bridges.channel import MessageChannel, MessageFrames, StampedEvent
from imud.bridges.ros2 import ENCAPSULATION, FIELDS, CdrWriter, Layout, Ros2Dialect, schema, time_of
from imud.contracts.status import Deviations
from imud.model.event import Event, EventKind
from imud.model.sample import Position, Sample
from tests.bridges.samples import BARE, EVENT, FULL, UTC_NS

DIALECT = Ros2Dialect()
BOW = MessageFrames("bow")
OWN = {"imud_msgs/SampleStamp", "imud_msgs/Losses"}
ROS = get_typestore(Stores.ROS2_HUMBLE)  # type definitions of rosbags, and imud's own definitions of its two types
for own in OWN:
    ROS.register(get_types_from_msg(FIELDS[own], own.replace("/", "/msg/")))


def channels(frames: MessageFrames = BOW) -> dict[str, MessageChannel[Sample]]:
    return {channel.topic: channel for channel in DIALECT.samples(frames)}


def read(channel: MessageChannel[Any], item: object) -> Any:
    data = channel.encode(item)
    assert data is not None
    return ROS.deserialize_cdr(data, channel.schema.name)


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def test_quantities() -> None:
    imu = read(channels()["/bow/imu/data"], FULL)
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec) == (1_790_000_000, 123_456_789)
    assert imu.header.frame_id == "bow"
    assert xyz(imu.angular_velocity) == FULL.gyro_rad_s
    assert xyz(imu.linear_acceleration) == FULL.accel_m_s2
    assert (imu.orientation.w, *xyz(imu.orientation)) == FULL.quat_wxyz
    for matrix in (imu.orientation_covariance, imu.angular_velocity_covariance, imu.linear_acceleration_covariance):
        assert list(matrix) == 9 * [0.0]
    assert channels()["/bow/imu/data_raw"].encode(FULL) is None
    assert channels()["/bow/imu/data"].encode(BARE) is None
    imu = read(channels()["/bow/imu/data_raw"], BARE)
    assert (imu.orientation_covariance[0], imu.linear_acceleration_covariance[0]) == (-1, -1)
    assert imu.angular_velocity_covariance[0] == 0
    assert xyz(imu.angular_velocity)[0::2] == (0.0, 1.0)
    assert math.isnan(imu.angular_velocity.y)
    noise = Deviations(accel_m_s2=0.5, gyro_rad_s=0.25, mag_t=2.0, attitude_rad=0.125, temperature_c=3.0)
    made = channels(MessageFrames("bow", deviations=noise))
    imu = read(made["/bow/imu/data"], FULL)
    assert list(imu.linear_acceleration_covariance) == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.25]
    assert (imu.angular_velocity_covariance[4], imu.orientation_covariance[8]) == (0.0625, 0.015625)
    assert read(made["/bow/imu/mag"], FULL).magnetic_field_covariance[0] == 4.0
    assert read(made["/bow/temperature"], FULL).variance == 9.0
    unsettled = msgspec.structs.replace(FULL, status=1 << UNSETTLED_BIT)
    imu = read(made["/bow/imu/data"], unsettled)
    assert (list(imu.orientation_covariance), imu.orientation.w) == ([-1, *8 * [0]], 1)
    assert imu.angular_velocity_covariance[4] == 0.0625
    assert made["/tf"].encode(unsettled) is None
    made = channels()
    assert xyz(read(made["/bow/imu/mag"], FULL).magnetic_field) == FULL.mag_t
    assert read(made["/bow/temperature"], FULL).temperature == 31.5
    assert read(made["/bow/pressure"], FULL).fluid_pressure == 101325.0
    for name in ("imu/mag", "temperature", "pressure"):
        assert made[f"/bow/{name}"].encode(BARE) is None


def test_transform_stamp_and_alignment() -> None:
    tf = channels(MessageFrames("bow"))["/tf"]
    (transform,) = read(tf, FULL).transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("enu", "bow")
    assert (transform.transform.rotation.w, *xyz(transform.transform.rotation)) == FULL.quat_wxyz
    assert xyz(transform.transform.translation) == (0, 0, 0)
    assert transform.header.stamp.nanosec == 123_456_789
    assert tf.encode(BARE) is None
    stamp = channels()["/bow/stamp"]
    full, bare = read(stamp, FULL), read(stamp, BARE)
    assert (full.seq, full.t_ns, full.t_rx_ns, full.t_dev_ns) == (7, FULL.t_ns, FULL.t_rx_ns, 5_000_000)
    assert (full.t_err_ns, full.sync, full.EDGE) == (12_000, 2, 2)
    assert (full.edge_seq, full.status, full.pps_age_ms) == (9, 3, 40)
    assert tuple(full.euler_rad) == FULL.euler_rad
    assert tuple(full.incli_rad) == FULL.incli_rad
    assert (bare.t_dev_ns, bare.edge_seq, bare.status, bare.pps_age_ms) == (-1, -1, -1, -1)
    assert bare.t_err_ns == 0xFFFF_FFFF
    assert all(map(math.isnan, (*bare.euler_rad, *bare.incli_rad, bare.heave_m)))
    assert (full.heave_m, full.gnss_utc_ns, bare.gnss_utc_ns) == (-0.125, UTC_NS + 9, -1)
    fix, velocity = channels()["/bow/fix"], channels()["/bow/velocity"]
    place = read(fix, FULL)
    assert (place.latitude, place.longitude, place.altitude) == (math.degrees(0.5), math.degrees(-1.25), 42.5)
    assert (place.status.status, place.status.service, place.position_covariance_type) == (2, 1, 0)
    invalid = read(fix, msgspec.structs.replace(FULL, position=Position(0.5, -1.25, quality=0)))
    assert (invalid.status.status, math.isnan(invalid.altitude)) == (-1, True)
    twist = read(velocity, FULL)
    assert (twist.header.frame_id, xyz(twist.twist.linear)) == ("enu", (1.5, -2.5, 0.25))
    assert xyz(twist.twist.angular) == (-0.5, 0.75, 0.25), "angular rate about east, north and up"
    assert (fix.encode(BARE), velocity.encode(BARE)) == (None, None)
    for length in range(1, 9):
        name = "abcdefgh"[:length]
        for where, channel in channels(MessageFrames(name, has_north=False)).items():
            data = channel.encode(FULL)
            if data is not None:
                message = ROS.deserialize_cdr(data, channel.schema.name)
                header = message.transforms[0].header if where == "/tf" else message.header  # type: ignore[attr-defined]
                own = {"/tf": f"{name}_level", f"/{name}/velocity": "enu"}
                assert header.frame_id == own.get(where, name)
                again = ROS.serialize_cdr(message, channel.schema.name)
                assert bytes(again) == data, where


@pytest.mark.parametrize(
    ("quality", "status"),
    [(None, 0), (0, -1), (1, 0), (2, 1), (3, 0), (4, 2), (5, 2), (6, -1), (7, -1), (8, -1), (9, -1), (254, -1)],
)
def test_fix_status(quality: int | None, status: int) -> None:
    """sensor_msgs/NavSatStatus: NO_FIX -1, FIX 0, SBAS_FIX 1, GBAS_FIX 2. Dead reckoning (6), manual (7) and simulation
    (8) are not fixes of satellites."""
    sample = msgspec.structs.replace(FULL, position=Position(0.5, -1.25, quality=quality))
    fix = read(channels()["/bow/fix"], sample)
    assert fix.status.status == status


def angular(sample: Sample, frames: MessageFrames = BOW) -> tuple[float, float, float]:
    return xyz(read(channels(frames)["/bow/velocity"], sample).twist.angular)


def test_angular_velocity() -> None:
    """A yaw of 90 degrees: the x axis points to the north. The rate about the axes of the body is the rate about north,
    west and up; in ned-frd about north, east and down, which is the same rotation."""
    half = math.sqrt(0.5)
    north = msgspec.structs.replace(FULL, quat_wxyz=(half, 0.0, 0.0, half), gyro_rad_s=(0.25, 0.5, -0.75))
    assert angular(north) == pytest.approx((-0.5, 0.25, -0.75))
    ned = msgspec.structs.replace(FULL, quat_wxyz=(1.0, 0.0, 0.0, 0.0), gyro_rad_s=(0.25, -0.5, 0.75))
    assert angular(ned, MessageFrames("bow", Convention.NED_FRD)) == pytest.approx((-0.5, 0.25, -0.75))


@pytest.mark.parametrize(
    "changes",
    [
        {"gyro_rad_s": None}, {"gyro_rad_s": (0.0, math.nan, 0.0)}, {"quat_wxyz": None}, {"quat_wxyz": (0.0,) * 4},
        {"quat_wxyz": (math.nan, 0.0, 0.0, 1.0)}, {"status": 1 << UNSETTLED_BIT},
    ],
)  # fmt: skip
def test_angular_velocity_is_zero_if_unknown(changes: dict[str, Any]) -> None:
    """Consumers of a Twist cannot use NaN. Drivers of GNSS receivers send zero."""
    assert angular(msgspec.structs.replace(FULL, **changes)) == (0.0, 0.0, 0.0)
    assert angular(FULL, MessageFrames("bow", has_north=False)) == (0.0, 0.0, 0.0)


def test_losses_events_and_diagnoses() -> None:
    losses = read(DIALECT.losses("bow"), bridge.LossCounts(1, UTC_NS, "bow", 100, 1, 2, 3, 4, 5))
    assert (losses.samples, losses.lost_gap_device, losses.lost_crc) == (100, 1, 2)
    assert (losses.lost_overrun, losses.lost_queue, losses.lost_unknown) == (3, 4, 5)
    log = read(DIALECT.events(), StampedEvent(EVENT, UTC_NS))
    assert (log.level, log.name, log.msg) == (30, "bow", 'loss: lost 3, "damaged"')
    assert log.stamp.sec == 1_790_000_000
    assert read(DIALECT.events(), StampedEvent(Event(1, "bow", EventKind.UP, "there"), UTC_NS)).level == 20
    values = {"t_err_ns": "12000", "state": "running"}
    bow = bridge.Diagnosis("bow", bridge.DiagnosisLevel.OK, "running", "17", values)
    mast = bridge.Diagnosis("mast", bridge.DiagnosisLevel.STALE, "silent: nothing comes", "", {})
    channel = DIALECT.diagnostics()
    assert channel.topic == "/diagnostics"
    array = read(channel, bridge.Diagnoses(UTC_NS, (bow, mast)))
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (1_790_000_000, 123_456_789)
    first, second = array.status
    assert (first.level, first.name, first.message, first.hardware_id) == (first.OK, "imud: bow", "running", "17")
    assert list(bridge.DiagnosisLevel) == [first.OK, first.WARN, first.ERROR, first.STALE]
    assert {one.key: one.value for one in first.values} == values
    assert (second.level, second.name, second.values) == (second.STALE, "imud: mast", [])
    assert bytes(ROS.serialize_cdr(array, channel.schema.name)) == channel.encode(bridge.Diagnoses(UTC_NS, (bow, mast)))


def test_definitions_are_those_of_ros_2_and_times_are_clipped() -> None:
    for name in FIELDS.keys() - OWN:
        full = name.replace("/", "/msg/")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema(name).data.decode(), full))
        assert store.hash_rihs01(full) == ROS.hash_rihs01(full), name
    text = schema("tf2_msgs/TFMessage").data.decode()
    assert text.count("MSG: geometry_msgs/Quaternion") == 1
    assert text.count("MSG: builtin_interfaces/Time") == 1
    assert schema("tf2_msgs/TFMessage").name == "tf2_msgs/msg/TFMessage"
    assert time_of(1_500_000_000) == (1, 500_000_000)
    assert time_of(-1) == (0, 0)
    assert time_of(1 << 62) == (0x7FFF_FFFF, (1 << 62) % 1_000_000_000)


def test_numbers_and_texts_are_aligned() -> None:
    layout = Layout("B", "I", "B", "d", "H")
    assert layout.pack(ENCAPSULATION, 1, 2, 3, 1.0, 4) == bytes.fromhex(
        "00010000"  # CDR_LE
        "01 000000"  # u8, padding to 4
        "02000000"
        "03 00000000000000"  # u8 at 8, padding to 16
        "000000000000f03f"
        "0400"
    )
    layout = Layout("B", '"bow', "I")
    assert layout.texts == (bytes.fromhex("04000000 626f7700"),)
    assert layout.pack(ENCAPSULATION, 7, *layout.texts, 5) == bytes.fromhex(
        "00010000 07000000 04000000 626f7700 05000000"
    )
    layout = Layout('"ab', "2d")
    packed = layout.pack(ENCAPSULATION, *layout.texts, 1.0, 2.0)
    assert packed == bytes.fromhex("00010000 03000000 616200 00") + struct.pack("<2d", 1.0, 2.0)
    layout = Layout("B", '"boé', "q", "H")
    written = CdrWriter().number("B", 9).text("boé").number("q", -1).number("H", 3).done()
    assert written == layout.pack(ENCAPSULATION, 9, *layout.texts, -1, 3)
    assert CdrWriter().text("a\0b").done() == bytes.fromhex("00010000 03000000 616200")
    with pytest.raises(struct.error):
        CdrWriter().number("B", 256)
