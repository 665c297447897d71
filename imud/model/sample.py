"""The two records of the sample path: a decoded message of a device, and the sample that imud makes of it.

A codec yields `Measurement`: device time and physical values, no host time. Only `imud.sampling` makes a `Sample`,
so a path that skips the clock does not type-check. All values are SI, in the right-handed sensor frame; a field is
None where the message has none, because absent is not zero.
"""

from enum import StrEnum
from typing import Final

import msgspec

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pair = tuple[float, float]


T_ERR_MOST: Final = 0xFFFF_FFFF
"""`t_err_ns` is 32 bits wide wherever it is published."""


class Sync(StrEnum):
    """Origin of a time stamp, worst first."""

    ARRIVAL = "arrival"
    """Time of arrival less the time on the wire; the device sends no usable time."""
    REGRESSION = "regression"
    """Device time fitted to arrival times."""
    EDGE = "edge"
    """Device time fitted to SOUT or PPS edges that the kernel stamped."""
    UTC = "utc"
    """The device itself is disciplined to UTC."""


class Measurement(msgspec.Struct, frozen=True, gc=False):
    """A message of a device, decoded to SI units, without host time."""

    size_bytes: int
    """Bytes of the message on the wire, all framing included."""
    trailing_bytes: int
    """Bytes of the same read that follow it: they were on the wire later, so the message came earlier than the read."""
    dev_ticks: int | None
    """Device time as sent, in the driver's ticks, still wrapping; None where the message has none."""
    accel_m_s2: Vector3 | None = None
    gyro_rad_s: Vector3 | None = None
    mag_t: Vector3 | None = None
    quat_wxyz: Quaternion | None = None
    """Rotation from body to navigation frame, scalar first."""
    euler_rad: Vector3 | None = None
    """Roll, pitch, yaw in the device's own convention, which the driver names."""
    temperature_c: float | None = None
    pressure_pa: float | None = None
    incli_rad: Pair | None = None
    """Inclinometer X and Y."""
    status: int | None = None
    """Status bits as sent."""
    pps_age_ms: int | None = None
    """Time from the last edge on the device's PPS/SIN input to this measurement; wraps as the device says."""


class Sample(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """A measurement with its host time. Field names are the names in JSON, which leaves absent fields out."""

    device: str
    """Name of the device in the configuration."""
    seq: int
    """Counts from 1 per device, +1 for every sample since start: a gap a reader sees is a sample that reader lost."""
    t_ns: int
    """CLOCK_MONOTONIC of the instant of measurement; strictly increasing, never later than the last byte's arrival."""
    t_err_ns: int
    """One-sigma error of `t_ns`: residual spread plus the known bias bound of the source."""
    sync: Sync
    t_rx_ns: int
    """CLOCK_MONOTONIC when the last byte was read."""
    utc_ns: int
    """`t_ns` on CLOCK_REALTIME (ns since 1970-01-01 UTC), from an offset sampled at arrival."""
    t_dev_ns: int | None = None
    """Device time unwrapped to 64 bits."""
    accel_m_s2: Vector3 | None = None
    gyro_rad_s: Vector3 | None = None
    mag_t: Vector3 | None = None
    quat_wxyz: Quaternion | None = None
    euler_rad: Vector3 | None = None
    temperature_c: float | None = None
    pressure_pa: float | None = None
    incli_rad: Pair | None = None
    status: int | None = None
    pps_age_ms: int | None = None
    edge_seq: int | None = None
    """Number of the rising edge on SOUT, or of the trigger on SIN, that belongs to this sample."""


SAMPLE_FIELDS: tuple[str, ...] = Sample.__struct_fields__


class FieldInfo(msgspec.Struct, frozen=True):
    """Description of one member of a sample."""

    name: str
    type: str
    """JSON type; `number[3]` is an array of three."""
    unit: str
    """Unit of the value, SI; empty where it has none."""
    frame: str
    """Frame or time scale of the value; empty where it has none."""
    meaning: str
    always: bool
    """False where the member is left out when the message had no such value."""


_SENSOR: Final = "sensor frame, right-handed"
_VECTORS: Final = "frame of the device, right-handed"
_MONOTONIC: Final = "CLOCK_MONOTONIC"

SAMPLE_SCHEMA: Final = (
    FieldInfo("device", "string", "", "", "name of the device in the configuration", True),
    FieldInfo("seq", "integer", "", "", "counts every sample of the device since start; a gap is a loss", True),
    FieldInfo("t_ns", "integer", "ns", _MONOTONIC, "instant of measurement, strictly increasing", True),
    FieldInfo("t_err_ns", "integer", "ns", "", "one-sigma error of t_ns", True),
    FieldInfo("sync", "string", "", "", "source of t_ns, worst first: arrival, regression, edge, utc", True),
    FieldInfo("t_rx_ns", "integer", "ns", _MONOTONIC, "when the last byte was read", True),
    FieldInfo("utc_ns", "integer", "ns", "CLOCK_REALTIME", "t_ns as time since 1970-01-01 UTC", True),
    FieldInfo("t_dev_ns", "integer", "ns", "device clock", "device time, unwrapped", False),
    FieldInfo("accel_m_s2", "number[3]", "m/s²", _VECTORS, "specific force; +g on the axis that points up", False),
    FieldInfo("gyro_rad_s", "number[3]", "rad/s", _VECTORS, "angular rate", False),
    FieldInfo("mag_t", "number[3]", "T", _VECTORS, "magnetic flux density", False),
    FieldInfo("quat_wxyz", "number[4]", "", "body to navigation_frame of the device", "attitude, scalar first", False),
    FieldInfo("euler_rad", "number[3]", "rad", "euler_convention of the device", "roll, pitch, yaw", False),
    FieldInfo("temperature_c", "number", "°C", "", "temperature of the sensor", False),
    FieldInfo("pressure_pa", "number", "Pa", "", "air pressure", False),
    FieldInfo("incli_rad", "number[2]", "rad", _SENSOR, "inclinometer X and Y", False),
    FieldInfo(
        "status", "integer", "", "", "status bits as sent; bit 31 is imud's own: the ALARM line was active", False
    ),
    FieldInfo(
        "pps_age_ms", "integer", "ms", "device clock",
        "time from the last edge on the device's PPS/SIN input to the measurement, as sent", False,
    ),
    FieldInfo(
        "edge_seq", "integer", "", "",
        "number of the rising edge on SOUT, or of the trigger on SIN, that belongs to the sample; left out where its "
        "own was not seen", False,
    ),
)  # fmt: skip
"""The `schema` method and `imud schema`; in the order of SAMPLE_FIELDS."""
