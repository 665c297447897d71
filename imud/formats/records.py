"""Records: the content of the blocks of a recording.

A record is a head of 7 bytes and a body, little-endian. A block contains complete records only::

    ┌──────────┬────────────┬────────────┬──────────────┐
    │ kind u8  │ device u16 │ length u32 │ length bytes │   device: number of the device, as in slots
    └──────────┴────────────┴────────────┴──────────────┘

Frequent records have a fixed layout (`DATA`, `FRAMES`, `READINGS`, `EDGES`, `CLOCKS`). All other records are
MessagePack. The records have the order of the daemon's operations, which a replay repeats. Edges and clocks that a read
needs are before this read. A reader skips unknown kinds.
"""

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta

from imud.formats.can import CanFrame
from imud.model.errors import ImudError, reason_of
from imud.model.ledger import LOST_FIELDS
from imud.model.sample import DEVICE_NAME_PATTERN

VERSION: Final = 1  # Version of the layout of records. A reader rejects other versions.
HEAD: Final = struct.Struct("<BHI")
_DATA: Final = struct.Struct("<qqB")
_FRAME: Final = struct.Struct("<qIBB")
_READING: Final = struct.Struct("<qqBBI")
_EDGE: Final = struct.Struct("<qBQ")
_CLOCKS: Final = struct.Struct("<qqqqqI")
_LOST: Final = struct.Struct("<QQq")
_EXTENDED: Final = 1
_AFTER_LOSS: Final = 2
NO_DEVICE: Final = 0xFFFF  # device number of records about all devices


# Maximum absolute value of a time, ns: 73 years. Sums and differences of two times then have 64 bits. Times of a replay
# can be negative.
TIME_MAX_NS: Final = 1 << 61
UTC_OFFSET_MAX_NS: Final = 1 << 62  # maximum of CLOCK_REALTIME minus CLOCK_MONOTONIC, ns: until the year 2116
COUNT_MAX: Final = 1 << 53  # maximum of a counter
PERIOD_MAX_NS: Final = 3_600_000_000_000  # maximum time between two reads of a polled device, ns
Time = Annotated[int, Meta(ge=-TIME_MAX_NS, le=TIME_MAX_NS)]
Count = Annotated[int, Meta(ge=0, le=COUNT_MAX)]
Utc = Annotated[int, Meta(ge=-UTC_OFFSET_MAX_NS, le=UTC_OFFSET_MAX_NS)]


class Kind(IntEnum):
    """Kinds of records."""

    SESSION = 1  # Daemon, host and file: `SessionRecord`. First record of a file.
    DEVICE = 2  # device as configured, with its known identity and settings: `DeviceRecord`
    PATH = 3  # driver of a device for the following records, and the state of its codec and clock: `PathRecord`
    CLOCKS = 4  # reading of the host clocks: `ClocksRecord`
    DATA = 5  # bytes of one read of a serial port: `DataRecord`
    FRAMES = 6  # CAN frames of one read, each with its own time stamp
    READINGS = 7  # transfers on I2C, SPI or RS-485: `ReadingRecord`s
    EDGES = 8  # edges of a GPIO line with time stamps of the kernel: `EdgesRecord`
    CALL = 9  # any other call of the path or the clock of a device: `CallRecord`
    CHECK = 10  # newest sample and ledger at this place: `CheckRecord`
    LOST = 11  # lost records at this place, because the disk was too slow: `LostRecord`
    EVENT = 12  # event as sent on the socket, MessagePack
    END = 13  # regular end of the file: `EndRecord`


class Record(NamedTuple):
    """Record as read."""

    kind: int
    device: int
    body: bytes


class SessionRecord(msgspec.Struct, frozen=True):
    """Start of a file: time, host and versions."""

    version: int  # layout of the records: VERSION
    imud: str  # version of the daemon
    python: str
    host: str  # name and kernel of the host
    epoch: int  # random number of the start of the daemon, equal in all files of one run
    number: int  # number of the file in one recording, starting at 0
    t_ns: Time  # CLOCK_MONOTONIC at the start of the file
    utc_ns: Utc  # CLOCK_REALTIME at the start of the file


# A name outside this pattern is forged: it could control the terminal of a program that prints it
DeviceName = Annotated[str, Meta(pattern=rf"^{DEVICE_NAME_PATTERN}\Z")]
DeviceNameOrEmpty = Annotated[str, Meta(pattern=rf"^({DEVICE_NAME_PATTERN})?\Z")]


