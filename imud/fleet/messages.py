"""Payloads of gateways: every one of a stream begins with a header by which a reader keeps the ledger.

    JSON      {"v": 1, "gateway": …, "boot": …, "device": …, "kind": …, "first": 1, "last": 200, …}
    slots     "IMUB" | version, u8 | 0 | header bytes, u16 | header, JSON | Zstandard frame of slots, 256 bytes each

Little-endian. Numbers `first` to `last` of a stream are covered by exactly one message, whatever its kind: whole
samples, what is left of them when the spool had no room (`intervals` in the stream `samples`), or that they were
dropped and why (`dropped`). What no message covers was lost on the way, and what two cover came twice.

Whoever may publish on a broker can send anything, and what is decoded here goes into databases: numbers are so small
that two of them add up within 64 bits, texts have no NUL, which PostgreSQL does not store.
"""

import math
import re
import struct
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import zstandard

from imud.formats.slot import SLOT_BYTES, decode_slot
from imud.model.errors import reason_of
from imud.model.event import Event
from imud.model.sample import Sample, Sync

ROOT: Final = "imud"
NAME_PATTERN: Final = "[A-Za-z0-9_-]{1,64}"
"""64 characters: of a topic of 65,535 bytes every name takes a small part, and a client id of three stays short."""
_NAME: Final = re.compile(NAME_PATTERN)


class Stream(StrEnum):
    """What is counted by itself: each stream of each device has numbers without gaps."""

    SAMPLES = "samples"
    """Whole samples, by their `seq`."""
    STATISTICS = "statistics"
    """Intervals, by the `seq` of the samples in them."""
    EVENTS = "events"
    """Events, counted from 1 since the start of the daemon."""


STATE: Final = "state"
STATUS: Final = "status"
SCHEMA: Final = "schema"
SETTINGS: Final = "settings"
COMMAND: Final = "command"
ANSWER: Final = "answer"
_DEVICE_TOPICS: Final = frozenset((*Stream, STATUS, SETTINGS, SCHEMA, COMMAND, ANSWER))
_GATEWAY_TOPICS: Final = frozenset((STATE, Stream.EVENTS))


class TopicParts(NamedTuple):
    """A topic, taken apart."""

    site: str
    gateway: str
    device: str
    """Empty for what is of the gateway itself."""
    leaf: str
    """`state`, `status`, `settings`, `schema`, `command`, `answer`, or the name of a `Stream`."""


def is_name(text: str) -> bool:
    """Whether a text can be the name of a site, a gateway or a device."""
    return _NAME.fullmatch(text) is not None


def topic_of(site: str, gateway: str, device: str, leaf: str) -> str:
    """Make a topic; without a device that of the gateway. Raises ValueError for a name that is none."""
    names = (site, gateway, device) if device else (site, gateway)
    for name in names:
        if not is_name(name):
            raise ValueError(f"expected a name of 1 to 64 letters, digits, '_' or '-', got {name!r}")
    if leaf not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        raise ValueError(f"expected the end of a topic of a {'device' if device else 'gateway'}, got {leaf!r}")
    return "/".join((ROOT, *names, leaf))


def parse_topic(topic: str) -> TopicParts | None:
    """Take a topic apart; None for one that is no gateway's."""
    parts = topic.split("/")
    if parts[0] != ROOT or len(parts) not in (4, 5) or not all(map(is_name, parts)):
        return None
    device = parts[3] if len(parts) == 5 else ""
    if parts[-1] not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        return None
    return TopicParts(parts[1], parts[2], device, parts[-1])


VERSION: Final = 1
MAGIC: Final = b"IMUB"
SLOTS_MAX: Final = 500
"""Slots in one message: 128 kB before compression, which is the smallest limit of the large brokers' services."""
SAMPLES_MAX: Final = 200
"""Samples in one JSON message: about 100 kB."""
HEADER_MAX: Final = 4096
LEVEL: Final = 3
"""Of Zstandard, its own default."""
NUMBER_MOST: Final = 1 << 62
"""Numbers are smaller, either way; ns since 1970 reach it in 2116."""
_NUL: Final = b"\\u0000"
"""NUL in a text of JSON, or a backslash and five characters."""
_NUL_ALONE: Final = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
"""Only the first of these; looking for it takes ten times as long as the decoding."""
_PREFIX: Final = struct.Struct("<4sBBH")
JSON_TYPE: Final = "application/json"
SLOTS_TYPE: Final = "application/vnd.imud.slots+zstd"


