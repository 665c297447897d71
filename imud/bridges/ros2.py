"""ROS 2 messages in CDR: sensor_msgs, tf2_msgs, diagnostic_msgs, and two message types of imud.

    /NAME/imu/data       sensor_msgs/Imu            with attitude; /NAME/imu/data_raw for a device without attitude
    /NAME/imu/mag        sensor_msgs/MagneticField
    /NAME/temperature    sensor_msgs/Temperature    after a change, and once per second
    /NAME/pressure       sensor_msgs/FluidPressure  after a change, and once per second
    /tf                  tf2_msgs/TFMessage         attitude
    /NAME/fix            sensor_msgs/NavSatFix      position
    /NAME/velocity       geometry_msgs/TwistStamped velocity to the east, to the north and up
    /NAME/stamp          imud_msgs/SampleStamp      sequence number, times, error and other fields of each sample
    /NAME/losses         imud_msgs/Losses           after each loss
    /events              rcl_interfaces/Log
    /diagnostics         diagnostic_msgs/DiagnosticArray   all devices

The topics of Imu and MagneticField have the names of REP-145. Coordinate frames and covariances of a device are
constant, so that an encoder needs one call of `struct` per message (measured: 1 µs).
"""

import re
import struct
from collections.abc import Callable, Sequence
from math import degrees, hypot, inf, isfinite, nan
from struct import Struct
from typing import Any, Final

from imud.attitude.conventions import Convention, is_settled
from imud.attitude.rotation import matrix_from_quat, matrix_times
from imud.bridges.channel import (
    STEADY_NS,
    Diagnoses,
    LossCounts,
    MessageChannel,
    MessageFrames,
    MessageSchema,
    StampedEvent,
    Steady,
    covariance,
    diagnosis_name,
    topic,
)
from imud.formats.slot import SYNC_CODES
from imud.model.sample import Quaternion, Sample, Sync, Vector3
from imud.model.units import NS_PER_S

ENCAPSULATION: Final = b"\x00\x01\x00\x00"  # encapsulation header: CDR_LE, no options
# Size and alignment by the code of `struct`, bytes. `s` is for encoded bytes.
SIZES: Final = {"B": 1, "b": 1, "?": 1, "s": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4, "Q": 8, "q": 8, "d": 8}
_NUMBERS: Final = re.compile(r"(\d*)([a-zA-Z?])")


class Layout:
    """Layout of messages of constant size: numbers and constant strings. Immutable."""

    def __init__(self, *parts: str) -> None:
        """A part contains codes of numbers, for example `iI` or `3d`, or `"` and a constant string."""
        self._format, self._at = f"<{len(ENCAPSULATION)}s", 0
        texts: list[bytes] = []
        for part in parts:
            if part.startswith('"'):
                texts.append(_text(part[1:]))
                self._align(SIZES["I"])
                self._add(len(texts[-1]), "s")
            else:
                for count, code in _NUMBERS.findall(part):
                    self._align(SIZES[code])
                    self._add(int(count or 1), code)
        self.texts: Final = tuple(texts)  # encoded constant strings, arguments of `pack`
        # Encodes a message. Arguments: ENCAPSULATION, then the numbers and `texts` in the order of the parts.
        self.pack: Final = struct.Struct(self._format).pack

    def _add(self, count: int, code: str) -> None:
        self._format += f"{count}{code}"
        self._at += count * SIZES[code]

    def _align(self, size: int) -> None:
        # padding to a multiple of the size
        missing = -self._at % size
        self._format += f"{missing}x" if missing else ""
        self._at += missing


class CdrWriter:
    """Encoder of one message of variable size. Synchronization: one thread."""

    def __init__(self) -> None:
        self._buffer = bytearray(ENCAPSULATION)

    def number(self, code: str, value: Any) -> "CdrWriter":
        """Append a number with a code of `struct`. Raises struct.error if the number is out of range."""
        self._align(SIZES[code])
        self._buffer += struct.pack("<" + code, value)
        return self

    def text(self, value: str) -> "CdrWriter":
        self._align(4)
        self._buffer += _text(value)
        return self

    def octets(self, value: bytes) -> "CdrWriter":
        """Append an array of octets."""
        self._buffer += value
        return self

    def done(self) -> bytes:
        """Return the encoded message."""
        return bytes(self._buffer)

    def _align(self, size: int) -> None:
        self._buffer += bytes(-(len(self._buffer) - len(ENCAPSULATION)) % size)


