"""Topics and payloads of the fleet: messages of streams, requests and replies.

    JSON      {"v": 1, "gateway": …, "boot": …, "device": …, "kind": …, "first": 1, "last": 200, …}
    slots     "IMUB" | version, u8 | 0 | header bytes, u16 | header, JSON | Zstandard frame of slots

`version` is the layout version of the slots: 1 with 256 bytes each, 2 with 320 bytes each. Integers are little-endian.
Exactly one message covers each sequence number of a stream. The message contains complete
samples, or statistics that replaced them in a full spool (`intervals` in the stream `samples`), or only the cause of
the loss (`dropped`). If no message covers a number, the network lost it. If two messages cover it, the second is a
duplicate.

Every client with write access to the broker can send any payload, and the collector stores decoded values in databases.
The decoder therefore accepts only numbers below NUMBER_MOST and strings without NUL, because PostgreSQL cannot store
NUL.
"""

import math
import re
import struct
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import Annotated, Any, Final, NamedTuple

import msgspec

from imud.fleet.settings import NAME_PATTERN, is_name
from imud.formats.slot import SLOT_BYTES, SLOT_BYTES_V1, SLOT_LAYOUT_VERSION, decode_slot
from imud.formats.zstandard import FrameEncoder, content_size, decode_frame
from imud.model.errors import reason_of
from imud.model.event import Event
from imud.model.sample import Position, Sample, Sync, values_of
from imud.model.units import NS_PER_S

ROOT: Final = "imud"


class Stream(StrEnum):
    """Streams of a device. Each stream has its own sequence numbers without gaps."""

    SAMPLES = "samples"  # complete samples, numbered by `seq`
    STATISTICS = "statistics"  # statistics of intervals, numbered by the `seq` of their samples
    EVENTS = "events"  # events, numbered from 1 since the start of the daemon


STATE: Final = "state"
STATUS: Final = "status"
SCHEMA: Final = "schema"
SETTINGS: Final = "settings"
COMMAND: Final = "command"
ANSWER: Final = "answer"
_DEVICE_TOPICS: Final = frozenset((*Stream, STATUS, SETTINGS, SCHEMA, COMMAND, ANSWER))
_GATEWAY_TOPICS: Final = frozenset((STATE, Stream.EVENTS))


class TopicParts(NamedTuple):
    site: str
    gateway: str
    device: str  # device name; empty for a topic of the gateway
    leaf: str  # `state`, `status`, `settings`, `schema`, `command`, `answer`, or the name of a `Stream`


def topic_of(site: str, gateway: str, device: str, leaf: str) -> str:
    """Return the topic of a device; empty `device`: of the gateway. Raises ValueError for an invalid name or `leaf`."""
    names = (site, gateway, device) if device else (site, gateway)
    for name in names:
        if not is_name(name):
            raise ValueError(f"expected a name of 1 to 64 letters, digits, '_' or '-', got {name!r}")
    if leaf not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        raise ValueError(f"expected the last level of a topic of a {'device' if device else 'gateway'}, got {leaf!r}")
    return "/".join((ROOT, *names, leaf))


def parse_topic(topic: str) -> TopicParts | None:
    """Return the parts of a topic; None if the topic does not belong to a gateway."""
    parts = topic.split("/")
    if parts[0] != ROOT or len(parts) not in (4, 5) or not all(map(is_name, parts)):
        return None
    device = parts[3] if len(parts) == 5 else ""
    if parts[-1] not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        return None
    return TopicParts(parts[1], parts[2], device, parts[-1])


VERSION: Final = 1
MAGIC: Final = b"IMUB"
# Maximum number of slots in one message: 160 kB before compression. After it, messages of real data stay far below
# 128 kB, the smallest limit of the large cloud brokers.
SLOTS_MAX: Final = 500
# Size of a slot by the version of the message. Version 1 omits the last bytes of slots, which are 0 in most slots.
_NO_MORE: Final = bytes(SLOT_BYTES - SLOT_BYTES_V1)
_SLOT_BYTES: Final = {1: SLOT_BYTES_V1, SLOT_LAYOUT_VERSION: SLOT_BYTES}
SAMPLES_MAX: Final = 200  # maximum number of samples in one JSON message, about 100 kB
HEADER_MAX: Final = 4096
LEVEL: Final = 3  # compression level of Zstandard, its default
# Limit of the absolute value of integers. The sum of two such numbers fits into 64 bits. ns since 1970 reach it in
# 2116.
NUMBER_MOST: Final = 1 << 62
# Start of 2020 as CLOCK_REALTIME, ns. A clock with an earlier time is not set.
CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
_NUL: Final = b"\\u0000"  # escaped NUL in a JSON string, or an escaped backslash followed by `u0000`
# Pattern of an escaped NUL only. This search takes ten times as long as the decoding.
_NUL_ALONE: Final = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
_PREFIX: Final = struct.Struct("<4sBBH")
JSON_TYPE: Final = "application/json"
SLOTS_TYPE: Final = "application/vnd.imud.slots+zstd"


