"""Forsense IMU61x on a UART: AHRS frames and replies. Manual "IMU61X Interface Protocol and Instructions", chapter 1.

    AHRS, id 0x0002, 44 bytes   timer µs u32 | pitch | roll | yaw ° | accel 3 g | gyro 3 °/s | temperature °C, all f32

Framing is in `framing.py`, the other frames in `replies.py`, commands in `commands.py`. Pitch
comes before roll. The quaternion is computed from the angles, whose convention is assumed (`common.EULER_CONVENTION`).

The timer counts µs and wraps after 71.6 minutes.

Strategy. A read is one AHRS frame, or several back to back, nearly always: `feed` itself and `_decode_run` take those
whose values are finite. NaN and infinity are looked for in the high bytes of all floats at once. All else goes through
`framing.FrameFinder`. `make bench-instructions` measures it.
"""

import re
import struct
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import takewhile
from math import cos, isfinite, sin
from typing import Any, Final
from zlib import crc32 as inverted_crc32

import msgspec

from imud.attitude.rotation import quat_from_euler_zyx
from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.script import Message, ReplyFrame
from imud.drivers.imu61x.common import CRC_INVERSION, CRC_START, M_S2_PER_G, RAD_S_PER_DEG_S, crc32, scaled
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import RAD_PER_DEG

DEVICE_SYNC: Final = b"\xaa\x55"
"""Begins what the device sends."""
HOST_SYNC: Final = b"\x55\xaa"
"""Begins what the host sends."""
HEADER: Final = struct.Struct("<2sHH")  # sync word, id, payload length
CRC_BYTES: Final = 4
OVERHEAD_BYTES: Final = HEADER.size + CRC_BYTES
PAYLOAD_BYTES_MAX: Final = 256
"""The longest known payload has 66 bytes (S1, whose length differs by model); a false length then hides at most five
samples, 23 ms at 115200 baud."""
FRAME_BYTES_MAX: Final = OVERHEAD_BYTES + PAYLOAD_BYTES_MAX


class Frame(msgspec.Struct, frozen=True, gc=False):
    """A frame whose CRC matches."""

    frame_id: int
    payload: bytes
    raw: bytes
    trailing_bytes: int
    """Bytes of the same read that follow it."""


def encode_frame(sync: bytes, frame_id: int, payload: bytes) -> bytes:
    """A frame around `payload`. Raises ValueError for a payload that is empty or above PAYLOAD_BYTES_MAX."""
    if not 1 <= len(payload) <= PAYLOAD_BYTES_MAX:
        raise ValueError(f"payload of {len(payload)} bytes: expected 1 … {PAYLOAD_BYTES_MAX}")
    body = HEADER.pack(sync, frame_id, len(payload)) + payload
    return body + crc32(body).to_bytes(CRC_BYTES, "little")


