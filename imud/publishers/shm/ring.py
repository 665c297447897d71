"""The writing side of one device's shared-memory ring (`imud.formats.ring`).

A slot is written in three stores: invalid sequence number, payload with CRC, sequence number; then the header's
`newest_seq`. The slots of a batch share the store of the payloads (`_write_run`). Single words go through memoryviews
cast to the word's type, because those make one aligned store: `struct.pack_into` first fills its target with zeros,
which a reader could see.

A store into a page that was cut off the file would end the daemon by SIGBUS. Only root and the daemon's own user may
cut it; the size is looked at before each batch (lseek), which leaves the microseconds from there to the last store.
"""

import mmap
import os
import struct
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress

from imud.errors import ServerError
from imud.formats.ring import (
    FIRST_WORD,
    HEADER_BYTES,
    HEARTBEAT_WORD,
    LEDGER_BLOCK_BYTES,
    LEDGER_BLOCK_OFFSET,
    LEDGER_UPDATE_WORD,
    NEWEST_WORD,
    OFFSETS,
    STATE_CLOSED,
    STATE_HALF_WORD,
    RingHeader,
    encode_header,
    encode_ledger_block,
    ring_path,
)
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES
from imud.publishers.shm.directory import RingDirectory
from imud.sample import Sample

_lseek, _END = os.lseek, os.SEEK_END  # looked up once: called for every batch
_CLOSED = struct.pack("<I", STATE_CLOSED)
_INVALID = struct.pack("<Q", SEQ_INVALID)
_PAYLOAD = slice(8, SLOT_BYTES)
_LEDGER_PAYLOAD = slice(LEDGER_BLOCK_OFFSET + 8, LEDGER_BLOCK_OFFSET + LEDGER_BLOCK_BYTES)


class ShmRing:
    """Owns the file of one device from creation to `close`. Synchronization: one thread."""

    def __init__(self, directory: RingDirectory, header: RingHeader, mode: int, group_id: int | None) -> None:
        """Make the file, whole before it appears in `directory`. Raises ServerError."""
        self._directory = directory
        self._name = ring_path(directory.path, header.device).name
        self._size_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
        self._fd = directory.make(self._name, self._size_bytes, encode_header(header), mode, group_id)
        self._status = os.fstat(self._fd)
        self.group_given = self._status.st_gid == group_id
        """Whether the file belongs to the group that was asked for."""
        self._memory = self._mapped()
        with memoryview(self._memory) as view:
            self._words, self._halves = view.cast("Q"), view.cast("I")
        self._mask = header.slot_count - 1
        self._newest = header.newest_seq
        self._update = 0
        self._known: tuple[str, Mapping[str, int]] | None = None
        self._least_bytes = self._size_bytes
        """Size of the file from which on it may be written; none is enough any more once it was cut."""
        self._closed = False

    @property
    def newest(self) -> int:
        """Sequence number of the newest sample that was to be written, 0 before the first."""
        return self._newest

    def write(self, samples: Sequence[Sample], slots: Sequence[bytes]) -> None:
        """Write `samples`, oldest first, which are encoded in `slots`; no-op if the file was cut."""
        if _lseek(self._fd, 0, _END) < self._least_bytes:
            self._restore_size()
            self._newest = samples[-1].seq
            return
        if len(slots) == 1:
            self._write_one(samples[0].seq, slots[0])
        elif slots and not self._write_run(samples[0].seq, samples[-1].seq, slots):
            for sample, slot in zip(samples, slots, strict=True):
                self._write_one(sample.seq, slot)

    def _write_one(self, seq: int, slot: bytes) -> None:
        words, at = self._words, HEADER_BYTES + (seq & self._mask) * SLOT_BYTES
        word = at >> 3
        words[word] = SEQ_INVALID
        self._memory[at + 8 : at + SLOT_BYTES] = slot[_PAYLOAD]
        words[word] = words[NEWEST_WORD] = seq  # from left to right
        if seq != self._newest + 1:  # samples in between were never here: readers must not wait for them
            words[FIRST_WORD] = seq
        self._newest = seq

    def _write_run(self, first: int, last: int, slots: Sequence[bytes]) -> bool:
        """Write slots back to back: all are invalid before the first payload is stored, and until the last one is.

        Returns False, with nothing written, where a number is missing before or between them, or the ring ends there.
        """
        count, begin = len(slots), first & self._mask
        if first != self._newest + 1 or last != self._newest + count or begin + count > self._mask + 1:
            return False
        at = HEADER_BYTES + begin * SLOT_BYTES
        words, numbers = self._words, range(at >> 3, (at + count * SLOT_BYTES) >> 3, SLOT_BYTES >> 3)
        for word in numbers:
            words[word] = SEQ_INVALID
        self._memory[at + 8 : at + count * SLOT_BYTES] = _INVALID.join([slot[_PAYLOAD] for slot in slots])
        for seq, word in enumerate(numbers, first):
            words[word] = seq
        self._newest = words[NEWEST_WORD] = last
        return True

    def beat(self, now_ns: int) -> None:
        """Show that the daemon lives."""
        if self._is_whole():
            self._words[HEARTBEAT_WORD] = now_ns

    def set_ledger(self, driver: str, ledger: Mapping[str, int]) -> None:
        """Show the ledger and the driver in use, if they are not what is shown already."""
        if self._known == (driver, ledger) or not self._is_whole():
            return
        self._known = (driver, dict(ledger))
        self._update += 1
        block = encode_ledger_block(self._update, driver, ledger)
        self._words[LEDGER_UPDATE_WORD] = SEQ_INVALID
        self._memory[_LEDGER_PAYLOAD] = block[8:]
        self._words[LEDGER_UPDATE_WORD] = self._update

    def is_intact(self, directory: RingDirectory) -> bool:
        """Whether the file has its size, and its name in `directory`."""
        return self._is_whole() and self.is_named(directory)

    def is_named(self, directory: RingDirectory) -> bool:
        """Whether the file has its name in `directory`."""
        return directory.names(self._name, self._status)

    def close(self) -> None:
        """Mark the ring closed for its readers, and remove the file if it is still this one; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._is_whole():
            self._halves[STATE_HALF_WORD] = STATE_CLOSED
        self._directory.remove(self._name, self._status)
        for view in (self._words, self._halves):
            view.release()
        self._memory.close()
        os.close(self._fd)

    def _mapped(self) -> mmap.mmap:
        try:
            return mmap.mmap(self._fd, self._size_bytes)
        except OSError as error:
            self._directory.remove(self._name, self._status)
            os.close(self._fd)
            raise ServerError(f"{self._name}: {self._size_bytes} bytes cannot be mapped: {error.strerror}") from error

    def _is_whole(self) -> bool:
        whole = _lseek(self._fd, 0, _END) >= self._least_bytes
        if not whole:
            self._restore_size()
        return whole

    def _restore_size(self) -> None:
        """Make the file as long as it was, for readers that have it mapped, and mark it closed, without the mapping.

        Nothing is written to it any more.
        """
        self._least_bytes = sys.maxsize
        with suppress(OSError):
            os.ftruncate(self._fd, self._size_bytes)
            os.pwrite(self._fd, _CLOSED, OFFSETS["state"])
