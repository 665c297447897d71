"""The 29-bit identifiers of SAE J1939 and NMEA 2000, which is built on it. SAE J1939-21, section 5.2.

    28      26   25    24   23          16 15          8 7         0
    +---------+-----+----+---------------+-------------+----------+
    | priority| EDP | DP | PF            | PS          | source   |
    +---------+-----+----+---------------+-------------+----------+

PF below 240 (PDU1): PS is the destination address, and no part of the number. From 240 on (PDU2) PS is part of the
number, and the message is a broadcast. The parameter group number (PGN) is EDP, DP, PF, PS. Priority only decides the
arbitration on the bus; receivers ignore it.
"""

from collections.abc import Container
from typing import Final, NamedTuple

from imud.formats.can import DATA_BYTES_MAX, CanFilter

GLOBAL: Final = 0xFF
"""Destination address of broadcasts."""
ADDRESS_MAX: Final = 253
"""Highest address of a node; 254 is the null address, of nodes that have none."""
PDU2_MIN: Final = 240
"""First PF of broadcasts."""
PRIORITY_MAX: Final = 7
PGN_MAX: Final = 0x3_FFFF
WITHOUT_PRIORITY: Final = 0x03FF_FFFF
"""Mask of an identifier without its priority, which distinguishes no messages."""
_WITHOUT_SOURCE: Final = WITHOUT_PRIORITY & ~0xFF


class J1939Id(NamedTuple):
    """An identifier, split."""

    priority: int
    """0 is the highest, 7 the lowest."""
    pgn: int
    """PGN; its low byte is 0 where a destination stands in the identifier."""
    source: int
    destination: int = GLOBAL


def split(can_id: int) -> J1939Id:
    """The parts of a 29-bit identifier."""
    pgn, destination = can_id >> 8 & PGN_MAX, GLOBAL
    if pgn >> 8 & 0xFF < PDU2_MIN:
        pgn, destination = pgn & ~0xFF, pgn & 0xFF
    return J1939Id(can_id >> 26 & PRIORITY_MAX, pgn, can_id & 0xFF, destination)


def join(parts: J1939Id) -> int:
    """The identifier. Raises ValueError for parts out of range, or a destination with a PDU2 number."""
    priority, pgn, source, destination = parts
    is_for_one = pgn >> 8 & 0xFF < PDU2_MIN
    if not (0 <= priority <= PRIORITY_MAX and 0 <= pgn <= PGN_MAX and 0 <= source <= 0xFF and 0 <= destination <= 0xFF):
        raise ValueError(f"no J1939 identifier: {parts}")
    if pgn & 0xFF if is_for_one else destination != GLOBAL:
        raise ValueError(
            f"no J1939 identifier: PGN {pgn:#x} {'ends in 00' if is_for_one else 'is for all'}, got {parts}"
        )
    return priority << 26 | (pgn | destination if is_for_one else pgn) << 8 | source


def sender_of(can_id: int, extended: bool, data: bytes, pgns: Container[int]) -> int | None:
    """The node that sent one of these messages of eight bytes, None for any other frame."""
    parts = split(can_id)
    is_one = extended and parts.pgn in pgns and len(data) == DATA_BYTES_MAX
    return parts.source if is_one and parts.source <= ADDRESS_MAX else None


def filter_of(pgn: int, source: int | None, destination: int = GLOBAL) -> CanFilter:
    """Messages of one kind, with any priority, from one node or (None) from any."""
    can_id = join(J1939Id(0, pgn, source or 0, destination))
    return CanFilter(can_id, _WITHOUT_SOURCE if source is None else WITHOUT_PRIORITY, True)
