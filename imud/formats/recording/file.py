"""A recording as a file: records are gathered into blocks on the way in, and read again on the way out.

Writing is pure: `BlockGatherer` is given records and returns blocks. `RecordingReader` reads whatever is left of a file
whose end or middle is missing, and says what that is.
"""

from collections.abc import Iterator
from typing import Final

from imud.errors import ImudError
from imud.formats.recording import blocks, records
from imud.formats.recording.blocks import BlockEncoder, BlockReader, ByteSource
from imud.formats.recording.records import Kind, Record, SessionRecord, decode_object, records_of

BLOCK_BYTES: Final = 256 << 10
"""Content of a block at most, unless one record is larger: half a minute of a device at 100 Hz. Larger ones are not
compressed better."""
RECORD_BYTES_MAX: Final = blocks.PLAIN_MAX - BLOCK_BYTES


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
