"""HiPNUC CH0x0/CH10x/HI14 on a UART: binary frames. Manual "IMU配置手冊" V1.5.9, chapter 3.

    0    1    2       4     6                 6 + length
    +----+----+-------+-----+-----------------+
    | 5A | A5 |length |crc  | payload         |    integers and floats little-endian
    +----+----+-------+-----+-----------------+

`crc` is CRC-16/XMODEM over bytes 0…3 and the payload. The payload is a sequence of sub-packets; the tag byte defines
the size: 0x91 (HI91, floats, 76 bytes), 0x92 (HI92, integers, 48 bytes), and of newer firmware 0x81 (HI81, 104 bytes)
and 0x83 (HI83, its bitmap defines the size; see `ins.py`). Lines of text, the replies to commands
(`commands.py`), are between the frames and may be split by frames (`replies.py`).

If the check of a frame fails, the codec skips only its sync word, because a valid frame may start inside the false
frame. The bytes up to its end by the length field count as bad unless they are valid frames. The codec holds the bytes
of an incomplete frame, at most FRAME_BYTES_MAX. `flush` ends the wait when the link is idle.

The kernel (`imud/_kernel.c`) decodes usual frames in less CPU time. `make bench-instructions` measures the cost.
"""

import re
import struct
import sys
from binascii import crc_hqx as crc16_xmodem
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import ClassVar, Final, Literal, ParamSpec

from imud.contracts.codec import BadFrame, BadReason, CodecEvent, count_unknown
from imud.contracts.lines import TimeBits
from imud.drivers.hipnuc.common import (
    EULER_RAD_PER_LSB,
    M_S2_PER_G,
    MAG_T_PER_LSB,
    PRESSURE_MAX_PA,
    PRESSURE_MIN_PA,
    QUAT_PER_LSB,
    byte_temperature_c,
    field_of,
    pressure_of,
    temperature_beside,
)
from imud.drivers.hipnuc.uart.ins import HI81, TAG_HI81, TAG_HI83, decode_hi81, decode_hi83, hi83_bytes
from imud.drivers.hipnuc.uart.replies import LINE_CHARACTERS_MAX, SENTENCE_TYPE_MIN, LineFinder, sentence_name
from imud.drivers.state import DAEMON, FLAG, OPTIONS, UNKNOWN
from imud.drivers.value_limits import (
    ACCEL_LIMIT_G,
    GYRO_LIMIT_DEG_S,
    MAG_LIMIT_UT,
    QUAT_SQUARE_MAX,
    QUAT_SQUARE_MIN,
    TURN_DEG,
    possible_angles,
    possible_quaternion,
    scaled,
)
from imud.formats.kernel import KernelFormat, KernelFrames
from imud.formats.state import Data, Field, Integer, OneOf, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Quaternion, Vector3
from imud.model.units import RAD_PER_DEG, T_PER_UT

# tag, pps_sync_stamp or status, temperature °C, pressure Pa, system_time ms, accel G, gyro °/s, mag µT, roll pitch yaw
# °, quaternion wxyz (section 3.3.1)
HI91: Final = struct.Struct("<BHbfI3f3f3f3f4f")
# tag, reserved status, temperature °C, pps_sync_stamp ms, pressure - 100000 Pa, reserved, gyro, accel, mag, roll pitch
# yaw, quaternion wxyz (section 3.3.2). In HI92, gyro is before accel.
HI92: Final = struct.Struct("<BHbHh2x3h3h3h3i4h")
TAG_HI91: Final = 0x91
TAG_HI92: Final = 0x92

# Modulus of pps_sync_stamp without an edge, ms (in a recording at 100 Hz, 8 follows 8190). The manual gives the range
# 0 … 8192. Larger values are filler bytes of firmware that does not write the field.
PPS_STAMP_MODULUS_MS: Final = 8192
# Maximum of bytes 1-2 of HI91. Bits 13 to 15 of the status are reserved: with them, the word is filler bytes.
WORD_MOST: Final = PPS_STAMP_MODULUS_MS
# Filler values of the pressure in HI92, and the ends of its range
PRESSURE_FILLERS: Final = (0, -1, -0x8000, 0x7FFF)

ACCEL_M_S2_PER_LSB: Final = 0.0048828  # scale of HI92 as printed; 160 / 32768 would be 2.6e-6 larger
GYRO_RAD_S_PER_LSB: Final = 0.001  # scale of HI92
PRESSURE_OFFSET_PA: Final = 100_000.0


