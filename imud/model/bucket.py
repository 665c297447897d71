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

    first_s: float  # time of the first sample, CLOCK_MONOTONIC, s
    last_s: float  # time of the last sample, CLOCK_MONOTONIC, s
    utc_s: float  # time of the last sample since 1970-01-01 UTC, s
    count: int  # number of samples
    seq: int  # sequence number of the last sample
    sync: str  # source of the time stamp of the last sample
    t_err_s: float  # maximum time stamp error, one sigma, s
    latency_s: float  # maximum time from the measurement to the arrival of the last byte, s
    accel_m_s2: Range | None = None  # minimum and maximum of each axis of the specific force, m/s²
    gyro_rad_s: Range | None = None  # minimum and maximum of each axis of the angular rate, rad/s
    mag_t: Range | None = None  # minimum and maximum of each axis of the magnetic flux density, T
    euler_rad: Range | None = None  # minimum and maximum of roll, pitch and yaw, rad
    quat_wxyz: tuple[float, ...] | None = None  # last attitude in the interval, scalar first
    temperature_c: float | None = None  # last temperature in the interval, °C
    pressure_pa: float | None = None  # last air pressure in the interval, Pa
    lost: int = 0  # number of lost samples by the ledger, without gaps of unknown size
    gaps: int = 0  # number of gaps of unknown size
