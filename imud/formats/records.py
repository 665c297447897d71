"""Records: what the content of a block is made of.

A record is a head of 7 bytes and a body, little-endian; a block has whole records only::

    ┌──────────┬────────────┬────────────┬──────────────┐
    │ kind u8  │ device u16 │ length u32 │ length bytes │   device: the daemon's number of it, as in slots
    └──────────┴────────────┴────────────┴──────────────┘

What comes often has a fixed layout (`DATA`, `FRAMES`, `READINGS`, `EDGES`, `CLOCKS`), the rest is MessagePack. The
order of the records is the order in which the daemon did what they say: it is what a replay does again. A record of
edges or clocks that a read needed stands before that read. A reader passes over kinds that it does not know.
"""

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple

import msgspec

from imud.formats.can import CanFrame
from imud.model.errors import ImudError, reason_of

VERSION: Final = 1
"""Of the layout of records; a reader refuses others."""
HEAD: Final = struct.Struct("<BHI")
_DATA: Final = struct.Struct("<qqB")
_FRAME: Final = struct.Struct("<qIBB")
_READING: Final = struct.Struct("<qqBBI")
_EDGE: Final = struct.Struct("<qBQ")
_CLOCKS: Final = struct.Struct("<qqqqqI")
_LOST: Final = struct.Struct("<QQq")
_EXTENDED: Final = 1
_AFTER_LOSS: Final = 2
_FAILED: Final = 1
NO_DEVICE: Final = 0xFFFF
"""Device of records that concern all of them."""


class Kind(IntEnum):
    """Kinds of records."""

    SESSION = 1
    """The daemon, the host and the file: `SessionRecord`. The first of a file."""
    DEVICE = 2
    """A device as configured, with its identity and settings as far as known: `DeviceRecord`."""
    PATH = 3
    """The driver of a device from here on, and the state of its codec and clock: `PathRecord`."""
    CLOCKS = 4
    """The host's clocks were read: `ClocksRecord`."""
    DATA = 5
    """Bytes of one read of a serial port: `DataRecord`."""
    FRAMES = 6
    """CAN frames of one read, each with its own stamp."""
    READINGS = 7
    """Transfers on I2C, SPI or RS-485: `ReadingRecord`s."""
    EDGES = 8
    """Edges of a GPIO line with the kernel's stamps: `EdgesRecord`."""
    CALL = 9
    """Anything else that was done to the path or the clock of a device: `CallRecord`."""
    CHECK = 10
    """The newest sample and the ledger at this place: `CheckRecord`."""
    LOST = 11
    """Records that are missing here: the disk was too slow. `LostRecord`."""
    EVENT = 12
    """An event as the socket has it, MessagePack."""
    END = 13
    """The regular end of the file: `EndRecord`."""


class Record(NamedTuple):
    """A record as read."""

    kind: int
    device: int
    body: bytes


class SessionRecord(msgspec.Struct, frozen=True):
    """Where and when a file was begun."""

    version: int
    """Layout of the records: VERSION."""
    imud: str
    """Version of the daemon."""
    python: str
    host: str
    """Name and kernel of the machine."""
    epoch: int
    """Random number of the daemon's start: files of one run have the same."""
    number: int
    """Counts the files of one recording from 0."""
    t_ns: int
    """CLOCK_MONOTONIC at the begin."""
    utc_ns: int
    """CLOCK_REALTIME then."""


class DeviceRecord(msgspec.Struct, frozen=True):
    """A device of the configuration."""

    name: str
    driver: str
    """As configured, `auto` included."""
    link: str
    """Name of its link in the configuration, for example `uart`."""
    where: str
    """Its port for people."""
    configuration: dict[str, Any]
    """What the configuration has below the device, with defaults: link, options, lines, frame, convention."""
    identity: dict[str, str]
    settings: dict[str, str]


class PathRecord(msgspec.Struct, frozen=True):
    """What decodes and dates from here on."""

    driver: str
    options: dict[str, Any]
    period_ns: int
    """Polled devices: time between two reads."""
    ledger: dict[str, int]
    state: bytes
    """State of codec, clock and path (`imud.recording.state`); empty where it cannot be had."""


