"""What each member of a `Sample` means: the table behind the `schema` method and `imud schema`."""

from typing import Final

import msgspec


class FieldInfo(msgspec.Struct, frozen=True):
    """One member of a sample."""

    name: str
    type: str
    """JSON type; `number[3]` is an array of three."""
    unit: str
    """Unit of the value, SI; empty where it has none."""
    frame: str
    """Frame or time scale that the value stands in; empty where it has none."""
    meaning: str
    always: bool
    """False where the member is left out when the message had no such value."""


_SENSOR: Final = "sensor frame, right-handed"
_MONOTONIC: Final = "CLOCK_MONOTONIC"

FIELDS: Final = (
    FieldInfo("device", "string", "", "", "name of the device in the configuration", True),
    FieldInfo("seq", "integer", "", "", "counts every sample of the device since start; a gap is a loss", True),
    FieldInfo("t_ns", "integer", "ns", _MONOTONIC, "instant of measurement, strictly increasing", True),
    FieldInfo("t_err_ns", "integer", "ns", "", "one-sigma error of t_ns", True),
    FieldInfo("sync", "string", "", "", "source of t_ns, worst first: arrival, regression, edge, utc", True),
    FieldInfo("t_rx_ns", "integer", "ns", _MONOTONIC, "when the last byte was read", True),
    FieldInfo("utc_ns", "integer", "ns", "CLOCK_REALTIME", "t_ns as time since 1970-01-01 UTC", True),
    FieldInfo("t_dev_ns", "integer", "ns", "device clock", "device time, unwrapped", False),
    FieldInfo("accel_m_s2", "number[3]", "m/s²", _SENSOR, "specific force; +g on the axis that points up", False),
    FieldInfo("gyro_rad_s", "number[3]", "rad/s", _SENSOR, "angular rate", False),
    FieldInfo("mag_t", "number[3]", "T", _SENSOR, "magnetic flux density", False),
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
"""In the order of `imud.sample.SAMPLE_FIELDS`."""
