"""The two records of the sample path: the decoded measurement of a device, and the sample with its time stamp.

A codec returns a `Measurement`: device time and physical values, without host time. Only `imud.sampling` makes a
`Sample`, so a path without a clock does not pass the type check. All values are SI values in right-handed sensor axes.
A field is None if the frame does not contain the value, because a missing value is not zero.
"""

from enum import StrEnum
from typing import Final

import msgspec

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pair = tuple[float, float]


class Position(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Position on the WGS 84 ellipsoid."""

    latitude_rad: float  # latitude, positive to the north
    longitude_rad: float  # longitude, positive to the east
    height_m: float | None = None  # height above mean sea level; None if the device does not send it
    quality: int | None = None  # quality of the position solution as sent, 0 … 254 (0: invalid)
    satellites: int | None = None  # number of satellites in the solution, 0 … 254


def values_of(position: Position) -> tuple[float, float, float | None, int | None, int | None]:
    """Return the fields of a position in their order, for tables with one column per value."""
    return position.latitude_rad, position.longitude_rad, position.height_m, position.quality, position.satellites


# Regular expression of device names. They are file names of shared memory, label values and words on a command line.
DEVICE_NAME_PATTERN: Final = r"[a-z0-9][a-z0-9_-]{0,31}"
T_ERR_MOST: Final = 0xFFFF_FFFF  # maximum of `t_err_ns`, which has 32 bits in all outputs


class Sync(StrEnum):
    """Source of a time stamp, worst first."""

    ARRIVAL = "arrival"  # Arrival time minus the time on the wire. The device sends no usable time.
    REGRESSION = "regression"  # device time, fitted to arrival times
    EDGE = "edge"  # device time, fitted to SOUT or PPS edges with time stamps of the kernel
    UTC = "utc"  # device time that the device synchronizes to UTC


class Measurement(msgspec.Struct, frozen=True, gc=False):
    """Values of one frame in SI units, without the host time of the measurement."""

    size_bytes: int  # size of the frame on the wire, bytes, with all framing
    # Number of bytes after the frame in the same read. The frame arrived earlier than the read by their wire time.
    trailing_bytes: int
    # Device counter as sent, in ticks of the driver, not unwrapped; None if the frame has no counter
    dev_ticks: int | None
    accel_m_s2: Vector3 | None = None
    gyro_rad_s: Vector3 | None = None
    mag_t: Vector3 | None = None
    quat_wxyz: Quaternion | None = None  # rotation from body to navigation frame, scalar first
    # Roll, pitch, yaw in the convention of the device (`euler_convention` of the driver)
    euler_rad: Vector3 | None = None
    temperature_c: float | None = None
    pressure_pa: float | None = None
    incli_rad: Pair | None = None  # inclinometer X and Y
    status: int | None = None  # status bits as sent
    # Time from the last edge on the PPS/SIN input of the device to this measurement, ms, not unwrapped
    pps_age_ms: int | None = None
    # Arrival of the first CAN frame of the measurement, CLOCK_MONOTONIC, ns; None on other links
    t_first_ns: int | None = None
    velocity_enu_m_s: Vector3 | None = None  # velocity to the east, to the north and up
    position: Position | None = None
    heave_m: float | None = None  # vertical displacement from the mean height, positive up
    gnss_utc_ns: int | None = None  # UTC of the measurement from the GNSS receiver of the device, ns since 1970


class Sample(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Measurement with its time stamp. Field names are the names in JSON, which omits absent fields."""

    device: str  # name of the device in the configuration
    # Sequence number of the device, starting at 1. A gap in the numbers of a reader is the number of samples it lost.
    seq: int
    t_ns: int  # CLOCK_MONOTONIC at the instant of the measurement; strictly increasing, never later than the last byte
    t_err_ns: int  # one-sigma error of `t_ns`: residual spread plus the maximum bias of the source
    sync: Sync
    t_rx_ns: int  # CLOCK_MONOTONIC at the read of the last byte
    utc_ns: int  # `t_ns` on CLOCK_REALTIME (ns since 1970-01-01 UTC), with the clock offset at the arrival
    t_dev_ns: int | None = None  # device time, unwrapped to 64 bits
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
    edge_seq: int | None = None  # number of the rising edge on SOUT, or of the trigger on SIN, for this sample
    velocity_enu_m_s: Vector3 | None = None
    position: Position | None = None
    heave_m: float | None = None
    gnss_utc_ns: int | None = None


SAMPLE_FIELDS: tuple[str, ...] = Sample.__struct_fields__


class FieldInfo(msgspec.Struct, frozen=True):
    """Description of one member of a sample."""

    name: str
    type: str  # JSON type; `number[3]` is an array of three numbers, `object` has the members that `meaning` names
    unit: str  # SI unit of the value; empty if it has no unit
    frame: str  # axes or time scale of the value; empty without axes or time scale
    meaning: str
    always: bool  # whether every sample contains the member


_SENSOR: Final = "sensor frame, right-handed"
_VECTORS: Final = "frame of the device, right-handed"
_MONOTONIC: Final = "CLOCK_MONOTONIC"

# Rows of the method `schema` and of `imud schema`, in the order of SAMPLE_FIELDS
SAMPLE_SCHEMA: Final = (
    FieldInfo("device", "string", "", "", "name of the device in the configuration", True),
    FieldInfo("seq", "integer", "", "", "sequence number of the device since start; a gap is a loss", True),
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
        "status", "integer", "", "",
        "status bits as sent; bits of imud: bit 31: the ALARM line was active; bit 30: the attitude filter of the host "
        "has not settled", False,
    ),
    FieldInfo(
        "pps_age_ms", "integer", "ms", "device clock",
        "time from the last edge on the device's PPS/SIN input to the measurement, as sent", False,
    ),
    FieldInfo(
        "edge_seq", "integer", "", "",
        "number of the rising edge on SOUT, or of the trigger on SIN, for the sample; absent if imud did not "
        "receive the edge", False,
    ),
    FieldInfo("velocity_enu_m_s", "number[3]", "m/s", "east, north, up", "velocity over ground", False),
    FieldInfo(
        "position", "object", "", "WGS 84",
        "latitude_rad, longitude_rad; if the device sends them: height_m (above mean sea level), quality (as sent; "
        "0 is invalid), satellites", False,
    ),
    FieldInfo("heave_m", "number", "m", "up", "vertical displacement from the mean height, positive up", False),
    FieldInfo(
        "gnss_utc_ns", "integer", "ns", "UTC",
        "time of the measurement by the device's GNSS receiver, since 1970", False,
    ),
)  # fmt: skip
