"""HiPNUC CH0x0/CH10x/HI14 on SAE J1939. Manual "IMU配置手冊" V1.5.9, chapter 6, and PGNs of newer firmware: FF10, FF14,
FF18 and FF26 of INS devices (source: the vendor's public SDK, `hipnuc_j1939_parser.c`).

    0CFF3408   priority 3 | PGN FF34 | source 08, the address of the device     eight bytes of values
    0CEF5508   reply to imud, see `commands.py`

Several devices share a bus and have different addresses. A receiver ignores the priority. A device sends each enabled
PGN at its own interval, without counter and time; `assembly.py` makes samples of them.

FF2F (UTC) is not a device time: it jumps when the receiver of the device finds the time, it has its own interval, and
no document states its instant. A sample contains this UTC if FF2F arrived in the same burst (UTC_NEAR_NS). Without a
date (zeros), FF2F of newer firmware contains the uptime modulo 24 h, which imud ignores. imud does not publish the
heading quality, the satellites of the heading, the INS status, the geoid separation, the age of corrections and the
ground speed.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import hypot, isfinite, nan
from typing import Annotated, ClassVar, Final, Literal

import msgspec
from msgspec import Meta

from imud.attitude.rotation import quat_from_euler312
from imud.contracts.codec import CodecEvent, count_unknown, wrong_length
from imud.contracts.script import ReplyFrame
from imud.drivers.hipnuc.assembly import Assembled, Assembly
from imud.drivers.hipnuc.assembly_state import ASSEMBLY, check_parts
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
from imud.drivers.hipnuc.uart.ins import (
    POSITION_RAD_PER_LSB,
    VELOCITY_M_S_PER_LSB,
    position_of,
    utc_fields,
    utc_ns_of,
)
from imud.drivers.state import DAEMON, OPTIONS, TIME, UNKNOWN
from imud.drivers.value_limits import HEIGHT_LIMIT_M, possible_quaternion, possible_temperature_c
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, join, split
from imud.formats.state import Field, Integer, Maybe, Row, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Position, Quaternion, Vector3
from imud.model.units import NS_PER_MS

# Message that makes samples, by the last four digits of its PGN
MeasuredName = Literal[
    "FF10", "FF14", "FF18", "FF26", "FF34", "FF37", "FF3A", "FF3D", "FF41", "FF43", "FF46", "FF4A",
]  # fmt: skip
PgnName = MeasuredName | Literal["FF2F", "FF5A", "FF5B"]  # any message
PLACE, HEIGHT, GNSS, VELOCITY = 0xFF10, 0xFF14, 0xFF18, 0xFF26
ACCEL, GYRO, ROLL_PITCH, HEADING, INCLINOMETER = 0xFF34, 0xFF37, 0xFF3D, 0xFF41, 0xFF4A
MAG, TEMPERATURE, QUATERNION, UTC = 0xFF3A, 0xFF43, 0xFF46, 0xFF2F
FAST_OLD, FAST = 0xFF5A, 0xFF5B  # CAN FD messages of `canfd.py`
# PGNs of the manual, in rising order
MANUAL_PGNS: Final = (UTC, ACCEL, GYRO, MAG, ROLL_PITCH, HEADING, TEMPERATURE, QUATERNION, INCLINOMETER)
NEWER_PGNS: Final = (PLACE, HEIGHT, GNSS, VELOCITY, FAST_OLD, FAST)  # PGNs of newer firmware, in rising order
PGNS: Final = tuple(sorted(MANUAL_PGNS + NEWER_PGNS))
MEASURED: Final = tuple(pgn for pgn in PGNS if pgn not in (UTC, FAST_OLD, FAST))  # PGNs that make samples
PRIORITY: Final = 3
MESSAGE_BYTES: Final = 8

VECTOR: Final = struct.Struct("<3hH")
TWO_ANGLES: Final = struct.Struct("<2i")
HEADING_LAYOUT: Final = struct.Struct("<Ii")
QUATERNION_LAYOUT: Final = struct.Struct("<4h")
HEIGHT_LAYOUT: Final = struct.Struct("<ihh")  # height, geoid separation, age of corrections
GNSS_LAYOUT: Final = struct.Struct("<5B3x")  # position quality, heading quality, satellites, of the heading, INS status
VELOCITY_LAYOUT: Final = struct.Struct("<4h")  # east, north, up, ground speed
TEMPERATURE_LAYOUT: Final = struct.Struct("<hHi")  # temperature, reserved, reserved
UTC_LAYOUT: Final = struct.Struct("<6BH")

HEIGHT_M_PER_LSB: Final = 0.01
# Maximum time between FF2F and the first frame of its sample, ns: half of the minimum interval of a message
UTC_NEAR_NS: Final = 5 * NS_PER_MS // 2
TURN: Final = 360_000  # counts of a full turn
HALF_TURN: Final = TURN // 2
PLACEHOLDER: Final = 999  # reserved bytes 4-7 of FF43 as devices without barometer send them
DAY_MS: Final = 86_400_000
MINUTE_S_MOST: Final = 60  # maximum second of FF2F: a leap second

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
        t_first_ns=t_first_ns, velocity_enu_m_s=parts.velocity, position=parts.position,
    )  # fmt: skip


class _Parts:
    """Values of the messages of one sample."""

    __slots__ = (
        "accel", "gnss", "gyro", "height_m", "incli", "mag", "pitch", "place", "quat", "roll", "temperature_c",
        "velocity", "yaw",
    )  # fmt: skip

    def __init__(self) -> None:
        self.accel: Vector3 | None = None
        self.gyro: Vector3 | None = None
        self.mag: Vector3 | None = None
        self.quat: Quaternion | None = None
        self.roll = self.pitch = self.yaw = nan
        self.incli: tuple[float, float] | None = None
        self.temperature_c: float | None = None
        self.place: tuple[float, float] | None = None  # longitude, latitude
        self.height_m: float | None = None
        self.gnss: tuple[int, int] | None = None  # quality, satellites
        self.velocity: Vector3 | None = None

    @property
    def euler(self) -> Vector3 | None:
        """Roll, pitch and yaw; NaN for an unknown angle, None without any angle."""
        roll, pitch, yaw = self.roll, self.pitch, self.yaw
        return (roll, pitch, yaw) if roll == roll or pitch == pitch or yaw == yaw else None  # noqa: PLR0124 - no NaN

    @property
    def position(self) -> Position | None:
        """Position; None without FF10."""
        if self.place is None:
            return None
        return position_of(*self.place, self.height_m, *(self.gnss or (None, None)))[0]

    def decode_place(self, data: bytes) -> None:
        latitude, longitude = TWO_ANGLES.unpack(data)
        if data != _NOTHING:
            self.place = longitude * POSITION_RAD_PER_LSB, latitude * POSITION_RAD_PER_LSB

    def decode_height(self, data: bytes) -> None:
        height_m = HEIGHT_LAYOUT.unpack(data)[0] * HEIGHT_M_PER_LSB
        if data != _NOTHING and abs(height_m) < HEIGHT_LIMIT_M:
            self.height_m = height_m

    def decode_gnss(self, data: bytes) -> None:
        quality, _, satellites, _, _ = GNSS_LAYOUT.unpack(data)
        self.gnss = quality, satellites

    def decode_velocity(self, data: bytes) -> None:
        east, north, up, _ = VELOCITY_LAYOUT.unpack(data)
        self.velocity = None if data == _NOTHING else vector_of(east, north, up, VELOCITY_M_S_PER_LSB)

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
    PLACE: _Parts.decode_place,
    HEIGHT: _Parts.decode_height,
    GNSS: _Parts.decode_gnss,
    VELOCITY: _Parts.decode_velocity,
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


def utc_of(data: bytes) -> int | None:
    """Return UTC of FF2F, ns since 1970; None without a date."""
    *minute, second, ms = UTC_LAYOUT.unpack(data)
    return utc_ns_of((*minute, second * 1000 + ms)) if second <= MINUTE_S_MOST and ms < 1000 else None


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_place(position: Position) -> bytes:
    """Return FF10."""
    return TWO_ANGLES.pack(
        counts_of(position.latitude_rad / POSITION_RAD_PER_LSB, 32),
        counts_of(position.longitude_rad / POSITION_RAD_PER_LSB, 32),
    )


def pack_height(position: Position) -> bytes:
    """Return FF14."""
    return HEIGHT_LAYOUT.pack(counts_of((position.height_m or 0.0) / HEIGHT_M_PER_LSB, 32), 0, 0)


def pack_gnss(position: Position) -> bytes:
    """Return FF18."""
    return GNSS_LAYOUT.pack(position.quality or 0, 0, position.satellites or 0, 0, 3)


def pack_velocity(velocity_enu_m_s: Vector3) -> bytes:
    """Return FF26."""
    east, north, up = velocity_enu_m_s
    speeds = (east, north, up, hypot(east, north))
    return VELOCITY_LAYOUT.pack(*(counts_of(speed / VELOCITY_M_S_PER_LSB, 16) for speed in speeds))


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


def pack_utc(utc_ns: int) -> bytes:
    """Return FF2F of UTC, ns since 1970."""
    *minute, ms = utc_fields(utc_ns)
    return UTC_LAYOUT.pack(*minute, *divmod(ms, 1000))


def pack_uptime(uptime_ms: int) -> bytes:
    """Return FF2F of newer firmware without a date: the uptime modulo 24 h."""
    seconds, ms = divmod(uptime_ms % DAY_MS, 1000)
    minutes, second = divmod(seconds, 60)
    return UTC_LAYOUT.pack(0, 0, 0, *divmod(minutes, 60), second, ms)


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


class NodeOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device with a J1939 address."""

    address: Address = FACTORY_ADDRESS
    """Address of the device on the bus (J1939 source address); its setting accepts 1 … 128."""
    host_address: Address = HOST_ADDRESS
    """Address of imud in requests to the device; 0x55 (85) as in the manual."""

    @property
    def peer(self) -> J1939Node:
        """Addresses of the device and of imud."""
        return J1939Node(self.address, self.host_address)


