"""Samples as ROS 2 messages in CDR: sensor_msgs, tf2_msgs, diagnostic_msgs, and two types of imud's own (`ros2_types`).

    /NAME/imu/data       sensor_msgs/Imu            with the attitude; /NAME/imu/data_raw of a device that sends none
    /NAME/imu/mag        sensor_msgs/MagneticField
    /NAME/temperature    sensor_msgs/Temperature    when it changes, and once a second
    /NAME/pressure       sensor_msgs/FluidPressure  when it changes, and once a second
    /tf                  tf2_msgs/TFMessage         attitude
    /NAME/stamp          imud_msgs/SampleStamp      number, times and error of each sample, and what has no other place
    /NAME/losses         imud_msgs/Losses           after each loss
    /events              rcl_interfaces/Log
    /diagnostics         diagnostic_msgs/DiagnosticArray   all devices

Names of the topics of Imu and MagneticField are those of REP-145. The encoders are made for a device once: frames and
covariances are constant, so that a message is one call of `struct`. Measured: 1 µs per message.
"""

from collections.abc import Callable, Sequence
from math import isfinite, nan
from struct import Struct
from typing import Final

from imud.bridges.cdr import ENCAPSULATION, CdrWriter, Layout
from imud.bridges.channel import (
    Diagnoses,
    LossCounts,
    MessageChannel,
    MessageFrames,
    StampedEvent,
    Steady,
    covariance,
    diagnosis_name,
    topic,
)
from imud.bridges.ros2_types import NONE, schema
from imud.formats.slot import SYNC_CODES
from imud.sample import Sample
from imud.units import NS_PER_S

LEVEL_INFO: Final = 20
LEVEL_WARN: Final = 30
SEC_MAX: Final = 0x7FFF_FFFF
"""`builtin_interfaces/Time` ends in 2038."""
_MATRIX: Final = Struct("<9d")
_NO_VECTOR: Final = (0.0, 0.0, 0.0)
_NO_ROTATION: Final = (1.0, 0.0, 0.0, 0.0)
_NO_ANGLES: Final = (nan, nan, nan)
_NO_INCLINATION: Final = (nan, nan)

Encoder = Callable[[Sample], bytes | None]


class Ros2Dialect:
    """Messages of ROS 2."""

    profile = "ros2"

    def samples(self, frames: MessageFrames) -> Sequence[MessageChannel[Sample]]:
        """Channels of the samples of a device."""
        name = frames.device
        rows: tuple[tuple[str, str, Encoder, set[str]], ...] = (
            (topic(name, "imu/data"), "sensor_msgs/Imu", _imu(frames, with_attitude=True), _IMU),
            (topic(name, "imu/data_raw"), "sensor_msgs/Imu", _imu(frames, with_attitude=False), _IMU),
            (topic(name, "imu/mag"), "sensor_msgs/MagneticField", _mag(frames), {"mag_t"}),
            (
                topic(name, "temperature"), "sensor_msgs/Temperature",
                _scalar(frames, "temperature_c", frames.deviations.temperature_c), {"temperature_c"},
            ),
            (
                topic(name, "pressure"), "sensor_msgs/FluidPressure",
                _scalar(frames, "pressure_pa", frames.deviations.pressure_pa), {"pressure_pa"},
            ),
            ("/tf", "tf2_msgs/TFMessage", _transform(frames), {"quat_wxyz"}),
            (topic(name, "stamp"), "imud_msgs/SampleStamp", _stamp(frames), _STAMP),
        )  # fmt: skip
        return [
            MessageChannel(where, schema(type_), "cdr", encode, frozenset(fields))
            for where, type_, encode, fields in rows
        ]

    def losses(self, device: str) -> MessageChannel[LossCounts]:
        """Channel of the losses of a device."""
        layout = Layout("iI", f'"{device}', "6Q")

        def encode(losses: LossCounts) -> bytes:
            sec, nanosec = time_of(losses.utc_ns)
            return layout.pack(ENCAPSULATION, sec, nanosec, *layout.texts, losses.samples, *losses.counts)

        return MessageChannel(topic(device, "losses"), schema("imud_msgs/Losses"), "cdr", encode)

    def events(self) -> MessageChannel[StampedEvent]:
        """Channel of the events of all devices."""
        return MessageChannel("/events", schema("rcl_interfaces/Log"), "cdr", _log)

    def diagnostics(self) -> MessageChannel[Diagnoses]:
        """Channel of how all devices are."""
        return MessageChannel("/diagnostics", schema("diagnostic_msgs/DiagnosticArray"), "cdr", _diagnostics)


_IMU: Final = {"accel_m_s2", "gyro_rad_s", "quat_wxyz"}
_STAMP: Final = {
    "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "t_dev_ns", "euler_rad", "incli_rad", "status",
    "pps_age_ms", "edge_seq",
}  # fmt: skip


def time_of(utc_ns: int) -> tuple[int, int]:
    """Return `sec` and `nanosec` of a stamp, clipped to what they hold."""
    sec, nanosec = divmod(utc_ns, NS_PER_S)
    return (sec, nanosec) if -SEC_MAX <= sec <= SEC_MAX else (SEC_MAX if sec > 0 else -SEC_MAX, nanosec)


