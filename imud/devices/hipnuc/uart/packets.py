"""Sub-packets of HiPNUC frames: HI91 (floats) and HI92 (integers). Manual "IMU配置手冊" V1.5.9, section 3.3.

    HI91, 76 bytes   tag | pps stamp or status u16 | °C i8 | Pa f32 | system time ms u32 | accel 3 | gyro 3 | mag 3 |
                     roll, pitch, yaw | quaternion wxyz, all f32
    HI92, 48 bytes   tag | status u16 | °C i8 | pps stamp u16 | Pa i16 | 2 reserved | gyro 3 | accel 3 | mag 3, i16 |
                     roll, pitch, yaw i32 | quaternion wxyz i16

Little-endian. Values are those of the sensor frame (right-handed), Euler angles as `imud.attitude` defines them.
"""

import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import msgspec

from imud.devices.hipnuc.common.air import PRESSURE_MAX_PA, PRESSURE_MIN_PA, pressure_of, temperature_beside
from imud.devices.hipnuc.common.raw_units import EULER_RAD_PER_LSB, M_S2_PER_G, MAG_T_PER_LSB, QUAT_PER_LSB
from imud.sample import Measurement, Quaternion, Vector3
from imud.units import RAD_PER_DEG, T_PER_UT

HI91: Final = struct.Struct("<BHbfI3f3f3f3f4f")
"""tag, pps_sync_stamp or status, temperature °C, pressure Pa, system_time ms, accel G, gyro °/s, mag µT,
roll pitch yaw °, quaternion wxyz (section 3.3.1)."""
HI92: Final = struct.Struct("<BHbHh2x3h3h3h3i4h")
"""tag, status, temperature °C, pps_sync_stamp ms, pressure - 100000 Pa, reserved, gyro, accel, mag, roll pitch yaw,
quaternion wxyz (section 3.3.2). Gyro stands before accel here."""
TAG_HI91: Final = 0x91
TAG_HI92: Final = 0x92

PPS_STAMP_MODULUS_MS: Final = 8192
"""pps_sync_stamp counts 0 … 8191 ms and wraps when no edge comes (in a recording at 100 Hz, 8190 is followed by 8)."""

ACCEL_M_S2_PER_LSB: Final = 0.0048828
"""Of HI92, as printed; 160 / 32768 would be 2.6e-6 more."""
GYRO_RAD_S_PER_LSB: Final = 0.001
"""Of HI92."""
PRESSURE_OFFSET_PA: Final = 100_000


HI91_VALUES: Final = struct.Struct(("@" if sys.byteorder == "little" else "<") + "xBBbfI16f")
"""HI91 behind its tag, the word in two bytes: in the machine's own layout `struct` reads a float in half the time."""
HI91_HIGH_BYTES: Final = slice(7, None, 4)
"""High bytes of all floats, and of system_time, in HI91 sub-packets back to back, because 76 is a multiple of 4. An
exponent of all ones (NaN, infinity) needs 0x7F or 0xFF there; finite values above 1.7e38 and 9 of every 1193 hours of
system time have them too."""


def decode_hi91(values: Sequence[Any], word_is_status: bool, size: int, trailing: int) -> Measurement:
    """The measurement of HI91_VALUES, where NaN and infinity stay; `size` and `trailing` are those of the frame."""
    low, high, temperature, pressure, ms, ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz = values
    # local names: a global costs twice as much, and there are thirty of them per frame
    g, rad, tesla = M_S2_PER_G, RAD_PER_DEG, T_PER_UT
    if not PRESSURE_MIN_PA <= pressure <= PRESSURE_MAX_PA:  # `pressure_of`; a call each costs a tenth of a frame
        temperature, pressure = temperature_beside(temperature, pressure), None
    word = low + 256 * high
    return Measurement(
        size, trailing, ms,
        (ax * g, ay * g, az * g), (gx * rad, gy * rad, gz * rad), (mx * tesla, my * tesla, mz * tesla),
        (qw, qx, qy, qz), (roll * rad, pitch * rad, yaw * rad), temperature, pressure, None,
        word if word_is_status else None, None if word_is_status else word,
    )  # fmt: skip


def decode_hi91_run(hi91s: bytes, word_is_status: bool, size: int, trailing: int) -> list[Measurement]:
    """`decode_hi91` of sub-packets back to back, one of each frame, written out: the call is a twentieth of the cost.

    `trailing` bytes follow the first frame.
    """
    g, rad, tesla = M_S2_PER_G, RAD_PER_DEG, T_PER_UT
    low_pa, high_pa = PRESSURE_MIN_PA, PRESSURE_MAX_PA
    made: list[Measurement] = []
    make, keep = Measurement, made.append
    for (
        low, high, temperature, pressure, ms, ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz,
    ) in HI91_VALUES.iter_unpack(hi91s):  # fmt: skip
        if not low_pa <= pressure <= high_pa:
            temperature, pressure = temperature_beside(temperature, pressure), None  # noqa: PLW2901
        word = low + 256 * high
        keep(
            make(
                size, trailing, ms,
                (ax * g, ay * g, az * g), (gx * rad, gy * rad, gz * rad), (mx * tesla, my * tesla, mz * tesla),
                (qw, qx, qy, qz), (roll * rad, pitch * rad, yaw * rad), temperature, pressure, None,
                word if word_is_status else None, None if word_is_status else word,
            )
        )  # fmt: skip
        trailing -= size
    return made


