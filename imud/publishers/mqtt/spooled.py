"""Rows of the spool: messages that wait, and what of a row is left that the disk has damaged.

A disk gives back other bytes than it was given now and then, and SQLite does not notice where only values changed. A
row is looked at before it is used: one that the broker would refuse, or that no reader could take, would be sent again
and again, with nothing behind it. In its place there is a note that says so, as far as the row still says which numbers
it had; of a row that does not, nothing is left, and its numbers show as missing.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from imud.formats.fleet.messages import (
    NUMBER_MOST,
    VERSION,
    DropCause,
    FleetMessage,
    MessageKind,
    check_payload,
    decode_message,
    encode_message,
)
from imud.formats.fleet.topics import Stream, is_name, parse_topic

_KINDS: Final = frozenset(kind.value for kind in MessageKind)
_STREAMS: Final = frozenset(stream.value for stream in Stream)


class Spooled(NamedTuple):
    """A message that waits, as a row of the file."""

    id: int
    """Counts messages of this file, in their order; 0 for one that is not stored yet."""
    boot: str
    device: str
    stream: str
    kind: str
    topic: str
    first: int
    last: int
    items: int
    """Samples or events that the numbers stand for."""
    stored_utc_ns: int
    """CLOCK_REALTIME when it was stored; before that, of the newest of it."""
    payload: bytes

    @property
    def key(self) -> tuple[str, str]:
        """What its numbers count in: boot and topic, which has the names of gateway, device and stream."""
        return self.boot, self.topic

    @property
    def gateway(self) -> str:
        """Name that the gateway had when the message was made."""
        return self.topic.split("/")[2]


def row_of(topic: str, stream: Stream, message: FleetMessage, payload: bytes, stored_utc_ns: int) -> Spooled:
    """A message that is to be stored."""
    return Spooled(
        0, message.boot, message.device, stream.value, message.kind.value, topic, message.first, message.last,
        message.count, stored_utc_ns, payload,
    )  # fmt: skip


def sound_row(values: Sequence[object]) -> Spooled | None:
    """The row with these values; None for one that is damaged."""
    row = _numbered(values)
    if row is None or row.kind not in _KINDS:
        return None
    try:
        head = check_payload(row.payload)
    except ValueError:
        return None
    own = (row.gateway, row.boot, row.device, row.first, row.last)
    return row if (head.gateway, head.boot, head.device, head.first, head.last) == own else None


def mended_row(values: Sequence[object]) -> Spooled | None:
    """A note in place of a row that is damaged; None where it does not say which numbers it had."""
    row = _numbered([*values[:4], "", *values[5:-1], b""])
    if row is None or row.items != row.last - row.first + 1:
        return None
    return row._replace(kind=MessageKind.DROPPED.value, payload=note_of(row, DropCause.DAMAGED))


def is_position(values: Sequence[object]) -> bool:
    """Whether these are boot, device, stream, begin and last of a stream; damaged ones are not."""
    match values:
        case (str() as boot, str(), str() as stream, int() as begin, int() as last):
            return is_name(boot) and stream in _STREAMS and 0 < begin <= last < NUMBER_MOST
    return False


def note_of(row: Spooled, cause: DropCause) -> bytes:
    """The payload that says that a message was dropped."""
    try:
        message = decode_message(row.payload)
    except ValueError:
        note = FleetMessage(
            v=VERSION, gateway=row.gateway, boot=row.boot, device=row.device, kind=MessageKind.DROPPED,
            begin=row.first, first=row.first, last=row.last, count=row.items, utc_ns=row.stored_utc_ns, cause=cause,
        )  # fmt: skip
    else:
        note = msgspec.structs.replace(
            message, kind=MessageKind.DROPPED, cause=cause, samples=[], intervals=[], events=[]
        )  # fmt: skip
    return encode_message(note)


def _numbered(values: Sequence[object]) -> Spooled | None:
    """The row, where it says of which stream it is and which numbers it has."""
    try:
        row = msgspec.convert(values, Spooled)
    except msgspec.ValidationError:
        return None
    parts = parse_topic(row.topic)
    if parts is None or row.stream not in _STREAMS or (parts.device, parts.leaf) != (row.device, row.stream):
        return None
    return row if is_name(row.boot) and 0 < row.first <= row.last < NUMBER_MOST else None
