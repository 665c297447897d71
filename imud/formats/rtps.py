"""RTPS messages of DDS (OMG formal/2014-09-01, RTPS 2.2): submessages and the data of discovery.

    header │ INFO_TS │ DATA │ HEARTBEAT     section 8.3: message = header and submessages
           └─ a submessage: id, flags (bit 0: little endian), length, content

`RtpsReader` reads the messages of other participants. It never raises an exception for any input. All functions that
make submessages use little endian. A GUID has 16 bytes: the prefix of the participant (12) and the entity (4).
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address
from struct import Struct
from typing import Final, NamedTuple

from imud.model.units import NS_PER_S

PREFIX_BYTES: Final = 12
GUID_BYTES: Final = 16
MAGIC: Final = b"RTPS\x02\x02"  # protocol 2.2
VENDOR: Final = b"\0\0"  # VENDORID_UNKNOWN (section 9.3.1.2): imud has no number of the OMG
HEADER_BYTES: Final = 20
PAYLOAD_MAX: Final = 64_000  # maximum payload without fragments, bytes: a UDP datagram has at most 65,507 bytes

# Entities (section 9.3.1.3)
PARTICIPANT: Final = b"\x00\x00\x01\xc1"
PARTICIPANT_WRITER: Final = b"\x00\x01\x00\xc2"
PARTICIPANT_READER: Final = b"\x00\x01\x00\xc7"
PUBLICATIONS_WRITER: Final = b"\x00\x00\x03\xc2"
PUBLICATIONS_READER: Final = b"\x00\x00\x03\xc7"
SUBSCRIPTIONS_WRITER: Final = b"\x00\x00\x04\xc2"
SUBSCRIPTIONS_READER: Final = b"\x00\x00\x04\xc7"
ANY_ENTITY: Final = b"\0\0\0\0"
KIND_WRITER_NO_KEY: Final = 0x03
# Endpoints that imud has (section 8.5.4.3): announcer and detector of participants, announcer of publications,
# detector of subscriptions. imud has no reader and needs no publications of other participants.
BUILTIN_ENDPOINTS: Final = 1 | 2 | 4 | 32

# Submessages (section 9.4.5)
ACKNACK, HEARTBEAT, GAP, INFO_TS, INFO_SRC, INFO_DST, DATA = 0x06, 0x07, 0x08, 0x09, 0x0C, 0x0E, 0x15
# Parameters (section 9.6.2.2)
P_SENTINEL, P_LEASE, P_TOPIC, P_TYPE, P_VERSION, P_VENDOR, P_RELIABILITY = 0x01, 0x02, 0x05, 0x07, 0x15, 0x16, 0x1A
P_LIVELINESS, P_DURABILITY, P_OWNERSHIP, P_DEADLINE, P_PARTITION, P_USER_DATA = 0x1B, 0x1D, 0x1F, 0x23, 0x29, 0x2C
P_UNICAST, P_DEFAULT_UNICAST, P_META_UNICAST, P_PARTICIPANT_GUID, P_BUILTIN = 0x2F, 0x31, 0x32, 0x50, 0x58
P_ENDPOINT_GUID, P_ENTITY_NAME, P_KEY_HASH, P_STATUS_INFO, P_DOMAIN = 0x5A, 0x62, 0x70, 0x71, 0x0F

MUST_UNDERSTAND: Final = 0x4000  # flag in the number of a parameter (section 9.6.2.2.1)

PL_CDR_LE: Final = b"\x00\x03\x00\x00"
UDP_V4: Final = 1  # kind of a locator
BEST_EFFORT, RELIABLE = 1, 2
VOLATILE, TRANSIENT_LOCAL = 0, 1
SHARED: Final = 0  # ownership
DISPOSED_UNREGISTERED: Final = b"\0\0\0\x03"  # status: the object is disposed and unregistered
INFINITE_S: Final = 0x7FFF_FFFF
DEFAULT_LEASE_S: Final = 100  # lease of a participant that does not send it (section 9.6.3.1)
BITS_MAX: Final = 256  # maximum number of sequence numbers in an ACKNACK or a GAP (section 9.4.2.6)

# Limits of received messages. They bound the work for one submessage and the stored state.
SEQ_MAX: Final = 1 << 62  # maximum sequence number: half of the range, so that no sum leaves the range of 64 bits
PARAMETERS_MAX: Final = 256  # maximum number of parameters in one list; Fast DDS sends about 40
LOCATORS_MAX: Final = 16  # maximum number of addresses of one kind; a host has one for each network interface
TEXT_BYTES_MAX: Final = 256  # maximum length of a topic or type; ROS 2 permits 255 characters

_TS, _DATA = Struct("<BBHiI"), Struct("<BBHHH4s4siI")
_HEARTBEAT: Final = Struct("<BBH4s4siIiIi")
_LOW_MASK: Final = 0xFFFF_FFFF  # low half of a sequence number


class Locator(NamedTuple):
    """IPv4 address and UDP port."""

    address: str
    port: int


def header(prefix: bytes) -> bytes:
    """Return the header of each message of a participant."""
    return MAGIC + VENDOR + prefix


def info_ts(utc_ns: int) -> bytes:
    """Return the source time stamp of the following DATA. Times outside the range of 32 bits wrap."""
    sec, ns = divmod(utc_ns, NS_PER_S)
    return _TS.pack(INFO_TS, 1, 8, sec & 0x7FFF_FFFF, (ns << 32) // NS_PER_S)


def data(
    writer: bytes, seq: int, payload: bytes, *, reader: bytes = ANY_ENTITY, key: bytes = b"", ended: bool = False
) -> bytes:
    """Return a DATA submessage. `key`: GUID of the described object, for discovery. `ended`: the object no longer
    exists, and the payload is its key."""
    payload += bytes(-len(payload) % 4)
    inline, flags = b"", 0x05
    if key:
        status = [(P_STATUS_INFO, DISPOSED_UNREGISTERED)] if ended else []
        inline, flags = parameters([(P_KEY_HASH, key), *status]), 0x0B if ended else 0x07
    size = 20 + len(inline) + len(payload)
    return _DATA.pack(DATA, flags, size, 0, 16, reader, writer, seq >> 32, seq & _LOW_MASK) + inline + payload


def heartbeat(
    writer: bytes, first: int, last: int, count: int, *, reader: bytes = ANY_ENTITY, final: bool = False
) -> bytes:
    """Return the announcement of the available sequence numbers. `final`: a reader without losses need not reply."""
    return _HEARTBEAT.pack(
        HEARTBEAT, 0x03 if final else 0x01, 28, reader, writer, first >> 32, first & _LOW_MASK, last >> 32,
        last & _LOW_MASK, count & 0x7FFF_FFFF,
    )  # fmt: skip


def gap(writer: bytes, reader: bytes, numbers: Sequence[int]) -> bytes:
    """Return the statement that these sequence numbers are not available: at least one, in ascending order, in a range
    of at most BITS_MAX numbers."""
    start = numbers[0]
    body = struct.pack("<4s4siI", reader, writer, start >> 32, start & _LOW_MASK)
    body += _number_set(start + 1, numbers[1:])
    return struct.pack("<BBH", GAP, 1, len(body)) + body


def acknack(reader: bytes, writer: bytes, base: int, missing: Sequence[int], count: int) -> bytes:
    """Return the receipt of all sequence numbers below `base` and the request of the `missing` ones."""
    body = struct.pack("<4s4s", reader, writer) + _number_set(base, missing) + struct.pack("<i", count & 0x7FFF_FFFF)
    return struct.pack("<BBH", ACKNACK, 0x01 if missing else 0x03, len(body)) + body


def _number_set(base: int, numbers: Sequence[int]) -> bytes:
    """Return a SequenceNumberSet (section 9.4.2.6): `base`, the number of bits, and the bits."""
    count = numbers[-1] - base + 1 if numbers else 0
    bits = [0] * ((count + 31) // 32)
    for seq in numbers:
        bits[(seq - base) // 32] |= 1 << (31 - (seq - base) % 32)
    return struct.pack(f"<iII{len(bits)}I", base >> 32, base & _LOW_MASK, count, *bits)


def info_dst(prefix: bytes) -> bytes:
    """Return the destination participant of the following submessages."""
    return struct.pack("<BBH12s", INFO_DST, 1, 12, prefix)


def parameters(values: Sequence[tuple[int, bytes]]) -> bytes:
    """Return a list of parameters, each padded to 4 bytes, with its end."""
    out = b""
    for number, value in values:
        padding = bytes(-len(value) % 4)
        out += struct.pack("<HH", number, len(value) + len(padding)) + value + padding
    return out + struct.pack("<HH", P_SENTINEL, 0)


def text(value: str) -> bytes:
    """Return a CDR string."""
    encoded = value.encode() + b"\0"
    return len(encoded).to_bytes(4, "little") + encoded


def octets(value: bytes) -> bytes:
    """Return a CDR sequence of octets."""
    return len(value).to_bytes(4, "little") + value


def locator(where: Locator) -> bytes:
    return struct.pack("<iI12x4s", UDP_V4, where.port, IPv4Address(where.address).packed)


def key_of(guid: bytes, *, is_participant: bool) -> bytes:
    """Return the payload of a DATA that ends an object."""
    return PL_CDR_LE + parameters([(P_PARTICIPANT_GUID if is_participant else P_ENDPOINT_GUID, guid)])


# --- read -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ReceivedData:
    """DATA of a builtin writer."""

    writer: bytes  # entity
    seq: int
    parameters: Mapping[int, Sequence[bytes]]  # of the payload
    is_little: bool  # byte order of the parameters
    key: bytes  # GUID in the inline parameters; empty without
    ended: bool  # the object no longer exists


@dataclass(frozen=True, slots=True)
class ReceivedHeartbeat:
    writer: bytes
    first: int
    last: int
    is_final: bool


@dataclass(frozen=True, slots=True)
class ReceivedGap:
    writer: bytes
    start: int
    end: int  # first sequence number after the gap
    more_numbers: Sequence[int]  # further sequence numbers that are not available


@dataclass(frozen=True, slots=True)
class ReceivedAckNack:
    reader: bytes
    writer: bytes
    base: int
    missing: Sequence[int]
    is_final: bool


Submessage = ReceivedData | ReceivedHeartbeat | ReceivedGap | ReceivedAckNack


class RtpsReader:
    """Reader of the messages for one participant. It counts invalid datagrams."""

    def __init__(self, prefix: bytes) -> None:
        self._prefix = prefix
        self.invalid = 0  # number of datagrams with an invalid or incomplete submessage

    def read(self, datagram: bytes) -> tuple[bytes, Iterator[Submessage | None]]:
        """Return the prefix of the sender and its submessages: None for a submessage that imud ignores.

        The iterator reads one submessage in each step, so that the caller can stop when its budget ends. Messages of
        this participant itself have no submessages.
        """
        if len(datagram) < HEADER_BYTES or datagram[:4] != MAGIC[:4] or datagram[4] != MAGIC[4]:
            self.invalid += 1
            return b"", iter(())
        prefix = datagram[8:HEADER_BYTES]
        if prefix == self._prefix:
            return prefix, iter(())
        return prefix, self._submessages(datagram)

    def _submessages(self, datagram: bytes) -> Iterator[Submessage | None]:
        try:
            yield from self._valid_submessages(datagram)
        except (struct.error, ValueError, IndexError):
            self.invalid += 1

    def _valid_submessages(self, datagram: bytes) -> Iterator[Submessage | None]:
        offset = HEADER_BYTES
        is_mine = True
        while offset + 4 <= len(datagram):
            kind = datagram[offset]
            flags = datagram[offset + 1]
            order = "<" if flags & 1 else ">"
            (size,) = struct.unpack_from(order + "H", datagram, offset + 2)
            # length 0: to the end of the datagram, except for PAD and INFO_TS (section 9.4.5.1.3)
            end = len(datagram) if size == 0 and kind not in (0x01, INFO_TS) else offset + 4 + size
            if end > len(datagram):
                raise ValueError
            if kind == INFO_SRC:
                return  # a relay; imud does not need it
            submessage: Submessage | None = None
            if kind == INFO_DST:
                is_mine = datagram[offset + 4 : end][:PREFIX_BYTES] in (self._prefix, bytes(PREFIX_BYTES))
            elif is_mine and kind in _READ:
                submessage = _READ[kind](datagram[offset + 4 : end], flags, order)
            yield submessage
            offset = end


def _data(body: bytes, flags: int, order: str) -> ReceivedData | None:
    to_inline, _reader, writer, high, low = struct.unpack_from(order + "xxH4s4siI", body)
    if writer not in (PARTICIPANT_WRITER, SUBSCRIPTIONS_WRITER):
        return None
    seq = _read_seq(high, low)
    at, key, status = 4 + to_inline, b"", 0
    if flags & 0x02:
        inline, at = _parameters(body, at, order)
        key = _first(inline, P_KEY_HASH)[:GUID_BYTES]
        status = int.from_bytes(_first(inline, P_STATUS_INFO)[:4], "big")
    found: Mapping[int, Sequence[bytes]] = {}
    is_little = True
    if flags & 0x0C:
        is_little = body[at + 1] == PL_CDR_LE[1]
        found, _ = _parameters(body, at + 4, "<" if is_little else ">")
    return ReceivedData(writer, seq, found, is_little, key, bool(status & 3))


def _heartbeat(body: bytes, flags: int, order: str) -> ReceivedHeartbeat | None:
    _reader, writer, high, low, last_high, last_low = struct.unpack_from(order + "4s4siIiI", body)
    if writer != SUBSCRIPTIONS_WRITER:
        return None
    first = max(1, _read_seq(high, low, minimum=0))  # older participants announce an empty writer with 0
    last = _read_seq(last_high, last_low, minimum=0)
    if last < first - 1:
        raise ValueError
    return ReceivedHeartbeat(writer, first, last, bool(flags & 2))


def _gap(body: bytes, _flags: int, order: str) -> ReceivedGap | None:
    _reader, writer, high, low = struct.unpack_from(order + "4s4siI", body)
    if writer != SUBSCRIPTIONS_WRITER:
        return None
    start = _read_seq(high, low)
    end, more_numbers = _read_number_set(body, 16, order, minimum=1)
    if end < start:
        raise ValueError
    return ReceivedGap(writer, start, end, more_numbers)


def _acknack(body: bytes, flags: int, order: str) -> ReceivedAckNack:
    reader, writer = struct.unpack_from("4s4s", body)
    # some participants begin with an empty set from 0
    base, missing = _read_number_set(body, 8, order, minimum=0)
    return ReceivedAckNack(reader, writer, base, missing, bool(flags & 2))


_READ: Final = {DATA: _data, HEARTBEAT: _heartbeat, GAP: _gap, ACKNACK: _acknack}


def _read_seq(high: int, low: int, *, minimum: int = 1) -> int:
    """Return a sequence number. Raises ValueError if it is out of range."""
    seq = (high << 32) + low
    if not minimum <= seq <= SEQ_MAX:
        raise ValueError
    return seq


def _read_number_set(body: bytes, offset: int, order: str, *, minimum: int) -> tuple[int, Sequence[int]]:
    """Return the base of a SequenceNumberSet and its numbers. Raises ValueError, struct.error."""
    high, low, count = struct.unpack_from(order + "iII", body, offset)
    base = _read_seq(high, low, minimum=minimum)
    if count > BITS_MAX:
        raise ValueError
    words = struct.unpack_from(f"{order}{(count + 31) // 32}I", body, offset + 12)
    return base, [base + bit for bit in range(count) if words[bit // 32] >> (31 - bit % 32) & 1]


def _parameters(body: bytes, at: int, order: str) -> tuple[dict[int, list[bytes]], int]:
    """Return the parameters and the position after them. Raises struct.error or ValueError without the end of the
    list, and for more than PARAMETERS_MAX parameters."""
    found: dict[int, list[bytes]] = {}
    for _ in range(PARAMETERS_MAX):
        number, size = struct.unpack_from(order + "HH", body, at)
        at += 4
        if number == P_SENTINEL:
            return found, at
        if at + size > len(body):
            raise ValueError
        found.setdefault(number & ~MUST_UNDERSTAND, []).append(body[at : at + size])
        at += size
    raise ValueError


def _first(found: Mapping[int, Sequence[bytes]], number: int) -> bytes:
    values = found.get(number)
    return values[0] if values else b""


@dataclass(frozen=True, slots=True)
class FoundParticipant:
    """A participant as it announces itself."""

    guid: bytes
    lease_s: int  # 1 to INFINITE_S
    meta: Sequence[Locator]  # addresses for discovery
    default: Sequence[Locator]  # addresses of its readers


@dataclass(frozen=True, slots=True)
class FoundReader:
    """A reader as its participant announces it."""

    guid: bytes
    topic: str
    type_name: str
    is_reliable: bool
    durability: int
    locators: Sequence[Locator]  # empty: the addresses of the participant
    fits: bool  # whether its other requirements allow a writer of imud: no deadline, lease, partition or ownership


def participant_of(received: ReceivedData) -> FoundParticipant | None:
    """Return the participant that a DATA describes; None if the DATA is not complete."""
    order, found = "<" if received.is_little else ">", received.parameters
    guid = _first(found, P_PARTICIPANT_GUID)[:GUID_BYTES] or received.key
    meta = _locators(found, P_META_UNICAST, order)
    if len(guid) != GUID_BYTES or not meta:
        return None
    lease_s = max(1, min(_int(found, P_LEASE, order, DEFAULT_LEASE_S), INFINITE_S))
    return FoundParticipant(guid, lease_s, meta, _locators(found, P_DEFAULT_UNICAST, order) or meta)


def reader_of(received: ReceivedData) -> FoundReader | None:
    """Return the reader that a DATA describes; None if the DATA is not complete."""
    order, found = "<" if received.is_little else ">", received.parameters
    guid = _first(found, P_ENDPOINT_GUID)[:GUID_BYTES] or received.key
    topic, type_name = _text(found, P_TOPIC, order), _text(found, P_TYPE, order)
    if len(guid) != GUID_BYTES or not topic or not type_name:
        return None
    if len(topic) > TEXT_BYTES_MAX or len(type_name) > TEXT_BYTES_MAX:
        return None
    fits = (
        _int(found, P_DEADLINE, order, INFINITE_S) == INFINITE_S
        and _int(found, P_LIVELINESS, order, 0) == 0
        and _int(found, P_LIVELINESS, order, INFINITE_S, at=4) == INFINITE_S
        and _int(found, P_OWNERSHIP, order, SHARED) == SHARED
        and _int(found, P_PARTITION, order, 0) == 0
    )
    return FoundReader(
        guid, topic, type_name, _int(found, P_RELIABILITY, order, BEST_EFFORT) >= RELIABLE,
        _int(found, P_DURABILITY, order, VOLATILE), _locators(found, P_UNICAST, order), fits,
    )  # fmt: skip


def _int(found: Mapping[int, Sequence[bytes]], number: int, order: str, default: int, *, at: int = 0) -> int:
    """Return an integer of a parameter: its first one, the seconds of a duration, or a length."""
    value = _first(found, number)
    return int(struct.unpack_from(order + "i", value, at)[0]) if len(value) >= at + 4 else default


def _text(found: Mapping[int, Sequence[bytes]], number: int, order: str) -> str:
    value = _first(found, number)
    size = max(0, _int(found, number, order, 0))
    return value[4 : 4 + min(size, TEXT_BYTES_MAX + 2)].rstrip(b"\0").decode(errors="replace")


def _locators(found: Mapping[int, Sequence[bytes]], number: int, order: str) -> list[Locator]:
    made = []
    for value in found.get(number, ())[:LOCATORS_MAX]:
        if len(value) >= 24:
            kind, port, address = struct.unpack_from(order + "iI12x4s", value)
            if kind == UDP_V4 and 0 < port < 1 << 16 and address != bytes(4):
                made.append(Locator(str(IPv4Address(address)), port))
    return made


def guid_in(received: ReceivedData) -> bytes:
    """Return the GUID in the parameters of an ended object; empty without."""
    return (_first(received.parameters, P_ENDPOINT_GUID) or _first(received.parameters, P_PARTICIPANT_GUID))[
        :GUID_BYTES
    ]
