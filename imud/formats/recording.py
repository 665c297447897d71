"""Blocks of a recording: compressed, checked, each readable without the others. No I/O but on the given file.

A file is blocks and nothing else, all integers little-endian::

    ┌─────────────┬───────────┬──────────┬───────────┬───────────┬──────────────┬──────────┬──────────────┐
    │ magic 8     │ method u8 │ 0 3 bytes│ number u32│ plain u32 │ stored u32   │ crc u32  │ stored bytes │
    └─────────────┴───────────┴──────────┴───────────┴───────────┴──────────────┴──────────┴──────────────┘

`plain` is the size of the content, `stored` that of what follows the head: the content itself (method 0) or a
Zstandard frame of it (method 1). `crc` is the CRC-32 of the head before it and of the stored bytes. `number` counts the
blocks of the file from 0, so that a block that is missing shows.

A file is only ever appended to, a whole block by one write: whenever the process is killed, all blocks that were
written before are whole. A reader takes a block whose CRC is right and looks for the next magic where it is not.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Final, NamedTuple, Protocol

import zstandard

from imud.formats import records
from imud.formats.records import Kind, Record, SessionRecord, decode_object, records_of
from imud.model.errors import ImudError

MAGIC: Final = b"\x89imudREC"
"""The first byte is no ASCII: nobody takes the file for text."""
HEAD: Final = struct.Struct("<8sB3xIIII")
"""Magic, method, number, plain size, stored size, CRC."""
_CRC_BYTES: Final = 4
PLAIN_MAX: Final = 4 << 20
"""Largest content of a block: sixteen times what a recorder gathers, for a record that is large itself. A reader
allocates no more for any file."""
STORED: Final = 0
ZSTANDARD: Final = 1
LEVEL: Final = 3
"""Zstandard's default: level 9 saves 3 % more on IMU data and takes four times as long."""
CHUNK_BYTES: Final = 1 << 16


class Block(NamedTuple):
    """A whole block as read."""

    number: int
    content: bytes
    stored_bytes: int
    """What it takes in the file, with its head."""


class BlockEncoder:
    """Encoder of the blocks of one file. Synchronization: one thread."""

    def __init__(self) -> None:
        self.number = 0
        """Of the next block."""
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)

    def encode(self, content: bytes) -> bytes:
        """Return the next block with this content. Raises ValueError for more than PLAIN_MAX bytes."""
        if len(content) > PLAIN_MAX:
            raise ValueError(f"expected a block of at most {PLAIN_MAX} bytes, got {len(content)}")
        method, stored = ZSTANDARD, self._compressor.compress(content)
        if len(stored) >= len(content):
            method, stored = STORED, content
        head = HEAD.pack(MAGIC, method, self.number, len(content), len(stored), 0)[:-_CRC_BYTES]
        self.number = (self.number + 1) & 0xFFFF_FFFF
        crc = zlib.crc32(stored, zlib.crc32(head))
        return b"".join((head, crc.to_bytes(_CRC_BYTES, "little"), stored))


class ByteSource(Protocol):
    """What blocks are read from: a file, or something like one."""

    def read(self, size: int, /) -> bytes:
        """Return at least one byte and at most `size`; none at the end."""
        ...


def renumbered(block: bytes, number: int) -> bytes:
    """Return a whole block with another number."""
    magic, method, _, plain, stored, _ = HEAD.unpack_from(block)
    head = HEAD.pack(magic, method, number, plain, stored, 0)[:-_CRC_BYTES]
    content = memoryview(block)[HEAD.size :]
    crc = zlib.crc32(content, zlib.crc32(head))
    return b"".join((head, crc.to_bytes(_CRC_BYTES, "little"), content))


class BlockReader:
    """Reader of all whole blocks of a file, seekable or not. Iterate once.

    It never raises for any bytes: what is no block is passed over and counted.
    """

    def __init__(self, file: ByteSource) -> None:
        self._file = file
        self._buffer = b""
        self._at = 0
        """Offset in the file of the first byte of the buffer."""
        self._is_at_end = False
        self.bytes_bad = 0
        """Bytes that belong to no whole block, except those of a block that is cut short at the end."""
        self.first_bad = -1
        """Offset of the first of them; -1 for none."""
        self.bytes_cut = 0
        """Bytes of a block at the end of the file whose rest is missing."""
        self.blocks_missing = 0
        """Blocks that are missing by their numbers."""
        self._decompressor = zstandard.ZstdDecompressor()

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
                self._skip(cut=bool(size) and len(self._buffer) < size)
        self.bytes_cut += len(self._buffer) if self._begins_magic() else 0
        self._count_bad(0 if self._begins_magic() else len(self._buffer))

    def _block_size(self) -> int:
        """Size of the block that the buffer begins with; 0 for none."""
        magic, method, _number, plain, stored, _crc = HEAD.unpack_from(self._buffer)
        fits = plain <= PLAIN_MAX and (stored == plain if method == STORED else stored < plain)
        return HEAD.size + stored if magic == MAGIC and method in (STORED, ZSTANDARD) and fits else 0

    def _decode(self, size: int) -> Block | None:
        """Return the block that the buffer begins with; None where it is damaged."""
        buffer = self._buffer
        _magic, method, number, plain, _stored, crc = HEAD.unpack_from(buffer)
        stored = buffer[HEAD.size : size]
        if zlib.crc32(stored, zlib.crc32(buffer[: HEAD.size - _CRC_BYTES])) != crc:
            return None
        if method == ZSTANDARD:
            try:
                if zstandard.frame_content_size(stored) != plain:  # it decides how much is allocated
                    return None
                stored = self._decompressor.decompress(stored)
            except zstandard.ZstdError:
                return None
        return Block(number, stored, size) if len(stored) == plain else None

    def _skip(self, *, cut: bool) -> None:
        """Go on at the next magic; `cut`: the file ends before the block that begins here, if it is one."""
        found = self._buffer.find(MAGIC, 1)
        if cut and found < 0:
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
        """Whether what is left is the begin of a block that was cut short in its head."""
        return bool(self._buffer) and self._buffer[: len(MAGIC)] == MAGIC[: len(self._buffer)]

    def _drop(self, count: int) -> None:
        self._buffer = self._buffer[count:]
        self._at += count

    def _fill(self, size: int) -> bool:
        """Have at least so many bytes in the buffer; return False where the file has no more."""
        while len(self._buffer) < size and not self._is_at_end:
            chunk = self._file.read(max(CHUNK_BYTES, size - len(self._buffer)))
            self._is_at_end = not chunk
            self._buffer += chunk
        return len(self._buffer) >= size


