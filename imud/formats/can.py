"""CAN frames (ISO 11898-1), filters, and the kernel's 16-byte `struct can_frame`.

Frames travel between a link and a codec as `CanFrame`, and to a link as `struct can_frame`, so that a command is bytes
on every kind of link.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple

from imud.model.units import NS_PER_S

DATA_BYTES_MAX: Final = 8
"""Data bytes of a classical CAN frame (ISO 11898-1)."""
STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF
EXTENDED_FLAG: Final = 0x8000_0000
"""Flag in the identifier of `struct can_frame`: 29 bits (CAN_EFF_FLAG of linux/can.h)."""
REMOTE_FLAG: Final = 0x4000_0000
"""Flag there: a remote frame, without data (CAN_RTR_FLAG)."""
ERROR_FLAG: Final = 0x2000_0000
"""Flag there: an error frame of the controller, no frame of the bus (CAN_ERR_FLAG)."""

RAW_FRAME: Final = struct.Struct("=IB3x8s")
"""`struct can_frame` in the machine's byte order: identifier with flags, length, data."""
STANDARD_OVERHEAD_BITS, EXTENDED_OVERHEAD_BITS = 47, 67
"""Bits of a frame without its data and stuff bits, with the interframe space of three bits (ISO 11898-1), for
identifiers of 11 and of 29 bits."""


class CanFrame(NamedTuple):
    """A data frame as received."""

    can_id: int
    """Identifier without flags."""
    extended: bool
    """Whether the identifier has 29 bits."""
    data: bytes
    t_rx_ns: int
    """CLOCK_MONOTONIC of its arrival, ns: the kernel's time stamp where there is one."""
    after_loss: bool = False
    """Whether frames are known to be missing right before it."""


@dataclass(frozen=True, slots=True)
class CanFilter:
    """Frames that a device needs: those whose identifier agrees with `can_id` in the bits of `mask`."""

    can_id: int
    mask: int
    extended: bool

    def matches(self, can_id: int, extended: bool) -> bool:
        """Whether a frame passes the filter."""
        return extended == self.extended and not (can_id ^ self.can_id) & self.mask

    def overlaps(self, other: "CanFilter") -> bool:
        """Whether some frame passes both filters."""
        return self.extended == other.extended and not (self.can_id ^ other.can_id) & self.mask & other.mask


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """A frame that imud sends at a fixed period because devices need it, such as CANopen SYNC.

    One device of a bus has it sent for all of them: a second one with a frame of the same identifier is refused.
    """

    can_id: int
    extended: bool
    data: bytes
    every_ns: int
    """Period in whole microseconds; the first frame is sent at once."""


def frame_bits(extended: bool, data_bytes: int) -> int:
    """Length of a frame on the wire in bits, interframe space included; stuff bits make it up to 22 % longer."""
    return (EXTENDED_OVERHEAD_BITS if extended else STANDARD_OVERHEAD_BITS) + 8 * data_bytes


def pack_frame(can_id: int, extended: bool, data: bytes) -> bytes:
    """A frame as `struct can_frame`. Raises ValueError for an identifier or a length out of range."""
    if not 0 <= can_id <= (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) or len(data) > DATA_BYTES_MAX:
        raise ValueError(f"no CAN frame: identifier {can_id:#x}{' (29 bits)' * extended}, {len(data)} data bytes")
    return RAW_FRAME.pack(can_id | EXTENDED_FLAG if extended else can_id, len(data), data)


LINE_BYTES_MAX: Final = 512
"""The longest line, CAN FD with 64 bytes and a long bus name, has some 190."""
_FRAME: Final = re.compile(
    rb"\((\d{1,18})\.(\d{1,9})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#((?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?"
    rb"(?: [RT])?\s*"
)
_OTHER: Final = re.compile(
    rb"\(\d{1,18}\.\d{1,9}\) +\S+ +[0-9A-Fa-f]{3,8}#(?:#[0-9A-Fa-f]+|R[\dA-Fa-f_]*)(?: [RT])?\s*"
)


class CandumpReader:
    """Reader of a log from any binary stream. Iterate once: frames with the log's times as `t_rx_ns`, never falling."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.passed_over = 0
        """Valid lines that are no data frame."""
        self.bad_lines = 0
        self.first_bad = 0
        """Number of the first line that is none of a log, from 1; 0 when there is none."""

    @property
    def problem(self) -> str:
        """After iterating: the fault of the file, one sentence; empty when it has none."""
        if not self.bad_lines:
            return ""
        return f"{self.bad_lines} lines are none of a candump log (candump -L), the first is line {self.first_bad}"

    def __iter__(self) -> Iterator[CanFrame]:
        newest_ns, number = 0, 0
        while line := self._file.readline(LINE_BYTES_MAX):
            number += 1
            match = _FRAME.fullmatch(line)
            if match is None:
                self._note(line, number)
                continue
            seconds, fraction, _, digits, data = match.groups()
            can_id = int(digits, 16)
            if can_id & ERROR_FLAG or can_id > EXTENDED_ID_MAX or (len(digits) == 3 and can_id > STANDARD_ID_MAX):
                self._note(line if can_id & ERROR_FLAG else b"bad", number, passed=bool(can_id & ERROR_FLAG))
                continue
            newest_ns = max(newest_ns, int(seconds) * NS_PER_S + int(fraction.ljust(9, b"0")))
            yield CanFrame(can_id, len(digits) == 8, bytes.fromhex(data.decode("ascii")), newest_ns)

    def _note(self, line: bytes, number: int, *, passed: bool = False) -> None:
        if passed or _OTHER.fullmatch(line):
            self.passed_over += 1
        elif line.strip():
            self.bad_lines += 1
            self.first_bad = self.first_bad or number
