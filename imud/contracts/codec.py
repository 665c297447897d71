"""Contract of a codec: bytes in, events out, no I/O. Invalid bytes become `BadFrame`, never an exception."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Protocol

import msgspec

from imud.ledger import Ledger
from imud.sample import Measurement


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


class TextLine(msgspec.Struct, frozen=True, gc=False):
    """One line of text found between binary frames, without its line end."""

    text: str


class ReplyFrame(msgspec.Struct, frozen=True, gc=False):
    """One binary frame that answers a command and carries no sample; for CAN, a frame that does."""

    frame_id: int
    """Kind of the frame as the protocol numbers them; for CAN the identifier."""
    payload: bytes


Message = str | ReplyFrame
"""A message that can answer a command: a line of text without its end, or a binary frame."""
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
