"""Blocks of a recording: compressed, with a CRC, each readable on its own. No I/O except on the given file.

A file contains only blocks. All integers are little-endian::

    ┌─────────────┬───────────┬──────────┬───────────┬───────────┬──────────────┬──────────┬──────────────┐
    │ magic 8     │ method u8 │ 0 3 bytes│ number u32│ plain u32 │ stored u32   │ crc u32  │ stored bytes │
    └─────────────┴───────────┴──────────┴───────────┴───────────┴──────────────┴──────────┴──────────────┘

`plain` is the size of the content. `stored` is the size of the data after the head: the content itself (method 0) or a
Zstandard frame of it (method 1). `crc` is the CRC-32 of the head before `crc` and of the stored bytes. `number` counts
the blocks of the file from 0, so that a reader detects missing blocks.

A writer only appends complete blocks, one write per block. After a kill of the process, all earlier blocks are
therefore complete. A reader accepts a block with a correct CRC and otherwise searches for the next magic.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Final, NamedTuple, Protocol

from imud.formats import records
from imud.formats.records import Kind, Record, SessionRecord, decode_object, records_of
from imud.formats.zstandard import FrameEncoder, content_size, decode_frame
from imud.model.errors import ImudError

# First bytes of a block. The first byte is not ASCII, so that no program mistakes the file for text.
MAGIC: Final = b"\x89imudREC"
HEAD: Final = struct.Struct("<8sB3xIIII")  # Magic, method, number, plain size, stored size, CRC
_CRC_BYTES: Final = 4
# Maximum content of a block, bytes: 16 times BLOCK_BYTES, for one large record. A reader never allocates more.
PLAIN_MAX: Final = 4 << 20
STORED: Final = 0
ZSTANDARD: Final = 1
LEVEL: Final = 3  # Default level of Zstandard. Level 9 saves 3 % more on IMU data and takes four times as long.
# Maximum ratio of plain and stored size. IMU data has about 4, repeated frames have less than 100. Zeros have 8,000: a
# small forged file of zeros would take hours.
RATIO_MAX: Final = 256
CHUNK_BYTES: Final = 1 << 16
# Maximum size of all possible blocks with a wrong CRC: VAIN_BYTES_MIN plus VAIN_FACTOR times the size of the read part.
# Each head of 28 bytes can announce a block of 4 MB, so that a small forged file would take hours.
VAIN_BYTES_MIN: Final = 64 << 20
VAIN_FACTOR: Final = 8


class Block(NamedTuple):
    """Complete block as read."""

    number: int
    content: bytes
    stored_bytes: int  # size of the block in the file, with its head


class BlockEncoder:
    """Encoder of the blocks of one file. Synchronization: one thread."""

    def __init__(self) -> None:
        self.number = 0  # number of the next block
        self._encoder = FrameEncoder(LEVEL)

    def encode(self, content: bytes) -> bytes:
        """Return the next block with this content. Raises ValueError for more than PLAIN_MAX bytes."""
        if len(content) > PLAIN_MAX:
            raise ValueError(f"expected a block of at most {PLAIN_MAX} bytes, got {len(content)}")
        method, stored = ZSTANDARD, self._encoder.encode(content)
        if not len(content) / RATIO_MAX <= len(stored) < len(content):
            method, stored = STORED, content
        head = HEAD.pack(MAGIC, method, self.number, len(content), len(stored), 0)[:-_CRC_BYTES]
        self.number = (self.number + 1) & 0xFFFF_FFFF
        crc = zlib.crc32(stored, zlib.crc32(head))
        return b"".join((head, crc.to_bytes(_CRC_BYTES, "little"), stored))


class ByteSource(Protocol):
    """Source of blocks: a file or a similar object."""

    def read(self, size: int, /) -> bytes:
        """Return 1 to `size` bytes; no bytes at the end."""
        ...


def renumbered(block: bytes, number: int) -> bytes:
    """Return a complete block with another number."""
    magic, method, _, plain, stored, _ = HEAD.unpack_from(block)
    head = HEAD.pack(magic, method, number, plain, stored, 0)[:-_CRC_BYTES]
    content = memoryview(block)[HEAD.size :]
    crc = zlib.crc32(content, zlib.crc32(head))
    return b"".join((head, crc.to_bytes(_CRC_BYTES, "little"), content))


class BlockReader:
    """Reader of all complete blocks of a file, seekable or not. Iterate once. It never raises an exception: it skips
    and counts all other bytes."""

    def __init__(self, file: ByteSource) -> None:
        self._file = file
        self._buffer = bytearray()  # its front is deleted without a copy
        self._at = 0  # offset of the first byte of the buffer in the file
        self._is_at_end = False
        self.bytes_bad = 0  # number of bytes outside complete blocks, without an incomplete block at the end
        self.first_bad = -1  # offset of the first of these bytes; -1 if there are none
        self.bytes_cut = 0  # size of an incomplete block at the end of the file
        self.blocks_missing = 0  # number of blocks that are missing according to the block numbers
        self._vain_bytes = 0  # size of all possible blocks with a wrong CRC

    def __iter__(self) -> Iterator[Block]:
        expected = 0
        while self._fill(HEAD.size):
            size = self._block_size()
            if size and self._fill(size) and (block := self._decode(size)) is not None:
                self.blocks_missing += max(0, block.number - expected)
                expected = block.number + 1
                self._drop(size)
                yield block
            else:
                self._skip(size)
        self.bytes_cut += len(self._buffer) if self._begins_magic() else 0
        self._count_bad(0 if self._begins_magic() else len(self._buffer))

    def _block_size(self) -> int:
        """Return the size of the block at the start of the buffer; 0 if there is no block."""
        magic, method, _number, plain, stored, _crc = HEAD.unpack_from(self._buffer)
        fits = plain <= PLAIN_MAX and (stored == plain if method == STORED else stored < plain <= RATIO_MAX * stored)
        return HEAD.size + stored if magic == MAGIC and method in (STORED, ZSTANDARD) and fits else 0

    def _decode(self, size: int) -> Block | None:
        """Return the block at the start of the buffer; None if it is damaged."""
        buffer = self._buffer
        _magic, method, number, plain, _stored, crc = HEAD.unpack_from(buffer)
        stored = bytes(buffer[HEAD.size : size])
        if zlib.crc32(stored, zlib.crc32(buffer[: HEAD.size - _CRC_BYTES])) != crc:
            self._vain_bytes += size
            return None
        if method == ZSTANDARD:
            try:
                if content_size(stored) != plain:  # this size decides the allocation
                    return None
                stored = decode_frame(stored)
            except ValueError:
                return None
        return Block(number, stored, size) if len(stored) == plain else None

    def _skip(self, size: int) -> None:
        """Skip to the next magic. `size`: size of the possible block here; 0 if there is no block."""
        found = self._buffer.find(MAGIC, 1)
        if found > 0 and self._vain_bytes > VAIN_BYTES_MIN + VAIN_FACTOR * self._at:
            found = max(found, min(size, len(self._buffer)))  # false heads in a forged file: skip the possible block
        if size > len(self._buffer) and found < 0:
            self.bytes_cut += len(self._buffer)
            self._drop(len(self._buffer))
            return
        keep = found if found >= 0 else max(1, len(self._buffer) - len(MAGIC) + 1)
        self._count_bad(keep)
        self._drop(keep)

    def _count_bad(self, count: int) -> None:
        if count:
            self.bytes_bad += count
            self.first_bad = self._at if self.first_bad < 0 else self.first_bad

    def _begins_magic(self) -> bool:
        """Return whether the buffer is the start of a block that ends in its head."""
        return bool(self._buffer) and self._buffer[: len(MAGIC)] == MAGIC[: len(self._buffer)]

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._at += count

    def _fill(self, size: int) -> bool:
        """Read until the buffer has `size` bytes; return False if the file has fewer bytes."""
        while len(self._buffer) < size and not self._is_at_end:
            chunk = self._file.read(max(CHUNK_BYTES, size - len(self._buffer)))
            self._is_at_end = not chunk
            self._buffer += chunk
        return len(self._buffer) >= size


def is_recording(begin: bytes) -> bool:
    """Return whether a file that starts with these bytes (at least the length of the magic) is a recording."""
    return begin.startswith(MAGIC)


def check_begin(begin: bytes, name: str) -> None:
    """Raise ImudError if a file does not start like a recording."""
    if not is_recording(begin):
        raise ImudError(f"{name} is not a recording of imud: expected the first bytes {MAGIC!r}, got {begin[:8]!r}")


# Maximum content of a block with several records, bytes: 30 s of a device at 100 Hz. Larger blocks compress equally.
BLOCK_BYTES: Final = 256 << 10
RECORD_BYTES_MAX: Final = PLAIN_MAX - BLOCK_BYTES


class BlockGatherer:
    """Collector of records for blocks. Synchronization: one thread."""

    def __init__(self) -> None:
        self._encoder = BlockEncoder()
        self._records: list[bytes] = []
        self._bytes = 0

    def add(self, record: bytes) -> bytes:
        """Add a record. Return the previous block if the record does not fit into it, otherwise no bytes. Raises
        ValueError for a record of more than RECORD_BYTES_MAX."""
        if len(record) > RECORD_BYTES_MAX:
            raise ValueError(f"expected a record of at most {RECORD_BYTES_MAX} bytes, got {len(record)}")
        block = self.finish() if self._bytes + len(record) > BLOCK_BYTES else b""
        self._records.append(record)
        self._bytes += len(record)
        return block

    def finish(self) -> bytes:
        """Return a block of all records since the previous block; no bytes without records."""
        if not self._records:
            return b""
        content = b"".join(self._records)
        self._records, self._bytes = [], 0
        return self._encoder.encode(content)


_LOOKED_AT: Final = frozenset({int(Kind.SESSION)})  # records that the reader itself evaluates


class RecordingReader:
    """Reader of the records of one file, seekable or not. Iterate once. The first record raises ImudError for a file
    that is not a recording or has another version."""

    def __init__(self, file: ByteSource, name: str) -> None:
        """`name` is for messages."""
        self._name = name
        self.blocks = BlockReader(file)  # damaged and missing blocks of the file, during and after the iteration
        self.session: SessionRecord | None = None  # newest start of a file
        self.records_unreadable = 0  # number of blocks without valid records: another program wrote them
        self.blocks_read = 0
        self.stored_bytes = self.plain_bytes = 0  # size of the blocks in the file, and size of their content
        self.ended = False  # whether the file has a regular end
        self._is_read = False  # whether the iteration reached the end of the file

    def __iter__(self) -> Iterator[Record]:
        for block in self.blocks:
            self.blocks_read += 1
            self.stored_bytes += block.stored_bytes
            self.plain_bytes += len(block.content)
            try:
                found = list(records_of(block.content))
            except ImudError:
                self.records_unreadable += 1
                continue
            for record in found:
                if record.kind in _LOOKED_AT:
                    self._look_at(record)
                yield record
            self.ended = found[-1].kind == Kind.END if found else self.ended
        self._is_read = True
        if not self.blocks_read:
            raise ImudError(f"{self._name} is not a recording of imud: expected at least one complete block, got none")

    def _look_at(self, record: Record) -> None:
        if record.kind == Kind.SESSION:
            self.session = decode_object(record, SessionRecord)
            if self.session is not None and self.session.version != records.VERSION:
                expected = f"expected records of version {records.VERSION}, got {self.session.version}"
                raise ImudError(f"cannot read {self._name}: {expected}")

    @property
    def is_damaged(self) -> bool:
        """After the iteration: whether blocks are damaged or missing. A file without a regular end may be undamaged."""
        return bool(self.blocks.bytes_bad or self.blocks.blocks_missing or self.records_unreadable)

    @property
    def problems(self) -> list[str]:
        """Errors of the read part of the file, one sentence each; empty for a complete file."""
        read, found = self.blocks, []
        if read.bytes_bad:
            found.append(f"{read.bytes_bad} bytes from byte {read.first_bad} are damaged; imud ignores them")
        if read.blocks_missing:
            found.append(f"missing blocks according to their numbers: {read.blocks_missing}")
        if read.bytes_cut:
            found.append(f"the last {read.bytes_cut} bytes are an incomplete block; imud ignores them")
        if self.records_unreadable:
            found.append(f"{self.records_unreadable} blocks contain no valid records; imud ignores them")
        if self._is_read and not self.ended:
            found.append(
                "the file has no regular end: imud or the host stopped during the recording, or it is still running"
            )
        return found
