"""Messages of NMEA 2000 for heading and attitude, and the messages of a node of the network.

The field definitions are from the public descriptions of NMEA 2000 and from ISO 11783-5 and SAE J1939-81. All fields
are little-endian. The maximum count of a type means "not available".

    single frame    up to 8 bytes
    fast packet     first frame: counter << 5, length, 6 bytes;  frame n: counter << 5 | n, 7 bytes, filled with FF
"""

import struct
from collections.abc import Sequence
from enum import IntEnum
from math import tau
from typing import Final

from imud.formats.j1939 import PGN_BYTES
from imud.model.units import NS_PER_MS

HEADING, RATE_OF_TURN, ATTITUDE = 127250, 127251, 127257
PRIORITIES: Final = {HEADING: 2, RATE_OF_TURN: 2, ATTITUDE: 3}  # default priorities of the standard
MESSAGE_BYTES: Final = 8

HEADING_LAYOUT: Final = struct.Struct("<BHhhB")
RATE_LAYOUT: Final = struct.Struct("<Bi3x")
ATTITUDE_LAYOUT: Final = struct.Struct("<BhhhB")
RAD_PER_LSB: Final = 1e-4
RATE_RAD_S_PER_LSB: Final = 1e-6 / 32

I16_MOST, I32_MOST, SID_MOST = 0x7FFC, 0x7FFF_FFFC, 252  # maximum counts that are values
HEADING_MOST: Final = 62_832  # maximum heading in counts: a full turn
NO_U16, NO_I16, NO_I32 = 0xFFFF, 0x7FFF, 0x7FFF_FFFF  # counts that mean "not available"


class Reference(IntEnum):
    """Reference of a heading."""

    TRUE = 0
    MAGNETIC = 1
    ERROR = 2
    UNKNOWN = 3


def pack_heading(
    sid: int, heading_rad: float | None, reference: Reference, variation_rad: float | None = None
) -> bytes:
    """Return 127250 of a clockwise heading, without deviation. `variation_rad`: positive to the east. None means "not
    available"."""
    # the modulus also after the rounding: 2π is 62,831.85 counts, and 62,832 counts are above a full turn
    counts = NO_U16 if heading_rad is None else round(heading_rad % tau / RAD_PER_LSB) % HEADING_MOST
    return HEADING_LAYOUT.pack(sid, counts, NO_I16, _i16(variation_rad), 0xFC | reference)


def pack_rate_of_turn(sid: int, rate_rad_s: float | None) -> bytes:
    """Return 127251 of a clockwise rate. None means "not available"."""
    counts = NO_I32 if rate_rad_s is None else _clip(rate_rad_s / RATE_RAD_S_PER_LSB, I32_MOST)
    return RATE_LAYOUT.pack(sid, counts)[:5] + b"\xff\xff\xff"


def pack_attitude(sid: int, roll_rad: float | None, pitch_rad: float | None, yaw_rad: float | None = None) -> bytes:
    """Return 127257. Roll is positive with the right side down, pitch with the bow up, yaw clockwise. None means "not
    available"."""
    return ATTITUDE_LAYOUT.pack(sid, _i16(yaw_rad), _i16(pitch_rad), _i16(roll_rad), 0xFF)


def _i16(angle_rad: float | None) -> int:
    return NO_I16 if angle_rad is None else _clip(angle_rad / RAD_PER_LSB, I16_MOST)


def _clip(value: float, most: int) -> int:
    return round(max(-most, min(most, value)))


# --- messages of a node (ISO 11783-5, SAE J1939-81) ----------------------------------------------------------------

PGN_LIST: Final = 126464
HEARTBEAT: Final = 126993
PRODUCT_INFORMATION: Final = 126996
CONFIGURATION_INFORMATION: Final = 126998

ADDRESS_LAST: Final = 251  # NMEA 2000 reserves the addresses 252 and 253
NAME_BYTES: Final = 8
UNIQUE_BITS: Final = 21  # bits of the unique number in a NAME

