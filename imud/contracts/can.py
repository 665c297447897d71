"""Contract of a driver for a CAN bus: the codec of its frames, and the row of the table of drivers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Protocol

from imud.contracts.codec import CodecEvent
from imud.contracts.driver import Driver, Identity
from imud.contracts.session import RequestScript
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.ledger import Ledger


def nothing_cyclic(_settings: Any) -> Sequence[CyclicFrame]:
    """Return no cyclic frames: the version for devices that need none."""
    return ()


class CanCodec(Protocol):
    """Decoder of the frames of one device. Frames of other devices may be among them and change nothing.

    The ledger counts data bytes: those of frames of other devices as skipped. Synchronization: one thread.
    """

    ledger: Ledger

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Decode one frame that arrived at `t_rx_ns` (CLOCK_MONOTONIC); return what it completed. Never raises."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """Return what waits for frames that will not come: the bus is idle."""
        ...

    def reset(self) -> None:
        """Discard frames that wait for the rest of their sample: some are missing here (overrun, bus down)."""
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

    Only for frames that carry samples; the codec must confirm it."""
    node_settings: Callable[[int], Any]
    """Settings for the device of that number, the rest at its default."""
    node_title: Callable[[int], str]
    """The device of that number for people, for example `node 8`."""
    identify: Callable[[Any], RequestScript[Identity]]
    """Asks the device with these settings what it is, and leaves it as it was."""
    read_settings: Callable[[Any], RequestScript[Mapping[str, str]]]
    """Reads back the own settings of the device with these settings, by its own names, and leaves it as it was."""
    apply_identity: Callable[[CanCodec, Identity], None] = lambda _codec, _identity: None
    """Passes the identity to the codec, where the frames depend on it."""
    sample_frames: int
    """Frames that make one sample."""
    example_frames: Callable[[Random], Sequence[CanFrame]]
    """Valid frames that make one sample, in the order they are sent, with random values and the default settings."""
    cyclic: Callable[[Any], Sequence[CyclicFrame]] = nothing_cyclic
    """Frames that imud must send for a device with these settings, as long as the link is open; of a link that may not
    send, none are."""