class MessageKind(StrEnum):
    """Kinds of messages of a stream."""

    SAMPLES = "samples"
    """Whole samples as JSON."""
    SLOTS = "slots"
    """Whole samples as compressed slots."""
    INTERVALS = "intervals"
    """Statistics of intervals."""
    EVENTS = "events"
    DROPPED = "dropped"
    """Nothing but the numbers of what was dropped by the gateway, and why."""


class DropCause(StrEnum):
    """Reasons for which a gateway drops what it was to send."""

    QUEUE = "queue"
    """The writer of the spool was too slow."""
    SPACE = "space"
    """The spool was full of what cannot be thinned any more."""
    AGE = "age"
    """It waited for longer than the spool keeps anything."""
    DISK = "disk"
    """The disk was full, or failed."""
    OFF = "off"
    """The output did not run, for example while its settings were changed."""
    DAMAGED = "damaged"
    """The spool gave back what it was not given."""


class Measures(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Statistics of one quantity over an interval, a value for each of its components; left out are those not asked."""

    mean: tuple[float, ...] | None = None
    min: tuple[float, ...] | None = None
    max: tuple[float, ...] | None = None
    rms: tuple[float, ...] | None = None


class Interval(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Samples of one interval of time, summed up."""

    first: int
    """`seq` of its first sample."""
    last: int
    count: int
    """Samples in it."""
    begin_t_ns: int
    """`t_ns` of the first sample."""
    end_t_ns: int
    begin_utc_ns: int
    end_utc_ns: int
    t_err_ns: int
    """The largest of all samples."""
    sync: Sync
    """The worst of all samples."""
    values: dict[str, Measures]
    """By the names that samples have."""
    status: int | None = None
    """Status bits that any of the samples had."""


class GatewayClock(msgspec.Struct, frozen=True, gc=False):
    """The wall clock of a gateway, as its kernel reports it (adjtimex(2))."""

    t_ns: int
    """CLOCK_MONOTONIC when it was read."""
    utc_offset_ns: int
    """CLOCK_REALTIME less CLOCK_MONOTONIC then."""
    synchronised: bool
    """Whether something keeps it: STA_UNSYNC is not set. Otherwise it can be wrong by any amount."""
    error_ns: int | None = None
    """One-sigma error of the offset; None while it is not synchronised."""


class FleetMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True, kw_only=True):
    """A message of a stream."""

    v: int
    """VERSION."""
    gateway: str
    boot: str
    """Number of the daemon's start, 16 hexadecimal digits: `epoch` on the socket and in shared memory."""
    device: str
    """Empty for the gateway itself."""
    kind: MessageKind
    begin: int
    """Number with which the stream began in this boot."""
    first: int
    """The first number that this message covers."""
    last: int
    count: int
    """Samples, or events, that the numbers stand for."""
    utc_ns: int
    """CLOCK_REALTIME of the newest of it."""
    clock: GatewayClock | None = None
    """The wall clock when the message was made; None of one by a version that did not say."""
    cause: DropCause | None = None
    """Why it was dropped."""
    samples: list[Sample] = []  # msgspec copies a mutable default
    intervals: list[Interval] = []
    events: list[Event] = []

    @property
    def newest_t_ns(self) -> int | None:
        """CLOCK_MONOTONIC of the newest of it; None of a message that does not speak of the clock."""
        return None if self.clock is None else self.utc_ns - self.clock.utc_offset_ns


class MessageHead(msgspec.Struct, frozen=True, gc=False):
    """What a message says of itself, as `FleetMessage` does."""

    gateway: str
    boot: str
    device: str
    first: int
    last: int


_ENCODER: Final = msgspec.json.Encoder()
_DECODER: Final = msgspec.json.Decoder(FleetMessage)
_HEAD_DECODER: Final = msgspec.json.Decoder(MessageHead)


