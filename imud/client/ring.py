"""Reads the shared-memory ring of one device (`imud.formats.ring`): samples without a system call per sample.

    with Ring("imu0") as ring:
        while True:
            for sample in ring.read().samples:
                print(sample.seq, sample.accel_m_s2)
            ring.wait(wake_fd, timeout_s=1.0)       # a descriptor of one's own, from `imud.client.Client.notify`

Nothing here waits busily: a slot that is not whole yet is given by a later call. A daemon that restarts makes a new
file, and so does one whose file was removed or cut; `read` and `latest` change over to it by themselves as soon as the
old one is closed, cut, or its heartbeat is stale. Each call looks at the file's size first, because reading a page that
was cut off ends the process by SIGBUS; only root and the daemon's user can cut it between that and the copy.
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
"""The writer may overtake one copy, hardly three in a row."""
_DRAIN_BYTES = 4096
"""Far more than wait in a descriptor of the daemon's, so that one read takes all."""
_NAME = re.compile(r"[\w-]{1,63}", re.ASCII)
_SHOWN_MAX = 32


class RingRead(NamedTuple):
    """What one `read` found."""

    samples: list[Sample]
    """New samples, oldest first."""
    missed: int
    """Samples that were overwritten before they could be read, since the `read` before."""


class Ring:
    """An open ring. Synchronization: one thread; every thread or process may open its own."""

    def __init__(
        self, device_or_path: str | Path, *, directory: str | None = None, from_oldest: bool = False,
        owner_uid: int = ROOT_UID, now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        """Open by device name, or by path if there is a '/' in it; `read` gives the samples that come from now on.

        `from_oldest`: it begins with the oldest sample that is still in the ring.

        A name is looked up in `directory`, by default as `default_directory` says. The file must belong to root, to
        the owner of the directory it is in, or to `owner_uid`, the daemon's user where that directory is a shared one
        such as /dev/shm. Raises ServerError: no such ring, not permitted, of another user, or of another layout.
        """
        text = str(device_or_path)
        self.path = Path(text) if "/" in text else ring_path(directory or default_directory(text), text)
        self.missed = 0
        """Samples missed since opening."""
        self._now_ns = now_ns
        self._owner_uid = owner_uid
        self._change_to(_RingFile.open(self.path, owner_uid))
        newest = self.newest_seq
        self._next = self._oldest(newest) if from_oldest and newest else newest + 1

    @property
    def header(self) -> RingHeader:
        """Epoch, process, device and sizes, which do not change while the ring lives; the rest as at opening."""
        return self._header

    @property
    def epoch(self) -> int:
        """Random number of the daemon's start; another one after a restart."""
        return self._header.epoch

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest sample, 0 before the first or when the file was cut."""
        return self._newest() if self._whole() else 0

    def alive(self, now_ns: int) -> bool:
        """Whether a daemon writes this ring, at `now_ns` of CLOCK_MONOTONIC."""
        return self._whole() and self._live(now_ns)

    def latest(self) -> Sample | None:
        """The newest sample, None before the first. Does not move `read`. Raises as `reopen`."""
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
        """All samples since the `read` before. Raises as `reopen`."""
        whole = self._whole()
        found = self._collect() if whole else RingRead([], 0)
        if not found.samples and not found.missed and not (whole and self._live(self._now_ns())) and self.reopen():
            found = self._collect()
        self.missed += found.missed
        return found

    def ledger(self) -> LedgerBlock | None:
        """The ledger and the driver in use; None before the first, while it is written, and when the file was cut."""
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
        """Change to the new ring of this device, if there is one; False if not.

        Samples come from the first on, or where the same daemon goes on with its numbers, from the last one read on;
        those that the ring no longer holds count as missed. Raises ServerError when there is a file that cannot be
        used, for example one of another user or another layout version.
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
            return False  # removed since
        continued = file.header.epoch == self.epoch and file.header.first_seq >= self._next
        self._next = self._next if continued else 1
        self.close()
        self._change_to(file)
        return True

    def wait(self, fd: int, timeout_s: float | None = None) -> bool:
        """Wait until `fd`, of `imud.client.Client.notify`, is readable, and drain it; False after `timeout_s`.

        Raises LinkMissing when the daemon ended it: it would be readable for ever.
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
        raise LinkMissing(f"{self.path}: the daemon ended the descriptor; connect to its socket and ask for another")

    def close(self) -> None:
        """Release the ring; may be called twice."""
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
        self._close_descriptor = weakref.finalize(self, os.close, self._fd)  # also for a ring that nobody closes
        with memoryview(self._memory) as view:
            self._words, self._halves = view.cast("Q"), view.cast("I")
        self._torn = (0, 0)
        self._size_bytes = len(self._memory)

    def _whole(self) -> bool:
        """Whether the file still has every page that is mapped."""
        return os.lseek(self._fd, 0, os.SEEK_END) >= self._size_bytes

    def _newest(self) -> int:
        return self._words[NEWEST_WORD]

    def _live(self, now_ns: int) -> bool:
        if self._halves[STATE_HALF_WORD] != STATE_LIVE:
            return False
        return abs(now_ns - self._words[HEARTBEAT_WORD]) < HEARTBEAT_LIMIT_NS  # far in the future is no sign of life

    def _collect(self) -> RingRead:
        newest, missed = self._newest(), 0
        if 0 < newest < self._next - 1:  # the numbers began anew in the same ring
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
        """The oldest sample the ring can hold when `newest` is its newest; `newest` + 1 when it holds none."""
        kept, first = max(newest - self._header.slot_count + 1, 1), self._words[FIRST_WORD]
        return first if kept < first <= newest + 1 else kept  # `first` may be seen before the `newest` it belongs to

    def _slot(self, seq: int) -> Sample | None:
        """Sample `seq` if its slot is whole and still its own."""
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
        """Whether the writer has meanwhile begun to use the slot of `_next` anew."""
        return self._oldest(self._newest()) > self._next

    def _never_whole(self) -> bool:
        """Whether `_next`, not whole before, still is not although newer samples were finished: it never will be."""
        newest = self._newest()
        seq, newest_then = self._torn
        if seq != self._next:
            self._torn = (self._next, newest)
            return False
        return newest > newest_then


def default_directory(device: str = "") -> str:
    """The directory where a ring is looked up by name: the environment variable IMUD_SHM, if that is set.

    Otherwise /run/imud/shm, or $XDG_RUNTIME_DIR/imud/shm if the ring of `device` is only there.
    """
    named = os.environ.get("IMUD_SHM")
    if named:
        return named
    first, *others = default_directories(os.environ)
    if device and not os.path.lexists(ring_path(first, device)):
        return next((other for other in others if os.path.lexists(ring_path(other, device))), first)
    return first


class _RingFile(NamedTuple):
    """A ring's file, open and mapped."""

    header: RingHeader
    memory: mmap.mmap
    descriptor: int
    inode: tuple[int, int]

    @classmethod
    def open(cls, path: Path, owner_uid: int) -> Self:
        """Raises ServerError for anything but a ring that may be read and believed."""
        try:
            descriptor = os.open(path, OPEN_FLAGS)
        except FileNotFoundError:
            raise ServerError(f"{path}: no such ring; {_what_there_is(path)}") from None
        except PermissionError as error:
            raise ServerError(
                f"{path} may not be read; is this user in the group that `ls -l {path}` shows?"
            ) from error
        except OSError as error:
            raise ServerError(f"{path} cannot be read: {error.strerror}") from error
        try:
            return cls._mapped(descriptor, path, owner_uid)
        except OSError as error:
            os.close(descriptor)
            raise ServerError(f"{path} cannot be read: {error.strerror}") from error
        except ServerError:
            os.close(descriptor)
            raise

    @classmethod
    def _mapped(cls, descriptor: int, path: Path, owner_uid: int) -> Self:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            kind = stat.filemode(status.st_mode)[0]
            raise ServerError(f"{path} is no ring of imud: expected a regular file (-), found another kind ({kind})")
        _check_owner(path, status.st_uid, owner_uid)
        header = decode_header(os.pread(descriptor, HEADER_BYTES, 0), str(path))
        expected_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
        if status.st_size < expected_bytes:
            raise ServerError(f"{path}: expected {expected_bytes} bytes, found {status.st_size}; the file was cut")
        memory = mmap.mmap(descriptor, expected_bytes, prot=mmap.PROT_READ)
        return cls(header, memory, descriptor, (status.st_dev, status.st_ino))


def _check_owner(path: Path, found_uid: int, owner_uid: int) -> None:
    """Raise ServerError where a user may have planted the file who is neither trusted nor named.

    The owner of the directory may replace every file in it anyway. The header's pid is no proof: it can be forged.
    """
    directory_uid = path.parent.stat().st_uid
    if found_uid not in (ROOT_UID, directory_uid, owner_uid):
        raise ServerError(
            f"{path} belongs to user {found_uid}, who may have planted it: expected root or user {directory_uid}, the"
            f" owner of {path.parent}; if the daemon runs as user {found_uid}, name that user (owner_uid)"
        )


def _what_there_is(path: Path) -> str:
    names = sorted(file.name.removeprefix(FILE_PREFIX) for file in path.parent.glob(FILE_PREFIX + "*"))
    shown = [name for name in names if _NAME.fullmatch(name)][:_SHOWN_MAX]  # in a shared directory: anybody's
    return f"there are rings for: {', '.join(shown)}" if shown else "there are none: is imud running, with shm enabled?"
