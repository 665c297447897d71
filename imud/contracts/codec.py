"""Contract of a codec: bytes in, events out, no I/O. Invalid bytes become `BadFrame`, never an exception."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import msgspec

from imud.contracts.script import Message, ReplyFrame, TextLine, Transfer
from imud.model.errors import TransferError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement


class BadReason(StrEnum):
    """Reasons to reject a frame; each has its own counter in the ledger."""

    CRC = "crc"
    """The check value does not match: damaged on the wire, or a sync word inside other data."""
    LENGTH = "length"
    """The length field is outside what the protocol allows."""
    CONTENT = "content"
    """The check value is right but the content is impossible, for example a sub-packet cut off by the frame's end."""
    NOT_FINITE = "not-finite"
    """The frame is good and its measurement follows, but without values that came as NaN or infinity."""


class BadFrame(msgspec.Struct, frozen=True, gc=False):
    """Bytes that began like a frame and are not one, or (reason NOT_FINITE) a good frame that lacks some values."""

    reason: BadReason
    raw: bytes
    """The bytes as they came, from the sync word to where the frame claimed to end (as far as they are there)."""


CodecEvent = Measurement | TextLine | ReplyFrame | BadFrame


def message_of(event: CodecEvent) -> Message | None:
    """Return the event if it can answer a command, else None."""
    if isinstance(event, TextLine):
        return event.text
    return event if isinstance(event, ReplyFrame) else None


class StreamCodec(Protocol):
    """Decoder of a byte stream. Any split of the bytes gives the same events.

    Synchronization: one thread. Memory is bounded by the longest frame plus the longest text line.
    """

    ledger: Ledger

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream; return the events they completed. Never raises for any bytes."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """Return whole frames that wait inside a longer frame that never came: the line is idle. Loses nothing."""
        ...

    def reset(self) -> None:
        """Count what is pending as skipped: the stream broke (unplugged, other baud rate)."""
        ...


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


@dataclass(frozen=True, slots=True)
class Poll:
    """A transfer that is repeated."""

    transfer: Transfer
    every_ns: int = 0
    """0 for at every deadline of the device, otherwise at the first deadline after so much time."""


class Reading(msgspec.Struct, frozen=True, gc=False):
    """The result of one poll."""

    poll: int
    """Index of the poll in the codec's `polls`."""
    data: bytes
    """All bytes read, in their order; empty if the transfer failed."""
    error: TransferError | None
    start_ns: int
    """CLOCK_MONOTONIC right before the transfer."""
    end_ns: int
    """CLOCK_MONOTONIC right after it."""


class Vanished(msgspec.Struct, frozen=True):
    """Evidence that the device is absent or has lost its settings: it must be identified again."""

    why: str


PolledEvent = CodecEvent | Vanished


class PolledCodec(Protocol):
    """Decoder of the results of polls. Synchronization: one thread."""

    ledger: Ledger
    polls: Sequence[Poll]
    """Cyclic reads; the first makes the samples."""

    @property
    def stale(self) -> int:
        """Frames that were the same as the one before: the device had nothing new."""
        ...

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer. Never raises for any bytes, of any length."""
        ...

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Process a poll whose transfer failed; return what follows from it. Most codecs have nothing to do."""
        ...

    def reset(self) -> None:
        """Forget the last frame, with which the next one is compared: the device was identified anew."""
        ...
