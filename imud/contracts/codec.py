"""Contract of a codec: bytes to events, without I/O. Invalid bytes become `BadFrame`, never an exception."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import msgspec

from imud.contracts.script import Message, ReplyFrame, TextLine, Transfer
from imud.formats.kernel import KernelFormat
from imud.model.errors import TransferError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement


class BadReason(StrEnum):
    """Reasons to reject a frame; each has its own counter in the ledger."""

    CRC = "crc"  # the check value does not match: bytes damaged on the wire, or a sync word inside other data
    LENGTH = "length"  # the length field is outside the range of the protocol
    # The check value is correct and the content is impossible, for example a sub-packet longer than the rest of the
    # frame
    CONTENT = "content"
    # The frame is valid. Its measurement follows, without NaN, infinity and physically impossible values.
    NOT_FINITE = "not-finite"


class BadFrame(msgspec.Struct, frozen=True, gc=False):
    """Bytes that begin like a frame and are not a frame, or (reason NOT_FINITE) a valid frame without some values."""

    reason: BadReason
    # Received bytes from the sync word to the end of the frame by its length field; fewer bytes if the rest is missing
    raw: bytes
    can_id: int | None = None  # identifier of a CAN frame


def wrong_length_words(ledger: Ledger, frame: BadFrame | None) -> str:
    """Describe the CAN frames of a wrong length by the newest such frame, one clause; empty without such a frame."""
    if frame is None or frame.can_id is None:
        return ""
    count = ledger.frames_bad_length
    return f"{count} frame{'s' * (count != 1)} of a wrong length, the last of CAN identifier {frame.can_id:03X}"


def wrong_length(ledger: Ledger, can_id: int, data: bytes) -> tuple[BadFrame]:
    """Count a CAN frame of a known identifier with another length than in the manual. Return its event."""
    ledger.bytes_in_bad_frames += len(data)
    ledger.frames_bad_length += 1
    return (BadFrame(BadReason.LENGTH, data, can_id),)


CodecEvent = Measurement | TextLine | ReplyFrame | BadFrame


def message_of(event: CodecEvent) -> Message | None:
    """Return the event as a message that can be a reply; None for all other events."""
    if isinstance(event, TextLine):
        return event.text
    return event if isinstance(event, ReplyFrame) else None


UNKNOWN_TYPES_MAX = 8  # maximum number of unknown frame types that a codec counts separately


def count_unknown(counts: dict[int, int], frame_type: int) -> None:
    """Count a valid frame of an unknown type. Ignore further types above UNKNOWN_TYPES_MAX."""
    if frame_type in counts or len(counts) < UNKNOWN_TYPES_MAX:
        counts[frame_type] = counts.get(frame_type, 0) + 1


@runtime_checkable
class KernelCodec(Protocol):
    """Codec of frames that the kernel decodes. `imud.drivers` implements it, and the sample path may not import it."""

    kernel_format: KernelFormat  # format of the newest frame. The kernel decodes only frames of this format.
    word_is_status: bool  # whether a word of the frame contains status bits

    def usual_frames(self, data: bytes) -> bytes:
        """Return all bytes that the codec has not decoded, with the next bytes `data` of the stream; empty if the first
        event needs `feed`. This method changes nothing."""
        ...

    def take(self, frames: bytes, count: int, data: bytes) -> bytes:
        """Count the first `count` frames of `usual_frames`, at least one, as samples. Return the end of `data` that
        `feed` must decode."""
        ...


class StreamCodec(Protocol):
    """Decoder of a byte stream. The events do not depend on how the bytes are split into reads. Synchronization: one
    thread. Maximum memory: the longest frame plus the longest text line."""

    ledger: Ledger
    unknown: dict[int, int]  # number of valid frames or sub-packets of each unknown type, by the number of the type

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream. Return the completed events. Never raises an exception."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """Return the complete frames inside an incomplete longer frame. imud calls it when the link is idle."""
        ...

    def reset(self) -> None:
        """Count the pending bytes as skipped. imud calls this method after a replug or a change of the baud rate."""
        ...


class CanCodec(Protocol):
    """Decoder of the frames of one CAN device. Frames of other devices do not affect the decoder. The ledger counts
    data bytes. Data bytes of other devices count as skipped. Synchronization: one thread."""

    ledger: Ledger
    unknown: dict[int, int]  # number of frames of each unknown type that the device may have sent, by identifier or PGN
    counts_losses: bool  # whether the codec counts the lost samples; False: the clock counts them by the device counter

    @property
    def problem(self) -> str:
        """Lasting problem of the device that the frames show, one sentence; empty if there is none."""
        ...

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Decode a frame that arrived at `t_rx_ns` (CLOCK_MONOTONIC). Return the completed events. Never raises."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """Return the events that were waiting for further frames. imud calls this method when the bus is idle."""
        ...

    def reset(self) -> None:
        """Discard the frames of an incomplete sample. imud calls this method after lost frames (overrun, bus down)."""
        ...


@dataclass(frozen=True, slots=True)
class Poll:
    """A transfer that imud repeats."""

    transfer: Transfer
    every_ns: int = 0  # 0: at every deadline of the device. Otherwise the minimum time between two transfers, ns.


class Reading(msgspec.Struct, frozen=True, gc=False):
    """The result of one poll."""

    poll: int  # index of the poll in `polls` of the codec
    data: bytes  # all received bytes in their order; empty if the transfer failed
    error: TransferError | None
    start_ns: int  # CLOCK_MONOTONIC immediately before the transfer
    end_ns: int  # CLOCK_MONOTONIC immediately after the transfer


class Vanished(msgspec.Struct, frozen=True):
    """Event: the device is absent or has lost its settings. imud must identify the device again."""

    why: str


PolledEvent = CodecEvent | Vanished


class PolledCodec(Protocol):
    """Decoder of the results of polls. Synchronization: one thread."""

    ledger: Ledger
    polls: Sequence[Poll]  # Cyclic reads. The first poll returns the samples.

    @property
    def stale(self) -> int:
        """Number of frames with the same bytes as the previous frame: the device had no new values."""
        ...

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer. Never raises an exception, also for bytes of any length."""
        ...

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Process a failed transfer of a poll. Return the resulting events; most codecs return no event."""
        ...

    def reset(self) -> None:
        """Forget the previous frame. imud calls this method after it identified the device again."""
        ...