# Code of the manufacturer in the NAME. NMEA assigns codes to its licensees, but not to imud. Other open-source nodes
# use the unassigned code 2046 as well.
MANUFACTURER: Final = 2046
FUNCTION_OWNSHIP_ATTITUDE: Final = 140  # function "ownship attitude" of the class navigation
CLASS_NAVIGATION: Final = 60
INDUSTRY_MARINE: Final = 4


def pack_name(unique: int, instance: int = 0) -> int:
    """Return the NAME of an attitude sensor with an arbitrary address (SAE J1939-81, section 4.1).

    `unique`: 21 bits; `instance`: device instance, 8 bits. A smaller NAME has a higher priority.
    """
    return (
        unique % (1 << UNIQUE_BITS)
        | MANUFACTURER << 21
        | instance << 32
        | FUNCTION_OWNSHIP_ATTITUDE << 40
        | CLASS_NAVIGATION << 49
        | INDUSTRY_MARINE << 60
        | 1 << 63  # arbitrary address capable
    )


def pack_nack(requester: int, pgn: int) -> bytes:
    """Return 59392 with control 1: imud does not support the requested PGN."""
    return bytes((1, 0xFF, 0xFF, 0xFF, requester)) + pgn.to_bytes(PGN_BYTES, "little")


HEARTBEAT_NS_PER_LSB: Final = 10 * NS_PER_MS  # resolution of the period in a heartbeat, ns


def pack_heartbeat(period_ns: int, counter: int) -> bytes:
    """Return 126993: period, counter 0 … 252; controller error-active, no second controller, equipment operational."""
    return struct.pack("<HBB", period_ns // HEARTBEAT_NS_PER_LSB, counter, 0b1100_1100) + b"\xff" * 4


VERSION: Final = 2100  # version of the message definitions, 1/1000
NO_U8: Final = 0xFF
TEXT_BYTES: Final = 32  # length of a text in the product information


def pack_product(model: str, software: str, serial: str) -> bytes:
    """Return 126996. Product code, certification level and load of the bus are "not available": imud has neither a
    product code nor a certificate of NMEA, and the supply of the CAN adapter is unknown."""
    texts = b"".join(_fixed(text) for text in (model, software, "", serial))
    return struct.pack("<HH", VERSION, NO_U16) + texts + bytes((NO_U8, NO_U8))


def pack_configuration(first: str, second: str, manufacturer: str) -> bytes:
    """Return 126998: two descriptions of the installation, and information of the manufacturer, at most 70 characters
    each. A text is its length with two bytes for the header, 1 for ASCII, and the characters."""
    made = bytearray()
    for text in (first, second, manufacturer):
        data = _ascii(text)[:70]
        made += bytes((len(data) + 2, 1)) + data
    return bytes(made)


def pack_pgn_list(received: bool, pgns: Sequence[int]) -> bytes:
    """Return 126464: the PGNs that a node sends, or with `received` the PGNs that it accepts."""
    return bytes((int(received),)) + b"".join(pgn.to_bytes(PGN_BYTES, "little") for pgn in pgns)


def _ascii(text: str) -> bytes:
    return text.encode("ascii", "replace")


def _fixed(text: str) -> bytes:
    return _ascii(text)[:TEXT_BYTES].ljust(TEXT_BYTES, b"\xff")


FAST_BYTES_MAX: Final = 223  # maximum length of a fast packet: 6 bytes, then 31 times 7
_FIRST, _NEXT = 6, 7  # data bytes in the first frame, and in each other frame


def fast_packet(counter: int, data: bytes) -> list[bytes]:
    """Return the frames of a message of 1 … 223 bytes. `counter` distinguishes successive messages, modulo 8."""
    head = (counter & 7) << 5
    frames = [bytes((head, len(data))) + data[:_FIRST].ljust(_FIRST, b"\xff")]
    for number, at in enumerate(range(_FIRST, len(data), _NEXT), 1):
        frames.append(bytes((head | number,)) + data[at : at + _NEXT].ljust(_NEXT, b"\xff"))
    return frames
