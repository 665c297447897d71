"""CAN frames (ISO 11898-1), filters, and the kernel's 16-byte `struct can_frame`.

Frames travel between a link and a codec as `CanFrame`, and to a link as `struct can_frame`, so that a command is bytes
on every kind of link.
"""

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

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