class FrameFinder:
    """Finder of the frames of one direction in bytes of any split. Synchronization: one thread.

    Books into the ledger every byte and every damaged frame, but not the frames it returns: only the caller knows
    whether they are good.
    """

    def __init__(self, ledger: Ledger, sync: bytes) -> None:
        self._ledger = ledger
        self._sync = sync
        self._tail = b""
        """Incomplete rest of the bytes: begins with a sync word, or is the first half of one."""
        self._bad_ahead = 0
        """Claimed rest of a damaged frame, in bytes from the begin of the tail."""
        self.idle = True
        """Whether the next bytes can be decoded without the earlier ones. To be read only."""

    def feed(self, data: bytes) -> Sequence[Frame | BadFrame]:
        """Add bytes in the order they came; return what they completed. Never raises for any bytes."""
        self._ledger.bytes_in += len(data)
        return self._scan(self._tail + data if self._tail else data, 0)

    def feed_rest(self, data: bytes, take_run: Callable[[bytes], int]) -> Sequence[Frame | BadFrame]:
        """Add bytes as `feed`, of which `take_run` takes whole frames first; it returns how many bytes those have.

        It is given what waited together with `data`, unless that may belong to a damaged frame.
        """
        self._ledger.bytes_in += len(data)
        if self._tail:
            data = self._tail + data
        return self._scan(data, 0, 0 if self._bad_ahead else take_run(data))

    def flush(self) -> Sequence[Frame | BadFrame]:
        """Drop an incomplete frame if a whole one waits inside it; no-op otherwise. Called when the line is idle."""
        found: list[Frame | BadFrame] = []
        while drop_before := self._whole_inside():
            found += self._scan(self._tail, drop_before)
        return found

    def reset(self) -> None:
        """Skip what is pending: the stream broke."""
        self._ledger.bytes_skipped += len(self._tail)
        self._tail = b""
        self._bad_ahead = 0
        self.idle = True
        self._ledger.bytes_pending = 0

    def _scan(self, data: bytes, drop_before: int, at: int = 0) -> list[Frame | BadFrame]:
        """Find all that is complete in `data` from `at`; incomplete frames that begin before `drop_before` are bad."""
        found: list[Frame | BadFrame] = []
        sync, total = self._sync, len(data)
        while at < total:
            begin = data.find(sync, at)
            if begin < 0:
                end = total - data.endswith(sync[:1], at)
                self._skip(at, end)
                at = end
                break
            self._skip(at, begin)
            at, waiting = begin, self._frame_at(data, begin, drop_before, found)
            if at == waiting:
                break
            at = waiting
        self._tail = data[at:]
        self._bad_ahead = max(self._bad_ahead - at, 0)
        self.idle = not (self._tail or self._bad_ahead)
        self._ledger.bytes_pending = total - at
        return found

    def _frame_at(self, data: bytes, at: int, drop_before: int, found: list[Frame | BadFrame]) -> int:
        """Find the frame whose sync word is at `at`; return where it ends, or `at` if it is not complete yet."""
        total = len(data)
        if total - at < HEADER.size:
            return self._spend_sync(data, at, total, BadReason.CRC, found) if at < drop_before else at
        frame_id: int
        length: int
        _, frame_id, length = HEADER.unpack_from(data, at)
        begin = at + HEADER.size
        if not 1 <= length <= PAYLOAD_BYTES_MAX:
            return self._spend_sync(data, at, begin, BadReason.LENGTH, found)
        end = begin + length + CRC_BYTES
        if end > total and at >= drop_before:
            return at
        raw = data[at:end]
        if end > total or not _crc_matches(raw):
            return self._spend_sync(data, at, end, BadReason.CRC, found)
        found.append(Frame(frame_id, raw[HEADER.size : -CRC_BYTES], raw, total - end))
        return end

    def _skip(self, at: int, end: int) -> None:
        """Count bytes that belong to no frame; those that a damaged frame claimed count as its."""
        bad = max(min(self._bad_ahead, end) - at, 0)
        self._ledger.bytes_in_bad_frames += bad
        self._ledger.bytes_skipped += end - at - bad

    def _spend_sync(self, data: bytes, at: int, end: int, reason: BadReason, found: list[Frame | BadFrame]) -> int:
        """Spend only the sync word of what begins at `at` and claims to reach `end`: it is no frame."""
        ledger = self._ledger
        if reason is BadReason.CRC:
            ledger.frames_bad_crc += 1
        else:
            ledger.frames_bad_length += 1
        ledger.bytes_in_bad_frames += len(self._sync)
        self._bad_ahead = max(self._bad_ahead, end)
        found.append(BadFrame(reason, data[at:end]))
        return at + len(self._sync)

    def _whole_inside(self) -> int:
        """Find the first frame with a matching CRC in the tail, after its own sync word; 0 for none."""
        tail, sync = self._tail, self._sync
        at = tail.find(sync, len(sync))
        while at > 0:
            length = int.from_bytes(tail[at + 4 : at + HEADER.size], "little")
            raw = tail[at : at + OVERHEAD_BYTES + length]
            if 1 <= length <= PAYLOAD_BYTES_MAX and len(raw) == OVERHEAD_BYTES + length and _crc_matches(raw):
                return at
            at = tail.find(sync, at + len(sync))
        return 0