def _text(value: str) -> bytes:
    # CDR strings end with NUL, which is part of the length
    data = value.replace("\0", "").encode(errors="replace") + b"\0"
    return len(data).to_bytes(4, "little") + data


SEPARATOR: Final = "=" * 80

# Fields of each type, as in its `.msg` file
FIELDS: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/MagneticField": (
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance"
    ),
    "sensor_msgs/NavSatStatus": (
        "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\nint8 status\n"
        "uint16 SERVICE_GPS=1\nuint16 service"
    ),
    "sensor_msgs/NavSatFix": (
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\n"
        "uint8 position_covariance_type"
    ),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "sensor_msgs/Temperature": "std_msgs/Header header\nfloat64 temperature\nfloat64 variance",
    "sensor_msgs/FluidPressure": "std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance",
    "sensor_msgs/TimeReference": "std_msgs/Header header\nbuiltin_interfaces/Time time_ref\nstring source",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "rcl_interfaces/Log": (
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
        "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    "imud_msgs/SampleStamp": "\n".join(
        [f"uint8 {sync.upper()}={code}" for code, sync in enumerate(Sync)]
        + [
            "std_msgs/Header header",
            "uint64 seq",
            "int64 t_ns",
            "int64 t_rx_ns",
            "int64 t_dev_ns",
            "int64 edge_seq",
            "int64 status",
            "int64 pps_age_ms",
            "int64 gnss_utc_ns",
            "float64[3] euler_rad",
            "float64[2] incli_rad",
            "float64 heave_m",
            "uint32 t_err_ns",
            "uint8 sync",
        ]
    ),
    "imud_msgs/Losses": (
        "std_msgs/Header header\nuint64 samples\nuint64 lost_gap_device\nuint64 lost_crc\nuint64 lost_overrun\n"
        "uint64 lost_queue\nuint64 lost_unknown"
    ),
}
# Integer of imud_msgs/SampleStamp for a value that the sample does not contain. For real numbers it is NaN.
NONE: Final = -1
EAST_NORTH_UP: Final = "enu"  # `frame_id` of velocities, in every convention


def schema(name: str) -> MessageSchema:
    """Return the definition of a type and of all types that it contains."""
    parts, done, waiting = [FIELDS[name]], {name}, _parts_of(name)
    while waiting:
        part = waiting.pop(0)
        if part not in done:
            done.add(part)
            parts.append(f"{SEPARATOR}\nMSG: {part}\n{FIELDS[part]}")
            waiting += _parts_of(part)
    package, _, message = name.partition("/")
    return MessageSchema(f"{package}/msg/{message}", "ros2msg", ("\n".join(parts) + "\n").encode())


def _parts_of(name: str) -> list[str]:
    words = [line.split()[0].removesuffix("[]") for line in FIELDS[name].splitlines()]
    return [word for word in words if word in FIELDS]


NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2  # `status` of sensor_msgs/NavSatStatus
# Status by the quality of a position. ROS has no status for a position that is not measured with satellites: dead
# reckoning (6), manual (7) and simulation (8) have NO_FIX. RTK (4, 5) uses a station on the ground.
FIX_STATUS: Final = {1: FIX, 2: SBAS_FIX, 3: FIX, 4: GBAS_FIX, 5: GBAS_FIX}  # all others: NO_FIX
LEVEL_INFO: Final = 20
LEVEL_WARN: Final = 30
SEC_MAX: Final = 0x7FFF_FFFF  # maximum `sec` of `builtin_interfaces/Time`, in the year 2038
_MATRIX: Final = Struct("<9d")
_NO_VECTOR: Final = (0.0, 0.0, 0.0)
_NO_ROTATION: Final = (1.0, 0.0, 0.0, 0.0)
_NO_ANGLES: Final = (nan, nan, nan)
_NO_INCLINATION: Final = (nan, nan)

Encoder = Callable[[Sample], bytes | None]


