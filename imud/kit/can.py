"""What a CAN device is to the rest of imud: frames, the codec that takes them, and the row a device file ends with.

Frames travel between a link and a codec as `CanFrame`, and to a link as the kernel's 16-byte `struct can_frame`, so
that a command is bytes on every kind of link.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Final, NamedTuple, Protocol

from imud.kit.codec import CodecEvent
from imud.kit.driver import Driver, Identity
from imud.kit.session import Conversation
from imud.ledger import Ledger

DATA_BYTES_MAX: Final = 8
"""Data bytes of a classical CAN frame (ISO 11898-1)."""
STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF
EXTENDED_FLAG: Final = 0x8000_0000
"""In the identifier of `struct can_frame`: 29 bits (CAN_EFF_FLAG of linux/can.h)."""
REMOTE_FLAG: Final = 0x4000_0000
"""The same: a request without data (CAN_RTR_FLAG)."""
ERROR_FLAG: Final = 0x2000_0000
"""The same: news of the controller, no frame of the bus (CAN_ERR_FLAG)."""

RAW_FRAME: Final = struct.Struct("=IB3x8s")
"""`struct can_frame` in the machine's byte order: identifier with flags, length, data."""
STANDARD_OVERHEAD_BITS, EXTENDED_OVERHEAD_BITS = 47, 67
"""Bits of a frame besides its data, the pause of three bits behind it included, stuff bits not (ISO 11898-1): with an
identifier of 11 bits, and of 29."""


class CanFrame(NamedTuple):
    """One data frame as received."""

    can_id: int
    """Identifier without flags."""
    extended: bool
    """Whether the identifier has 29 bits."""
    data: bytes
    t_rx_ns: int
    """CLOCK_MONOTONIC of its arrival: when the kernel had it, where the kernel says so."""
    after_loss: bool = False
    """Whether frames are known to be missing right before it."""


@dataclass(frozen=True, slots=True)
class CanFilter:
    """Frames that a device needs: those whose identifier agrees with `can_id` in the bits of `mask`."""

    can_id: int
    mask: int
    extended: bool

    def takes(self, can_id: int, extended: bool) -> bool:
        """Whether a frame passes."""
        return extended == self.extended and not (can_id ^ self.can_id) & self.mask


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """A frame that a bus must carry again and again for its devices to work (CANopen SYNC, say); imud sends it.

    One device of a bus has it sent for all of them: a second one with a frame of the same identifier is refused."""

    can_id: int
    extended: bool
    data: bytes
    every_ns: int
    """Its period, whole microseconds; the first one is sent at once."""


def nothing_cyclic(_settings: Any) -> Sequence[CyclicFrame]:
    """The cyclic frames of a device that needs none."""
    return ()


class CanCodec(Protocol):
    """Turns the frames of one device into events. Frames of others may be among them and change nothing.

    The ledger counts data bytes: those of frames of other devices as skipped. Synchronization: one thread.
    """

    ledger: Ledger

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Take one frame that arrived then (CLOCK_MONOTONIC); return what it completed. Never raises for any frame."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """The bus is idle: return what need not wait any longer."""
        ...

    def reset(self) -> None:
        """Frames are missing here (overrun, bus gone): frames that wait for the rest of their sample are given up."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CanDriver(Driver):
    """A device on a CAN bus, which it may share with others."""

    make_codec: Callable[[Ledger, Any], CanCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    filters: Callable[[Any], Sequence[CanFilter]]
    """The frames that a device with these settings sends, replies included."""
    node_of: Callable[[int, bool, bytes], int | None]
    """Which device of this protocol would send such a frame (identifier, 29 bits or not, data): its number, or None.

    A frame that carries samples only; what this says is a guess that a codec must confirm."""
    node_settings: Callable[[int], Any]
    """Settings for the device of that number, the rest at its default."""
    node_title: Callable[[int], str]
    """The device of that number for people, for example `node 8`."""
    identify: Callable[[Any], Conversation[Identity]]
    """Asks the device with these settings what it is, and leaves it as it was."""
    read_settings: Callable[[Any], Conversation[Mapping[str, str]]]
    """Reads back the own settings of the device with these settings, by its own names, and leaves it as it was."""
    apply_identity: Callable[[CanCodec, Identity], None] = lambda _codec, _identity: None
    """Tells the codec what is known of the device, where what it sends depends on that."""
    sample_frames: int
    """Frames that make one sample."""
    example_frames: Callable[[Random], Sequence[CanFrame]]
    """Valid frames that make one sample, in the order they are sent, with random values and the default settings."""
    cyclic: Callable[[Any], Sequence[CyclicFrame]] = nothing_cyclic
    """Frames that imud must send for a device with these settings, as long as the link is open; of a link that may not
    send, none are."""


def frame_bits(extended: bool, data_bytes: int) -> int:
    """Shortest time of a frame on the wire, pause included, in bits; stuff bits make it up to 22 % longer."""
    return (EXTENDED_OVERHEAD_BITS if extended else STANDARD_OVERHEAD_BITS) + 8 * data_bytes


def pack_frame(can_id: int, extended: bool, data: bytes) -> bytes:
    """A frame as `struct can_frame`. Raises ValueError for an identifier or a length that no frame can have."""
    if not 0 <= can_id <= (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) or len(data) > DATA_BYTES_MAX:
        raise ValueError(f"no CAN frame: identifier {can_id:#x}{' (29 bits)' * extended}, {len(data)} data bytes")
    return RAW_FRAME.pack(can_id | EXTENDED_FLAG if extended else can_id, len(data), data)