def _decode_hi91(data: bytes, at: int, word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    values = HI91_VALUES.unpack_from(data, at)
    measurement = decode_hi91(values, word_is_status, size, trailing)
    if all(map(isfinite, values)):
        return measurement, True
    return _finite_groups(measurement), False


_GROUPS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad")


def _finite_groups(m: Measurement) -> Measurement:
    """Decode without the groups of values of which one is NaN or infinite."""
    absent = [name for name in _GROUPS if not all(map(isfinite, getattr(m, name)))]
    return msgspec.structs.replace(m, **dict.fromkeys(absent))


def _decode_hi92(data: bytes, at: int, _word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    """Decode HI92, which has no device time: `dev_ticks` is None."""
    (
        _, status, temperature, pps_ms, pressure, gx, gy, gz, ax, ay, az, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz,
    ) = HI92.unpack_from(data, at)  # fmt: skip
    a, w, b, angle, q = ACCEL_M_S2_PER_LSB, GYRO_RAD_S_PER_LSB, MAG_T_PER_LSB, EULER_RAD_PER_LSB, QUAT_PER_LSB
    return Measurement(
        size, trailing, None,
        (ax * a, ay * a, az * a), (gx * w, gy * w, gz * w), (mx * b, my * b, mz * b),
        (qw * q, qx * q, qy * q, qz * q), (roll * angle, pitch * angle, yaw * angle),
        temperature, pressure_of(pressure + PRESSURE_OFFSET_PA), None, status, pps_ms,
    ), True  # fmt: skip


@dataclass(frozen=True, slots=True)
class Packet:
    """A kind of sub-packet."""

    size: int
    """In bytes, tag included."""
    decode: Callable[[bytes, int, bool, int, int], tuple[Measurement, bool]]
    """`decode(data, at, word_is_status, size, trailing)` returns the measurement, and whether all is finite."""


PACKETS: Final = {TAG_HI91: Packet(HI91.size, _decode_hi91), TAG_HI92: Packet(HI92.size, _decode_hi92)}


def pack_hi91(
    *,
    system_time_ms: int,
    accel_m_s2: Vector3,
    gyro_rad_s: Vector3,
    mag_t: Vector3,
    euler_rad: Vector3,
    quat_wxyz: Quaternion,
    temperature_c: float,
    pressure_pa: float,
    word_1_2: int = 0,
) -> bytes:
    """An HI91 sub-packet. Values are clipped to the format's range, time wraps at 2³² ms; NaN is sent as it is."""
    values = (
        *(a / M_S2_PER_G for a in accel_m_s2),
        *(w / RAD_PER_DEG for w in gyro_rad_s),
        *(b / T_PER_UT for b in mag_t),
        *(angle / RAD_PER_DEG for angle in euler_rad),
        *quat_wxyz,
    )
    return HI91.pack(
        TAG_HI91,
        _clip(word_1_2, 0, 0xFFFF),
        _clip(temperature_c, -128, 127),
        _clip_float(pressure_pa),
        system_time_ms % 2**32,
        *map(_clip_float, values),
    )


def pack_hi92(
    *,
    pps_stamp_ms: int,
    accel_m_s2: Vector3,
    gyro_rad_s: Vector3,
    mag_t: Vector3,
    euler_rad: Vector3,
    quat_wxyz: Quaternion,
    temperature_c: float,
    pressure_pa: float,
    status: int = 0,
) -> bytes:
    """An HI92 sub-packet. Values are clipped to the format's range. Raises ValueError, OverflowError if not finite."""
    return HI92.pack(
        TAG_HI92,
        _clip(status, 0, 0xFFFF),
        _clip(temperature_c, -128, 127),
        _clip(pps_stamp_ms, 0, 0xFFFF),
        _clip16(pressure_pa - PRESSURE_OFFSET_PA),
        *(_clip16(w / GYRO_RAD_S_PER_LSB) for w in gyro_rad_s),
        *(_clip16(a / ACCEL_M_S2_PER_LSB) for a in accel_m_s2),
        *(_clip16(b / MAG_T_PER_LSB) for b in mag_t),
        *(_clip(angle / EULER_RAD_PER_LSB, -(2**31), 2**31 - 1) for angle in euler_rad),
        *(_clip16(q / QUAT_PER_LSB) for q in quat_wxyz),
    )


_FLOAT32_MAX: Final = (2 - 2**-23) * 2.0**127


def _clip(value: float, low: int, high: int) -> int:
    return max(low, min(high, round(value)))


def _clip16(value: float) -> int:
    return _clip(value, -0x8000, 0x7FFF)


def _clip_float(value: float) -> float:
    return max(-_FLOAT32_MAX, min(_FLOAT32_MAX, value)) if isfinite(value) else value
