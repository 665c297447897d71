"""CAN frames (ISO 11898-1), filters, the kernel's 16-byte `struct can_frame`, and candump logs.

A link delivers frames to a codec as `CanFrame`. It sends frames as `struct can_frame`, so that a command consists of
bytes on every kind of link.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple

from imud.model.units import NS_PER_S

DATA_BYTES_MAX: Final = 8  # maximum number of data bytes of a classical CAN frame (ISO 11898-1)
STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF
# Flag in the identifier of `struct can_frame`: 29 bits (CAN_EFF_FLAG of linux/can.h)
EXTENDED_FLAG: Final = 0x8000_0000
REMOTE_FLAG: Final = 0x4000_0000  # flag in the identifier: a remote frame, without data (CAN_RTR_FLAG)
# Flag in the identifier: an error frame of the controller, not a frame of the bus (CAN_ERR_FLAG)
ERROR_FLAG: Final = 0x2000_0000

# `struct can_frame` in the byte order of the host: identifier with flags, length, data
RAW_FRAME: Final = struct.Struct("=IB3x8s")
STANDARD_OVERHEAD_BITS, EXTENDED_OVERHEAD_BITS = 47, 67
"""Length of a frame without data and stuff bits, with three bits of interframe space (ISO 11898-1), for 11 and 29
bits.
"""


class CanFrame(NamedTuple):
    """Received data frame."""

    can_id: int  # identifier without flags
    extended: bool  # whether the identifier has 29 bits
    data: bytes
    t_rx_ns: int  # arrival time, CLOCK_MONOTONIC, ns: the time stamp of the kernel if it exists
    after_loss: bool = False  # whether frames were lost immediately before this frame


@dataclass(frozen=True, slots=True)
class CanFilter:
    """Filter for identifiers that are equal to `can_id` in the bits of `mask`."""

    can_id: int
    mask: int
    extended: bool

    def matches(self, can_id: int, extended: bool) -> bool:
        """Return whether a frame passes the filter."""
        return extended == self.extended and not (can_id ^ self.can_id) & self.mask

    def overlaps(self, other: "CanFilter") -> bool:
        """Return whether a frame exists that passes both filters."""
        return self.extended == other.extended and not (self.can_id ^ other.can_id) & self.mask & other.mask


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """Frame that imud sends periodically because devices need it, for example CANopen SYNC. One device of a bus
    requests the frame for all devices. imud rejects a second device with the same identifier."""

    can_id: int
    extended: bool
    data: bytes
    every_ns: int  # period in whole microseconds. imud sends the first frame immediately.


def frame_bits(extended: bool, data_bytes: int) -> int:
    """Return the bits of a frame on the wire with interframe space. Stuff bits add up to 22 %."""
    return (EXTENDED_OVERHEAD_BITS if extended else STANDARD_OVERHEAD_BITS) + 8 * data_bytes


def pack_frame(can_id: int, extended: bool, data: bytes) -> bytes:
    """Return a frame as `struct can_frame`. Raises ValueError for an identifier or a length out of range."""
    if not 0 <= can_id <= (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) or len(data) > DATA_BYTES_MAX:
        raise ValueError(f"invalid CAN frame: identifier {can_id:#x}{' (29 bits)' * extended}, {len(data)} data bytes")
    return RAW_FRAME.pack(can_id | EXTENDED_FLAG if extended else can_id, len(data), data)


# Maximum length of a line, bytes. CAN FD with 64 data bytes and a long bus name needs about 190.
LINE_BYTES_MAX: Final = 512
_FRAME: Final = re.compile(
    rb"\((\d{1,18})\.(\d{1,9})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#((?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?"
    rb"(?: [RT])?\s*"
)
_OTHER: Final = re.compile(
    rb"\(\d{1,18}\.\d{1,9}\) +\S+ +[0-9A-Fa-f]{3,8}#(?:#[0-9A-Fa-f]+|R[\dA-Fa-f_]*)(?: [RT])?\s*"
)


class CandumpReader:
    """Reader of a candump log from a binary stream. Iterate once. `t_rx_ns` is the time in the log, never falling."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.passed_over = 0  # number of valid lines without a data frame
        self.bad_lines = 0
        self.first_bad = 0  # number of the first invalid line, starting at 1; 0 if all lines are valid

    @property
    def problem(self) -> str:
        """Error of the file after the iteration, one sentence; empty if there is no error."""
        if not self.bad_lines:
            return ""
        return f"expected a candump log (candump -L), got {self.bad_lines} invalid lines (first: line {self.first_bad})"

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
            # the clock can step backwards during the log
            newest_ns = max(newest_ns, int(seconds) * NS_PER_S + int(fraction.ljust(9, b"0")))
            yield CanFrame(can_id, len(digits) == 8, bytes.fromhex(data.decode("ascii")), newest_ns)

    def _note(self, line: bytes, number: int, *, passed: bool = False) -> None:
        if passed or _OTHER.fullmatch(line):
            self.passed_over += 1
        elif line.strip():
            self.bad_lines += 1
            self.first_bad = self.first_bad or number
