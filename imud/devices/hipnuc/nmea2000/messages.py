"""Three PGNs of NMEA 2000 as any heading or attitude sensor sends them: layouts, scales, "not available" values.

    127250 Vessel Heading  | SID u8 | heading u16 | deviation i16 | variation i16 | reference 2 bits, 6 reserved |
    127251 Rate of Turn    | SID u8 | rate i32 | 3 reserved |
    127257 Attitude        | SID u8 | yaw i16 | pitch i16 | roll i16 | 1 reserved |

Little-endian; one count is 1e-4 rad, of rate 1e-6/32 rad/s. The highest value of a field means "not available", the one
below "out of range", the next is reserved: what says one of them is absent. HiPNUC's manual (chapter 7) defines nothing
of its own.

Frames. Heading, yaw and rate are clockwise seen from above and heading is 0 … 2π from north; pitch is positive with the
bow up, roll with the starboard side down, in the order yaw, pitch, roll. imud's sensor frame is x to starboard, y to
the bow, z up, its navigation frame ENU, its order 312, which is the same one: roll and pitch keep their values,
yaw = -heading, and gyro z = -rate. What is not sent (the other two rates, say) is NaN in a vector of which a part is.
"""

import struct
from collections.abc import Sequence
from enum import IntEnum
from math import isfinite, nan, pi, tau
from typing import Final, NamedTuple

from imud.attitude import quat_from_euler312
from imud.sample import Measurement, Vector3

HEADING, RATE_OF_TURN, ATTITUDE = 127250, 127251, 127257
PGNS: Final = (HEADING, RATE_OF_TURN, ATTITUDE)
PRIORITIES: Final = {HEADING: 2, RATE_OF_TURN: 2, ATTITUDE: 3}
"""Defaults of the standard."""
MESSAGE_BYTES: Final = 8

HEADING_LAYOUT: Final = struct.Struct("<BHhhB")
RATE_LAYOUT: Final = struct.Struct("<Bi3x")
ATTITUDE_LAYOUT: Final = struct.Struct("<BhhhB")
RAD_PER_LSB: Final = 1e-4
RATE_RAD_S_PER_LSB: Final = 1e-6 / 32

I16_MOST, U16_MOST, I32_MOST, SID_MOST = 0x7FFC, 0xFFFC, 0x7FFF_FFFC, 252
"""Highest counts that are values."""


class Reference(IntEnum):
    """North to which a heading refers."""

    TRUE = 0
    MAGNETIC = 1
    ERROR = 2
    UNKNOWN = 3


class Head(NamedTuple):
    """Header of a message: all that is known before its values."""

    sid: int | None
    """Number of the instant, the same in all messages of one; None where the sender has none."""
    reference: Reference | None
    """Of a heading."""


def head_of(pgn: int, data: bytes) -> Head:
    """Decode the header of a message of eight bytes."""
    reference = Reference(data[7] & 3) if pgn == HEADING else None
    return Head(data[0] if data[0] <= SID_MOST else None, reference)


def measurement_of(messages: Sequence[tuple[int, bytes]], *, heading_elsewhere: bool = False) -> Measurement:
    """Make one sample of messages (PGN, data) of one instant, each PGN at most once.

    Yaw is that of the heading, else that of the attitude, but for a device that sends its heading in other samples.
    """
    roll = pitch = yaw = rate = nan
    has_heading = heading_elsewhere
    for pgn, data in messages:
        if pgn == HEADING:
            _, heading, _, _, reference = HEADING_LAYOUT.unpack(data)
            has_heading = True
            is_good = heading <= U16_MOST and reference & 3 != Reference.ERROR
            yaw = _counter_clockwise(heading) if is_good else nan
        elif pgn == RATE_OF_TURN:
            _, counts = RATE_LAYOUT.unpack(data)
            rate = -counts * RATE_RAD_S_PER_LSB if counts <= I32_MOST else nan
        else:
            _, clockwise, pitch_counts, roll_counts, _ = ATTITUDE_LAYOUT.unpack(data)
            roll, pitch = _angle(roll_counts), _angle(pitch_counts)
            if not has_heading and clockwise <= I16_MOST:
                yaw = _counter_clockwise(clockwise)
    euler = (roll, pitch, yaw)
    is_whole = isfinite(roll + pitch + yaw)
    return Measurement(
        MESSAGE_BYTES * len(messages), 0, None,
        gyro_rad_s=(nan, nan, rate) if isfinite(rate) else None,
        quat_wxyz=quat_from_euler312(euler) if is_whole else None,
        euler_rad=euler if is_whole or any(map(isfinite, euler)) else None,
    )  # fmt: skip


def _angle(counts: int) -> float:
    return counts * RAD_PER_LSB if counts <= I16_MOST else nan


def _counter_clockwise(clockwise: int) -> float:
    """Yaw in ±π of a clockwise angle in counts."""
    angle = -clockwise * RAD_PER_LSB
    return angle if -pi <= angle <= pi else (angle + pi) % tau - pi


# --- the device's side ------------------------------------------------------------------------------------------------


def pack_heading(sid: int, yaw_rad: float | None, reference: Reference) -> bytes:
    """Pack 127250 of a counter-clockwise yaw, without deviation and variation; None is "not available"."""
    counts = 0xFFFF if yaw_rad is None else round(-yaw_rad % tau / RAD_PER_LSB)
    return HEADING_LAYOUT.pack(sid, counts, 0x7FFF, 0x7FFF, 0xFC | reference)


def pack_rate_of_turn(sid: int, gyro_z_rad_s: float | None) -> bytes:
    """Pack 127251 of a counter-clockwise rate."""
    counts = 0x7FFF_FFFF if gyro_z_rad_s is None else _clip(-gyro_z_rad_s / RATE_RAD_S_PER_LSB, I32_MOST)
    return RATE_LAYOUT.pack(sid, counts)[:5] + b"\xff\xff\xff"


def pack_attitude(sid: int, euler_rad: Vector3, *, has_yaw: bool = True) -> bytes:
    """Pack 127257 of roll, pitch and a counter-clockwise yaw."""
    roll, pitch, yaw = (_clip(angle / RAD_PER_LSB, I16_MOST) for angle in euler_rad)
    return ATTITUDE_LAYOUT.pack(sid, -yaw if has_yaw else 0x7FFF, pitch, roll, 0xFF)


def _clip(value: float, most: int) -> int:
    return max(-most, min(most, round(value)))