class ClocksRecord(NamedTuple):
    """A reading of the host's clocks."""

    monotonic_ns: int
    raw_ns: int
    """CLOCK_MONOTONIC_RAW at the same instant."""
    held_raw_ns: int
    """CLOCK_MONOTONIC_RAW when the reading before was last found to hold."""
    error_ns: int
    """Bound of the difference between the two instants."""
    utc_offset_ns: int
    """CLOCK_REALTIME minus CLOCK_MONOTONIC that holds from here on."""
    suspends: int
    """Times that the machine was suspended."""


class DataRecord(NamedTuple):
    """Bytes of one read."""

    t_rx_ns: int
    """CLOCK_MONOTONIC right after the read."""
    waited_ns: int
    """How long they may have waited in the kernel; -1 where they were processed at once."""
    data: bytes


class ReadingRecord(NamedTuple):
    """One transfer."""

    poll: int
    start_ns: int
    """CLOCK_MONOTONIC right before it."""
    end_ns: int
    """CLOCK_MONOTONIC right after it."""
    trouble: int
    """0 where it succeeded; otherwise 1 + the place of the trouble in `imud.model.errors.Trouble`."""
    data: bytes
    """The bytes read; of a transfer that failed, the error's words in UTF-8."""


class EdgeRecord(NamedTuple):
    """One edge."""

    t_ns: int
    rising: bool
    number: int


class EdgesRecord(NamedTuple):
    """Edges of one line."""

    line: str
    """Key of the line in the configuration, for example `sout`."""
    edges: list[EdgeRecord]


class CallRecord(msgspec.Struct, frozen=True, array_like=True):
    """A call of a method of the path, the clock, or the data-ready edges."""

    target: str
    method: str
    arguments: list[Any] = []  # msgspec copies a mutable default
    keywords: dict[str, Any] = {}


class CheckRecord(msgspec.Struct, frozen=True):
    """What a replay must have at this place."""

    t_ns: int
    """CLOCK_MONOTONIC."""
    seq: int
    sample_t_ns: int
    sample_t_err_ns: int
    """Of the newest sample; 0 without one."""
    ledger: dict[str, int]


class LostRecord(NamedTuple):
    """Records that were dropped."""

    records: int
    bytes: int
    t_ns: int
    """CLOCK_MONOTONIC of the first of them."""


class EndRecord(msgspec.Struct, frozen=True):
    """The end of a file."""

    t_ns: int
    utc_ns: int
    reason: str


LINES: Final = ("sout", "sout_div", "pps", "data_ready", "alarm")
"""Lines by their number in an EDGES record."""

_encode: Final = msgspec.msgpack.Encoder().encode


def encode(kind: Kind, device: int, body: bytes) -> bytes:
    """Return a record."""
    return HEAD.pack(kind, device, len(body)) + body


def encode_object(kind: Kind, device: int, value: object) -> bytes:
    """Return a record whose body is MessagePack."""
    return encode(kind, device, _encode(value))


_DATA_WHOLE: Final = struct.Struct("<BHIqqB")


def encode_data(device: int, data: bytes, t_rx_ns: int, waited_ns: int) -> bytes:
    """Return a DATA record; `waited_ns` -1 for bytes that were processed at once."""
    return _DATA_WHOLE.pack(Kind.DATA, device, _DATA.size + len(data), t_rx_ns, waited_ns, 0) + data


def encode_frames(device: int, frames: Sequence[CanFrame]) -> bytes:
    """Return a FRAMES record."""
    parts = []
    for can_id, extended, data, t_rx_ns, after_loss in frames:
        flags = (_EXTENDED if extended else 0) | (_AFTER_LOSS if after_loss else 0)
        parts.append(_FRAME.pack(t_rx_ns, can_id, flags, len(data)))
        parts.append(data)
    return encode(Kind.FRAMES, device, b"".join(parts))


def encode_readings(device: int, readings: Sequence[ReadingRecord]) -> bytes:
    """Return a READINGS record."""
    parts = []
    for poll, start_ns, end_ns, trouble, data in readings:
        parts.append(_READING.pack(start_ns, end_ns, poll, trouble, len(data)))
        parts.append(data)
    return encode(Kind.READINGS, device, b"".join(parts))