class Ros2Dialect:
    """Dialect with ROS 2 messages."""

    profile = "ros2"

    def samples(self, frames: MessageFrames) -> Sequence[MessageChannel[Sample]]:
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
            (topic(name, "fix"), "sensor_msgs/NavSatFix", _fix(frames), {"position"}),
            (topic(name, "velocity"), "geometry_msgs/TwistStamped", _velocity(frames), {"velocity_enu_m_s"}),
            (topic(name, "stamp"), "imud_msgs/SampleStamp", _stamp(frames), _STAMP),
        )  # fmt: skip
        return [
            MessageChannel(where, schema(type_), "cdr", encode, frozenset(fields))
            for where, type_, encode, fields in rows
        ]

    def losses(self, device: str) -> MessageChannel[LossCounts]:
        layout = Layout("iI", f'"{device}', "6Q")

        def encode(losses: LossCounts) -> bytes:
            sec, nanosec = time_of(losses.utc_ns)
            return layout.pack(ENCAPSULATION, sec, nanosec, *layout.texts, losses.samples, *losses.counts)

        return MessageChannel(topic(device, "losses"), schema("imud_msgs/Losses"), "cdr", encode)

    def events(self) -> MessageChannel[StampedEvent]:
        return MessageChannel("/events", schema("rcl_interfaces/Log"), "cdr", _log)

    def diagnostics(self) -> MessageChannel[Diagnoses]:
        return MessageChannel("/diagnostics", schema("diagnostic_msgs/DiagnosticArray"), "cdr", _diagnostics)


_IMU: Final = {"accel_m_s2", "gyro_rad_s", "quat_wxyz"}
_STAMP: Final = {
    "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "t_dev_ns", "euler_rad", "incli_rad", "status",
    "pps_age_ms", "edge_seq", "heave_m", "gnss_utc_ns",
}  # fmt: skip


def time_of(utc_ns: int) -> tuple[int, int]:
    """Return `sec` and `nanosec` of a time, at least 0, limited to the range of `builtin_interfaces/Time`."""
    # a measurement before the first frame of a log that starts at 0 has a negative time, which ROS 2 rejects
    sec, nanosec = divmod(max(utc_ns, 0), NS_PER_S)
    return min(sec, SEC_MAX), nanosec


def _imu(frames: MessageFrames, *, with_attitude: bool) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "4d", "72s", "3d", "72s", "3d", "72s")
    pack, (body,) = layout.pack, layout.texts
    noise = frames.deviations
    attitude = _MATRIX.pack(*covariance(noise.attitude_rad))
    rate = _MATRIX.pack(*covariance(noise.gyro_rad_s))
    force = _MATRIX.pack(*covariance(noise.accel_m_s2))
    missing = _MATRIX.pack(*covariance(None, present=False))

    def encode(sample: Sample) -> bytes | None:
        gyro, accel, quat = sample.gyro_rad_s, sample.accel_m_s2, sample.quat_wxyz
        if (quat is not None) is not with_attitude or (gyro is None and accel is None):
            return None
        if not is_settled(sample.status):
            quat = None
        w, x, y, z = quat or _NO_ROTATION
        gx, gy, gz = gyro or _NO_VECTOR
        ax, ay, az = accel or _NO_VECTOR
        sec, nanosec = time_of(sample.utc_ns)
        return pack(
            ENCAPSULATION, sec, nanosec, body, x, y, z, w, missing if quat is None else attitude,
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
    """Return the encoder of a scalar value with its variance; 0 if the variance is unknown."""
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


def time_reference(frames: MessageFrames) -> MessageChannel[Sample]:
    """Return the channel for the time of a device, once per second: UTC of its GNSS receiver, otherwise its own time.
    The stamp of the header is the same instant on CLOCK_REALTIME."""
    sources = {source: Layout("iI", f'"{frames.body}', "iI", f'"{source}') for source in ("gnss", "device")}
    due_ns = 0

    def encode(sample: Sample) -> bytes | None:
        nonlocal due_ns
        source, time_ns = "gnss", sample.gnss_utc_ns
        if time_ns is None:
            source, time_ns = "device", sample.t_dev_ns
        if time_ns is None or due_ns - STEADY_NS <= sample.utc_ns < due_ns:
            return None
        due_ns = sample.utc_ns + STEADY_NS
        layout = sources[source]
        body, name = layout.texts
        return layout.pack(ENCAPSULATION, *time_of(sample.utc_ns), body, *time_of(time_ns), name)

    where = topic(frames.device, "time_reference")
    fields = frozenset({"gnss_utc_ns", "t_dev_ns"})
    return MessageChannel(where, schema("sensor_msgs/TimeReference"), "cdr", encode, fields)


def _transform(frames: MessageFrames) -> Encoder:
    layout = Layout("I", "iI", f'"{frames.navigation}', f'"{frames.body}', "3d", "4d")
    pack, (navigation, body) = layout.pack, layout.texts

    def encode(sample: Sample) -> bytes | None:
        quat = sample.quat_wxyz
        if quat is None or not is_settled(sample.status):
            return None
        if not isfinite(sum(quat)):  # tf refuses NaN and prints a warning for each message
            return None
        w, x, y, z = quat
        sec, nanosec = time_of(sample.utc_ns)
        return pack(ENCAPSULATION, 1, sec, nanosec, navigation, body, 0.0, 0.0, 0.0, x, y, z, w)

    return encode


def _fix(frames: MessageFrames) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "b", "H", "3d", "72s", "B")
    pack, (body,) = layout.pack, layout.texts
    unknown = bytes(72)

    def encode(sample: Sample) -> bytes | None:
        place = sample.position
        if place is None:
            return None
        # SERVICE_GPS: the device does not send the systems of its satellites
        status = FIX if place.quality is None else FIX_STATUS.get(place.quality, NO_FIX)
        altitude = nan if place.height_m is None else place.height_m
        sec, nanosec = time_of(sample.utc_ns)
        return pack(
            ENCAPSULATION, sec, nanosec, body, status, 1, degrees(place.latitude_rad), degrees(place.longitude_rad),
            altitude, unknown, 0,
        )  # fmt: skip

    return encode


