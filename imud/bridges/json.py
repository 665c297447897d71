"""JSON messages with JSON schemas: attitude and events of Foxglove, diagnostics of ROS, other messages of imud.

    /NAME/imu/data       imud.Imu                  angular rate, specific force, attitude
    /NAME/imu/mag        imud.MagneticField
    /NAME/temperature    imud.Temperature          after a change, and once per second
    /NAME/pressure       imud.FluidPressure        after a change, and once per second
    /NAME/attitude       foxglove.FrameTransform   body in the navigation frame
    /NAME/fix            foxglove.LocationFix      position, degrees
    /NAME/stamp          imud.SampleStamp          sequence number, times, time stamp error, other fields of each sample
    /NAME/losses         imud.Losses               after each loss
    /NAME/status         imud.DeviceStatus         for a live device, as in `imud status --json`
    /events              foxglove.Log
    /diagnostics         diagnostic_msgs/DiagnosticArray   all devices

The members have the names of the corresponding ROS messages, so that a viewer shows both dialects in the same way. A
message contains only the members that the sample contains; NaN is null. It contains covariances only if they are known.
"""

from collections.abc import Callable, Sequence
from math import degrees, isfinite
from operator import attrgetter
from typing import Any, Final

import msgspec

from imud.attitude.conventions import is_settled
from imud.bridges.channel import (
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
from imud.contracts.status import DeviceStatus
from imud.host.log import printable
from imud.model.sample import SAMPLE_SCHEMA, Pair, Position, Quaternion, Sample, Sync, Vector3
from imud.model.units import NS_PER_S

Matrix = tuple[float, ...]  # matrix of 3 × 3 elements, row by row


class Timestamp(msgspec.Struct, frozen=True, gc=False):
    """Time since 1970-01-01 UTC in the format of Foxglove."""

    sec: int
    nsec: int


class VectorMember(msgspec.Struct, frozen=True, gc=False):
    """Vector with three axes."""

    x: float
    y: float
    z: float


class RotationMember(msgspec.Struct, frozen=True, gc=False):
    """Quaternion, scalar last."""

    x: float
    y: float
    z: float
    w: float


class ImuMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Message imud.Imu."""

    timestamp: Timestamp
    frame_id: str
    orientation: RotationMember | None = None
    angular_velocity: VectorMember | None = None
    linear_acceleration: VectorMember | None = None
    orientation_covariance: Matrix | None = None
    angular_velocity_covariance: Matrix | None = None
    linear_acceleration_covariance: Matrix | None = None


class MagneticMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Message imud.MagneticField."""

    timestamp: Timestamp
    frame_id: str
    magnetic_field: VectorMember
    magnetic_field_covariance: Matrix | None = None


class TransformMessage(msgspec.Struct, frozen=True, gc=False):
    """Message foxglove.FrameTransform."""

    timestamp: Timestamp
    parent_frame_id: str
    child_frame_id: str
    translation: VectorMember
    rotation: RotationMember


class StampMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Message imud.SampleStamp: the time, and fields of the sample by name."""

    timestamp: Timestamp
    seq: int
    t_ns: int
    t_err_ns: int
    sync: Sync
    t_rx_ns: int
    utc_ns: int
    t_dev_ns: int | None = None
    euler_rad: Vector3 | None = None
    incli_rad: Pair | None = None
    status: int | None = None
    pps_age_ms: int | None = None
    edge_seq: int | None = None
    velocity_enu_m_s: Vector3 | None = None
    position: Position | None = None
    heave_m: float | None = None
    gnss_utc_ns: int | None = None


STAMP_FIELDS = StampMessage.__struct_fields__[1:]  # fields of a sample in imud.SampleStamp


def timestamp(utc_ns: int) -> Timestamp:
    return Timestamp(*divmod(utc_ns, NS_PER_S))


LEVEL_INFO: Final = 2
LEVEL_WARNING: Final = 3
NO_COVARIANCE: Final = (0.0,) * 9
TEXT_MAX: Final = 4096  # maximum length of a log line, characters
_encode: Final = msgspec.json.Encoder().encode
_stamp_values: Final = attrgetter(*STAMP_FIELDS)

Encoder = Callable[[Sample], bytes | None]
Properties = dict[str, Any]

# --- schemas ----------------------------------------------------------------------------------------------------------


def _object(properties: Properties, *, always: Sequence[str] = ()) -> Properties:
    made: Properties = {"type": "object", "properties": properties}
    return made | ({"required": list(always)} if always else {})


def _numbers(names: str, meaning: str = "") -> Properties:
    made = _object({name: {"type": "number"} for name in names})
    return made | ({"description": meaning} if meaning else {})


def _matrix(meaning: str) -> Properties:
    return {"type": "array", "items": {"type": "number"}, "minItems": 9, "maxItems": 9, "description": meaning}


def _list(items: Properties) -> Properties:
    return {"type": "array", "items": items}


def _schema(name: str, properties: Properties) -> MessageSchema:
    timestamp = _object({"sec": {"type": "integer"}, "nsec": {"type": "integer"}}, always=("sec", "nsec"))
    whole = {"title": name, **_object({"timestamp": timestamp, **properties}, always=("timestamp",))}
    return MessageSchema(name, "jsonschema", _encode(whole))


_TEXT: Final = {"type": "string"}
_NUMBER: Final = {"type": "number"}
_INTEGER: Final = {"type": "integer"}
_FIELD_TYPES: Final = {"string": _TEXT, "integer": _INTEGER, "number": _NUMBER, "object": {"type": "object"}}


def _field(name: str) -> Properties:
    (row,) = (one for one in SAMPLE_SCHEMA if one.name == name)
    kind = _FIELD_TYPES.get(row.type, {"type": "array", "items": _NUMBER})
    return {**kind, "description": f"{row.meaning}{f', {row.unit}' if row.unit else ''}"}


IMU_SCHEMA: Final = _schema(
    "imud.Imu",
    {
        "frame_id": _TEXT,
        "orientation": _numbers("xyzw", "rotation from the body to the navigation frame"),
        "angular_velocity": _numbers("xyz", "rad/s"),
        "linear_acceleration": _numbers("xyz", "specific force, m/s²"),
        "orientation_covariance": _matrix("rad², about the axes of the body"),
        "angular_velocity_covariance": _matrix("rad²/s²"),
        "linear_acceleration_covariance": _matrix("m²/s⁴"),
    },
)
MAGNETIC_SCHEMA: Final = _schema(
    "imud.MagneticField",
    {"frame_id": _TEXT, "magnetic_field": _numbers("xyz", "T"), "magnetic_field_covariance": _matrix("T²")},
)
STAMP_SCHEMA: Final = _schema("imud.SampleStamp", {name: _field(name) for name in STAMP_FIELDS})
LOSSES_SCHEMA: Final = _schema("imud.Losses", dict.fromkeys(LossCounts._fields[3:], _INTEGER))
STATUS_SCHEMA: Final = _schema(
    "imud.DeviceStatus",
    {
        "state": _TEXT, "problem": _TEXT, "rate_hz": _NUMBER, "expected_rate_hz": _NUMBER,
        "clock": {"type": "object"}, "ledger": {"type": "object"}, "temperature_c": _NUMBER,
    },
)  # fmt: skip
FRAME_TRANSFORM_SCHEMA: Final = _schema(
    "foxglove.FrameTransform",
    {
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _numbers("xyz"),
        "rotation": _numbers("xyzw"),
    },
)
LOCATION_SCHEMA: Final = _schema(
    "foxglove.LocationFix",
    {
        "frame_id": _TEXT, "latitude": _NUMBER, "longitude": _NUMBER, "altitude": _NUMBER,
        "position_covariance": _matrix("m²; unknown"), "position_covariance_type": _INTEGER,
    },
)  # fmt: skip
LOG_SCHEMA: Final = _schema(
    "foxglove.Log", {"level": _INTEGER, "message": _TEXT, "name": _TEXT, "file": _TEXT, "line": _INTEGER}
)

# Schema of the diagnostics. The diagnostics panels of Foxglove and Lichtblick find topics by its name.
DIAGNOSTICS_SCHEMA: Final = MessageSchema(
    "diagnostic_msgs/DiagnosticArray",
    "jsonschema",
    _encode(
        {"title": "diagnostic_msgs/DiagnosticArray"}
        | _object(
            {
                "header": _object({"stamp": _object({"sec": _INTEGER, "nsec": _INTEGER}), "frame_id": _TEXT}),
                "status": _list(
                    _object(
                        {
                            "level": _INTEGER, "name": _TEXT, "message": _TEXT, "hardware_id": _TEXT,
                            "values": _list(_object({"key": _TEXT, "value": _TEXT})),
                        }
                    )
                ),
            }
        )
    ),
)  # fmt: skip

# --- messages ---------------------------------------------------------------------------------------------------------


class JsonDialect:
    """Dialect with JSON messages."""

    profile = ""

    def samples(self, frames: MessageFrames) -> Sequence[MessageChannel[Sample]]:
        name, noise = frames.device, frames.deviations
        rows: tuple[tuple[str, MessageSchema, Encoder, Sequence[str]], ...] = (
            ("imu/data", IMU_SCHEMA, _imu(frames), ("accel_m_s2", "gyro_rad_s", "quat_wxyz")),
            ("imu/mag", MAGNETIC_SCHEMA, _mag(frames), ("mag_t",)),
            ("temperature", *_scalar(frames, "temperature_c", "imud.Temperature", noise.temperature_c)),
            ("pressure", *_scalar(frames, "pressure_pa", "imud.FluidPressure", noise.pressure_pa)),
            ("attitude", FRAME_TRANSFORM_SCHEMA, _transform(frames), ("quat_wxyz",)),
            ("fix", LOCATION_SCHEMA, _fix(frames), ("position",)),
            ("stamp", STAMP_SCHEMA, _stamp, STAMP_FIELDS),
        )
        return [
            MessageChannel(topic(name, place), schema, "json", encode, frozenset(fields))
            for place, schema, encode, fields in rows
        ]

    def losses(self, device: str) -> MessageChannel[LossCounts]:
        return MessageChannel(topic(device, "losses"), LOSSES_SCHEMA, "json", _losses)

    def events(self) -> MessageChannel[StampedEvent]:
        return MessageChannel("/events", LOG_SCHEMA, "json", _log)

    def diagnostics(self) -> MessageChannel[Diagnoses]:
        return MessageChannel("/diagnostics", DIAGNOSTICS_SCHEMA, "json", _diagnostics)


def status_channel(device: str) -> MessageChannel[tuple[DeviceStatus, int]]:
    """Return the channel for the status of a live device with the CLOCK_REALTIME of the request.

    The channel is JSON in both dialects, because no ROS message can contain the status.
    """
    return MessageChannel(topic(device, "status"), STATUS_SCHEMA, "json", _status)


def _imu(frames: MessageFrames) -> Encoder:
    body, noise = frames.body, frames.deviations
    known = [_known(sigma) for sigma in (noise.attitude_rad, noise.gyro_rad_s, noise.accel_m_s2)]

    def encode(sample: Sample) -> bytes | None:
        gyro, accel, quat = sample.gyro_rad_s, sample.accel_m_s2, sample.quat_wxyz
        if gyro is None and accel is None:
            return None
        return _encode(
            ImuMessage(
                timestamp(sample.utc_ns),
                body,
                _rotation(quat) if quat is not None and is_settled(sample.status) else None,
                None if gyro is None else VectorMember(*gyro),
                None if accel is None else VectorMember(*accel),
                *known,
            )
        )

    return encode


def _known(sigma: float | None) -> Matrix | None:
    return None if sigma is None else covariance(sigma)


def _rotation(quat: Quaternion) -> RotationMember:
    w, x, y, z = quat
    return RotationMember(x, y, z, w)


def _mag(frames: MessageFrames) -> Encoder:
    body, known = frames.body, _known(frames.deviations.mag_t)

    def encode(sample: Sample) -> bytes | None:
        mag = sample.mag_t
        if mag is None:
            return None
        return _encode(MagneticMessage(timestamp(sample.utc_ns), body, VectorMember(*mag), known))

    return encode


def _scalar(
    frames: MessageFrames, name: str, title: str, sigma: float | None
) -> tuple[MessageSchema, Encoder, Sequence[str]]:
    """Return the schema, the encoder and the field of a scalar value."""
    member = "temperature" if name == "temperature_c" else "fluid_pressure"
    schema = _schema(title, {"frame_id": _TEXT, member: _field(name), "variance": _NUMBER})
    known, steady = {} if sigma is None else {"variance": sigma * sigma}, Steady()

    def encode(sample: Sample) -> bytes | None:
        value: float | None = getattr(sample, name)
        if value is None or not steady.passes(value, sample.utc_ns):
            return None
        return _encode({"timestamp": timestamp(sample.utc_ns), "frame_id": frames.body, member: value, **known})

    return schema, encode, (name,)


def _transform(frames: MessageFrames) -> Encoder:
    navigation, body, nowhere = frames.navigation, frames.body, VectorMember(0.0, 0.0, 0.0)

    def encode(sample: Sample) -> bytes | None:
        quat = sample.quat_wxyz
        # a viewer cannot draw NaN
        if quat is None or not is_settled(sample.status) or not isfinite(sum(quat)):
            return None
        return _encode(TransformMessage(timestamp(sample.utc_ns), navigation, body, nowhere, _rotation(quat)))

    return encode


def _fix(frames: MessageFrames) -> Encoder:
    def encode(sample: Sample) -> bytes | None:
        place = sample.position
        if place is None or place.quality == 0:  # an invalid position
            return None
        return _encode(
            {
                "timestamp": timestamp(sample.utc_ns), "frame_id": frames.body,
                "latitude": degrees(place.latitude_rad), "longitude": degrees(place.longitude_rad),
                "altitude": place.height_m or 0.0, "position_covariance": NO_COVARIANCE, "position_covariance_type": 0,
            }
        )  # fmt: skip

    return encode


def _stamp(sample: Sample) -> bytes:
    return _encode(StampMessage(timestamp(sample.utc_ns), *_stamp_values(sample)))


def _losses(losses: LossCounts) -> bytes:
    return _encode({"timestamp": timestamp(losses.utc_ns), **dict(zip(losses._fields[3:], losses[3:], strict=True))})


def _log(stamped: StampedEvent) -> bytes:
    event = stamped.event
    return _encode(
        {
            "timestamp": timestamp(stamped.utc_ns),
            "level": LEVEL_WARNING if stamped.is_warning else LEVEL_INFO,
            "message": printable(f"{event.kind}: {event.message}", TEXT_MAX),
            "name": event.device or "imud", "file": "", "line": 0,
        }
    )  # fmt: skip


def _status(timed: tuple[DeviceStatus, int]) -> bytes:
    status, utc_ns = timed
    return _encode({"timestamp": timestamp(utc_ns), **msgspec.to_builtins(status)})


def _diagnostics(diagnoses: Diagnoses) -> bytes:
    statuses = [
        {
            "level": one.level, "name": diagnosis_name(one.device), "message": one.message, "hardware_id": one.hardware,
            "values": [{"key": key, "value": value} for key, value in one.values.items()],
        }
        for one in diagnoses.devices
    ]  # fmt: skip
    return _encode({"header": {"stamp": timestamp(diagnoses.utc_ns), "frame_id": ""}, "status": statuses})