def boot_text(epoch: int) -> str:
    """The number of a start as text: JSON of other languages has no integers above 2⁵³."""
    return f"{epoch & 0xFFFF_FFFF_FFFF_FFFF:016x}"


def encode_message(message: FleetMessage) -> bytes:
    """The payload as JSON. Values that JSON does not have (not a number, infinity) are left out of samples."""
    payload = _ENCODER.encode(message)
    if message.samples and b"null" in payload:
        payload = _ENCODER.encode(msgspec.structs.replace(message, samples=[finite(one) for one in message.samples]))
    return payload


def encode_slots_message(message: FleetMessage, slots: Sequence[bytes]) -> bytes:
    """The payload with slots, 1 to SLOTS_MAX of them."""
    header = _ENCODER.encode(message)
    compressed = zstandard.ZstdCompressor(level=LEVEL).compress(b"".join(slots))
    return _PREFIX.pack(MAGIC, VERSION, 0, len(header)) + header + compressed


def decode_message(payload: bytes) -> FleetMessage:
    """The message in a payload, slots as samples. Raises ValueError for anything else."""
    try:
        message = _decode_slots(payload) if payload.startswith(MAGIC) else _DECODER.decode(checked_json(payload))
    except (msgspec.DecodeError, RecursionError, zstandard.ZstdError, struct.error) as error:
        raise ValueError(f"expected a message of a gateway, got {len(payload)} other bytes") from error
    if message.v != VERSION:
        raise ValueError(f"expected a message of version {VERSION}, got {message.v}: the gateway has a newer imud")
    if not 0 < message.begin <= message.first <= message.last:
        raise ValueError(f"expected numbers in order, got {message.begin}, {message.first} and {message.last}")
    numbers = message.last - message.first + 1
    if len(message.events) > numbers:
        raise ValueError(f"expected an event per number, got {len(message.events)} events for {numbers} numbers")
    check_boot(message.boot)
    check_numbers(_numbers(message))
    return message


def check_payload(payload: bytes) -> MessageHead:
    """What a payload says of itself, where its JSON and its slots can be read. Raises ValueError for anything else.

    It costs a third of `decode_message` at most, and does not look at values.
    """
    try:
        if not payload.startswith(MAGIC):
            return _HEAD_DECODER.decode(payload)
        header, slots = _parts_of_slots(payload)
        _decompressed(slots)
        return _HEAD_DECODER.decode(header)
    except (msgspec.DecodeError, RecursionError, zstandard.ZstdError, struct.error) as error:
        raise ValueError(f"expected a message of a gateway, got {len(payload)} other bytes") from error


def checked_json(payload: bytes) -> bytes:
    """The payload itself. Raises ValueError for JSON with NUL in a text."""
    if _NUL in payload and _NUL_ALONE.search(payload):
        raise ValueError("expected text without NUL, got one with it")
    return payload


def check_boot(boot: str) -> None:
    """Raises ValueError for what cannot be the number of a start."""
    if not is_name(boot):
        raise ValueError(f"expected the number of a start, 1 to 64 letters, digits, '_' or '-', got {boot[:100]!r}")


def check_numbers(numbers: Iterable[int | None]) -> None:
    """Raises ValueError for a number from NUMBER_MOST on."""
    for number in numbers:
        if number is not None and abs(number) >= NUMBER_MOST:
            raise ValueError(f"expected numbers below 2**62, got one of {number.bit_length()} bits")


def clock_numbers(clock: GatewayClock | None) -> tuple[int | None, ...]:
    """The numbers in what a gateway says of its clock."""
    return () if clock is None else (clock.t_ns, clock.utc_offset_ns, clock.error_ns)


def _numbers(message: FleetMessage) -> Iterable[int | None]:
    """All numbers that are no component of a physical value."""
    yield from (message.last, message.count, message.utc_ns, *clock_numbers(message.clock))
    for sample in message.samples:
        yield from (
            sample.seq, sample.t_ns, sample.t_err_ns, sample.t_rx_ns, sample.utc_ns, sample.t_dev_ns, sample.status,
            sample.pps_age_ms, sample.edge_seq,
        )  # fmt: skip
    for one in message.intervals:
        yield from (
            one.first, one.last, one.count, one.begin_t_ns, one.end_t_ns, one.begin_utc_ns, one.end_utc_ns,
            one.t_err_ns, one.status,
        )  # fmt: skip
    for event in message.events:
        yield event.t_ns


