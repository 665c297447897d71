"""The PGNs of HiPNUC modules on J1939. Manual "IMU配置手冊" V1.5.9, section 6.1; FF3A, FF43, FF46, FF2F are newer.

    FF34  accel x y z i16   2 reserved        FF4A  inclinometer X i32, Y i32
    FF37  gyro x y z i16    2 reserved        FF3A  magnetic field x y z i16, 2 reserved
    FF3D  roll i32          pitch i32         FF43  temperature i16, 2 reserved, pressure i32
    FF41  heading u32       4 reserved *      FF46  quaternion w x y z i16
                                              FF2F  UTC: year month day hour minute second u8, millisecond u16

Little-endian, eight bytes each. 1 G is the firmware's 9.8 m/s², as on the other ports.

(*) Heading is 0 … 360°, clockwise. Newer firmware sends the same angle as -180 … 180°, counter-clockwise, in the bytes
that the manual reserves. Nothing says which firmware it is, and nothing has to: bytes 0 … 3 mean the same in both, they
alone are read, and their sign is turned so that yaw is counter-clockwise as on the UART.

"Not available". J1939 sets the upper end of each unsigned range aside (FF… not available, FE… error). The values here
are signed and use their whole range: FFFF is an honest -1 count. So a value is absent where it is out of its physical
range (which covers both patterns in a heading and in pressure), where a quaternion has not unit length, where accel or
field have all eight bytes FF (neither gravity nor the earth's field is that small), and where field, or temperature
with pressure, read zero, as in products without the sensor (a guess). Which pressures are one: `common/air.py`.

Angles stay together in a sample as they are known: where one is absent it is NaN, where all are the vector is None.
"""

import struct
from collections.abc import Callable, Sequence
from math import hypot, isfinite, nan
from typing import Final, Literal

from imud.attitude import quat_from_euler312
from imud.devices.hipnuc.common.air import pressure_of
from imud.devices.hipnuc.common.raw_units import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    PRESSURE_PA_PER_LSB,
    QUAT_PER_LSB,
    TEMPERATURE_C_PER_LSB,
    counts_of,
)
from imud.sample import Measurement, Quaternion, Vector3

MeasuredName = Literal["FF34", "FF37", "FF3A", "FF3D", "FF41", "FF43", "FF46", "FF4A"]
"""A message that samples are made of, by the last four digits of its number."""
PgnName = MeasuredName | Literal["FF2F"]
"""Any message."""
ACCEL, GYRO, ROLL_PITCH, HEADING, INCLINOMETER = 0xFF34, 0xFF37, 0xFF3D, 0xFF41, 0xFF4A
MAG, TEMPERATURE, QUATERNION, UTC = 0xFF3A, 0xFF43, 0xFF46, 0xFF2F
PGNS: Final = (UTC, ACCEL, GYRO, MAG, ROLL_PITCH, HEADING, TEMPERATURE, QUATERNION, INCLINOMETER)
"""All PGNs, in rising order."""
MEASURED: Final = PGNS[1:]
"""Messages that become samples."""
PRIORITY: Final = 3
MESSAGE_BYTES: Final = 8

VECTOR: Final = struct.Struct("<3hH")
TWO_ANGLES: Final = struct.Struct("<2i")
HEADING_LAYOUT: Final = struct.Struct("<Ii")
QUATERNION_LAYOUT: Final = struct.Struct("<4h")
TEMPERATURE_LAYOUT: Final = struct.Struct("<hHi")
UTC_LAYOUT: Final = struct.Struct("<6BH")

TURN: Final = 360_000
"""Counts of a full turn."""
HALF_TURN: Final = TURN // 2
TEMPERATURE_MOST_C: Final = 150.0
"""Highest valid temperature: no module works beyond."""
UNIT_TOLERANCE: Final = 0.02
YEAR_ZERO: Final = 2000
"""Of the year in FF2F (assumed)."""

_NOTHING: Final = bytes([0xFF]) * MESSAGE_BYTES
_ZERO_VECTOR: Final = bytes(6)


def measurement_of(messages: Sequence[tuple[int, bytes]]) -> Measurement:
    """Make one sample of messages of eight bytes (PGN, data) of one instant, each PGN at most once."""
    parts = _Parts()
    for pgn, data in messages:
        _DECODE[pgn](parts, data)
    euler, quat = parts.euler, parts.quat
    if quat is None and euler is not None and isfinite(sum(euler)):
        quat = quat_from_euler312(euler)
    return Measurement(
        MESSAGE_BYTES * len(messages), 0, None,
        parts.accel, parts.gyro, parts.mag, quat, euler, parts.temperature_c, parts.pressure_pa, parts.incli,
    )  # fmt: skip


