"""Reader of the shared-memory ring of one device (`imud.formats.ring`), without a system call per sample.

    with Ring("imu0") as ring:
        while True:
            for sample in ring.read().samples:
                print(sample.seq, sample.accel_m_s2)
            ring.wait(wake_fd, timeout_s=1.0)       # descriptor from `imud.client.Client.notify`

The reader never waits busily: a later call returns a slot that is incomplete now. The daemon makes a new file after a
restart, or if the file was removed or truncated. `read` and `latest` change to the new file when the old file is closed
or truncated, or its heartbeat is too old. Each call checks the size of the file first, because a read of a truncated
page ends the process (SIGBUS). Only root and the daemon's user can truncate the file between check and read.
"""

import mmap
import os
import re
import select
import stat
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from imud.formats.ring import (
    FILE_PREFIX,
    FIRST_WORD,
    HEADER_BYTES,
    HEARTBEAT_LIMIT_NS,
    HEARTBEAT_WORD,
    LEDGER_BLOCK_BYTES,
    LEDGER_BLOCK_OFFSET,
    LEDGER_UPDATE_WORD,
    NEWEST_WORD,
    OPEN_FLAGS,
    STATE_HALF_WORD,
    STATE_LIVE,
    LedgerBlock,
    RingHeader,
    decode_header,
    decode_ledger_block,
    default_directories,
    ring_path,
)
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES, decode_slot
from imud.model.errors import LinkMissing, ServerError
from imud.model.sample import Sample

ROOT_UID = 0
_ATTEMPTS = 3
"""Number of attempts to copy a slot. The writer may overwrite it during one copy, but not during three copies."""
_DRAIN_BYTES = 4096
"""Size of one read from the descriptor, much more than it contains, bytes."""
_NAME = re.compile(r"[\w-]{1,63}", re.ASCII)
_SHOWN_MAX = 32


class RingRead(NamedTuple):
    """Result of `read`."""

    samples: list[Sample]  # new samples, oldest first
    missed: int  # number of samples overwritten before this `read`, since the previous `read`