def _parts_of_slots(payload: bytes) -> tuple[bytes, bytes]:
    """The header, and the frame of slots."""
    _, version, _, size = _PREFIX.unpack_from(payload)
    if version != VERSION or size > HEADER_MAX:
        raise ValueError(f"expected slots of version {VERSION}, got {version} and a header of {size} bytes")
    begin = _PREFIX.size
    return payload[begin : begin + size], payload[begin + size :]


def _decompressed(frame: bytes) -> bytes:
    if not 0 < zstandard.frame_content_size(frame) <= SLOTS_MAX * SLOT_BYTES:  # it decides how much is allocated
        raise ValueError(f"expected 1 to {SLOTS_MAX} slots, got {zstandard.frame_content_size(frame)} bytes")
    slots = zstandard.ZstdDecompressor().decompress(frame)
    if len(slots) % SLOT_BYTES:
        raise ValueError(f"expected slots of {SLOT_BYTES} bytes, got {len(slots)}")
    return slots


def _decode_slots(payload: bytes) -> FleetMessage:
    header, frame = _parts_of_slots(payload)
    message = _DECODER.decode(checked_json(header))
    slots = _decompressed(frame)
    samples = [
        decode_slot(slots[at : at + SLOT_BYTES], message.device) for at in range(0, len(slots), SLOT_BYTES)
    ]  # fmt: skip
    return msgspec.structs.replace(message, samples=samples)


def finite(sample: Sample) -> Sample:
    """The sample without vectors and values that have a component which is not finite."""
    bad: dict[str, None] = {}
    for name in sample.__struct_fields__:
        value = getattr(sample, name)
        parts = value if isinstance(value, tuple) else (value,)
        if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
            bad[name] = None
    return msgspec.structs.replace(sample, **bad) if bad else sample


REQUEST_BYTES: Final = 4096
"""Of a request: the longest arguments of any action have some hundred."""
Id = Annotated[str, msgspec.Meta(pattern=f"^{NAME_PATTERN}$")]


class Outcome(StrEnum):
    """Ends of a request."""

    DONE = "done"
    """The action ran; `result` has what it returned."""
    FAILED = "failed"
    """The action was refused by the device or by its checks, or did not end; `error` says why."""
    DENIED = "denied"
    """The gateway's configuration does not have the action in its list."""
    STALE = "stale"
    """The request is too old, of the future, or of before the gateway's start; or the gateway's clock is not set."""
    DUPLICATE = "duplicate"
    """A request with this id came before, and has or will have its answer."""
    BUSY = "busy"
    """Too many requests wait, or came within a minute."""


class CommandRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request for one action of one device."""

    v: int
    """VERSION."""
    id: Id
    """Chosen by who asks, another one for each request."""
    action: Id
    """As `imud command` takes it."""
    arguments: dict[str, Any] = {}  # msgspec copies a mutable default
    issued_utc_ns: int
    """CLOCK_REALTIME of who asks: an old request is not carried out."""


class CommandAnswer(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """The answer to a request."""

    v: int
    id: str
    gateway: str
    device: str
    action: str
    outcome: Outcome
    result: Any = None
    error: str = ""
    """Why it is not done, one sentence."""


_REQUEST_DECODER: Final = msgspec.json.Decoder(CommandRequest)


def decode_request(payload: bytes) -> CommandRequest:
    """The request in a payload. Raises ValueError for anything else."""
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
    """The topic of an answer: the device's own, or below it the one that is wanted; None where that is elsewhere.

    A gateway answers nowhere else: who may ask it could otherwise make it write where only it may write.
    """
    own = topic_of(site, gateway, device, ANSWER)
    if not wanted or wanted == own:
        return own
    head, _, name = wanted.rpartition("/")
    return wanted if head == own and is_name(name) else None
