"""Sub-packets of HiPNUC frames: HI91 (floats) and HI92 (integers). Manual "IMU配置手冊" V1.5.9, section 3.3.

    HI91, 76 bytes   tag | pps stamp or status u16 | °C i8 | Pa f32 | system time ms u32 | accel 3 | gyro 3 | mag 3 |
                     roll, pitch, yaw | quaternion wxyz, all f32
    HI92, 48 bytes   tag | status u16 | °C i8 | pps stamp u16 | Pa i16 | 2 reserved | gyro 3 | accel 3 | mag 3, i16 |
                     roll, pitch, yaw i32 | quaternion wxyz i16

Little-endian. Values are those of the sensor frame (right-handed), Euler angles as `imud.attitude` defines them.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

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

# HI91
M_S2_PER_G: Final = 9.8  # the firmware divides m/s² by 9.8, so this G is not standard gravity
# HI92, as printed; 160 / 32768 and 1000 / 32768 would be 2.6e-6 and 1.9e-5 more
ACCEL_M_S2_PER_LSB: Final = 0.0048828
GYRO_RAD_S_PER_LSB: Final = 0.001
MAG_T_PER_LSB: Final = 0.030517 * T_PER_UT
EULER_RAD_PER_LSB: Final = 0.001 * RAD_PER_DEG
QUAT_PER_LSB: Final = 0.0001
PRESSURE_OFFSET_PA: Final = 100_000


def _scaled3(values: Sequence[float], factor: float) -> Vector3 | None:
    x, y, z = values
    return (x * factor, y * factor, z * factor) if isfinite(x) and isfinite(y) and isfinite(z) else None


def _decode_hi91(v: Sequence[Any], word_is_status: bool, size: int, trailing: int) -> Measurement:
    """A group of values of which one is NaN or infinite is None."""
    quat: Quaternion = v[17], v[18], v[19], v[20]
    return Measurement(
        size, trailing, v[4],
        accel_m_s2=_scaled3(v[5:8], M_S2_PER_G),
        gyro_rad_s=_scaled3(v[8:11], RAD_PER_DEG),
        mag_t=_scaled3(v[11:14], T_PER_UT),
        quat_wxyz=quat if all(map(isfinite, quat)) else None,
        euler_rad=_scaled3(v[14:17], RAD_PER_DEG),
        temperature_c=v[2],
        pressure_pa=v[3] if isfinite(v[3]) else None,
        status=v[1] if word_is_status else None,
        pps_age_ms=None if word_is_status else v[1],
    )  # fmt: skip


def decode_finite_hi91(data: bytes, at: int, word_is_status: bool, size: int, trailing: int) -> Measurement:
    """The sub-packet at `at`, all of whose values are known to be finite: a third of the cost of the general way."""
    _, word, temperature, pressure, ms, ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz = (
        HI91.unpack_from(data, at)
    )
    g, rad, tesla = M_S2_PER_G, RAD_PER_DEG, T_PER_UT
    return Measurement(
        size, trailing, ms,
        (ax * g, ay * g, az * g), (gx * rad, gy * rad, gz * rad), (mx * tesla, my * tesla, mz * tesla),
        (qw, qx, qy, qz), (roll * rad, pitch * rad, yaw * rad), temperature, pressure, None,
        word if word_is_status else None, None if word_is_status else word,
    )  # fmt: skip


def _decode_hi92(v: Sequence[Any], _word_is_status: bool, size: int, trailing: int) -> Measurement:
    """HI92 has no device time: `dev_ticks` is None."""
    return Measurement(
        size, trailing, None,
        accel_m_s2=_scaled3(v[8:11], ACCEL_M_S2_PER_LSB),
        gyro_rad_s=_scaled3(v[5:8], GYRO_RAD_S_PER_LSB),
        mag_t=_scaled3(v[11:14], MAG_T_PER_LSB),
        quat_wxyz=(v[17] * QUAT_PER_LSB, v[18] * QUAT_PER_LSB, v[19] * QUAT_PER_LSB, v[20] * QUAT_PER_LSB),
        euler_rad=_scaled3(v[14:17], EULER_RAD_PER_LSB),
        temperature_c=v[2],
        pressure_pa=v[4] + PRESSURE_OFFSET_PA,
        status=v[1],
        pps_age_ms=v[3],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Packet:
    """A kind of sub-packet: its layout, tag included, and what makes a measurement of its values."""

    layout: struct.Struct
    decode: Callable[[Sequence[Any], bool, int, int], Measurement]


PACKETS: Final = {TAG_HI91: Packet(HI91, _decode_hi91), TAG_HI92: Packet(HI92, _decode_hi92)}


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