class DeviceRecord(msgspec.Struct, frozen=True):
    """Device of the configuration."""

    name: DeviceName
    driver: str  # driver as configured, may be `auto`
    link: str  # name of the link in the configuration, for example `uart`
    where: str  # readable name of the port
    configuration: dict[str, Any]  # configuration of the device with defaults: link, options, lines, frame, convention
    identity: dict[str, str]
    settings: dict[str, str]


class PathRecord(msgspec.Struct, frozen=True):
    """Codec and clock for the following records."""

    driver: str
    options: dict[str, Any]
    period_ns: Annotated[int, Meta(ge=0, le=PERIOD_MAX_NS)]  # time between two reads of a polled device, ns
    ledger: dict[str, Count]
    state: bytes  # state of codec, clock and path (`imud.recording.state`); empty if imud cannot save the state


class ClocksRecord(NamedTuple):
    """Reading of the host clocks."""

    monotonic_ns: int
    raw_ns: int  # CLOCK_MONOTONIC_RAW at the same instant
    held_raw_ns: int  # CLOCK_MONOTONIC_RAW at the last confirmation of the previous reading
    error_ns: int  # maximum difference between the two instants, ns
    utc_offset_ns: int  # CLOCK_REALTIME minus CLOCK_MONOTONIC for the following records
    suspends: int  # number of suspends of the host


class DataRecord(NamedTuple):
    """Bytes of one read."""

    t_rx_ns: int  # CLOCK_MONOTONIC immediately after the read
    waited_ns: int  # maximum hold of the bytes in the kernel, ns; -1 without a hold
    data: bytes


class ReadingRecord(NamedTuple):
    """One transfer."""

    poll: int
    start_ns: int  # CLOCK_MONOTONIC immediately before the transfer
    end_ns: int  # CLOCK_MONOTONIC immediately after the transfer
    trouble: int  # 0 if the transfer succeeded; otherwise 1 + the index of the failure in `imud.model.errors.Trouble`
    data: bytes  # received bytes; for a failed transfer, the error text in UTF-8


class EdgeRecord(NamedTuple):
    t_ns: int
    rising: bool
    number: int


class EdgesRecord(NamedTuple):
    """Edges of one line."""

    line: str  # key of the line in the configuration, for example `sout`
    edges: list[EdgeRecord]


class CallRecord(msgspec.Struct, frozen=True, array_like=True):
    """Call of a method of the path, the clock, or the data-ready edges."""

    target: str
    method: str
    arguments: list[Any] = []  # msgspec copies a mutable default
    keywords: dict[str, Any] = {}


class CheckRecord(msgspec.Struct, frozen=True):
    """Expected state of a replay at this place."""

    t_ns: Time  # CLOCK_MONOTONIC
    seq: int
    sample_t_ns: int
    sample_t_err_ns: int  # error of the newest sample; 0 without a sample
    ledger: dict[str, Count]

    def __post_init__(self) -> None:
        """Raise ValueError if the ledger lacks a counter of lost samples."""
        if missing := [name for name in LOST_FIELDS if name not in self.ledger]:
            raise ValueError(f"expected a ledger with {missing[0]}")


class LostRecord(NamedTuple):
    """Number and time of dropped records."""

    records: int
    bytes: int
    t_ns: int  # CLOCK_MONOTONIC of the first dropped record


class EndRecord(msgspec.Struct, frozen=True):
    """End of a file."""

    t_ns: Time
    utc_ns: Utc
    reason: str


LINES: Final = ("sout", "sout_div", "pps", "data_ready", "alarm")  # Lines, by their number in an EDGES record

# Maximum size of a MessagePack body: a state of 1 MiB and the configuration of a device. Python needs up to 75 bytes of
# memory for one byte.
OBJECT_BYTES_MAX: Final = 5 << 18

_encode: Final = msgspec.msgpack.Encoder().encode


def encode(kind: Kind, device: int, body: bytes) -> bytes:
    """Return a record."""
    return HEAD.pack(kind, device, len(body)) + body


def encode_object(kind: Kind, device: int, value: object) -> bytes:
    """Return a record with a MessagePack body."""
    return encode(kind, device, _encode(value))


_DATA_WHOLE: Final = struct.Struct("<BHIqqB")


def encode_data(device: int, data: bytes, t_rx_ns: int, waited_ns: int) -> bytes:
    """Return a DATA record; `waited_ns` is -1 for bytes without a hold."""
    return _DATA_WHOLE.pack(Kind.DATA, device, _DATA.size + len(data), t_rx_ns, waited_ns, 0) + data


def encode_frames(device: int, frames: Sequence[CanFrame]) -> bytes:
    parts = []
    for can_id, extended, data, t_rx_ns, after_loss in frames:
        flags = (_EXTENDED if extended else 0) | (_AFTER_LOSS if after_loss else 0)
        parts.append(_FRAME.pack(t_rx_ns, can_id, flags, len(data)))
        parts.append(data)
    return encode(Kind.FRAMES, device, b"".join(parts))