# HI91 without its tag. The word is two bytes. In the native layout, `struct` reads a float in half the time.
HI91_VALUES: Final = struct.Struct(("@" if sys.byteorder == "little" else "<") + "xBBbfI16f")


# `byte_temperature_c` of each value. Negative values are indices from the end.
_TEMPERATURES_C: Final = tuple(byte_temperature_c(value) for value in (*range(128), *range(-128, 0)))

# Squares of limits: the square of a 32-bit float is exact
_LIMIT_SQUARES: Final = (ACCEL_LIMIT_G**2, GYRO_LIMIT_DEG_S**2, MAG_LIMIT_UT**2, TURN_DEG**2)


def _decode_hi91(data: bytes, at: int, word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    (
        low, high, temperature, pressure, ms, ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz,
    ) = HI91_VALUES.unpack_from(data, at)  # fmt: skip
    # Local names and no calls for usual values: a global name costs twice as much, a call a twentieth of a frame. If
    # the sum of the squares is below the square of the limit, every value is below the limit.
    g, rad, tesla = M_S2_PER_G, RAD_PER_DEG, T_PER_UT
    g_square, deg_s_square, ut_square, turn_square = _LIMIT_SQUARES
    is_finite, mag = True, None
    if ax * ax + ay * ay + az * az < g_square:
        accel: Vector3 | None = (ax * g, ay * g, az * g)
    else:
        is_finite = (accel := scaled((ax, ay, az), g, ACCEL_LIMIT_G)) is not None
    if gx * gx + gy * gy + gz * gz < deg_s_square:
        gyro: Vector3 | None = (gx * rad, gy * rad, gz * rad)
    else:
        is_finite &= (gyro := scaled((gx, gy, gz), rad, GYRO_LIMIT_DEG_S)) is not None
    if mx or my or mz:  # a device without magnetometer sends zeros
        if mx * mx + my * my + mz * mz < ut_square:
            mag = (mx * tesla, my * tesla, mz * tesla)
        else:
            is_finite &= (mag := scaled((mx, my, mz), tesla, MAG_LIMIT_UT)) is not None
    if roll * roll + pitch * pitch + yaw * yaw < turn_square:
        euler: Vector3 | None = (roll * rad, pitch * rad, yaw * rad)
    else:
        is_finite &= (euler := scaled((roll, pitch, yaw), rad, TURN_DEG)) is not None
    # `possible_quaternion` without a call
    is_rotation = QUAT_SQUARE_MIN < qw * qw + qx * qx + qy * qy + qz * qz < QUAT_SQUARE_MAX
    quat, temperature_c, pressure_pa = (qw, qx, qy, qz) if is_rotation else None, _TEMPERATURES_C[temperature], pressure
    if not PRESSURE_MIN_PA <= pressure <= PRESSURE_MAX_PA:
        temperature_c, pressure_pa = temperature_beside(temperature_c, pressure), None
    if pressure_pa is None or quat is None:
        is_finite &= isfinite(pressure + qw + qx + qy + qz)
    word = low + 256 * high
    if word > WORD_MOST:
        word = None
    return Measurement(
        size, trailing, ms, accel, gyro, mag, quat, euler, temperature_c, pressure_pa,
        None, word if word_is_status else None, None if word_is_status else word,
    ), is_finite  # fmt: skip


def _decode_hi92(data: bytes, at: int, _word_is_status: bool, size: int, trailing: int) -> tuple[Measurement, bool]:
    (
        _, _, temperature, pps_ms, pressure, gx, gy, gz, ax, ay, az, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz,
    ) = HI92.unpack_from(data, at)  # fmt: skip
    a, w, angle, q = ACCEL_M_S2_PER_LSB, GYRO_RAD_S_PER_LSB, EULER_RAD_PER_LSB, QUAT_PER_LSB
    euler = possible_angles((roll * angle, pitch * angle, yaw * angle))
    # no device time: `dev_ticks` is None; the manual reserves the status
    return Measurement(
        size, trailing, None, (ax * a, ay * a, az * a), (gx * w, gy * w, gz * w),
        field_of(mx, my, mz),
        possible_quaternion(qw * q, qx * q, qy * q, qz * q),
        euler, byte_temperature_c(temperature),
        None if pressure in PRESSURE_FILLERS else pressure_of(pressure + PRESSURE_OFFSET_PA), None, None,
        pps_ms if pps_ms <= PPS_STAMP_MODULUS_MS else None,
    ), euler is not None  # fmt: skip


@dataclass(frozen=True, slots=True)
class Packet:
    """Kind of sub-packet."""

    kernel_format: KernelFormat | None  # None: the kernel does not decode it
    size: int  # size with tag, bytes; 0 for HI83, see `hi83_bytes`
    # `decode(data, at, word_is_status, size, trailing)` returns the measurement and whether all values are finite
    decode: Callable[[bytes, int, bool, int, int], tuple[Measurement, bool]]


def tag_name(tag: int) -> str:
    """Return the name of an unknown tag or sentence type, for example `tag 0x05`."""
    return sentence_name(tag) if tag >= SENTENCE_TYPE_MIN else f"tag {tag:#04x}"


SYNC: Final = b"\x5a\xa5"
HEADER: Final = struct.Struct("<2sHH")  # sync word, payload length, CRC
HEADER_BYTES: Final = HEADER.size  # the attribute is slower than a name


def _format(name: str, size: int) -> KernelFormat:
    return KernelFormat(name, SYNC + size.to_bytes(2, "little"), HEADER.size + size)


HI91_FORMAT: Final = _format("HI91", HI91.size)
HI92_FORMAT: Final = _format("HI92", HI92.size)
PACKETS: Final = {
    TAG_HI91: Packet(HI91_FORMAT, HI91.size, _decode_hi91),
    TAG_HI92: Packet(HI92_FORMAT, HI92.size, _decode_hi92),
    TAG_HI81: Packet(None, HI81.size, decode_hi81),
    TAG_HI83: Packet(None, 0, decode_hi83),
}


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
    """Return an HI91 sub-packet. Values are clipped to the range, time wraps at 2³² ms, NaN is sent unchanged."""
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
    """Return an HI92 sub-packet. Values are clipped to the range. Raises ValueError, OverflowError if not finite."""
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


PAYLOAD_BYTES_MAX: Final = 512  # section 3.1; devices make frames in a buffer of 512 bytes, with header
FRAME_BYTES_MAX: Final = HEADER.size + PAYLOAD_BYTES_MAX
# CRC of bytes 0 to 3 by the payload length
_HEAD_CRC: Final = [crc16_xmodem(SYNC + length.to_bytes(2, "little"), 0) for length in range(PAYLOAD_BYTES_MAX + 1)]

# First firmware version (1.6.9) with MAIN_STATUS in bytes 1-2 of HI91; older firmware sends pps_sync_stamp there
STATUS_SINCE_APP_VER: Final = 169
# Status bits of MAIN_STATUS about time: frame with a SOUT pulse; `system_time` not synchronized to UTC
TIME_BITS: Final = TimeBits(sync_out=1 << 12, not_utc=1 << 11)

# Pattern of a line directly before the idle time: at least two characters and both line end characters. Shorter text
# can occur by chance inside an incomplete frame, which `flush` would drop.
_IDLE_LINE: Final = re.compile(rb"[\t\x20-\x7e]{2,%d}\r\n\Z" % LINE_CHARACTERS_MAX)


class HipnucOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on a UART."""

    hi91_word: Literal["auto", "pps", "status"] = "auto"
    """Meaning of bytes 1-2 of HI91: time since the last PPS edge (firmware before 1.6.9) or status bits (newer
    firmware). `auto` selects `pps` until the device reports its firmware version."""


class HipnucCodec(KernelFrames):
    """Decoder of frames and lines of text from a byte stream. Synchronization: one thread.

    Every known sub-packet becomes one `Measurement` with the size of the complete frame, so that all sub-packets of a
    frame have the same time. A sub-packet that is cut off by the end of the payload makes the frame bad. For a frame
    with NaN or infinity, the codec returns a `BadFrame` (not-finite) and the measurement without these values; the
    frame counts as good.
    """

    STATE: ClassVar = StateTable(
        (
            Field(1, "_tail", Data(FRAME_BYTES_MAX)),
            Field(2, "unknown", UNKNOWN),
            Field(3, "word_is_status", FLAG),
            Field(4, "kernel_format", OneOf(HI91_FORMAT, HI92_FORMAT)),
            Field(5, "_lines", LineFinder.STATE),
            Field(6, "_bad_ahead", Integer(0, FRAME_BYTES_MAX)),
            Field(7, "_barred_ahead", Integer(0, FRAME_BYTES_MAX)),
        ),
        {"ledger": DAEMON, "_word_is_fixed": OPTIONS},
    )

    def __init__(self, ledger: Ledger, settings: HipnucOptions) -> None:
        super().__init__(ledger)
        self.unknown: dict[int, int] = {}  # number of sub-packets by unknown tag, and of NMEA sentences by type
        self.word_is_status = settings.hi91_word == "status"  # whether bytes 1-2 of HI91 are status bits
        self.kernel_format = HI91_FORMAT  # of the newest frame that the kernel can decode
        self._word_is_fixed = settings.hi91_word != "auto"
        self._lines = LineFinder(ledger, self.unknown)
        self._bad_ahead = 0  # rest of a damaged frame by its length field, in bytes from the start of the tail
        self._barred_ahead = 0  # rest of a complete damaged frame, in which the codec does not look for lines

    def learn_app_ver(self, app_ver: int) -> None:
        """Set the firmware version, 169 for 1.6.9. Do nothing if the configuration defines the meaning of bytes 1-2."""
        if not self._word_is_fixed:
            self.word_is_status = app_ver >= STATUS_SINCE_APP_VER

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream. Return the completed events. Never raises an exception."""
        self.ledger.bytes_in += len(data)
        return self._scan(self._tail + data if self._tail else data, 0)

    # --- frames for the kernel --------------------------------------------------------------------------------------

    def usual_frames(self, data: bytes) -> bytes:
        tail = self._tail
        if self._bad_ahead or self._barred_ahead or self.ledger.bytes_pending != len(tail):  # a line is incomplete
            return b""
        return tail + data if tail else data

    # --- end of the stream ------------------------------------------------------------------------------------------

    def flush(self) -> Sequence[CodecEvent]:
        """Drop an incomplete frame that contains a complete frame or line. imud calls it when the link is idle."""
        events: list[CodecEvent] = []
        while give_up := self._whole_inside():
            events += self._scan(self._tail, give_up)
        return events

    def reset(self) -> None:
        """Count the pending bytes as skipped. The known firmware version stays."""
        self._lines.clear()
        self.ledger.bytes_skipped += len(self._tail)
        self._tail = b""
        self._bad_ahead = self._barred_ahead = 0
        self.ledger.bytes_pending = 0

    def _scan(self, data: bytes, give_up: int) -> list[CodecEvent]:
        """Decode all complete frames in `data`. Incomplete frames that start before `give_up` are bad."""
        events: list[CodecEvent] = []
        at, total = 0, len(data)
        while at < total:
            after = self._decode_frame(data, at, give_up, events)
            if after == at:
                break
            at = after
        self._tail = data[at:]
        self._bad_ahead, self._barred_ahead = max(self._bad_ahead - at, 0), max(self._barred_ahead - at, 0)
        self.ledger.bytes_pending = total - at + self._lines.pending_bytes
        return events

    def _decode_frame(self, data: bytes, at: int, give_up: int, events: list[CodecEvent]) -> int:
        """Decode the frame or the text at `at`. Return its end, or `at` if it is incomplete."""
        total = len(data)
        if total - at < HEADER_BYTES:
            return self._decode_rest(data, at, give_up, events)
        sync: bytes
        length: int
        sync, length, crc = HEADER.unpack_from(data, at)
        if sync != SYNC:
            return self._add_text(data, at, events)
        if not 1 <= length <= PAYLOAD_BYTES_MAX:
            return self._spend_sync(data, at, at + 4, BadReason.LENGTH, events)
        begin = at + HEADER_BYTES
        end = begin + length
        if end > total or crc16_xmodem(data[begin:end], _HEAD_CRC[length]) != crc:
            is_incomplete = end > total and at >= give_up
            return at if is_incomplete else self._spend_sync(data, at, end, BadReason.CRC, events)
        ledger, finite, first = self.ledger, True, len(events)
        while begin < end:
            packet = PACKETS.get(data[begin])
            if packet is None:
                ledger.unknown_tags += 1
                count_unknown(self.unknown, data[begin])
                break
            decode, after = packet.decode, begin + (packet.size or hi83_bytes(data, begin, end))
            if after > end:
                ledger.frames_bad_content += 1
                ledger.bytes_in_bad_frames += end - at
                events[first:] = [BadFrame(BadReason.CONTENT, data[at:end])]
                return end
            measurement, is_finite = decode(data, begin, self.word_is_status, end - at, total - end)
            finite = finite and is_finite
            self.kernel_format = packet.kernel_format or self.kernel_format
            events.append(measurement)
            begin = after
        ledger.bytes_in_good_frames += begin - at
        ledger.bytes_skipped += end - begin  # an unknown tag and the bytes after it
        ledger.frames_good += 1
        if len(events) > first:
            ledger.frames_in_samples += 1
        else:
            ledger.frames_ignored += 1
        if not finite:
            ledger.frames_not_finite += 1
            events.insert(first, BadFrame(BadReason.NOT_FINITE, data[at:end]))
        return end

    def _decode_rest(self, data: bytes, at: int, give_up: int, events: list[CodecEvent]) -> int:
        """Do `_decode_frame` for fewer bytes than a header."""
        if not data.startswith(SYNC, at):
            return self._add_text(data, at, events)
        return self._spend_sync(data, at, len(data), BadReason.CRC, events) if at < give_up else at

    def _add_text(self, data: bytes, at: int, events: list[CodecEvent]) -> int:
        """Add the bytes before the next sync word. Return their end."""
        sync = data.find(SYNC, at)
        end = sync if sync >= 0 else len(data) - data.endswith(SYNC[:1], at)
        events += self._lines.add(data[at:end], self._bad_ahead - at, self._barred_ahead - at)
        return end

    def _spend_sync(self, data: bytes, at: int, end: int, reason: BadReason, events: list[CodecEvent]) -> int:
        """Reject a frame, and skip only its sync word. `end` is its end according to its length field."""
        ledger = self.ledger
        if reason is BadReason.CRC:
            ledger.frames_bad_crc += 1
        else:
            ledger.frames_bad_length += 1
        ledger.bytes_in_bad_frames += len(SYNC)
        self._lines.break_off()
        self._bad_ahead = max(self._bad_ahead, end)
        if end <= len(data):
            self._barred_ahead = max(self._barred_ahead, end)
        events.append(BadFrame(reason, data[at:end]))
        return at + len(SYNC)

    def _whole_inside(self) -> int:
        """Return the start of the first complete frame in the tail; otherwise the end of a complete line, or 0."""
        tail = self._tail
        at = tail.find(SYNC, len(SYNC))
        while at >= 0:
            if _is_whole(tail, at):
                return at
            at = tail.find(SYNC, at + len(SYNC))
        return len(tail) if _IDLE_LINE.search(tail) else 0


def _is_whole(data: bytes, at: int) -> bool:
    """Return whether a frame with a correct CRC starts at `at`."""
    if len(data) - at < HEADER.size:
        return False
    length: int
    crc: int
    _, length, crc = HEADER.unpack_from(data, at)
    begin, end = at + HEADER.size, at + HEADER.size + length
    if not 1 <= length <= PAYLOAD_BYTES_MAX or end > len(data):
        return False
    return crc16_xmodem(data[begin:end], _HEAD_CRC[length]) == crc


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode_frame(payload: bytes) -> bytes:
    """Return a frame with `payload`. Raises ValueError for an empty payload or more than PAYLOAD_BYTES_MAX bytes."""
    if not 1 <= len(payload) <= PAYLOAD_BYTES_MAX:
        raise ValueError(f"payload of {len(payload)} bytes: expected 1 … {PAYLOAD_BYTES_MAX}")
    head = SYNC + len(payload).to_bytes(2, "little")
    return head + crc16_xmodem(payload, crc16_xmodem(head, 0)).to_bytes(2, "little") + payload


_Values = ParamSpec("_Values")


def _framed(pack: Callable[_Values, bytes]) -> Callable[_Values, bytes]:
    def encode(*args: _Values.args, **values: _Values.kwargs) -> bytes:
        return encode_frame(pack(*args, **values))

    return encode


encode_hi91 = _framed(pack_hi91)  # returns a complete HI91 frame from SI values; see `pack_hi91`
encode_hi92 = _framed(pack_hi92)  # returns a complete HI92 frame from SI values; see `pack_hi92`