class _Parts:
    """Values of the messages of one sample."""

    __slots__ = ("accel", "gyro", "incli", "mag", "pitch", "pressure_pa", "quat", "roll", "temperature_c", "yaw")

    def __init__(self) -> None:
        self.accel: Vector3 | None = None
        self.gyro: Vector3 | None = None
        self.mag: Vector3 | None = None
        self.quat: Quaternion | None = None
        self.roll = self.pitch = self.yaw = nan
        self.incli: tuple[float, float] | None = None
        self.temperature_c: float | None = None
        self.pressure_pa: float | None = None

    @property
    def euler(self) -> Vector3 | None:
        """The known ones of roll, pitch and yaw."""
        roll, pitch, yaw = self.roll, self.pitch, self.yaw
        return (roll, pitch, yaw) if roll == roll or pitch == pitch or yaw == yaw else None  # noqa: PLR0124 - no NaN

    def decode_accel(self, data: bytes) -> None:
        if data != _NOTHING:
            self.accel = _vector(data, ACCEL_M_S2_PER_LSB)

    def decode_gyro(self, data: bytes) -> None:
        self.gyro = _vector(data, GYRO_RAD_S_PER_LSB)

    def decode_mag(self, data: bytes) -> None:
        if data != _NOTHING and data[:6] != _ZERO_VECTOR:
            self.mag = _vector(data, MAG_T_PER_LSB)

    def decode_roll_pitch(self, data: bytes) -> None:
        roll, pitch = TWO_ANGLES.unpack(data)
        self.roll, self.pitch = _angle(roll), _angle(pitch)

    def decode_heading(self, data: bytes) -> None:
        clockwise, _ = HEADING_LAYOUT.unpack(data)
        if clockwise <= TURN:
            self.yaw = (-clockwise if clockwise <= HALF_TURN else TURN - clockwise) * EULER_RAD_PER_LSB

    def decode_inclinometer(self, data: bytes) -> None:
        x, y = (_angle(counts) for counts in TWO_ANGLES.unpack(data))
        if isfinite(x) or isfinite(y):
            self.incli = x, y

    def decode_temperature(self, data: bytes) -> None:
        celsius, _, pressure = TEMPERATURE_LAYOUT.unpack(data)
        celsius, pressure = celsius * TEMPERATURE_C_PER_LSB, pressure * PRESSURE_PA_PER_LSB
        if abs(celsius) <= TEMPERATURE_MOST_C and (celsius or pressure) and data != _NOTHING:
            self.temperature_c = celsius
        self.pressure_pa = pressure_of(pressure)

    def decode_quaternion(self, data: bytes) -> None:
        w, x, y, z = QUATERNION_LAYOUT.unpack(data)
        k = QUAT_PER_LSB
        if abs(hypot(w, x, y, z) * k - 1) <= UNIT_TOLERANCE:
            self.quat = w * k, x * k, y * k, z * k


_DECODE: Final[dict[int, Callable[[_Parts, bytes], None]]] = {
    ACCEL: _Parts.decode_accel,
    GYRO: _Parts.decode_gyro,
    MAG: _Parts.decode_mag,
    ROLL_PITCH: _Parts.decode_roll_pitch,
    HEADING: _Parts.decode_heading,
    TEMPERATURE: _Parts.decode_temperature,
    QUATERNION: _Parts.decode_quaternion,
    INCLINOMETER: _Parts.decode_inclinometer,
}


def _vector(data: bytes, factor: float) -> Vector3:
    x, y, z, _ = VECTOR.unpack(data)
    return x * factor, y * factor, z * factor


def _angle(counts: int) -> float:
    """Decode an angle to rad; NaN beyond a full turn."""
    return counts * EULER_RAD_PER_LSB if -TURN <= counts <= TURN else nan


# --- the device's side ------------------------------------------------------------------------------------------------


def pack_accel(accel_m_s2: Vector3) -> bytes:
    """Pack FF34. Values beyond the range are clipped, here and in all of these."""
    return _pack_vector(accel_m_s2, ACCEL_M_S2_PER_LSB)


def pack_gyro(gyro_rad_s: Vector3) -> bytes:
    """Pack FF37."""
    return _pack_vector(gyro_rad_s, GYRO_RAD_S_PER_LSB)


def pack_mag(mag_t: Vector3) -> bytes:
    """Pack FF3A."""
    return _pack_vector(mag_t, MAG_T_PER_LSB)


def pack_roll_pitch(roll_rad: float, pitch_rad: float) -> bytes:
    """Pack FF3D."""
    return TWO_ANGLES.pack(counts_of(roll_rad / EULER_RAD_PER_LSB, 32), counts_of(pitch_rad / EULER_RAD_PER_LSB, 32))


def pack_heading(yaw_rad: float, *, twice: bool = True) -> bytes:
    """Pack FF41 of a counter-clockwise yaw; `twice` as newer firmware does, else with zeros in the reserved bytes."""
    counter_clockwise = round(yaw_rad / EULER_RAD_PER_LSB)
    signed = (counter_clockwise + HALF_TURN) % TURN - HALF_TURN
    return HEADING_LAYOUT.pack(-counter_clockwise % TURN, signed if twice else 0)


def pack_inclinometer(x_rad: float, y_rad: float) -> bytes:
    """Pack FF4A."""
    return pack_roll_pitch(x_rad, y_rad)


def pack_temperature(temperature_c: float, pressure_pa: float) -> bytes:
    """Pack FF43."""
    celsius, pressure = temperature_c / TEMPERATURE_C_PER_LSB, pressure_pa / PRESSURE_PA_PER_LSB
    return TEMPERATURE_LAYOUT.pack(counts_of(celsius, 16), 0, counts_of(pressure, 32))


def pack_quaternion(quat_wxyz: Quaternion) -> bytes:
    """Pack FF46."""
    return QUATERNION_LAYOUT.pack(*(counts_of(q / QUAT_PER_LSB, 16) for q in quat_wxyz))


def pack_utc(year: int, month: int, day: int, second_of_day: float) -> bytes:
    """Pack FF2F."""
    whole, millisecond = divmod(int(second_of_day * 1000), 1000)
    minutes, second = divmod(whole, 60)
    return UTC_LAYOUT.pack(year - YEAR_ZERO, month, day, *divmod(minutes, 60), second, millisecond)


def _pack_vector(vector: Vector3, factor: float) -> bytes:
    return VECTOR.pack(*(counts_of(value / factor, 16) for value in vector), 0)
