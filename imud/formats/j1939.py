"""29-bit identifiers of SAE J1939 and NMEA 2000. SAE J1939-21, section 5.2.

    28      26   25    24   23          16 15          8 7         0
    +---------+-----+----+---------------+-------------+----------+
    | priority| EDP | DP | PF            | PS          | source   |
    +---------+-----+----+---------------+-------------+----------+

PF below 240 (PDU1): PS is the destination address and not part of the parameter group number (PGN). PF from 240 (PDU2):
PS is part of the PGN, and the message is a broadcast. The PGN is EDP, DP, PF, PS. Priority decides only the arbitration
on the bus. Receivers ignore it.
"""

from collections.abc import Container
from typing import Final, NamedTuple

from imud.formats.can import DATA_BYTES_MAX, CanFilter

GLOBAL: Final = 0xFF  # destination address of broadcasts
ADDRESS_MAX: Final = 253  # maximum address of a node
NULL_ADDRESS: Final = 254  # source of "cannot claim"
PDU2_MIN: Final = 240  # minimum PF of broadcasts
PRIORITY_MAX: Final = 7
PGN_MAX: Final = 0x3_FFFF
WITHOUT_PRIORITY: Final = 0x03FF_FFFF  # mask of an identifier without its priority
_WITHOUT_SOURCE: Final = WITHOUT_PRIORITY & ~0xFF

# PGNs of every node (J1939-21, J1939-81)
ACKNOWLEDGEMENT: Final = 59392  # 0xE800
REQUEST: Final = 59904  # 0xEA00: requests another PGN
TRANSPORT_DATA: Final = 60160  # 0xEB00: a part of a message of more than eight bytes
TRANSPORT_CONTROL: Final = 60416  # 0xEC00: its announcement
CLAIMED: Final = 60928  # 0xEE00, "address claimed" (J1939-81), a broadcast
COMMANDED_ADDRESS: Final = 65240  # 0xFED8: NAME and its new address
PGN_BYTES: Final = 3  # length of a PGN in the data of a frame


class J1939Id(NamedTuple):
    """Parts of a 29-bit identifier."""

    priority: int  # 0 is the highest, 7 the lowest priority
    pgn: int  # PGN; its low byte is 0 if the identifier contains a destination
    source: int
    destination: int = GLOBAL


def split(can_id: int) -> J1939Id:
    """Return the parts of a 29-bit identifier."""
    pgn, destination = can_id >> 8 & PGN_MAX, GLOBAL
    if pgn >> 8 & 0xFF < PDU2_MIN:
        pgn, destination = pgn & ~0xFF, pgn & 0xFF
    return J1939Id(can_id >> 26 & PRIORITY_MAX, pgn, can_id & 0xFF, destination)


def join(parts: J1939Id) -> int:
    """Return the identifier. Raises ValueError for parts out of range, or a destination with a PDU2 number."""
    priority, pgn, source, destination = parts
    is_for_one = pgn >> 8 & 0xFF < PDU2_MIN
    if not (0 <= priority <= PRIORITY_MAX and 0 <= pgn <= PGN_MAX and 0 <= source <= 0xFF and 0 <= destination <= 0xFF):
        raise ValueError(f"invalid J1939 identifier: {parts}")
    if pgn & 0xFF if is_for_one else destination != GLOBAL:
        raise ValueError(
            f"invalid J1939 identifier: PGN {pgn:#x} {'ends in 00' if is_for_one else 'is a broadcast'}, got {parts}"
        )
    return priority << 26 | (pgn | destination if is_for_one else pgn) << 8 | source


def sender_of(can_id: int, extended: bool, data: bytes, pgns: Container[int]) -> int | None:
    """Return the node that sent a frame of eight bytes with one of these PGNs; None for all other frames."""
    parts = split(can_id)
    is_one = extended and parts.pgn in pgns and len(data) == DATA_BYTES_MAX
    return parts.source if is_one and parts.source <= ADDRESS_MAX else None


def all_of(source: int | None) -> CanFilter:
    """Return the filter for all frames of one node; None: of all nodes."""
    return CanFilter(source or 0, 0 if source is None else 0xFF, True)


def pgn_name(pgn: int) -> str:
    """Return the readable name of a PGN."""
    return f"PGN {pgn} (0x{pgn:04X})"


def filter_of(pgn: int, source: int | None, destination: int = GLOBAL) -> CanFilter:
    """Return the filter for one PGN with any priority from one node; None: from any node."""
    can_id = join(J1939Id(0, pgn, source or 0, destination))
    return CanFilter(can_id, _WITHOUT_SOURCE if source is None else WITHOUT_PRIORITY, True)


# --- broadcasts of several frames (SAE J1939-21, section 5.10) ------------------------------------------------------

BROADCAST: Final = 32  # control byte of the announcement (TP.CM_BAM)
TRANSPORT_BYTES: Final = 7  # data bytes of a frame
PART_TIMEOUT_NS: Final = 750_000_000  # maximum time between two frames (T1), ns


class Announced(NamedTuple):
    """Announced broadcast with its present content."""

    source: int
    data: bytes
    t_ns: int  # arrival time of the newest frame


class BroadcastReader:
    """Assembly of the broadcasts with one PGN of a known length. It keeps the newest broadcast only, because hostile
    frames must not use memory."""

    def __init__(self, pgn: int, size: int) -> None:
        self._announced = bytes((BROADCAST, size, 0, -(-size // TRANSPORT_BYTES), 0xFF)) + pgn.to_bytes(
            PGN_BYTES, "little"
        )
        self._size = size
        self._present: Announced | None = None

    def announce(self, source: int, data: bytes, t_ns: int) -> None:
        """Add an announcement. Ignore other PGNs and lengths."""
        if data == self._announced:
            self._present = Announced(source, b"", t_ns)

    def add(self, source: int, data: bytes, t_ns: int) -> bytes | None:
        """Add a data frame. Return the complete message; None before its end, and after a frame that does not fit."""
        present = self._present
        if present is None or source != present.source:
            return None
        self._present = None
        number = len(present.data) // TRANSPORT_BYTES + 1
        if len(data) != DATA_BYTES_MAX or data[0] != number or t_ns - present.t_ns > PART_TIMEOUT_NS:
            return None
        whole = present.data + data[1:]
        if len(whole) >= self._size:
            return whole[: self._size]
        self._present = present._replace(data=whole, t_ns=t_ns)
        return None
