"""Sub-packets HI81 and HI83 of HiPNUC firmware 1.6.9 to 1.7: attitude, position and velocity of INS devices.

The manual V1.5.9 does not contain them. Source: the vendor's public SDK, `hi81_t` and `hi83_t`. Little-endian.

    HI81, 104 bytes
    0    1        3     4      6     10  12    18     24   30        32     34      35
    +----+--------+-----+------+-----+---+-----+------+----+---------+------+-------+------------------------+
    | 81 | status | INS | week | tow | 0 | gyro| accel| mag| pressure| speed| temp. | y m d h min u8, u16 ms |
    +----+--------+-----+------+-----+---+-----+------+----+---------+------+-------+------------------------+
    42       44     46       48    56         60        64      68     70             78        84      90
    +--------+------+--------+-----+----------+---------+-------+------+--------------+---------+-------+----+
    | roll   | pitch| heading| quat| longitude| latitude| height| DOPs | qualities …  | velocity| accel | 0  |
    +--------+------+--------+-----+----------+---------+-------+------+--------------+---------+-------+----+

    HI83
    0    1        3     4        8
    +----+--------+-----+--------+----------------------------------------------------------------------+
    | 83 | status | INS | bitmap | fields of the set bits of `bitmap`, in ascending order of the bits …  |
    +----+--------+-----+--------+----------------------------------------------------------------------+

`status` is MAIN_STATUS of HI91. imud publishes the INS status in bits 16 to 23 of `status`: 0 invalid, 1 aligning, 3
navigating, 6 dead reckoning. The roll, pitch and quaternion of both sub-packets have the convention of HI91: the
quaternion of the vendor's example of HI81 gives its roll, its pitch and its negative heading. HI83 contains yaw, not
the heading (assumption: counter-clockwise, as in HI91).

imud does not publish: GPS time, DOP, heading quality, age of corrections, geoid separation, antenna, odometer,
acceleration in ENU, inclination, surge, sway, frequencies of heave, surge and sway, node identifier, position and
velocity of the GNSS receiver alone (bits 30, 31). No output of imud needs these values, and no source defines the axes
of surge and sway.
"""

import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from math import isfinite
from typing import Any, Final

from imud.drivers.hipnuc.common import (
    FILLERS,
    MAG_T_PER_LSB,
    QUAT_PER_LSB,
    byte_temperature_c,
    counts_of,
    field_of,
    pressure_of,
    vector_of,
)
from imud.drivers.value_limits import (
    ACCEL_LIMIT_G,
    GYRO_LIMIT_DEG_S,
    HEAVE_LIMIT_M,
    HEIGHT_LIMIT_M,
    MAG_LIMIT_UT,
    TURN_DEG,
    VELOCITY_LIMIT_M_S,
    are_within,
    possible_angles,
    possible_quaternion,
    possible_temperature_c,
    scaled,
)
from imud.model.sample import Measurement, Position, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US, RAD_PER_DEG, STANDARD_GRAVITY_M_S2, T_PER_UT

TAG_HI81: Final = 0x81
TAG_HI83: Final = 0x83

# tag, main status, INS status, GPS week, time of week ms, reserved, gyro, accel, mag, pressure, odometer, temperature,
# year month day hour minute, second * 1000 + ms, roll, pitch, heading, quaternion, longitude, latitude, height, PDOP,
# HDOP, position quality, satellites, heading quality, heading satellites, age, geoid, antenna, velocity, accel ENU
HI81: Final = struct.Struct("<BHBHI2x3h3h3hhhb5BH2hH4h3i2B4BBhB3h3h14x")
HI83_HEAD: Final = struct.Struct("<BHBI")  # tag, main status, INS status, bitmap

