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
from collections.abc import Iterable, Sequence
from itertools import takewhile
from math import cos, isfinite, sin
from typing import Any, Final
from zlib import crc32 as inverted_crc32

from imud.attitude import quat_from_euler_zyx
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, ReplyFrame
from imud.contracts.settings import Settings
from imud.devices.imu61x.common.family import CRC_INVERSION, CRC_START, M_S2_PER_G, RAD_S_PER_DEG_S, scaled
from imud.devices.imu61x.uart.commands import AHRS_FRAME_BYTES
from imud.devices.imu61x.uart.framing import CRC_BYTES, DEVICE_SYNC, HEADER, Frame, FrameFinder, encode_frame
from imud.devices.imu61x.uart.replies import (
    PARAMETER_FRAME,
    RESULT_DONE,
    STATUS_FRAME,
    Status,
    is_reply,
    pack_acknowledgement,
    pack_parameters,
    pack_status,
)
from imud.ledger import Ledger
from imud.sample import Measurement, Vector3
from imud.units import RAD_PER_DEG

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

    def __init__(self, ledger: Ledger, _settings: Settings | None = None) -> None:
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
