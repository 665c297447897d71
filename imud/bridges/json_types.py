"""JSON messages of samples: their members in order. msgspec writes these faster than dictionaries.

What is None by default is left out. What the members mean is in the schemas of `json_channels`.
"""

import msgspec

from imud.sample import Pair, Sync, Vector3
from imud.units import NS_PER_S

Matrix = tuple[float, ...]
"""Of three by three, row by row."""


class Timestamp(msgspec.Struct, frozen=True, gc=False):
    """A time since 1970-01-01 UTC as Foxglove has it."""

    sec: int
    nsec: int


class VectorMember(msgspec.Struct, frozen=True, gc=False):
    """Three axes."""

    x: float
    y: float
    z: float


class RotationMember(msgspec.Struct, frozen=True, gc=False):
    """A quaternion, scalar last."""

    x: float
    y: float
    z: float
    w: float


class ImuMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """A message of imud.Imu."""

    timestamp: Timestamp
    frame_id: str
    orientation: RotationMember | None = None
    angular_velocity: VectorMember | None = None
    linear_acceleration: VectorMember | None = None
    orientation_covariance: Matrix | None = None
    angular_velocity_covariance: Matrix | None = None
    linear_acceleration_covariance: Matrix | None = None


class MagneticMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """A message of imud.MagneticField."""

    timestamp: Timestamp
    frame_id: str
    magnetic_field: VectorMember
    magnetic_field_covariance: Matrix | None = None


class TransformMessage(msgspec.Struct, frozen=True, gc=False):
    """A message of foxglove.FrameTransform."""

    timestamp: Timestamp
    parent_frame_id: str
    child_frame_id: str
    translation: VectorMember
    rotation: RotationMember


class StampMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """A message of imud.SampleStamp: the time, and fields of the sample by their names."""

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


STAMP_FIELDS = StampMessage.__struct_fields__[1:]
"""Fields of a sample that its stamp has."""


def timestamp(utc_ns: int) -> Timestamp:
    """Return the stamp of a time."""
    return Timestamp(*divmod(utc_ns, NS_PER_S))
