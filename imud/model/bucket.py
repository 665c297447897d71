"""Minimum and maximum of the samples of one device in one interval, for plots.

Times are floating-point numbers in s, because JavaScript has no 64-bit integers. After a year of uptime, a double has a
resolution of 4 ns.
"""

from typing import Final

import msgspec

VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad")
"""Members of a sample with minimum and maximum in a bucket."""

Range = tuple[tuple[float, ...], tuple[float, ...]]
"""Minimum and maximum of each axis."""


class Bucket(msgspec.Struct, frozen=True, omit_defaults=True):
    """The samples of one device in one interval. A member is absent if no sample contains it."""

    first_s: float  # time of the first sample, CLOCK_MONOTONIC
    last_s: float  # time of the last sample, CLOCK_MONOTONIC
    utc_s: float  # time of the last sample since 1970-01-01 UTC
    count: int
    seq: int  # sequence number of the last sample
    sync: str  # source of the time stamp of the last sample
    t_err_s: float  # maximum time stamp error, one sigma
    latency_s: float  # maximum time from the measurement to the arrival of the last byte
    accel_m_s2: Range | None = None
    gyro_rad_s: Range | None = None
    mag_t: Range | None = None
    euler_rad: Range | None = None
    # the last value in the interval
    quat_wxyz: tuple[float, ...] | None = None
    temperature_c: float | None = None
    pressure_pa: float | None = None
    lost: int = 0  # number of lost samples by the ledger, without gaps of unknown size
    gaps: int = 0  # number of gaps of unknown size