GYRO_RAD_S_PER_LSB: Final = 0.001
ACCEL_M_S2_PER_LSB: Final = 0.0048828  # as HI92
EULER_RAD_PER_LSB: Final = 0.01 * RAD_PER_DEG
POSITION_RAD_PER_LSB: Final = 1e-7 * RAD_PER_DEG
HEIGHT_M_PER_LSB: Final = 0.001
VELOCITY_M_S_PER_LSB: Final = 0.01
PRESSURE_OFFSET_PA: Final = 100_000.0
HALF_TURN, TURN = 18_000, 36_000  # counts of EULER_RAD_PER_LSB
WEEK_MS: Final = 604_800_000
TICK_MODULUS: Final = 1 << 32
RESERVED_STATUS: Final = 0xE000  # reserved bits of MAIN_STATUS: a word with one of them is filler bytes
NOT_UTC: Final = 1 << 11
INS_SHIFT: Final = 16
NO_COUNT: Final = 0xFF  # filler of a quality or a number of satellites
YEAR_ZERO: Final = 2000
MINUTE_MS_MOST: Final = 60_999  # in a leap second
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


# Layout of the fields of HI83 by bit. `x` is a byte that imud does not use.
FIELDS: Final[Mapping[int, struct.Struct]] = {
    bit: struct.Struct("<" + code)
    for bit, code in {
        0: "3f", 1: "3f", 2: "3f", 3: "3f", 4: "4f", 5: "Q", 6: "5BHx", 7: "f", 8: "f", 9: "3f", 10: "3f", 11: "3f",
        12: "3f", 13: "3f", 14: "3d", 15: "4B", 16: "f", 17: "f", 18: "f", 19: "B3x", 30: "3d", 31: "3f",
    }.items()
}  # fmt: skip
KNOWN_BITS: Final = sum(1 << bit for bit in FIELDS)
ACCEL, GYRO, MAG, EULER, QUAT, TIME, UTC_TIME, PRESSURE, TEMPERATURE = range(9)
MOTION, VELOCITY, PLACE, QUALITY = 10, 12, 14, 15


def hi83_size(bitmap: int) -> int:
    """Return the size of an HI83 sub-packet with these known bits, bytes."""
    return HI83_HEAD.size + sum(field.size for bit, field in FIELDS.items() if bitmap >> bit & 1)


def hi83_bytes(data: bytes, at: int, end: int) -> int:
    """Return the size of the HI83 sub-packet at `at`; more than the rest of the payload up to `end` if the bitmap does
    not match the rest, or contains an internal or unknown bit (20 to 29), because then the size is not known."""
    rest = end - at
    if rest < HI83_HEAD.size:
        return rest + 1
    bitmap: int = HI83_HEAD.unpack_from(data, at)[3]
    size = hi83_size(bitmap)
    return size if size == rest and not bitmap & ~KNOWN_BITS else rest + 1