def _imu(frames: MessageFrames, *, with_attitude: bool) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "4d", "72s", "3d", "72s", "3d", "72s")
    pack, (body,) = layout.pack, layout.texts
    noise = frames.deviations
    attitude = _MATRIX.pack(*covariance(noise.attitude_rad, present=with_attitude))
    rate = _MATRIX.pack(*covariance(noise.gyro_rad_s))
    force = _MATRIX.pack(*covariance(noise.accel_m_s2))
    missing = _MATRIX.pack(*covariance(None, present=False))

    def encode(sample: Sample) -> bytes | None:
        gyro, accel, quat = sample.gyro_rad_s, sample.accel_m_s2, sample.quat_wxyz
        if (quat is not None) is not with_attitude or (gyro is None and accel is None):
            return None
        w, x, y, z = quat or _NO_ROTATION
        gx, gy, gz = gyro or _NO_VECTOR
        ax, ay, az = accel or _NO_VECTOR
        sec, nanosec = time_of(sample.utc_ns)
        return pack(
            ENCAPSULATION, sec, nanosec, body, x, y, z, w, attitude,
            gx, gy, gz, missing if gyro is None else rate, ax, ay, az, missing if accel is None else force,
        )  # fmt: skip

    return encode


def _mag(frames: MessageFrames) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "3d", "72s")
    pack, (body,) = layout.pack, layout.texts
    noise = _MATRIX.pack(*covariance(frames.deviations.mag_t))

    def encode(sample: Sample) -> bytes | None:
        mag = sample.mag_t
        if mag is None:
            return None
        x, y, z = mag
        sec, nanosec = time_of(sample.utc_ns)
        return pack(ENCAPSULATION, sec, nanosec, body, x, y, z, noise)

    return encode


def _scalar(frames: MessageFrames, name: str, sigma: float | None) -> Encoder:
    """A value without direction, with its variance; 0 where that is not known."""
    layout = Layout("iI", f'"{frames.body}', "2d")
    pack, (body,) = layout.pack, layout.texts
    variance, steady = (sigma or 0.0) ** 2, Steady()

    def encode(sample: Sample) -> bytes | None:
        value: float | None = getattr(sample, name)
        if value is None or not steady.passes(value, sample.utc_ns):
            return None
        sec, nanosec = time_of(sample.utc_ns)
        return pack(ENCAPSULATION, sec, nanosec, body, value, variance)

    return encode


def _transform(frames: MessageFrames) -> Encoder:
    layout = Layout("I", "iI", f'"{frames.navigation}', f'"{frames.body}', "3d", "4d")
    pack, (navigation, body) = layout.pack, layout.texts

    def encode(sample: Sample) -> bytes | None:
        quat = sample.quat_wxyz
        if quat is None or not isfinite(sum(quat)):  # tf refuses what is not finite, and warns of it each time
            return None
        w, x, y, z = quat
        sec, nanosec = time_of(sample.utc_ns)
        return pack(ENCAPSULATION, 1, sec, nanosec, navigation, body, 0.0, 0.0, 0.0, x, y, z, w)

    return encode


def _stamp(frames: MessageFrames) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "Q6q", "3d", "2d", "I", "B")
    pack, (body,) = layout.pack, layout.texts

    def encode(sample: Sample) -> bytes | None:
        roll, pitch, yaw = sample.euler_rad or _NO_ANGLES
        incli_x, incli_y = sample.incli_rad or _NO_INCLINATION
        sec, nanosec = time_of(sample.utc_ns)
        return pack(
            ENCAPSULATION, sec, nanosec, body, sample.seq, sample.t_ns, sample.t_rx_ns, _or_none(sample.t_dev_ns),
            _or_none(sample.edge_seq), _or_none(sample.status), _or_none(sample.pps_age_ms), roll, pitch, yaw,
            incli_x, incli_y, sample.t_err_ns, SYNC_CODES[sample.sync],
        )  # fmt: skip

    return encode


def _or_none(value: int | None) -> int:
    return NONE if value is None else value


def _log(stamped: StampedEvent) -> bytes:
    event, (sec, nanosec) = stamped.event, time_of(stamped.utc_ns)
    writer = CdrWriter().number("i", sec).number("I", nanosec)
    writer.number("B", LEVEL_WARN if stamped.is_warning else LEVEL_INFO)
    writer.text(event.device or "imud").text(f"{event.kind}: {event.message}")
    return writer.text("").text("").number("I", 0).done()


def _diagnostics(diagnoses: Diagnoses) -> bytes:
    sec, nanosec = time_of(diagnoses.utc_ns)
    writer = CdrWriter().number("i", sec).number("I", nanosec).text("")
    writer.number("I", len(diagnoses.devices))
    for one in diagnoses.devices:
        writer.number("B", one.level).text(diagnosis_name(one.device)).text(one.message).text(one.hardware)
        writer.number("I", len(one.values))
        for key, value in one.values.items():
            writer.text(key).text(value)
    return writer.done()