def _crc_matches(raw: bytes) -> bool:
    return crc32(raw[:-CRC_BYTES]) == int.from_bytes(raw[-CRC_BYTES:], "little")


STATUS_FRAME: Final = 0x00FF
PARAMETER_FRAME: Final = 0x0006

_STATUS_HEAD: Final = struct.Struct("<IIH3I")  # 22 bytes: what every model sends
_STATUS_REST: Final = struct.Struct("<IHHBBBB32s")
_STATUS_STEPS: Final = tuple(_STATUS_HEAD.size + n for n in (4, 6, 8, 9, 10, 11, 12, 44))
"""End offset of each member of the rest; a member that is not complete is absent."""
STATUS_BYTES_MIN: Final = _STATUS_HEAD.size
PARAMETERS: Final = struct.Struct("<ffIIii")
"""P1, and R1 of commands: value, 0, index, 0, 0, 0 (tables 8 and 11)."""
ACKNOWLEDGEMENT: Final = struct.Struct("<HH")

RESULT_DONE: Final = 0
"""Result of K1 for a command that was carried out; assumed."""


class Parameter(IntEnum):
    """Parameters that can be read, by their index (table 9)."""

    BAUD = 3
    """Rate of the UART, bit/s."""
    GYRO_X_OFF = 8
    """Zero bias found by the static calibration, °/s; Y and Z as well."""
    GYRO_Y_OFF = 9
    GYRO_Z_OFF = 10
    INSTALL_X_OFF = 16
    """Mounting error angle, °; Y and Z as well."""
    INSTALL_Y_OFF = 17
    INSTALL_Z_OFF = 18
    AHRS_RATE = 21
    """AHRS frames per second, Hz."""
    BUS_MODE = 27
    """The second bus, next to the UART, see `commands.BusMode`."""
    I2C_ADDRESS = 30
    FILTER = 31
    """Filter codes as in FILTER_CTRL, see `filter_codes` of `common/family.py`."""


@dataclass(frozen=True, slots=True)
class Status:
    """S1. Members that the model does not send are None; codes are as sent."""

    software_version: int
    hardware_version: int
    model: int
    serial_number: tuple[int, int, int]
    system_status: int | None = None
    cpu_load: int | None = None
    drop_rate: int | None = None
    i2c_master: int | None = None
    voltage: int | None = None
    user_config_status: int | None = None
    calibration_status: int | None = None
    imu_health: bytes | None = None
    """32 bytes."""


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """P1."""

    index: int
    value: float


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """K1."""

    command: int
    result: int
    """The raw value."""


def is_reply(frame_id: int, payload: bytes) -> bool:
    """Whether a frame is S1, P1 or K1 by its id and length."""
    size = len(payload)
    return (
        size == ACKNOWLEDGEMENT.size
        or (frame_id == STATUS_FRAME and size >= STATUS_BYTES_MIN)
        or (frame_id == PARAMETER_FRAME and size >= PARAMETERS.size)
    )


def parse_status(message: Message) -> Status | None:
    """S1 of any length from 22 bytes on; None for anything else."""
    if not isinstance(message, ReplyFrame) or message.frame_id != STATUS_FRAME:
        return None
    payload = message.payload
    if len(payload) < STATUS_BYTES_MIN:
        return None
    software, hardware, model, *serial = _STATUS_HEAD.unpack_from(payload)
    padded = payload[STATUS_BYTES_MIN:].ljust(_STATUS_REST.size, b"\x00")
    rest = [
        value if len(payload) >= end else None
        for value, end in zip(_STATUS_REST.unpack_from(padded), _STATUS_STEPS, strict=True)
    ]
    return Status(software, hardware, model, (serial[0], serial[1], serial[2]), *rest)


def parse_parameter(message: Message) -> ParameterValue | None:
    """P1; None for anything else. Its value may be NaN or infinite."""
    if not isinstance(message, ReplyFrame) or message.frame_id != PARAMETER_FRAME:
        return None
    if len(message.payload) < PARAMETERS.size:
        return None
    value, _, index, *_ = PARAMETERS.unpack_from(message.payload)
    return ParameterValue(index, value)