def decode_hi81(data: bytes, at: int, _word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    """Return the measurement of the sub-packet at `at`, and whether all values are possible."""
    v = HI81.unpack_from(data, at)
    main, ins = v[1:3]
    pressure, _, temperature = v[14:17]
    roll, pitch, heading, qw, qx, qy, qz, longitude, latitude, height = v[23:33]
    status = _status(main, ins)
    yaw = -heading if heading <= HALF_TURN else TURN - heading  # counter-clockwise
    angle, q = EULER_RAD_PER_LSB, QUAT_PER_LSB
    euler = None
    if not (roll == pitch and roll in FILLERS):
        euler = possible_angles((roll * angle, pitch * angle, yaw * angle)) if heading <= TURN else None
    place = (longitude * POSITION_RAD_PER_LSB, latitude * POSITION_RAD_PER_LSB, height * HEIGHT_M_PER_LSB)
    position, is_place = position_of(*place, *v[35:37])
    return Measurement(
        size, trailing, None,  # the GPS time is another counter than `system_time` of a frame between two HI81
        _vector(v[8:11], ACCEL_M_S2_PER_LSB), _vector(v[5:8], GYRO_RAD_S_PER_LSB), field_of(*v[11:14]),
        possible_quaternion(qw * q, qx * q, qy * q, qz * q), euler, byte_temperature_c(temperature),
        pressure_of(pressure + PRESSURE_OFFSET_PA) if pressure else None, None, status, None, None,
        _vector(v[42:45], VELOCITY_M_S_PER_LSB), position, None, utc_ns_of(v[17:23], status),
    ), heading <= TURN and is_place  # fmt: skip


def decode_hi83(data: bytes, at: int, _word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    """Return the measurement of the sub-packet at `at` with a size of `hi83_bytes`, and whether all values are
    possible."""
    _, main, ins, bitmap = HI83_HEAD.unpack_from(data, at)
    at += HI83_HEAD.size
    sent: dict[int, Any] = {}
    for bit, field in FIELDS.items():
        if bitmap >> bit & 1:
            sent[bit] = field.unpack_from(data, at)
            at += field.size
    is_possible = True

    def vector(bit: int, factor: float, limit: float) -> Vector3 | None:
        nonlocal is_possible
        if bit not in sent:
            return None
        made = scaled(sent[bit], factor, limit)
        is_possible &= made is not None
        return made

    def number(bit: int, possible: Any) -> float | None:
        nonlocal is_possible
        if bit not in sent:
            return None
        is_possible &= isfinite(sent[bit][0])
        made: float | None = possible(sent[bit][0])
        return made

    status = _status(main, ins)
    quality, satellites, _, _ = sent.get(QUALITY, (NO_COUNT,) * 4)
    longitude, latitude, height_m = sent.get(PLACE, (0.0, 0.0, None))
    place = (longitude * RAD_PER_DEG, latitude * RAD_PER_DEG, height_m)
    position, is_place = position_of(*place, quality, satellites)
    quat = sent.get(QUAT)
    heave = None
    if MOTION in sent:
        heave = sent[MOTION][0] if are_within(sent[MOTION][:1], HEAVE_LIMIT_M) else None
        is_possible &= heave is not None
    ticks = sent[TIME][0] * NS_PER_US // NS_PER_MS % TICK_MODULUS if TIME in sent else None
    return Measurement(
        size, trailing, ticks, vector(ACCEL, 1.0, ACCEL_LIMIT_G * STANDARD_GRAVITY_M_S2),
        vector(GYRO, 1.0, GYRO_LIMIT_DEG_S * RAD_PER_DEG),
        vector(MAG, T_PER_UT, MAG_LIMIT_UT) if any(sent.get(MAG, ())) else None,
        None if quat is None else possible_quaternion(*quat), vector(EULER, RAD_PER_DEG, TURN_DEG),
        number(TEMPERATURE, possible_temperature_c), number(PRESSURE, pressure_of), None, status, None, None,
        vector(VELOCITY, 1.0, VELOCITY_LIMIT_M_S), position, heave, utc_ns_of(sent.get(UTC_TIME), status),
    ), is_possible and is_place and (quat is None or isfinite(sum(quat)))  # fmt: skip


def _vector(counts: Sequence[int], factor: float) -> Vector3 | None:
    x, y, z = counts
    return vector_of(x, y, z, factor)


def _status(main: int, ins: int) -> int | None:
    return None if main & RESERVED_STATUS else main | ins << INS_SHIFT


def position_of(
    longitude_rad: float, latitude_rad: float, height_m: float | None, quality: int | None, satellites: int | None
) -> tuple[Position | None, bool]:
    """Return the position, and whether it is possible. A device without a position sends zeros."""
    if longitude_rad == latitude_rad == 0.0:
        return None, True
    if not (
        abs(longitude_rad) <= HALF_TURN * EULER_RAD_PER_LSB
        and abs(latitude_rad) <= HALF_TURN / 2 * EULER_RAD_PER_LSB
        and (height_m is None or abs(height_m) < HEIGHT_LIMIT_M)
    ):
        return None, False
    return Position(latitude_rad, longitude_rad, height_m, _known(quality), _known(satellites)), True


def _known(count: int | None) -> int | None:
    return None if count == NO_COUNT else count


def utc_ns_of(utc: Sequence[int] | None, status: int | None = 0) -> int | None:
    """Return UTC of year - 2000, month, day, hour, minute and ms of the minute, ns since 1970; None without UTC."""
    if utc is None or status is None or status & NOT_UTC:
        return None
    year, month, day, hour, minute, ms = utc
    if ms > MINUTE_MS_MOST:
        return None
    try:
        begin = datetime(YEAR_ZERO + year, month, day, hour, minute, tzinfo=UTC)
    except ValueError:
        return None
    return (begin - _EPOCH) // timedelta(seconds=1) * NS_PER_S + ms * NS_PER_MS


# --- encoder for simulated devices ------------------------------------------------------------------------------------


def utc_fields(utc_ns: int) -> tuple[int, ...]:
    """Return the fields that `utc_ns_of` reads."""
    minute = _EPOCH + timedelta(minutes=utc_ns // (60 * NS_PER_S))
    ms = utc_ns // NS_PER_MS % 60_000
    return minute.year - YEAR_ZERO, minute.month, minute.day, minute.hour, minute.minute, ms


def _counts(vector: Sequence[float], scale: float) -> list[int]:
    return [counts_of(value / scale, 16) for value in vector]


def pack_hi81(
    values: Measurement, *, main_status: int = 0, ins_status: int = 0, week: int = 0, tow_ms: int = 0
) -> bytes:
    """Return an HI81 sub-packet. Absent values are zeros; values are clipped to the range of their field. Raises
    ValueError for NaN."""
    zero = (0.0, 0.0, 0.0)
    roll, pitch, yaw = values.euler_rad or zero
    place = values.position or Position(0.0, 0.0)
    return HI81.pack(
        TAG_HI81, main_status, ins_status, week, tow_ms,
        *_counts(values.gyro_rad_s or zero, GYRO_RAD_S_PER_LSB),
        *_counts(values.accel_m_s2 or zero, ACCEL_M_S2_PER_LSB),
        *_counts(values.mag_t or zero, MAG_T_PER_LSB),
        0 if values.pressure_pa is None else counts_of(values.pressure_pa - PRESSURE_OFFSET_PA, 16), 0,
        counts_of(values.temperature_c or 0.0, 8),
        *(utc_fields(values.gnss_utc_ns) if values.gnss_utc_ns is not None else (0,) * 6),
        counts_of(roll / EULER_RAD_PER_LSB, 16), counts_of(pitch / EULER_RAD_PER_LSB, 16),
        round(-yaw / EULER_RAD_PER_LSB) % TURN,
        *_counts(values.quat_wxyz or (0.0, 0.0, 0.0, 0.0), QUAT_PER_LSB),
        counts_of(place.longitude_rad / POSITION_RAD_PER_LSB, 32),
        counts_of(place.latitude_rad / POSITION_RAD_PER_LSB, 32),
        counts_of((place.height_m or 0.0) / HEIGHT_M_PER_LSB, 32), 0, 0, place.quality or 0, place.satellites or 0, 0,
        0, 0, 0, 0, *_counts(values.velocity_enu_m_s or zero, VELOCITY_M_S_PER_LSB), 0, 0, 0,
    )  # fmt: skip


def pack_hi83(
    values: Measurement, bitmap: int, *, main_status: int = 0, ins_status: int = 0, system_time_us: int = 0
) -> bytes:
    """Return an HI83 sub-packet with the fields of `bitmap`. Absent values are zeros."""
    zero = (0.0, 0.0, 0.0)
    place = values.position or Position(0.0, 0.0)
    sent: dict[int, Sequence[float]] = {
        ACCEL: values.accel_m_s2 or zero, GYRO: values.gyro_rad_s or zero,
        MAG: [tesla / T_PER_UT for tesla in values.mag_t or zero],
        EULER: [angle / RAD_PER_DEG for angle in values.euler_rad or zero],
        QUAT: values.quat_wxyz or (0.0, 0.0, 0.0, 0.0), TIME: (system_time_us % 2**64,),
        UTC_TIME: utc_fields(values.gnss_utc_ns) if values.gnss_utc_ns is not None else (0,) * 6,
        PRESSURE: (values.pressure_pa or 0.0,), TEMPERATURE: (values.temperature_c or 0.0,),
        MOTION: (values.heave_m or 0.0, 0.0, 0.0), VELOCITY: values.velocity_enu_m_s or zero,
        PLACE: (place.longitude_rad / RAD_PER_DEG, place.latitude_rad / RAD_PER_DEG, place.height_m or 0.0),
        QUALITY: (place.quality or 0, place.satellites or 0, 0, 0),
    }  # fmt: skip
    parts = [HI83_HEAD.pack(TAG_HI83, main_status, ins_status, bitmap)]
    for bit, field in FIELDS.items():
        if bitmap >> bit & 1:
            parts.append(field.pack(*sent[bit]) if bit in sent else bytes(field.size))
    return b"".join(parts)