class HipnucJ1939Options(NodeOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on J1939."""

    pgns: Literal["auto"] | Annotated[tuple[MeasuredName, ...], Meta(min_length=1)] = "auto"
    """Messages that make samples; `auto` = all received messages."""

    def measured(self) -> tuple[int, ...]:
        """Return the PGNs that make samples."""
        if self.pgns == "auto":
            return MEASURED
        return tuple(int(name, 16) for name in self.pgns)


class NodeCodec:
    """Sorting of the frames of one device: messages, replies, other frames. Synchronization: one thread."""

    counts_losses = True

    def __init__(self, ledger: Ledger, settings: NodeOptions, pgns: Iterable[int]) -> None:
        """`pgns`: PGNs of the messages for `_decode`."""
        self.ledger = ledger
        self._pgns = {join(J1939Id(0, pgn, settings.address)): pgn for pgn in pgns}
        self._reply_ids = settings.peer.reply_ids()
        self._address = settings.address
        self.unknown: dict[int, int] = {}  # number of frames by unknown PGN

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
        if pgn is not None:
            return self._decode(pgn, can_id, data, t_rx_ns)
        if size != MESSAGE_BYTES:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        ledger.frames_in_replies += 1
        return (ReplyFrame(can_id, data),)

    def _decode(self, pgn: int, can_id: int, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Decode a message of any length, and count it in the ledger."""
        raise NotImplementedError


_SIZES: Final = dict.fromkeys(MEASURED, MESSAGE_BYTES)  # length of the messages of a sample, bytes
# Attributes of a `NodeCodec` that are not state
NODE_OTHER: Final = {"ledger": DAEMON, "_pgns": OPTIONS, "_reply_ids": OPTIONS, "_address": OPTIONS}


class HipnucJ1939Codec(NodeCodec):
    """Decoder of the classical CAN messages of one device."""

    STATE: ClassVar = StateTable(
        (
            Field(1, "_assembly", ASSEMBLY),
            Field(2, "_utc", Maybe(Row(Integer(0, (1 << 63) - 1), TIME))),
            Field(3, "unknown", UNKNOWN),
        ),
        NODE_OTHER,
        lambda codec: check_parts(codec._assembly, _SIZES),
    )

    def __init__(self, ledger: Ledger, settings: HipnucJ1939Options) -> None:
        super().__init__(ledger, settings, (UTC, *settings.measured()))
        self._assembly = Assembly(ledger)
        self._utc: tuple[int, int] | None = None  # UTC and arrival of FF2F, ns, until the next sample

    @property
    def problem(self) -> str:
        """Return the address conflict that the frames show; empty without a conflict."""
        return self._assembly.problem

    def _decode(self, pgn: int, can_id: int, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        ledger = self.ledger
        if len(data) != MESSAGE_BYTES:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += MESSAGE_BYTES
        ledger.frames_good += 1
        if pgn == UTC:
            self._add_utc(data, t_rx_ns)
            return ()
        made = self._assembly.add_frame(pgn, data, t_rx_ns)
        return self._measured(made) if made else ()

    def _measured(self, made: Sequence[Assembled]) -> list[Measurement]:
        found = [measurement_of(*one) for one in made]
        if self._utc is not None and found:
            utc_ns, t_rx_ns = self._utc
            for place, one in enumerate(found):
                if abs((one.t_first_ns or 0) - t_rx_ns) < UTC_NEAR_NS:
                    found[place] = msgspec.structs.replace(one, gnss_utc_ns=utc_ns)
                    self._drop_utc(is_used=True)
                    break
        return self._assembly.watched(found)

    def _add_utc(self, data: bytes, t_rx_ns: int) -> None:
        self._drop_utc()
        utc_ns = utc_of(data)
        if utc_ns is None:
            self.ledger.frames_ignored += 1
        else:
            self._utc = utc_ns, t_rx_ns
            self.ledger.frames_pending += 1

    def _drop_utc(self, *, is_used: bool = False) -> None:
        """Count the waiting FF2F as used or as ignored."""
        if self._utc is not None:
            self._utc = None
            self.ledger.frames_pending -= 1
            self.ledger.frames_in_samples += is_used
            self.ledger.frames_ignored += not is_used

    def flush(self) -> Sequence[CodecEvent]:
        """Return the incomplete sample."""
        events = self._measured(self._assembly.flush())
        self._drop_utc()
        return events

    def reset(self) -> None:
        """Drop the incomplete sample after lost frames."""
        self._drop_utc()
        self._assembly.reset()


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, address: int = FACTORY_ADDRESS) -> tuple[int, bytes]:
    """Return a message as (identifier, data)."""
    return join(J1939Id(PRIORITY, pgn, address)), data
