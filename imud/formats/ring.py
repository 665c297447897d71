"""Shared-memory ring of one device: a header page, then slots of `imud.formats.slot`, all little-endian.

The file is `/run/imud/shm/imud.<device>`. `HEADER_FIELDS` is the only table of the header. The writer, the Python
reader and the check of the C header use it. Three cache lines contain the constant fields and `state`, one cache line
the fields that change with every sample, bytes 256 to 771 the fields that change once per second.

       0         8       12       16     20     24     28       32      40    44     48                  64       128
    +---------+-------+--------+------+------+------+--------+-------+-----+-------+-----------+------+----------+
    | magic   |version|slot    |header|slot  |slot  |ledger  | epoch | pid | state | device_id | 0…   | device   |
    |         |       |version |bytes |bytes |count |count   |       |     |       |           |      | (UTF-8)  |
    +---------+-------+--------+------+------+------+--------+-------+-----+-------+-----------+------+----------+
    | 192: newest_seq | 200: first_seq | 208: heartbeat_ns | 0…                                                  |
    | 256: ledger_update | 264: driver | 296: ledger, 59×u64, the first ledger_count in use | 768: ledger_crc32    |
    | 4096: slot (seq & (slot_count - 1)) of each sequence number …                                               |
    +-------------------------------------------------------------------------------------------------------------+

Rules for a reader, because the writer has no memory fence:
- Accept a slot only if its `seq` before the copy, its CRC-32, and its `seq` after the copy agree.
- Accept the ledger block only if `ledger_update` before and after the copy is equal and the CRC-32 over bytes 256…767
  matches.
- Samples `max(first_seq, newest_seq - slot_count + 1)` … `newest_seq` are in the ring. Older samples are lost.
- `newest_seq`, `first_seq`, `heartbeat_ns`, `state` and every `seq` are aligned. The writer sets each with one store.
"""

import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from imud.formats.slot import SLOT_BYTES, SLOT_LAYOUT_VERSION, SlotField
from imud.model.errors import ServerError
from imud.model.ledger import LEDGER_FIELDS

# Directory in which only imud can create files. In /dev/shm any user could put a FIFO or a forged ring in the way.
DIRECTORY: Final = "/run/imud/shm"
FILE_PREFIX: Final = "imud."
# Flags for a file that another user may have created: follow no link and do not wait for the writer of a FIFO
OPEN_FLAGS: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC

MAGIC: Final = b"imudshm\0"
RING_LAYOUT_VERSION: Final = 2
HEADER_BYTES: Final = 4096  # size of the header: one page, so that slots start on a page
# Maximum number of counters in the block. New counters use free places and need no new layout version.
LEDGER_ROOM: Final = 59

STATE_LIVE: Final = 1
STATE_CLOSED: Final = 2  # the daemon closed the ring and does not write to this file again

# Maximum age of a heartbeat, ns. The daemon writes ten heartbeats per second; an older ring has no daemon.
HEARTBEAT_LIMIT_NS: Final = 1_000_000_000

HEADER_FIELDS: Final = (
    SlotField("magic", "s", 8, 0),
    SlotField("layout_version", "I", 1, 8),
    SlotField("slot_layout_version", "I", 1, 12),
    SlotField("header_bytes", "I", 1, 16),
    SlotField("slot_bytes", "I", 1, 20),
    SlotField("slot_count", "I", 1, 24),
    SlotField("ledger_count", "I", 1, 28),
    SlotField("epoch", "Q", 1, 32),
    SlotField("pid", "I", 1, 40),
    SlotField("state", "I", 1, 44),
    SlotField("device_id", "I", 1, 48),
    SlotField("reserved0", "B", 12, 52),
    SlotField("device", "s", 64, 64),
    SlotField("reserved1", "B", 64, 128),
    SlotField("newest_seq", "Q", 1, 192),
    SlotField("first_seq", "Q", 1, 200),
    SlotField("heartbeat_ns", "q", 1, 208),
    SlotField("reserved2", "B", 40, 216),
    SlotField("ledger_update", "Q", 1, 256),
    SlotField("driver", "s", 32, 264),
    SlotField("ledger", "Q", LEDGER_ROOM, 296),
    SlotField("ledger_crc32", "I", 1, 768),
    SlotField("reserved3", "B", 3324, 772),
)

OFFSETS: Final = {field.name: field.offset for field in HEADER_FIELDS}

NEWEST_WORD: Final = OFFSETS["newest_seq"] // 8
FIRST_WORD: Final = OFFSETS["first_seq"] // 8
HEARTBEAT_WORD: Final = OFFSETS["heartbeat_ns"] // 8
LEDGER_UPDATE_WORD: Final = OFFSETS["ledger_update"] // 8
# Index of the field in a memoryview of the ring, cast to u64 (half words: to u32)
STATE_HALF_WORD: Final = OFFSETS["state"] // 4

LEDGER_BLOCK_OFFSET: Final = OFFSETS["ledger_update"]
LEDGER_CRC_OFFSET: Final = OFFSETS["ledger_crc32"]
LEDGER_BLOCK_BYTES: Final = LEDGER_CRC_OFFSET + 4 - LEDGER_BLOCK_OFFSET