def _velocity(frames: MessageFrames) -> Encoder:
    """Return the encoder of the velocity. Its angular part is the angular rate in the same frame (geometry_msgs/Twist);
    zero without a settled attitude from north, as GNSS drivers of ROS send. A Twist cannot contain "unknown", and
    consumers integrate or filter NaN."""
    layout = Layout("iI", f'"{EAST_NORTH_UP}', "6d")
    pack, (enu,) = layout.pack, layout.texts

    def encode(sample: Sample) -> bytes | None:
        velocity = sample.velocity_enu_m_s
        if velocity is None:
            return None
        sec, nanosec = time_of(sample.utc_ns)
        rate = _NO_VECTOR
        if frames.has_north and is_settled(sample.status):
            rate = _rate_enu(sample.gyro_rad_s, sample.quat_wxyz, frames.convention)
        return pack(ENCAPSULATION, sec, nanosec, enu, *velocity, *rate)

    return encode


def _rate_enu(gyro: Vector3 | None, quat: Quaternion | None, convention: Convention) -> Vector3:
    """Return the angular rate about east, north and up; zeros if it is unknown."""
    if gyro is None or quat is None or not isfinite(sum(gyro)) or not 0.0 < hypot(*quat) < inf:
        return _NO_VECTOR
    x, y, z = matrix_times(matrix_from_quat(quat), gyro)
    return (y, x, -z) if convention is Convention.NED_FRD else (x, y, z)


def _stamp(frames: MessageFrames) -> Encoder:
    layout = Layout("iI", f'"{frames.body}', "Q7q", "6d", "I", "B")
    pack, (body,) = layout.pack, layout.texts

    def encode(sample: Sample) -> bytes | None:
        roll, pitch, yaw = sample.euler_rad or _NO_ANGLES
        incli_x, incli_y = sample.incli_rad or _NO_INCLINATION
        heave = nan if sample.heave_m is None else sample.heave_m
        sec, nanosec = time_of(sample.utc_ns)
        return pack(
            ENCAPSULATION, sec, nanosec, body, sample.seq, sample.t_ns, sample.t_rx_ns, _or_none(sample.t_dev_ns),
            _or_none(sample.edge_seq), _or_none(sample.status), _or_none(sample.pps_age_ms),
            _or_none(sample.gnss_utc_ns), roll, pitch, yaw, incli_x, incli_y, heave, sample.t_err_ns,
            SYNC_CODES[sample.sync],
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