class Ring:
    """An open ring of one device. The end of a `with` block closes it.

    After a restart of the daemon, `read` and `latest` change to the new ring file. Synchronization: one thread. Every
    thread or process may open its own Ring.
    """

    def __init__(
        self, device_or_path: str | Path, *, directory: str | None = None, from_oldest: bool = False,
        owner_uid: int = ROOT_UID, now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        """Open the ring of a device, or the file at a path that contains '/'.

        - `directory`: folder of the rings; None for `default_directory(device)`.
        - `from_oldest`: `read` begins with the oldest sample in the ring. Otherwise it begins with the next sample.
        - `owner_uid`: accepted owner of the file, in addition to root and the owner of its folder. Set it to the
          daemon's user if the folder is shared, such as /dev/shm.
        - `now_ns`: function that returns CLOCK_MONOTONIC in ns, for tests.

        Raises ServerError if there is no ring, no permission, another owner, or another layout.
        """
        text = str(device_or_path)
        # path of the ring file
        self.path: Path = Path(text) if "/" in text else ring_path(directory or default_directory(text), text)
        self.missed: int = 0  # number of samples that `read` missed since opening
        self._now_ns = now_ns
        self._owner_uid = owner_uid
        self._change_to(_RingFile.open(self.path, owner_uid))
        newest = self.newest_seq
        self._next = self._oldest(newest) if from_oldest and newest else newest + 1

    @property
    def header(self) -> RingHeader:
        """The header at the time of opening. Epoch, process, device and sizes never change."""
        return self._header

    @property
    def epoch(self) -> int:
        """Random number of the daemon's start. A restart changes it."""
        return self._header.epoch

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest sample; 0 before the first sample, or if the file is truncated."""
        return self._newest() if self._whole() else 0

    def alive(self, now_ns: int) -> bool:
        """Return whether a daemon writes this ring at `now_ns`, CLOCK_MONOTONIC."""
        return self._whole() and self._live(now_ns)

    def latest(self) -> Sample | None:
        """Return the newest sample; None before the first. `read` still returns this sample. Raises as `reopen`."""
        whole = self._whole()
        if not (whole and self._live(self._now_ns())) and not self.reopen() and not whole:
            return None
        for _ in range(_ATTEMPTS):
            newest = self._newest()
            sample = self._slot(newest) if newest else None
            if sample is not None:
                return sample
        return None

    def read(self) -> RingRead:
        """Return all samples since the previous `read`. Raises as `reopen`."""
        whole = self._whole()
        found = self._collect() if whole else RingRead([], 0)
        if not found.samples and not found.missed and not (whole and self._live(self._now_ns())) and self.reopen():
            found = self._collect()
        self.missed += found.missed
        return found

    def ledger(self) -> LedgerBlock | None:
        """Return the ledger and the driver; None before the first, during a write, or if the file is truncated."""
        if not self._whole():
            return None
        words, at = self._words, LEDGER_BLOCK_OFFSET
        for _ in range(_ATTEMPTS):
            before = words[LEDGER_UPDATE_WORD]
            block = decode_ledger_block(self._copy(at, LEDGER_BLOCK_BYTES), self._header.ledger_count)
            if 0 < before < SEQ_INVALID and block is not None and block.update == before == words[LEDGER_UPDATE_WORD]:
                return block
        return None

    def reopen(self) -> bool:
        """Change to the new ring file of this device. Return False if there is no new file.

        `read` then begins with the first sample of the new ring. If the same daemon continues its sequence numbers,
        `read` continues after the last sample, and overwritten samples count as missed. Raises ServerError if the new
        file is unusable, for example because of its owner or its layout version.
        """
        try:
            status = self.path.lstat()
        except OSError:
            return False
        if (status.st_dev, status.st_ino) == self._inode:
            return False
        try:
            file = _RingFile.open(self.path, self._owner_uid)
        except ServerError:
            if os.path.lexists(self.path):
                raise
            return False  # removed in the meantime
        continued = file.header.epoch == self.epoch and file.header.first_seq >= self._next
        self._next = self._next if continued else 1
        self.close()
        self._change_to(file)
        return True

    def wait(self, fd: int, timeout_s: float | None = None) -> bool:
        """Wait until `fd`, from `imud.client.Client.notify`, is readable, and empty it. Return False after `timeout_s`.

        Raises LinkMissing if the daemon ended the descriptor.
        """
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        if not poller.poll(None if timeout_s is None else timeout_s * 1000):
            return False
        try:
            if os.read(fd, _DRAIN_BYTES):
                return True
        except BlockingIOError:  # another thread or process was faster
            return True
        raise LinkMissing(f"{self.path}: the daemon ended the descriptor; connect to its socket and call notify again")

    def close(self) -> None:
        """Close the ring. A second call does nothing."""
        for view in (self._words, self._halves):
            view.release()
        self._memory.close()
        self._close_descriptor()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _change_to(self, file: "_RingFile") -> None:
        self._header, self._memory, self._fd, self._inode = file
        self._close_descriptor = weakref.finalize(self, os.close, self._fd)  # also if the user does not call `close`
        with memoryview(self._memory) as view:
            self._words, self._halves = view.cast("Q"), view.cast("I")
        self._torn = (0, 0)
        self._size_bytes = len(self._memory)

    def _whole(self) -> bool:
        """Return whether the file still contains every mapped page."""
        return os.lseek(self._fd, 0, os.SEEK_END) >= self._size_bytes

    def _newest(self) -> int:
        return self._words[NEWEST_WORD]

    def _live(self, now_ns: int) -> bool:
        if self._halves[STATE_HALF_WORD] != STATE_LIVE:
            return False
        # abs: a heartbeat in the future is invalid too
        return abs(now_ns - self._words[HEARTBEAT_WORD]) < HEARTBEAT_LIMIT_NS

    def _collect(self) -> RingRead:
        newest, missed = self._newest(), 0
        if 0 < newest < self._next - 1:  # the sequence numbers restarted in the same ring
            self._next = self._oldest(newest)
        samples: list[Sample] = []
        while self._next <= newest:
            oldest = self._oldest(newest)
            if self._next < oldest:
                missed += oldest - self._next
                self._next = oldest
            sample = self._slot(self._next)
            if sample is not None:
                samples.append(sample)
            elif not self._overtaken():
                if not self._never_whole():
                    break
                missed += 1
            else:
                newest = self._newest()
                continue
            self._next += 1
        return RingRead(samples, missed)

    def _copy(self, at: int, size_bytes: int) -> bytes:
        return self._memory[at : at + size_bytes]

    def _oldest(self, newest: int) -> int:
        """Return the oldest sequence number in the ring if `newest` is the newest; `newest` + 1 if it is empty."""
        kept, first = max(newest - self._header.slot_count + 1, 1), self._words[FIRST_WORD]
        # above `newest` + 1: the writer has changed `first` since `newest` was read
        return first if kept < first <= newest + 1 else kept

    def _slot(self, seq: int) -> Sample | None:
        """Return sample `seq`; None if its slot is incomplete or contains another sample."""
        at = HEADER_BYTES + (seq & (self._header.slot_count - 1)) * SLOT_BYTES
        word = at >> 3
        if self._words[word] != seq:
            return None
        slot = self._copy(at, SLOT_BYTES)
        try:
            sample = decode_slot(slot, self._header.device)
        except ValueError:
            return None
        return sample if sample.seq == seq == self._words[word] else None

    def _overtaken(self) -> bool:
        """Return whether the writer has reused the slot of `_next`."""
        return self._oldest(self._newest()) > self._next

    def _never_whole(self) -> bool:
        """Return whether slot `_next` will stay incomplete: it was incomplete before, and newer slots are complete."""
        newest = self._newest()
        seq, newest_then = self._torn
        if seq != self._next:
            self._torn = (self._next, newest)
            return False
        return newest > newest_then


def default_directory(device: str = "") -> str:
    """Return the folder of the rings: the environment variable IMUD_SHM if it is not empty.

    Otherwise /run/imud/shm, or $XDG_RUNTIME_DIR/imud/shm if only this folder contains the ring of `device`.
    """
    named = os.environ.get("IMUD_SHM")
    if named:
        return named
    first, *others = default_directories(os.environ)
    if device and not os.path.lexists(ring_path(first, device)):
        return next((other for other in others if os.path.lexists(ring_path(other, device))), first)
    return first


class _RingFile(NamedTuple):
    """An open and mapped ring file."""

    header: RingHeader
    memory: mmap.mmap
    descriptor: int
    inode: tuple[int, int]

    @classmethod
    def open(cls, path: Path, owner_uid: int) -> Self:
        """Open the file. Raises ServerError if it is not a readable ring of a trusted owner."""
        try:
            descriptor = os.open(path, OPEN_FLAGS)
        except FileNotFoundError:
            raise ServerError(f"{path}: no such ring; {_what_there_is(path)}") from None
        except PermissionError as error:
            raise ServerError(
                f"cannot read {path}: no permission; add this user to the group of the file (ls -l {path})"
            ) from error
        except OSError as error:
            raise ServerError(f"cannot read {path}: {error.strerror}") from error
        try:
            return cls._mapped(descriptor, path, owner_uid)
        except OSError as error:
            os.close(descriptor)
            raise ServerError(f"cannot read {path}: {error.strerror}") from error
        except ServerError:
            os.close(descriptor)
            raise

    @classmethod
    def _mapped(cls, descriptor: int, path: Path, owner_uid: int) -> Self:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            kind = stat.filemode(status.st_mode)[0]
            raise ServerError(f"{path} is not a ring file: expected a regular file (-), got another kind ({kind})")
        _check_owner(path, status.st_uid, owner_uid)
        header = decode_header(os.pread(descriptor, HEADER_BYTES, 0), str(path))
        expected_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
        if status.st_size < expected_bytes:
            raise ServerError(f"{path}: expected {expected_bytes} bytes, got {status.st_size}; the file is truncated")
        memory = mmap.mmap(descriptor, expected_bytes, prot=mmap.PROT_READ)
        return cls(header, memory, descriptor, (status.st_dev, status.st_ino))


def _check_owner(path: Path, found_uid: int, owner_uid: int) -> None:
    """Raise ServerError if the owner of the file is not trusted, because any user could have made it."""
    # the owner of the folder can replace every file in it; the pid in the header can be forged
    directory_uid = path.parent.stat().st_uid
    if found_uid not in (ROOT_UID, directory_uid, owner_uid):
        raise ServerError(
            f"{path} belongs to user {found_uid}: expected root or user {directory_uid}, the owner of {path.parent}; "
            f"set owner_uid={found_uid} if the daemon runs as this user"
        )


def _what_there_is(path: Path) -> str:
    names = sorted(file.name.removeprefix(FILE_PREFIX) for file in path.parent.glob(FILE_PREFIX + "*"))
    # a shared folder may contain files of any user
    shown = [name for name in names if _NAME.fullmatch(name)][:_SHOWN_MAX]
    return f"there are rings for: {', '.join(shown)}" if shown else "there are none: is imud running, with shm enabled?"