def encode_readings(device: int, readings: Sequence[ReadingRecord]) -> bytes:
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
    return encode(Kind.CLOCKS, NO_DEVICE, _CLOCKS.pack(*clocks))


def encode_lost(lost: LostRecord) -> bytes:
    return encode(Kind.LOST, NO_DEVICE, _LOST.pack(*lost))


def records_of(content: bytes) -> Iterator[Record]:
    """Yield the records of a block. Raises ImudError for an incomplete record."""
    at, end = 0, len(content)
    while at < end:
        if end - at < HEAD.size:
            raise ImudError(f"a block ends in the head of a record: expected {HEAD.size} bytes, got {end - at}")
        kind, device, length = HEAD.unpack_from(content, at)
        at += HEAD.size
        if length > end - at:
            raise ImudError(f"cannot read a record: expected {length} bytes, got {end - at} at the end of the block")
        yield Record(kind, device, content[at : at + length])
        at += length


def decode_object(record: Record, type_: type[Any]) -> Any:
    """Return the body of a record as `type_`. Raises ImudError for invalid bytes."""
    if len(record.body) > OBJECT_BYTES_MAX:
        got = f"expected at most {OBJECT_BYTES_MAX} bytes, got {len(record.body)}"
        raise ImudError(f"cannot read a record of kind {record.kind}: {got}")
    try:
        return msgspec.msgpack.decode(record.body, type=type_)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ImudError(f"cannot read a record of kind {record.kind}: {reason_of(error)}") from None


def decode_data(body: bytes) -> DataRecord:
    """Return the body of a DATA record. Raises ImudError."""
    _check_length(body, _DATA.size, "bytes")
    t_rx_ns, waited_ns, _ = _DATA.unpack_from(body)
    _check_times(t_rx_ns, waited_ns)
    return DataRecord(t_rx_ns, waited_ns, body[_DATA.size :])


def decode_frames(body: bytes) -> list[CanFrame]:
    """Return the frames of a FRAMES record. Raises ImudError."""
    frames, at = [], 0
    while at < len(body):
        _check_length(body, at + _FRAME.size, "frames")
        t_rx_ns, can_id, flags, length = _FRAME.unpack_from(body, at)
        at += _FRAME.size + length
        _check_length(body, at, "frames")
        _check_times(t_rx_ns)
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
        _check_times(start_ns, end_ns)
        readings.append(ReadingRecord(poll, start_ns, end_ns, trouble, body[at - length : at]))
    return readings


def decode_edges(body: bytes) -> EdgesRecord:
    """Return the edges of an EDGES record. Raises ImudError."""
    _check_length(body, 1, "edges")
    if body[0] >= len(LINES) or (len(body) - 1) % _EDGE.size:
        raise ImudError(f"cannot read edges: line {body[0]}, {len(body) - 1} bytes")
    edges = [EdgeRecord(t_ns, bool(rising), number) for t_ns, rising, number in _EDGE.iter_unpack(body[1:])]
    _check_times(*(edge.t_ns for edge in edges))
    return EdgesRecord(LINES[body[0]], edges)


def decode_clocks(body: bytes) -> ClocksRecord:
    """Return a reading of the clocks. Raises ImudError."""
    _check_length(body, _CLOCKS.size, "clocks")
    clocks = ClocksRecord(*_CLOCKS.unpack_from(body))
    _check_times(clocks.monotonic_ns, clocks.raw_ns, clocks.held_raw_ns, clocks.error_ns)
    if clocks.error_ns < 0 or abs(clocks.utc_offset_ns) > UTC_OFFSET_MAX_NS:
        expected = f"expected an error of 0 or more and an offset of at most {UTC_OFFSET_MAX_NS} ns"
        raise ImudError(f"cannot read clocks: {expected}, got {clocks.error_ns} and {clocks.utc_offset_ns}")
    return clocks


def decode_lost(body: bytes) -> LostRecord:
    """Return the number of lost records. Raises ImudError."""
    _check_length(body, _LOST.size, "lost records")
    return LostRecord(*_LOST.unpack_from(body))


def _check_times(*times_ns: int) -> None:
    for time_ns in times_ns:
        if not -TIME_MAX_NS <= time_ns <= TIME_MAX_NS:
            raise ImudError(f"cannot read a record: expected times of at most {TIME_MAX_NS} ns, got {time_ns}")


def _check_length(body: bytes, expected: int, what: str) -> None:
    if len(body) < expected:
        raise ImudError(f"a record of {what} is too short: expected {expected} bytes, got {len(body)}")