def parse_acknowledgement(message: Message) -> Acknowledgement | None:
    """K1; None for anything else."""
    if not isinstance(message, ReplyFrame) or len(message.payload) != ACKNOWLEDGEMENT.size:
        return None
    return Acknowledgement(*ACKNOWLEDGEMENT.unpack(message.payload))


# --- the device's side ------------------------------------------------------------------------------------------------


def pack_status(status: Status) -> bytes:
    """Payload of S1, up to the first member that is None."""
    head = _STATUS_HEAD.pack(status.software_version, status.hardware_version, status.model, *status.serial_number)
    rest = (
        status.system_status, status.cpu_load, status.drop_rate, status.i2c_master, status.voltage,
        status.user_config_status, status.calibration_status, status.imu_health,
    )  # fmt: skip
    there = next((n for n, value in enumerate(rest) if value is None), len(rest))
    values = [b"" if n == 7 else 0 for n in range(8)]
    values[:there] = [value for value in rest[:there] if value is not None]
    end = _STATUS_STEPS[there - 1] if there else STATUS_BYTES_MIN
    return (head + _STATUS_REST.pack(*values))[:end]


def pack_parameters(value: float, index: int) -> bytes:
    """Payload of P1 and of a command (R1). Raises OverflowError for a value beyond 32-bit floats."""
    return PARAMETERS.pack(value, 0.0, index, 0, 0, 0)


def pack_acknowledgement(command: int, result: int) -> bytes:
    """Payload of K1."""
    return ACKNOWLEDGEMENT.pack(command, result)


AHRS_FRAME_BYTES: Final = OVERHEAD_BYTES + 44

AHRS: Final = struct.Struct("<I10f")
"""timer µs, pitch roll yaw °, accel x y z g, gyro x y z °/s, temperature °C (table 4)."""
AHRS_FRAME: Final = 0x0002
TIMER_MODULUS: Final = 2**32

_HEAD: Final = HEADER.pack(DEVICE_SYNC, AHRS_FRAME, AHRS.size)
_ONLY: Final = struct.Struct(f"<{HEADER.size}xI10f{CRC_BYTES}x")  # the values of a whole frame
_ONLY_HIGH_BYTES: Final = slice(HEADER.size + 7, AHRS_FRAME_BYTES - CRC_BYTES, 4)
"""High bytes of the floats of a whole frame. An exponent of all ones (NaN, infinity) needs 0x7F or 0xFF there; finite
values above 1.7e38 have them too."""
_RUN: Final = re.compile(rb"(?s:%b.{%d})+" % (re.escape(_HEAD), AHRS_FRAME_BYTES - HEADER.size))
"""AHRS frames back to back by their headers."""
_RUN_PARTS: Final = struct.Struct(f"<{HEADER.size}x{AHRS.size}sI")  # payload and CRC
_RUN_SEED: Final = inverted_crc32(_HEAD, CRC_START)
_RUN_VALUES: Final = struct.Struct(("@" if sys.byteorder == "little" else "<") + "I10f")
"""AHRS in the machine's own layout: there `struct` reads a float in half the time."""
_RUN_HIGH_BYTES: Final = slice(3, None, 4)
"""High bytes of the timers and floats in payloads back to back; a timer's are 0x7F or 0xFF for 34 s of its 71.6
minutes."""
_HIGH_BYTES_APART: Final = slice(7, None, 4)
"""High bytes of the floats of a payload, without the timer's."""