class MessageKind(StrEnum):
    """Kinds of stream messages."""

    SAMPLES = "samples"  # complete samples as JSON
    SLOTS = "slots"  # complete samples as compressed slots
    INTERVALS = "intervals"  # statistics of intervals
    EVENTS = "events"
    DROPPED = "dropped"  # only the numbers and the cause of dropped samples or events


class DropCause(StrEnum):
    """Causes for which a gateway drops samples or events."""

    QUEUE = "queue"  # the queue of the spool writer was full
    SPACE = "space"  # the spool was full and contained only statistics
    AGE = "age"  # the message was older than the maximum age in the spool
    DISK = "disk"  # the disk was full or failed
    OFF = "off"  # the output did not run, for example during a change of its configuration
    DAMAGED = "damaged"  # the message in the spool was damaged


class Measures(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Statistics of one quantity over an interval, one value per component; None for excluded measures."""

    mean: tuple[float, ...] | None = None
    min: tuple[float, ...] | None = None
    max: tuple[float, ...] | None = None
    rms: tuple[float, ...] | None = None


class Interval(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Statistics of the samples of one interval."""

    first: int  # `seq` of the first sample
    last: int
    count: int  # number of samples
    begin_t_ns: int  # `t_ns` of the first sample
    end_t_ns: int
    begin_utc_ns: int
    end_utc_ns: int
    t_err_ns: int  # maximum time stamp error of the samples
    sync: Sync  # worst synchronization of the samples
    values: dict[str, Measures]  # statistics by the names of the sample fields
    status: int | None = None  # bitwise OR of the status bits of all samples


class GatewayClock(msgspec.Struct, frozen=True, gc=False):
    """Wall clock of a gateway, as its kernel reports it (adjtimex(2))."""

    t_ns: int  # CLOCK_MONOTONIC of the reading
    utc_offset_ns: int  # CLOCK_REALTIME minus CLOCK_MONOTONIC at the reading
    # True if the kernel reports a synchronized clock (STA_UNSYNC not set). Otherwise the clock can have any error.
    synchronised: bool
    error_ns: int | None = None  # One-sigma error of the offset; None if the clock is not synchronized


class FleetMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True, kw_only=True):
    """Message of a stream."""

    v: int  # version of the format, VERSION
    gateway: str
    # Identifier of the start of the daemon, 16 hexadecimal digits: `epoch` on the socket and in shared memory
    boot: str
    device: str  # device name; empty for the gateway
    kind: MessageKind
    begin: int  # first number of the stream in this boot
    first: int  # first number that this message covers
    last: int
    count: int  # number of samples or events in this range
    utc_ns: int  # CLOCK_REALTIME of the newest sample or event
    # Wall clock when the message was made; None if the version of the gateway does not send it
    clock: GatewayClock | None = None
    cause: DropCause | None = None  # cause of the loss, for the kind `dropped`
    samples: list[Sample] = []  # msgspec copies a mutable default
    intervals: list[Interval] = []
    events: list[Event] = []

    @property
    def newest_t_ns(self) -> int | None:
        """Return CLOCK_MONOTONIC of the newest sample or event; None if the message has no `clock`."""
        return None if self.clock is None else self.utc_ns - self.clock.utc_offset_ns


class MessageHead(msgspec.Struct, frozen=True, gc=False):
    """Fields of a `FleetMessage` that identify it."""

    gateway: str
    boot: str
    device: str
    first: int
    last: int


_ENCODER: Final = msgspec.json.Encoder()
_DECODER: Final = msgspec.json.Decoder(FleetMessage)
_HEAD_DECODER: Final = msgspec.json.Decoder(MessageHead)


def boot_text(epoch: int) -> str:
    """Return the epoch as a string, because JSON in other languages has no integers above 2⁵³."""
    return f"{epoch & 0xFFFF_FFFF_FFFF_FFFF:016x}"