_CONSTANT = struct.Struct("<8s6IQ3I12x64s64x")  # magic … reserved1
_LIVELY = struct.Struct("<QQq")  # newest_seq, first_seq, heartbeat_ns
_BLOCK = struct.Struct(f"<Q32s{LEDGER_ROOM}Q")
_OWN_BLOCK = struct.Struct(f"<Q32s{len(LEDGER_FIELDS)}Q{8 * (LEDGER_ROOM - len(LEDGER_FIELDS))}x")
_CRC = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class RingHeader:
    """Header at one moment, without the ledger block."""

    epoch: int  # random number of the start of the daemon that made the ring
    pid: int  # process of the daemon
    state: int  # 1: a daemon writes the ring; 2: the daemon closed the ring
    device: str  # name of the device
    device_id: int  # number of the device in slots
    slot_count: int  # number of slots, a power of two
    newest_seq: int = 0  # sequence number of the newest sample; 0 before the first sample
    first_seq: int = 1  # sequence number of the first sample in this ring
    heartbeat_ns: int = 0  # CLOCK_MONOTONIC of the newest heartbeat
    ledger_count: int = len(LEDGER_FIELDS)  # number of counters in the ledger


@dataclass(frozen=True, slots=True)
class LedgerBlock:
    """Ledger in shared memory, with the present driver."""

    update: int  # number of changes, starting at 1
    driver: str  # name of the driver; empty until imud finds the device
    ledger: dict[str, int]  # counters by name


def default_directories(environment: Mapping[str, str]) -> list[str]:
    """Return the default directories: the directory of the system, then imud/shm in XDG_RUNTIME_DIR if that is set. A
    daemon uses the first directory in which it can create files; a reader the first directory with the ring."""
    own = environment.get("XDG_RUNTIME_DIR", "")
    return [DIRECTORY, f"{own}/imud/shm"] if own.startswith("/") else [DIRECTORY]


def ring_path(directory: str, device: str) -> Path:
    """Return the ring file of `device`. Raises ServerError if the name contains `/` or is too long."""
    room = next(field.count for field in HEADER_FIELDS if field.name == "device") - 1  # readers in C need a final 0
    if not device or "/" in device or "\0" in device or len(device.encode()) > room:
        raise ServerError(f"device {device!r}: expected a name of 1 to {room} bytes without '/' for its shared memory")
    return Path(directory, FILE_PREFIX + device)


def encode_header(header: RingHeader) -> bytes:
    """Return the first HEADER_BYTES of a ring, with an empty ledger block."""
    constant = _CONSTANT.pack(
        MAGIC, RING_LAYOUT_VERSION, SLOT_LAYOUT_VERSION, HEADER_BYTES, SLOT_BYTES, header.slot_count,
        header.ledger_count, header.epoch, header.pid, header.state, header.device_id,
        header.device.encode(),
    )  # fmt: skip
    lively = _LIVELY.pack(header.newest_seq, header.first_seq, header.heartbeat_ns)
    return (constant + lively).ljust(HEADER_BYTES, b"\0")


def decode_header(raw: bytes, where: str) -> RingHeader:
    """Return the header in `raw`. Raises ServerError with `where` for any other content."""
    if len(raw) < HEADER_BYTES or not raw.startswith(MAGIC):
        raise ServerError(f"{where} is not a ring of imud: expected the first bytes {MAGIC!r}, got {raw[:8]!r}")
    _, version, slot_version, *sizes, epoch, pid, state, device_id, device = _CONSTANT.unpack_from(raw)
    header_bytes, slot_bytes, slot_count, ledger_count = sizes
    expected = (RING_LAYOUT_VERSION, SLOT_LAYOUT_VERSION, HEADER_BYTES, SLOT_BYTES)
    found = (version, slot_version, header_bytes, slot_bytes)
    if found != expected:
        raise ServerError(
            f"{where}: expected layout, slot layout, header bytes and slot bytes {expected}, got {found};"
            " use the same version of imud for daemon and reader"
        )
    if slot_count == 0 or slot_count & (slot_count - 1) or ledger_count > LEDGER_ROOM:
        raise ServerError(
            f"{where}: impossible header: {slot_count} slots and {ledger_count} counters; is the file damaged?"
        )
    newest_seq, first_seq, heartbeat_ns = _LIVELY.unpack_from(raw, OFFSETS["newest_seq"])
    name = device.rstrip(b"\0").decode("utf-8", "replace")
    return RingHeader(
        epoch, pid, state, name, device_id, slot_count, newest_seq, first_seq, heartbeat_ns, ledger_count
    )  # fmt: skip


def encode_ledger_block(update: int, driver: str, counters: Sequence[int]) -> bytes:
    """Return LEDGER_BLOCK_BYTES bytes. `counters` are all LEDGER_FIELDS in their order. A name is cut to 31 bytes."""
    body = _OWN_BLOCK.pack(update, driver.encode()[:31], *counters)
    return body + _CRC.pack(zlib.crc32(body))


def decode_ledger_block(block: bytes, ledger_count: int) -> LedgerBlock | None:
    """Return the decoded ledger block without unknown counters; None if it changed during the copy."""
    body = block[:-4]
    if len(block) != LEDGER_BLOCK_BYTES or zlib.crc32(body) != _CRC.unpack_from(block, len(body))[0]:
        return None
    update, driver, *values = _BLOCK.unpack(body)
    ledger = dict(zip(LEDGER_FIELDS, values[:ledger_count], strict=False))  # writer or reader may be newer
    return LedgerBlock(update, driver.rstrip(b"\0").decode("utf-8", "replace"), ledger)
