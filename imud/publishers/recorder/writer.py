"""Writer of recordings in a thread of its own: records wait in a bounded queue, and are written a block at a time.

    loop ──put──▶ queue ──once a second, or RING_BYTES──▶ thread: block, compress, write, now and then sync

The loop never waits: a record that has no room in the queue is dropped and counted. An error of the disk ends the
writing; the thread says why, and goes on emptying the queue until it is given a new file.
"""

import errno
import os
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Generic, TypeVar

from imud.errors import reason_of
from imud.formats.recording.file import RECORD_BYTES_MAX, BlockGatherer
from imud.units import NS_PER_S
from imud.worker import StartWorker

QUEUE_BYTES: Final = 16 << 20
"""Records that wait: 2 minutes of a device at 1 kHz, 5 s of 24 of them. An SD card that erases stalls for a second."""
RING_BYTES: Final = 256 << 10
"""The thread is woken for so many: a block of them is full."""
WRITE_NS: Final = NS_PER_S
"""Records are in the file so long after they came: so much is missing when the process is killed."""
SYNC_NS: Final = 5 * NS_PER_S
"""And on the disk so long after: so much is missing when the power fails."""
FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_APPEND

M = TypeVar("M")
"""What stands between records, for example the path of a file that begins; never bytes."""


class RecordQueue(Generic[M]):
    """Queue of records, and of marks between them. Synchronization: one thread puts, one takes."""

    def __init__(self, bytes_max: int = QUEUE_BYTES) -> None:
        self.dropped = 0
        """Records that had no room since the start."""
        self.dropped_bytes = 0
        self._items: deque[bytes | M] = deque()
        self._bytes_max = bytes_max
        self._put = self._taken = 0
        self._rung = 0
        self.ring: Callable[[], None] = lambda: None
        """Wakes the thread; set by it."""

    @property
    def waiting_bytes(self) -> int:
        """Records that wait."""
        return self._put - self._taken

    @property
    def is_easy(self) -> bool:
        """Whether at least half of the room is free."""
        return 2 * self.waiting_bytes < self._bytes_max

    def put(self, record: bytes) -> None:
        """Add a record, or drop and count it."""
        size = len(record)
        if self._put - self._taken + size > self._bytes_max or size > RECORD_BYTES_MAX:
            self.dropped += 1
            self.dropped_bytes += size
            return
        self._items.append(record)
        self._put += size
        if self._put - self._rung >= RING_BYTES:
            self._rung = self._put
            self.ring()

    def mark(self, mark: M) -> None:
        """Add a mark after the records so far, for which there is always room, and wake the thread."""
        self._items.append(mark)
        self.ring()

    def take(self) -> bytes | M | None:
        """Return the oldest item; None for none."""
        try:
            item = self._items.popleft()
        except IndexError:
            return None
        if isinstance(item, bytes):
            self._taken += len(item)
        return item


class RecordingWriter:
    """The thread and its file. Synchronization: the counters are written by the thread and read by any."""

    def __init__(self, queue: RecordQueue[Path], now_ns: Callable[[], int], start_worker: StartWorker) -> None:
        self.file_bytes = 0
        """Size of the present file."""
        self.written_bytes = 0
        """What was written to all files."""
        self.records = 0
        """Records that were written."""
        self.problem = ""
        """Why nothing is written any more, until a new file begins; empty while all is well."""
        self._queue = queue
        self._now_ns = now_ns
        self._gatherer = BlockGatherer()
        self._descriptor = -1
        self._synced_ns = now_ns()
        self._failure: BaseException | None = None
        self._worker = start_worker("recorder", self._round, self._failed)
        queue.ring = self._worker.ring

    def close(self) -> None:
        """Write what waits and end the thread; may be called twice."""
        self._queue.ring = lambda: None
        self._worker.end()
        self._round()
        self._close_file()

    @property
    def failure(self) -> BaseException | None:
        """The exception that ended the thread, which is an internal error."""
        return self._failure

    # --- the thread's side -------------------------------------------------------------------------------------------

    def _round(self) -> int:
        """Write all that waits; return the time until the next round, ns."""
        queue = self._queue
        while (item := queue.take()) is not None:
            try:
                if isinstance(item, Path):
                    self._begin(item)
                elif self._descriptor >= 0:
                    self._write(self._gatherer.add(item))
                    self.records += 1
            except OSError as error:
                self._fail(error)
        if self._descriptor >= 0:
            try:
                self._write(self._gatherer.finish())
                self._sync()
            except OSError as error:
                self._fail(error)
        return WRITE_NS

    def _begin(self, path: Path) -> None:
        if self._descriptor >= 0:
            self._write(self._gatherer.finish())
            self._close_file()
        self._gatherer = BlockGatherer()
        self._descriptor = os.open(path, FLAGS, 0o640)
        self.file_bytes, self.problem = 0, ""

    def _write(self, block: bytes) -> None:
        if not block:
            return
        written = os.write(self._descriptor, block)
        if written < len(block):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.file_bytes += written
        self.written_bytes += written

    def _sync(self) -> None:
        now_ns = self._now_ns()
        if now_ns - self._synced_ns >= SYNC_NS:
            self._synced_ns = now_ns
            os.fdatasync(self._descriptor)

    def _fail(self, error: OSError) -> None:
        """Leave the file with its whole blocks, and write nothing more to it."""
        with suppress(OSError):
            if self._descriptor >= 0:
                os.ftruncate(self._descriptor, self.file_bytes)
        self._close_file()
        self.problem = reason_of(error)

    def _close_file(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            with suppress(OSError):
                os.fdatasync(descriptor)
            os.close(descriptor)

    def _failed(self, error: BaseException) -> None:
        self._failure = error
