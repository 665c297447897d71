"""HiPNUC CH0x0/CH10x/HI14 on SAE J1939. Manual "IMU配置手冊" V1.5.9, chapter 6.

    0CFF3408   priority 3 | PGN FF34 | source 08, the address of the device     eight bytes of values
    0CEF5508   reply to imud, see `commands.py`

Several devices share a bus and have different addresses. A receiver ignores the priority. A device sends each enabled
PGN at its own interval, without counter and time; `assembly.py` makes samples of them.

imud ignores FF2F (UTC), because it is not a device time: it jumps when the receiver of the device finds the time, it
has its own interval, and no document states its instant.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import quat_from_euler312
from imud.contracts.codec import CodecEvent, count_unknown, wrong_length
from imud.contracts.script import ReplyFrame
from imud.drivers.hipnuc.assembly import Assembly
from imud.drivers.hipnuc.common import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    QUAT_PER_LSB,
    TEMPERATURE_C_PER_LSB,
    counts_of,
    field_of,
    vector_of,
)
from imud.drivers.value_limits import possible_quaternion, possible_temperature_c
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, join, split
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Quaternion, Vector3

# Message that makes samples, by the last four digits of its PGN
MeasuredName = Literal["FF34", "FF37", "FF3A", "FF3D", "FF41", "FF43", "FF46", "FF4A"]
PgnName = MeasuredName | Literal["FF2F"]  # any message
ACCEL, GYRO, ROLL_PITCH, HEADING, INCLINOMETER = 0xFF34, 0xFF37, 0xFF3D, 0xFF41, 0xFF4A
MAG, TEMPERATURE, QUATERNION, UTC = 0xFF3A, 0xFF43, 0xFF46, 0xFF2F
# All PGNs, in rising order
PGNS: Final = (UTC, ACCEL, GYRO, MAG, ROLL_PITCH, HEADING, TEMPERATURE, QUATERNION, INCLINOMETER)
MEASURED: Final = PGNS[1:]  # PGNs that make samples
PRIORITY: Final = 3
MESSAGE_BYTES: Final = 8

VECTOR: Final = struct.Struct("<3hH")
TWO_ANGLES: Final = struct.Struct("<2i")
HEADING_LAYOUT: Final = struct.Struct("<Ii")
QUATERNION_LAYOUT: Final = struct.Struct("<4h")
TEMPERATURE_LAYOUT: Final = struct.Struct("<hHi")  # temperature, reserved, reserved
UTC_LAYOUT: Final = struct.Struct("<6BH")

TURN: Final = 360_000  # counts of a full turn
HALF_TURN: Final = TURN // 2
PLACEHOLDER: Final = 999  # reserved bytes 4-7 of FF43 as devices without barometer send them
# year 0 in FF2F (assumed)
YEAR_ZERO: Final = 2000

_NOTHING: Final = bytes([0xFF]) * MESSAGE_BYTES


def measurement_of(messages: Sequence[tuple[int, bytes]], t_first_ns: int | None = None) -> Measurement:
    """Return the measurement of messages of one instant (PGN, eight bytes), each PGN at most once."""
    parts = _Parts()
    for pgn, data in messages:
        _DECODE[pgn](parts, data)
    euler, quat = parts.euler, parts.quat
    if quat is None and euler is not None and isfinite(sum(euler)):
        quat = quat_from_euler312(euler)
    return Measurement(
        MESSAGE_BYTES * len(messages), 0, None,
        parts.accel, parts.gyro, parts.mag, quat, euler, parts.temperature_c, None, parts.incli,
        t_first_ns=t_first_ns,
    )  # fmt: skip


class _Parts:
    """Values of the messages of one sample."""

    __slots__ = ("accel", "gyro", "incli", "mag", "pitch", "quat", "roll", "temperature_c", "yaw")

    def __init__(self) -> None:
        self.accel: Vector3 | None = None
        self.gyro: Vector3 | None = None
        self.mag: Vector3 | None = None
        self.quat: Quaternion | None = None
        self.roll = self.pitch = self.yaw = nan
        self.incli: tuple[float, float] | None = None
        self.temperature_c: float | None = None

    @property
    def euler(self) -> Vector3 | None:
        """Roll, pitch and yaw; NaN for an unknown angle, None without any angle."""
        roll, pitch, yaw = self.roll, self.pitch, self.yaw
        return (roll, pitch, yaw) if roll == roll or pitch == pitch or yaw == yaw else None  # noqa: PLR0124 - no NaN

    def decode_accel(self, data: bytes) -> None:
        if data != _NOTHING:
            self.accel = _vector(data, ACCEL_M_S2_PER_LSB)

    def decode_gyro(self, data: bytes) -> None:
        if data != _NOTHING:
            self.gyro = _vector(data, GYRO_RAD_S_PER_LSB)

    def decode_mag(self, data: bytes) -> None:
        x, y, z, _ = VECTOR.unpack(data)
        self.mag = field_of(x, y, z)

    def decode_roll_pitch(self, data: bytes) -> None:
        if data == _NOTHING:
            return
        roll, pitch = TWO_ANGLES.unpack(data)
        self.roll, self.pitch = _angle(roll), _angle(pitch)

    def decode_heading(self, data: bytes) -> None:
        clockwise, _ = HEADING_LAYOUT.unpack(data)
        if clockwise <= TURN:
            self.yaw = (-clockwise if clockwise <= HALF_TURN else TURN - clockwise) * EULER_RAD_PER_LSB

    def decode_inclinometer(self, data: bytes) -> None:
        x, y = (_angle(counts) for counts in TWO_ANGLES.unpack(data))
        if data != _NOTHING and (isfinite(x) or isfinite(y)):
            self.incli = x, y

    def decode_temperature(self, data: bytes) -> None:
        celsius, _, reserved = TEMPERATURE_LAYOUT.unpack(data)
        if (celsius or reserved) and data != _NOTHING:
            self.temperature_c = possible_temperature_c(celsius * TEMPERATURE_C_PER_LSB)

    def decode_quaternion(self, data: bytes) -> None:
        w, x, y, z = QUATERNION_LAYOUT.unpack(data)
        k = QUAT_PER_LSB
        self.quat = possible_quaternion(w * k, x * k, y * k, z * k)


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


def _vector(data: bytes, factor: float) -> Vector3 | None:
    x, y, z, _ = VECTOR.unpack(data)
    return vector_of(x, y, z, factor)


def _angle(counts: int) -> float:
    """Return an angle, rad; NaN beyond a full turn."""
    return counts * EULER_RAD_PER_LSB if -TURN <= counts <= TURN else nan


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_accel(accel_m_s2: Vector3) -> bytes:
    """Return FF34. This function and the following functions clip values to the range."""
    return _pack_vector(accel_m_s2, ACCEL_M_S2_PER_LSB)


def pack_gyro(gyro_rad_s: Vector3) -> bytes:
    """Return FF37."""
    return _pack_vector(gyro_rad_s, GYRO_RAD_S_PER_LSB)


def pack_mag(mag_t: Vector3) -> bytes:
    """Return FF3A."""
    return _pack_vector(mag_t, MAG_T_PER_LSB)


def pack_roll_pitch(roll_rad: float, pitch_rad: float) -> bytes:
    """Return FF3D."""
    return TWO_ANGLES.pack(counts_of(roll_rad / EULER_RAD_PER_LSB, 32), counts_of(pitch_rad / EULER_RAD_PER_LSB, 32))


def pack_heading(yaw_rad: float, *, twice: bool = True) -> bytes:
    """Return FF41 of a counter-clockwise yaw; `twice` as newer firmware, otherwise with zeros in the reserved bytes."""
    counter_clockwise = round(yaw_rad / EULER_RAD_PER_LSB)
    signed = (counter_clockwise + HALF_TURN) % TURN - HALF_TURN
    return HEADING_LAYOUT.pack(-counter_clockwise % TURN, signed if twice else 0)


def pack_inclinometer(x_rad: float, y_rad: float) -> bytes:
    """Return FF4A."""
    return pack_roll_pitch(x_rad, y_rad)


def pack_temperature(temperature_c: float, reserved: int = PLACEHOLDER) -> bytes:
    """Return FF43."""
    return TEMPERATURE_LAYOUT.pack(counts_of(temperature_c / TEMPERATURE_C_PER_LSB, 16), 0, reserved)


def pack_quaternion(quat_wxyz: Quaternion) -> bytes:
    """Return FF46."""
    return QUATERNION_LAYOUT.pack(*(counts_of(q / QUAT_PER_LSB, 16) for q in quat_wxyz))


def pack_utc(year: int, month: int, day: int, second_of_day: float) -> bytes:
    """Return FF2F."""
    whole, millisecond = divmod(int(second_of_day * 1000), 1000)
    minutes, second = divmod(whole, 60)
    return UTC_LAYOUT.pack(year - YEAR_ZERO, month, day, *divmod(minutes, 60), second, millisecond)


def _pack_vector(vector: Vector3, factor: float) -> bytes:
    return VECTOR.pack(*(counts_of(value / factor, 16) for value in vector), 0)


CONFIGURE: Final = 0xEF00  # PGN of requests and replies (proprietary A)
HOST_ADDRESS: Final = 0x55  # source address in the manual's example, and destination of all replies


@dataclass(frozen=True, slots=True)
class J1939Node:
    """Device, and the address of imud in requests to it."""

    address: int
    host: int = HOST_ADDRESS

    def reply_ids(self) -> frozenset[int]:
        """Return the identifiers of replies, without priority."""
        return frozenset(
            join(J1939Id(0, CONFIGURE, self.address, destination)) for destination in (self.host, HOST_ADDRESS)
        )


FACTORY_ADDRESS: Final = 8
Address = Annotated[int, Meta(ge=0, le=ADDRESS_MAX)]


class HipnucJ1939Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on J1939."""

    address: Address = FACTORY_ADDRESS
    """Address of the device on the bus (J1939 source address); its setting accepts 1 … 128."""
    pgns: Literal["auto"] | Annotated[tuple[MeasuredName, ...], Meta(min_length=1)] = "auto"
    """Messages that make samples; `auto` = all received messages."""
    host_address: Address = HOST_ADDRESS
    """Address of imud in requests to the device; 0x55 (85) as in the manual."""

    @property
    def peer(self) -> J1939Node:
        """Addresses of the device and of imud."""
        return J1939Node(self.address, self.host_address)

    def measured(self) -> tuple[int, ...]:
        """Return the PGNs that make samples."""
        if self.pgns == "auto":
            return MEASURED
        return tuple(int(name, 16) for name in self.pgns)