def encode_edges(device: int, line: str, edges: Sequence[tuple[int, bool, int]]) -> bytes:
    """Return an EDGES record of a line in LINES."""
    body = b"".join(_EDGE.pack(*edge) for edge in edges)
    return encode(Kind.EDGES, device, bytes([LINES.index(line)]) + body)


def encode_clocks(clocks: ClocksRecord) -> bytes:
    """Return a CLOCKS record."""
    return encode(Kind.CLOCKS, NO_DEVICE, _CLOCKS.pack(*clocks))


def encode_lost(lost: LostRecord) -> bytes:
    """Return a LOST record."""
    return encode(Kind.LOST, NO_DEVICE, _LOST.pack(*lost))


def records_of(content: bytes) -> Iterator[Record]:
    """The records of a block's content. Raises ImudError for a content that is not made of whole records."""
    at, end = 0, len(content)
    while at < end:
        if end - at < HEAD.size:
            raise ImudError(f"a block ends in the head of a record: expected {HEAD.size} bytes, got {end - at}")
        kind, device, length = HEAD.unpack_from(content, at)
        at += HEAD.size
        if length > end - at:
            raise ImudError(f"a record of {length} bytes in a block that has {end - at} left")
        yield Record(kind, device, content[at : at + length])
        at += length


def decode_object(record: Record, type_: type[Any]) -> Any:
    """Return the body of a record as `type_`. Raises ImudError for what is none."""
    try:
        return msgspec.msgpack.decode(record.body, type=type_)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ImudError(f"a record of kind {record.kind} cannot be read: {reason_of(error)}") from None


def decode_data(body: bytes) -> DataRecord:
    """Return the body of a DATA record. Raises ImudError."""
    _check_length(body, _DATA.size, "bytes")
    t_rx_ns, waited_ns, _ = _DATA.unpack_from(body)
    return DataRecord(t_rx_ns, waited_ns, body[_DATA.size :])


def decode_frames(body: bytes) -> list[CanFrame]:
    """Return the frames of a FRAMES record. Raises ImudError."""
    frames, at = [], 0
    while at < len(body):
        _check_length(body, at + _FRAME.size, "frames")
        t_rx_ns, can_id, flags, length = _FRAME.unpack_from(body, at)
        at += _FRAME.size + length
        _check_length(body, at, "frames")
        data = body[at - length : at]
        frames.append(CanFrame(can_id, bool(flags & _EXTENDED), data, t_rx_ns, bool(flags & _AFTER_LOSS)))
    return frames


def decode_readings(body: bytes) -> list[ReadingRecord]:
    """Return the transfers of a READINGS record. Raises ImudError."""
    readings, at = [], 0
    while at < len(body):
        _check_length(body, at + _READING.size, "readings")
        start_ns, end_ns, poll, trouble, length = _READING.unpack_from(body, at)
        at += _READING.size + length
        _check_length(body, at, "readings")
        readings.append(ReadingRecord(poll, start_ns, end_ns, trouble, body[at - length : at]))
    return readings


def decode_edges(body: bytes) -> EdgesRecord:
    """Return the edges of an EDGES record. Raises ImudError."""
    _check_length(body, 1, "edges")
    if body[0] >= len(LINES) or (len(body) - 1) % _EDGE.size:
        raise ImudError(f"edges cannot be read: line {body[0]}, {len(body) - 1} bytes")
    edges = [EdgeRecord(t_ns, bool(rising), number) for t_ns, rising, number in _EDGE.iter_unpack(body[1:])]
    return EdgesRecord(LINES[body[0]], edges)


def decode_clocks(body: bytes) -> ClocksRecord:
    """Return a reading of the clocks. Raises ImudError."""
    _check_length(body, _CLOCKS.size, "clocks")
    return ClocksRecord(*_CLOCKS.unpack_from(body))


def decode_lost(body: bytes) -> LostRecord:
    """Return what is missing. Raises ImudError."""
    _check_length(body, _LOST.size, "what was lost")
    return LostRecord(*_LOST.unpack_from(body))


def _check_length(body: bytes, expected: int, what: str) -> None:
    if len(body) < expected:
        raise ImudError(f"a record of {what} is too short: expected {expected} bytes, got {len(body)}")