def encode_message(message: FleetMessage) -> bytes:
    """Return the payload as JSON, without sample fields that contain NaN or infinity."""
    payload = _ENCODER.encode(message)
    # "null" can also be a value that the device sent as None; this check avoids a search in most messages
    if message.samples and b"null" in payload:
        payload = _ENCODER.encode(msgspec.structs.replace(message, samples=[finite(one) for one in message.samples]))
    return payload


def encode_slots_message(message: FleetMessage, slots: Sequence[bytes]) -> bytes:
    """Return the payload with 1 to SLOTS_MAX slots."""
    header = _ENCODER.encode(message)
    version = SLOT_LAYOUT_VERSION if any(slot[SLOT_BYTES_V1:] != _NO_MORE for slot in slots) else 1
    packed = b"".join(slots if version > 1 else [slot[:SLOT_BYTES_V1] for slot in slots])
    compressed = FrameEncoder(LEVEL).encode(packed)
    return _PREFIX.pack(MAGIC, version, 0, len(header)) + header + compressed


def decode_message(payload: bytes) -> FleetMessage:
    """Return the message of a payload, with its slots as samples. Raises ValueError if the payload is invalid."""
    try:
        message = _decode_slots(payload) if payload.startswith(MAGIC) else _DECODER.decode(checked_json(payload))
    except (msgspec.DecodeError, RecursionError, struct.error) as error:
        raise ValueError(f"expected a message of a gateway, got {len(payload)} other bytes") from error
    if message.v != VERSION:
        raise ValueError(f"expected a message of version {VERSION}, got {message.v}: the gateway has a newer imud")
    if not 0 < message.begin <= message.first <= message.last:
        raise ValueError(f"expected numbers in order, got {message.begin}, {message.first} and {message.last}")
    numbers = message.last - message.first + 1
    if len(message.events) > numbers:
        raise ValueError(f"expected one event per number, got {len(message.events)} events for {numbers} numbers")
    check_boot(message.boot)
    check_numbers(_numbers(message))
    return message


def check_payload(payload: bytes) -> MessageHead:
    """Return the head of a payload after checking its JSON and its slots. Raises ValueError if they are invalid. This
    function does not check values. It takes at most a third of the time of `decode_message`."""
    try:
        if not payload.startswith(MAGIC):
            return _HEAD_DECODER.decode(payload)
        header, slots, slot_bytes = _parts_of_slots(payload)
        _decompressed(slots, slot_bytes)
        return _HEAD_DECODER.decode(header)
    except (msgspec.DecodeError, RecursionError, struct.error) as error:
        raise ValueError(f"expected a message of a gateway, got {len(payload)} other bytes") from error


def checked_json(payload: bytes) -> bytes:
    """Return `payload`. Raises ValueError if a JSON string contains NUL."""
    # the first test is cheap and excludes nearly all payloads
    if _NUL in payload and _NUL_ALONE.search(payload):
        raise ValueError("expected strings without NUL, got a string with NUL")
    return payload


def check_boot(boot: str) -> None:
    """Raise ValueError if `boot` cannot identify a start of the daemon."""
    if not is_name(boot):
        raise ValueError(f"expected a boot of 1 to 64 letters, digits, '_' or '-', got {boot[:100]!r}")


def check_numbers(numbers: Iterable[int | None]) -> None:
    """Raise ValueError if the absolute value of a number is NUMBER_MOST or more."""
    for number in numbers:
        if number is not None and abs(number) >= NUMBER_MOST:
            raise ValueError(f"expected numbers below 2**62, got a number of {number.bit_length()} bits")


def clock_numbers(clock: GatewayClock | None) -> tuple[int | None, ...]:
    return () if clock is None else (clock.t_ns, clock.utc_offset_ns, clock.error_ns)


def _numbers(message: FleetMessage) -> Iterable[int | None]:
    """Return all integers of a message except components of physical values."""
    yield from (message.last, message.count, message.utc_ns, *clock_numbers(message.clock))
    for sample in message.samples:
        yield from (
            sample.seq, sample.t_ns, sample.t_err_ns, sample.t_rx_ns, sample.utc_ns, sample.t_dev_ns, sample.status,
            sample.pps_age_ms, sample.edge_seq, sample.gnss_utc_ns,
        )  # fmt: skip
        if (position := sample.position) is not None:
            yield from (position.quality, position.satellites)
    for one in message.intervals:
        yield from (
            one.first, one.last, one.count, one.begin_t_ns, one.end_t_ns, one.begin_utc_ns, one.end_utc_ns,
            one.t_err_ns, one.status,
        )  # fmt: skip
    for event in message.events:
        yield event.t_ns