class HipnucJ1939Codec:
    """Decoder of the frames of one device. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, settings: HipnucJ1939Options) -> None:
        self.ledger = ledger
        taken = (UTC, *settings.measured())
        self._pgns = {join(J1939Id(0, pgn, settings.address)): pgn for pgn in taken}
        self._reply_ids = settings.peer.reply_ids()
        self._address = settings.address
        self._assembly = Assembly(ledger)
        self.unknown: dict[int, int] = {}  # number of frames by unknown PGN

    @property
    def problem(self) -> str:
        """Return the address conflict that the frames show; empty without a conflict."""
        return self._assembly.problem

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Add one frame. Return the completed events. Never raises an exception."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        key = can_id & WITHOUT_PRIORITY
        pgn = self._pgns.get(key)
        if not extended or (pgn is None and key not in self._reply_ids):
            ledger.bytes_skipped += size
            if extended and can_id & 0xFF == self._address:
                count_unknown(self.unknown, split(can_id).pgn)
            return ()
        if size != MESSAGE_BYTES:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if pgn is None:
            ledger.frames_in_replies += 1
            return (ReplyFrame(can_id, data),)
        if pgn == UTC:
            ledger.frames_ignored += 1
            return ()
        made = self._assembly.add_frame(pgn, data, t_rx_ns)
        return self._assembly.watched([measurement_of(*one) for one in made]) if made else ()

    def flush(self) -> Sequence[CodecEvent]:
        """Return the incomplete sample."""
        return self._assembly.watched([measurement_of(*one) for one in self._assembly.flush()])

    def reset(self) -> None:
        """Drop the incomplete sample after lost frames."""
        self._assembly.reset()


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, address: int = FACTORY_ADDRESS) -> tuple[int, bytes]:
    """Return a message as (identifier, data)."""
    return join(J1939Id(PRIORITY, pgn, address)), data
