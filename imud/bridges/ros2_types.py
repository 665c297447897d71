"""Table: definitions of the ROS 2 messages that imud makes, as MCAP and rosbag2 store them (`ros2msg`).

Types of sensor_msgs, tf2_msgs, diagnostic_msgs and rcl_interfaces are those of ROS 2, field by field. Two types are
imud's own: what ROS has no message for. A file has the definition with it, so that readers need not know them.
"""

from typing import Final

from imud.bridges.channel import MessageSchema
from imud.sample import Sync

SEPARATOR: Final = "=" * 80

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
    "sensor_msgs/Temperature": "std_msgs/Header header\nfloat64 temperature\nfloat64 variance",
    "sensor_msgs/FluidPressure": "std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance",
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
            "float64[3] euler_rad",
            "float64[2] incli_rad",
            "uint32 t_err_ns",
            "uint8 sync",
        ]
    ),
    "imud_msgs/Losses": (
        "std_msgs/Header header\nuint64 samples\nuint64 lost_gap_device\nuint64 lost_crc\nuint64 lost_overrun\n"
        "uint64 lost_queue\nuint64 lost_unknown"
    ),
}
"""Fields of each type, as in its file with the ending `.msg`."""
NONE: Final = -1
"""Stands in an integer of imud_msgs/SampleStamp for a value that the sample does not have; in numbers it is NaN."""


def schema(name: str) -> MessageSchema:
    """Return the definition of a type with those of all types that it is made of, each once."""
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