def _parts_of_slots(payload: bytes) -> tuple[bytes, bytes, int]:
    """Return the header, the compressed slots, and the size of a slot."""
    _, version, _, size = _PREFIX.unpack_from(payload)
    if version not in _SLOT_BYTES or size > HEADER_MAX:
        raise ValueError(
            f"expected slots of version 1 to {SLOT_LAYOUT_VERSION}, got {version} and a header of {size} bytes; is the "
            "imud of the gateway newer?"
        )
    begin = _PREFIX.size
    return payload[begin : begin + size], payload[begin + size :], _SLOT_BYTES[version]


def _decompressed(frame: bytes, slot_bytes: int) -> bytes:
    # the sender declares this size, and the decompressor allocates it
    if not 0 < (size := content_size(frame)) <= SLOTS_MAX * slot_bytes:
        raise ValueError(f"expected 1 to {SLOTS_MAX} slots, got {size} bytes")
    slots = decode_frame(frame)
    if len(slots) % slot_bytes:
        raise ValueError(f"expected slots of {slot_bytes} bytes, got {len(slots)}")
    return slots


def _decode_slots(payload: bytes) -> FleetMessage:
    header, frame, slot_bytes = _parts_of_slots(payload)
    message = _DECODER.decode(checked_json(header))
    slots = _decompressed(frame, slot_bytes)
    samples = [
        decode_slot(slots[at : at + slot_bytes].ljust(SLOT_BYTES, b"\0"), message.device)
        for at in range(0, len(slots), slot_bytes)
    ]
    return msgspec.structs.replace(message, samples=samples)


def finite(sample: Sample) -> Sample:
    """Return the sample without fields that contain a value that is not finite."""
    bad: dict[str, None] = {}
    for name in sample.__struct_fields__:
        value = getattr(sample, name)
        parts = values_of(value) if isinstance(value, Position) else value if isinstance(value, tuple) else (value,)
        if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
            bad[name] = None
    return msgspec.structs.replace(sample, **bad) if bad else sample


# Maximum length of a request, bytes. The longest arguments of a command have some hundred bytes.
REQUEST_BYTES: Final = 4096
Id = Annotated[str, msgspec.Meta(pattern=f"^{NAME_PATTERN}$")]


class Outcome(StrEnum):
    """Outcomes of a request."""

    DONE = "done"  # the command ran; `result` contains its return value
    # The device or a check rejected the command, or the command did not end; `error` contains the cause
    FAILED = "failed"
    DENIED = "denied"  # the configuration of the gateway does not allow the command
    # The request is too old, from the future, or from before the start of the gateway, or the gateway clock is not set
    STALE = "stale"
    DUPLICATE = "duplicate"  # The gateway already received a request with this ID. It has sent or will send the reply.
    BUSY = "busy"  # too many requests are waiting, or too many requests arrived within a minute


class CommandRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request for one command of one device."""

    v: int  # version of the format, VERSION
    id: Id  # Identifier of the request. The sender must use a new ID for each request.
    action: Id  # name of the command, as in `imud command`
    arguments: dict[str, Any] = {}  # msgspec copies a mutable default
    issued_utc_ns: int  # CLOCK_REALTIME of the sender. The gateway rejects old requests.


class CommandAnswer(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """Reply to a request."""

    v: int
    id: str
    gateway: str
    device: str
    action: str
    outcome: Outcome
    result: Any = None
    error: str = ""  # cause of the failure, one sentence


_REQUEST_DECODER: Final = msgspec.json.Decoder(CommandRequest)


def decode_request(payload: bytes) -> CommandRequest:
    """Return the request of a payload. Raises ValueError if the payload is invalid."""
    if len(payload) > REQUEST_BYTES:
        raise ValueError(f"expected at most {REQUEST_BYTES} bytes, got {len(payload)}")
    try:
        request = _REQUEST_DECODER.decode(payload)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"expected a request as JSON: {reason_of(error)}") from error
    if request.v != VERSION:
        raise ValueError(f"expected a request of version {VERSION}, got {request.v}")
    return request


def answer_topic(site: str, gateway: str, device: str, wanted: str = "") -> str | None:
    """Return the topic of a reply: `wanted` if it is below the reply topic of the device, otherwise None.

    An empty `wanted` means the reply topic of the device. A sender of requests must not be able to make the gateway
    write to other topics.
    """
    own = topic_of(site, gateway, device, ANSWER)
    if not wanted or wanted == own:
        return own
    head, _, name = wanted.rpartition("/")
    return wanted if head == own and is_name(name) else None
