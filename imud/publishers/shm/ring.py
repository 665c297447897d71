"""The writing side of one device's shared-memory ring (`imud.formats.ring`).

A slot is written in three stores: invalid sequence number, payload with CRC, sequence number; then the header's
`newest_seq`. Single words go through memoryviews cast to the word's type, because those make one aligned store:
`struct.pack_into` first fills its target with zeros, which a reader could see.
"""

import mmap
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from imud.errors import ServerError
from imud.formats.ring import (
    FIRST_WORD,
    HEADER_BYTES,
    HEARTBEAT_LIMIT_NS,
    HEARTBEAT_WORD,
    LEDGER_BLOCK_BYTES,
    LEDGER_BLOCK_OFFSET,
    LEDGER_UPDATE_WORD,
    NEWEST_WORD,
    STATE_CLOSED,
    STATE_HALF_WORD,
    STATE_LIVE,
    RingHeader,
    decode_header,
    encode_header,
    encode_ledger_block,
)
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES
from imud.sample import Sample

_LEDGER_PAYLOAD = slice(LEDGER_BLOCK_OFFSET + 8, LEDGER_BLOCK_OFFSET + LEDGER_BLOCK_BYTES)
_CREATE = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


class ShmRing:
    """Owns the file of one device from creation to `close`. Synchronization: one thread."""

    def __init__(self, path: Path, header: RingHeader, mode: int, group_id: int | None) -> None:
        """Make the file at `path`, whole before it appears there. Raises ServerError."""
        self.path = path
        self._memory, status = _create(path, header, mode, group_id)
        self._inode = status.st_dev, status.st_ino
        self.group_given = status.st_gid == group_id
        """Whether the file belongs to the group that was asked for."""
        self._bytes = memoryview(self._memory)
        self._words = self._bytes.cast("Q")
        self._halves = self._bytes.cast("I")
        self._mask = header.slot_count - 1
        self._newest = 0
        self._update = 0
        self._known: tuple[str, Mapping[str, int]] | None = None
        self._closed = False

    def write(self, samples: Sequence[Sample], slots: Sequence[bytes]) -> None:
        """Write `samples`, oldest first, which are encoded in `slots`."""
        content, words, mask, newest = self._bytes, self._words, self._mask, self._newest
        for sample, slot in zip(samples, slots, strict=True):
            seq = sample.seq
            at = HEADER_BYTES + (seq & mask) * SLOT_BYTES
            word = at >> 3
            words[word] = SEQ_INVALID
            content[at + 8 : at + SLOT_BYTES] = slot[8:]
            words[word] = seq
            words[NEWEST_WORD] = seq
            if seq != newest + 1:  # samples in between were never here: readers must not wait for them
                words[FIRST_WORD] = seq
            newest = seq
        self._newest = newest

    def beat(self, now_ns: int) -> None:
        """Show that the daemon lives."""
        self._words[HEARTBEAT_WORD] = now_ns

    def set_ledger(self, driver: str, ledger: Mapping[str, int]) -> None:
        """Show the ledger and the driver in use, if they are not what is shown already."""
        if self._known == (driver, ledger):
            return
        self._known = (driver, dict(ledger))
        self._update += 1
        block = encode_ledger_block(self._update, driver, ledger)
        self._words[LEDGER_UPDATE_WORD] = SEQ_INVALID
        self._bytes[_LEDGER_PAYLOAD] = block[8:]
        self._words[LEDGER_UPDATE_WORD] = self._update

    def close(self) -> None:
        """Mark the ring closed for its readers, and remove the file if it is still this one; may be called twice."""
        if self._closed:
            return
        self._closed = True
        self._halves[STATE_HALF_WORD] = STATE_CLOSED
        if _inode_of(self.path) == self._inode:
            with suppress(OSError):  # the directory's rights changed: readers see the end by `state` all the same
                self.path.unlink(missing_ok=True)
        for view in (self._words, self._halves, self._bytes):
            view.release()
        self._memory.close()


def refuse_second_writer(path: Path, now_ns: int) -> None:
    """Raise ServerError when another living process writes the ring at `path`; a dead one's file may be replaced."""
    try:
        with path.open("rb") as file:
            header = decode_header(file.read(HEADER_BYTES), str(path))
    except (OSError, ServerError):
        return  # nothing there, or nothing that a reader of this version would take for a ring
    fresh = now_ns - header.heartbeat_ns < HEARTBEAT_LIMIT_NS
    if header.state == STATE_LIVE and fresh and header.pid != os.getpid() and _lives(header.pid):
        raise ServerError(f"{path} is written by another imud, process {header.pid}: stop that one first")


def _create(path: Path, header: RingHeader, mode: int, group_id: int | None) -> tuple[mmap.mmap, os.stat_result]:
    if sys.byteorder != "little":
        raise ServerError("shared memory is little-endian and this machine is not: set `shm: {enabled: false}`")
    size_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.unlink(missing_ok=True)  # left by a daemon that died in here
        descriptor = os.open(temporary, _CREATE, 0o600)
    except OSError as error:
        raise ServerError(f"{temporary} cannot be made: {error.strerror}; may imud write to {path.parent}?") from error
    try:
        os.posix_fallocate(descriptor, 0, size_bytes)  # a write into a page that does not fit would end us by SIGBUS
        memory = mmap.mmap(descriptor, size_bytes)
        memory[:HEADER_BYTES] = encode_header(header)
        if group_id is not None:
            with suppress(PermissionError):  # not in the group: the caller sees it by the result
                os.fchown(descriptor, -1, group_id)
        os.fchmod(descriptor, mode)
        status = os.fstat(descriptor)
        os.rename(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ServerError(
            f"{path} cannot be made, {size_bytes} bytes: {error.strerror};"
            f" look at the free space (df {path.parent}), or set fewer `slots`"
        ) from error
    finally:
        os.close(descriptor)
    return memory, status


def _inode_of(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # another user's
    return True
