"""Reads the shared-memory ring of one device (`imud.formats.ring`): samples without a system call per sample.

    with Ring("imu0") as ring:
        while True:
            for sample in ring.read().samples:
                print(sample.seq, sample.accel_m_s2)
            ring.wait(wake_fd, timeout_s=1.0)       # a descriptor of one's own, from `imud.client.Client.notify`

Nothing here waits busily: a slot that is not whole yet is given by a later call. A daemon that restarts makes a new
file; `read` and `latest` change over to it by themselves as soon as the old one is closed or its heartbeat is stale.
"""

import mmap
import os
import select
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from imud.errors import LinkMissing, ServerError
from imud.formats.ring import (
    DIRECTORY,
    FILE_PREFIX,
    FIRST_WORD,
    HEADER_BYTES,
    HEARTBEAT_LIMIT_NS,
    HEARTBEAT_WORD,
    LEDGER_BLOCK_BYTES,
    LEDGER_BLOCK_OFFSET,
    LEDGER_UPDATE_WORD,
    NEWEST_WORD,
    STATE_HALF_WORD,
    STATE_LIVE,
    LedgerBlock,
    RingHeader,
    decode_header,
    decode_ledger_block,
    ring_path,
)
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES, decode_slot
from imud.sample import Sample

_ATTEMPTS = 3
"""The writer may overtake one copy, hardly three in a row."""
_DRAIN_BYTES = 4096
"""Far more than wait in a descriptor of the daemon's, so that one read takes all."""


class RingRead(NamedTuple):
    """What one `read` found."""

    samples: list[Sample]
    """New samples, oldest first."""
    missed: int
    """Samples that were overwritten before they could be read, since the `read` before."""


class Ring:
    """An open ring. Synchronization: one thread; every thread or process may open its own."""

    def __init__(
        self, device_or_path: str | Path, *, directory: str | None = None, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Open by device name, or by path if there is a '/' in it; `read` gives the samples that come from now on.

        A name is looked up in `directory`, by default the one that `default_directory` gives.
        Raises ServerError: no such ring, not permitted, or of another layout.
        """
        text = str(device_or_path)
        self.path = Path(text) if "/" in text else ring_path(directory or default_directory(), text)
        self.missed = 0
        """Samples missed since opening."""
        self._now_ns = now_ns
        self._torn = (0, 0)
        self._header, self._memory, self._inode = _map(self.path)
        self._views()
        self._next = self.newest_seq + 1

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
        """Sequence number of the newest sample, 0 before the first."""
        return self._words[NEWEST_WORD]

    def alive(self, now_ns: int) -> bool:
        """Whether a daemon writes this ring, at `now_ns` of CLOCK_MONOTONIC."""
        return self._halves[STATE_HALF_WORD] == STATE_LIVE and now_ns - self._words[HEARTBEAT_WORD] < HEARTBEAT_LIMIT_NS

    def latest(self) -> Sample | None:
        """The newest sample, None before the first. Does not move `read`. Raises as `reopen`."""
        self._change_over()
        for _ in range(_ATTEMPTS):
            newest = self.newest_seq
            sample = self._slot(newest) if newest else None
            if sample is not None:
                return sample
        return None

    def read(self) -> RingRead:
        """All samples since the `read` before. Raises as `reopen`."""
        found = self._collect()
        if not found.samples and not found.missed and self._change_over():
            found = self._collect()
        self.missed += found.missed
        return found

    def ledger(self) -> LedgerBlock | None:
        """The ledger and the driver in use; None before the first or while it is being written."""
        words, at = self._words, LEDGER_BLOCK_OFFSET
        for _ in range(_ATTEMPTS):
            before = words[LEDGER_UPDATE_WORD]
            block = decode_ledger_block(self._copy(at, LEDGER_BLOCK_BYTES), self._header.ledger_count)
            if 0 < before < SEQ_INVALID and block is not None and block.update == before == words[LEDGER_UPDATE_WORD]:
                return block
        return None

    def reopen(self) -> bool:
        """Change to the ring of a restarted daemon, if there is one; False if not.

        Its samples come from the first on; those it no longer holds count as missed. Raises ServerError when there is
        a file that cannot be used, for example one of another layout version.
        """
        try:
            status = self.path.stat()
        except OSError:
            return False
        if (status.st_dev, status.st_ino) == self._inode:
            return False
        try:
            header, memory, inode = _map(self.path)
        except ServerError:
            if self.path.exists():
                raise
            return False  # removed since
        self.close()
        self._header, self._memory, self._inode = header, memory, inode
        self._views()
        self._next, self._torn = 1, (0, 0)
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _views(self) -> None:
        with memoryview(self._memory) as view:
            self._words, self._halves = view.cast("Q"), view.cast("I")

    def _change_over(self) -> bool:
        return not self.alive(self._now_ns()) and self.reopen()

    def _collect(self) -> RingRead:
        newest, missed = self.newest_seq, 0
        if newest + 1 < self._next:  # the numbers began anew in the same ring
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
                newest = self.newest_seq
                continue
            self._next += 1
        return RingRead(samples, missed)

    def _copy(self, at: int, size_bytes: int) -> bytes:
        return self._memory[at : at + size_bytes]

    def _oldest(self, newest: int) -> int:
        """The oldest sample the ring can hold when `newest` is its newest."""
        kept, first = max(newest - self._header.slot_count + 1, 1), self._words[FIRST_WORD]
        return first if kept < first <= newest else kept  # `first` may be seen before the `newest` it belongs to

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
        return self._oldest(self.newest_seq) > self._next

    def _never_whole(self) -> bool:
        """Whether `_next`, not whole before, still is not although newer samples were finished: it never will be."""
        newest = self.newest_seq
        seq, newest_then = self._torn
        if seq != self._next:
            self._torn = (self._next, newest)
            return False
        return newest > newest_then


def default_directory() -> str:
    """The directory of rings: the environment variable IMUD_SHM; where that is not set or empty, /dev/shm."""
    return os.environ.get("IMUD_SHM") or DIRECTORY


def _map(path: Path) -> tuple[RingHeader, mmap.mmap, tuple[int, int]]:
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            header = decode_header(file.read(HEADER_BYTES), str(path))
            expected_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
            if status.st_size < expected_bytes:
                raise ServerError(f"{path}: expected {expected_bytes} bytes, found {status.st_size}; the file was cut")
            memory = mmap.mmap(file.fileno(), expected_bytes, prot=mmap.PROT_READ)
    except FileNotFoundError:
        raise ServerError(f"{path}: no such ring; {_what_there_is(path)}") from None
    except PermissionError as error:
        raise ServerError(f"{path} may not be read; is this user in the group that `ls -l {path}` shows?") from error
    except OSError as error:
        raise ServerError(f"{path} cannot be read: {error.strerror}") from error
    return header, memory, (status.st_dev, status.st_ino)


def _what_there_is(path: Path) -> str:
    names = sorted(file.name.removeprefix(FILE_PREFIX) for file in path.parent.glob(FILE_PREFIX + "*"))
    return f"there are rings for: {', '.join(names)}" if names else "there are none: is imud running, with shm enabled?"