def is_recording(begin: bytes) -> bool:
    """Whether a file that begins with these bytes (at least those of the magic) is a recording."""
    return begin.startswith(MAGIC)


def check_begin(begin: bytes, name: str) -> None:
    """Raises ImudError for a file that begins otherwise than a recording."""
    if not is_recording(begin):
        raise ImudError(f"{name} is no recording of imud: expected it to begin with {MAGIC!r}, got {begin[:8]!r}")


BLOCK_BYTES: Final = 256 << 10
"""Content of a block at most, unless one record is larger: half a minute of a device at 100 Hz. Larger ones are not
compressed better."""
RECORD_BYTES_MAX: Final = PLAIN_MAX - BLOCK_BYTES


class BlockGatherer:
    """Gatherer of records into blocks. Synchronization: one thread."""

    def __init__(self) -> None:
        self._encoder = BlockEncoder()
        self._records: list[bytes] = []
        self._bytes = 0

    def add(self, record: bytes) -> bytes:
        """Add a record; return the block that it did not fit into any more, or nothing.

        Raises ValueError for a record of more than RECORD_BYTES_MAX.
        """
        if len(record) > RECORD_BYTES_MAX:
            raise ValueError(f"expected a record of at most {RECORD_BYTES_MAX} bytes, got {len(record)}")
        block = self.finish() if self._bytes + len(record) > BLOCK_BYTES else b""
        self._records.append(record)
        self._bytes += len(record)
        return block

    def finish(self) -> bytes:
        """Return a block of all records so far; nothing without any."""
        if not self._records:
            return b""
        content = b"".join(self._records)
        self._records, self._bytes = [], 0
        return self._encoder.encode(content)


_LOOKED_AT: Final = frozenset({int(Kind.SESSION)})
"""Records that the reader itself looks at."""


class RecordingReader:
    """Reader of the records of one file, seekable or not. Iterate once.

    Raises ImudError, at the first record, for a file that is no recording or one of another version.
    """

    def __init__(self, file: ByteSource, name: str) -> None:
        """`name` is for messages."""
        self._name = name
        self.blocks = BlockReader(file)
        """What was damaged or missing in the file, while iterating and afterwards."""
        self.session: SessionRecord | None = None
        """The newest begin of a file."""
        self.records_unreadable = 0
        """Blocks whose content is not made of records: written by something else."""
        self.blocks_read = 0
        self.stored_bytes = self.plain_bytes = 0
        """What the blocks take in the file, and what is in them."""
        self.ended = False
        """Whether the file has its regular end."""
        self._is_read = False
        """Whether the iteration came to the end of the file."""

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
            raise ImudError(f"{self._name} is no recording of imud, or nothing of it is left: no whole block is in it")

    def _look_at(self, record: Record) -> None:
        if record.kind == Kind.SESSION:
            self.session = decode_object(record, SessionRecord)
            if self.session is not None and self.session.version != records.VERSION:
                raise ImudError(
                    f"{self._name} has records of version {self.session.version}, this imud reads {records.VERSION}"
                )

    @property
    def is_damaged(self) -> bool:
        """After iterating: whether blocks are damaged or missing. A file without its regular end need not be."""
        return bool(self.blocks.bytes_bad or self.blocks.blocks_missing or self.records_unreadable)

    @property
    def problems(self) -> list[str]:
        """After iterating: what is wrong with what was read of the file, one sentence each; empty for a whole one."""
        read, found = self.blocks, []
        if read.bytes_bad:
            found.append(f"{read.bytes_bad} bytes from byte {read.first_bad} on are damaged, and left out")
        if read.blocks_missing:
            found.append(f"blocks that are missing by their numbers: {read.blocks_missing}")
        if read.bytes_cut:
            found.append(f"the last {read.bytes_cut} bytes are a block cut short, left out")
        if self.records_unreadable:
            found.append(f"{self.records_unreadable} blocks hold something else than records, left out")
        if self._is_read and not self.ended:
            found.append("it has no regular end: imud or the machine stopped while it was written, or still writes")
        return found