class Imu61xCodec:
    """Decoder of bytes in any split into measurements and reply frames. Synchronization: one thread.

    Frames of an unknown kind are counted (`frames_ignored`) and dropped. Frames of a known kind that are too short are
    bad. A frame with NaN or infinity is delivered without the values concerned, after a `BadFrame` (not-finite) that
    reports it; its bytes and itself count as good.
    """

    def __init__(self, ledger: Ledger, _settings: Options | None = None) -> None:
        self.ledger = ledger
        self._finder = FrameFinder(ledger, DEVICE_SYNC)

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode bytes in the order they came; return what they completed. Never raises for any bytes."""
        if len(data) == AHRS_FRAME_BYTES and self._finder.idle and inverted_crc32(data, CRC_START) == CRC_INVERSION:
            high_bytes = data[_ONLY_HIGH_BYTES]
            if data.startswith(_HEAD) and 0x7F not in high_bytes and 0xFF not in high_bytes:
                ledger = self.ledger
                ledger.bytes_in += AHRS_FRAME_BYTES
                ledger.bytes_in_good_frames += AHRS_FRAME_BYTES
                ledger.frames_good += 1
                ledger.frames_in_samples += 1
                return _finite_measurements((_ONLY.unpack(data),), AHRS_FRAME_BYTES, 0)
        return self._decode(data)

    def flush(self) -> Sequence[CodecEvent]:
        """Return whole frames that wait inside a longer frame that never came. Called when the line is idle."""
        events: list[CodecEvent] = []
        self._add_found(self._finder.flush(), events)
        return events

    def reset(self) -> None:
        """Skip what is pending: the stream broke."""
        self._finder.reset()

    def _decode(self, data: bytes) -> Sequence[CodecEvent]:
        events: list[CodecEvent] = []
        self._add_found(self._finder.feed_rest(data, lambda data: self._decode_run(data, events)), events)
        return events

    def _decode_run(self, data: bytes, events: list[CodecEvent]) -> int:
        """Decode AHRS frames back to back at the begin, up to one that is damaged or not finite; return their size."""
        run = _RUN.match(data)
        if run is None:
            return 0
        size, seed, crc_of = AHRS_FRAME_BYTES, _RUN_SEED, inverted_crc32
        payloads: list[bytes] = []
        keep = payloads.append
        for payload, crc in _RUN_PARTS.iter_unpack(run[0]):
            if crc_of(payload, seed) ^ CRC_INVERSION != crc:
                break
            keep(payload)
        joined = b"".join(payloads)
        high_bytes = joined[_RUN_HIGH_BYTES]
        if 0x7F in high_bytes or 0xFF in high_bytes:
            finite: list[bytes] = list(takewhile(_is_finite, payloads))
            joined = b"".join(finite)
        count = len(joined) // AHRS.size
        events += _finite_measurements(_RUN_VALUES.iter_unpack(joined), size, len(data) - size)
        ledger = self.ledger
        ledger.bytes_in_good_frames += count * size
        ledger.frames_good += count
        ledger.frames_in_samples += count
        return count * size

    def _add_found(self, found: Sequence[Frame | BadFrame], events: list[CodecEvent]) -> None:
        for frame in found:
            if isinstance(frame, BadFrame):
                events.append(frame)
            else:
                self._add_frame(frame, events)

    def _add_frame(self, frame: Frame, events: list[CodecEvent]) -> None:
        """Count a frame whose CRC matches, and add the event that it is."""
        ledger, size = self.ledger, len(frame.raw)
        reply = is_reply(frame.frame_id, frame.payload)
        measured = frame.frame_id == AHRS_FRAME and not reply
        if (measured and len(frame.payload) < AHRS.size) or (not reply and frame.frame_id in _REPLY_FRAMES):
            ledger.frames_bad_content += 1
            ledger.bytes_in_bad_frames += size
            events.append(BadFrame(BadReason.CONTENT, frame.raw))
            return
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if reply:
            ledger.frames_in_replies += 1
            events.append(ReplyFrame(frame.frame_id, frame.payload))
        elif measured:
            ledger.frames_in_samples += 1
            self._measure(frame, events)
        else:
            ledger.frames_ignored += 1

    def _measure(self, frame: Frame, events: list[CodecEvent]) -> None:
        values = AHRS.unpack_from(frame.payload)
        size, trailing = len(frame.raw), frame.trailing_bytes
        if isfinite(sum(values)):  # 32-bit floats cannot add up to a 64-bit infinity
            events += _finite_measurements((values,), size, trailing)
            return
        self.ledger.frames_not_finite += 1
        events.append(BadFrame(BadReason.NOT_FINITE, frame.raw))
        events.append(_partial_measurement(values, size, trailing))


_REPLY_FRAMES: Final = (STATUS_FRAME, PARAMETER_FRAME)


def _is_finite(payload: bytes) -> bool:
    high_bytes = payload[_HIGH_BYTES_APART]
    return 0x7F not in high_bytes and 0xFF not in high_bytes


def _finite_measurements(frames: Iterable[Sequence[Any]], size: int, trailing: int) -> list[Measurement]:
    """AHRS frames back to back by their values, all of which are finite; `trailing` bytes follow the first frame.

    The quaternion is `quat_from_euler_zyx`, written out for speed: a call is a twentieth of the cost of a frame.
    """
    made: list[Measurement] = []
    keep, make, g, rad, cosine, sine = made.append, Measurement, M_S2_PER_G, RAD_PER_DEG, cos, sin
    for us, pitch_deg, roll_deg, yaw_deg, ax, ay, az, gx, gy, gz, temperature_c in frames:
        roll, pitch, yaw = roll_deg * rad, pitch_deg * rad, yaw_deg * rad
        half_roll, half_pitch, half_yaw = roll * 0.5, pitch * 0.5, yaw * 0.5
        cr, sr, cp, sp = cosine(half_roll), sine(half_roll), cosine(half_pitch), sine(half_pitch)
        cy, sy = cosine(half_yaw), sine(half_yaw)
        cc, ss, cs, sc = cy * cp, sy * sp, cy * sp, sy * cp
        keep(
            make(
                size, trailing, us,
                (ax * g, ay * g, az * g), (gx * rad, gy * rad, gz * rad), None,
                (cc * cr + ss * sr, cc * sr - ss * cr, cs * cr + sc * sr, sc * cr - cs * sr),
                (roll, pitch, yaw), temperature_c,
            )
        )  # fmt: skip
        trailing -= size
    return made


def _partial_measurement(values: Sequence[Any], size: int, trailing: int) -> Measurement:
    """The same without the groups of values of which one is NaN or infinite."""
    us, pitch, roll, yaw = values[:4]
    euler = scaled((roll, pitch, yaw), RAD_PER_DEG)
    return Measurement(
        size, trailing, us,
        accel_m_s2=scaled(values[4:7], M_S2_PER_G),
        gyro_rad_s=scaled(values[7:10], RAD_S_PER_DEG_S),
        quat_wxyz=None if euler is None else quat_from_euler_zyx(euler),
        euler_rad=euler,
        temperature_c=values[10] if isfinite(values[10]) else None,
    )  # fmt: skip


# --- the device's side ------------------------------------------------------------------------------------------------

K1_FRAME: Final = 0x000C
"""Id under which the simulator sends K1; no source has it, the codec takes any."""


def encode_ahrs(
    *, timer_us: int, accel_m_s2: Vector3, gyro_rad_s: Vector3, euler_rad: Vector3, temperature_c: float
) -> bytes:
    """A whole AHRS frame from SI values, `euler_rad` roll, pitch, yaw; time wraps. Raises OverflowError beyond f32."""
    roll, pitch, yaw = euler_rad
    payload = AHRS.pack(
        timer_us % TIMER_MODULUS,
        *(angle / RAD_PER_DEG for angle in (pitch, roll, yaw)),
        *(a / M_S2_PER_G for a in accel_m_s2),
        *(w / RAD_S_PER_DEG_S for w in gyro_rad_s),
        temperature_c,
    )
    return encode_frame(DEVICE_SYNC, AHRS_FRAME, payload)


def encode_status(status: Status) -> bytes:
    """A whole S1 frame."""
    return encode_frame(DEVICE_SYNC, STATUS_FRAME, pack_status(status))


def encode_parameter(index: int, value: float) -> bytes:
    """A whole P1 frame."""
    return encode_frame(DEVICE_SYNC, PARAMETER_FRAME, pack_parameters(value, index))


def encode_acknowledgement(command: int, result: int = RESULT_DONE, frame_id: int = K1_FRAME) -> bytes:
    """A whole K1 frame."""
    return encode_frame(DEVICE_SYNC, frame_id, pack_acknowledgement(command, result))
