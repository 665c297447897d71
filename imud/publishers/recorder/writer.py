"""Writer of recordings: records wait in a limited queue, and a thread writes them in blocks.

    loop ──put──▶ queue ──once a second, or RING_BYTES──▶ thread: block, compress, write, sometimes sync

The event loop never waits. If the queue is full, imud drops and counts records. After an error of the disk, the thread
stores the problem and empties the queue until the next file.
"""

import errno
import os
import platform
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from imud import __version__
from imud.contracts.publisher import PublisherContext, PutRecord
from imud.formats import records
from imud.formats.recording import RECORD_BYTES_MAX, BlockGatherer
from imud.formats.records import NO_DEVICE, EndRecord, Kind, LostRecord, SessionRecord
from imud.host.threads import StartWorker
from imud.model.errors import reason_of
from imud.model.event import Event
from imud.model.units import NS_PER_S

# Maximum size of the queue, bytes: 2 minutes of a device at 1 kHz, 5 s of 24 devices. An SD card can stall for a second
# while it erases.
QUEUE_BYTES: Final = 16 << 20
RING_BYTES: Final = 256 << 10  # size that wakes the thread, bytes: one full block
WRITE_NS: Final = NS_PER_S  # Time between two writes, ns. If the process is killed, newer records are lost.
# Time between two synchronizations with the disk, ns. A power failure loses newer records.
SYNC_NS: Final = 5 * NS_PER_S
FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_APPEND

M = TypeVar("M")  # type of the marks between records, for example the path of a new file; never bytes


class RecordQueue(Generic[M]):
    """Queue of records and marks. Synchronization: one thread puts, one thread takes."""

    def __init__(self, bytes_max: int = QUEUE_BYTES) -> None:
        self.dropped = 0  # number of records that had no room since the start
        self.dropped_bytes = 0
        self._items: deque[bytes | M] = deque()
        self._bytes_max = bytes_max
        self._put = self._taken = 0
        self._rung = 0
        self.ring: Callable[[], None] = lambda: None  # wakes the thread, which sets it

    @property
    def waiting_bytes(self) -> int:
        """Return the size of the waiting records, bytes."""
        return self._put - self._taken

    @property
    def is_easy(self) -> bool:
        """Return whether at least half of the queue is free."""
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
        """Add a mark after the present records, and wake the thread. There is always room for a mark."""
        self._items.append(mark)
        self.ring()

    def take(self) -> bytes | M | None:
        """Return the oldest item; None if the queue is empty."""
        try:
            item = self._items.popleft()
        except IndexError:
            return None
        if isinstance(item, bytes):
            self._taken += len(item)
        return item


class RecordingWriter:
    """Thread and file of a recording. Synchronization: the thread writes the counters, any thread reads them."""

    def __init__(self, queue: RecordQueue[Path], now_ns: Callable[[], int], start_worker: StartWorker) -> None:
        self.file_bytes = 0  # size of the present file
        self.written_bytes = 0  # size of all files since the start
        self.records = 0  # number of written records
        self.problem = ""  # cause of a failed write, until the next file starts; empty if there is no problem
        self.failure: BaseException | None = None  # internal error that ended the thread
        self._queue = queue
        self._now_ns = now_ns
        self._gatherer = BlockGatherer()
        self._descriptor = -1
        self._synced_ns = now_ns()
        self._worker = start_worker("recorder", self)
        queue.ring = self._worker.ring

    def close(self) -> None:
        """Write the waiting records and end the thread. A second call does nothing."""
        self._queue.ring = lambda: None
        self._worker.end()
        self.do_round()
        self._close_file()

    # --- thread -------------------------------------------------------------------------------------------------------

    def do_round(self) -> int:
        """Write the waiting records. Return the time until the next round, ns."""
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
        """Close the file after its last complete block, and drop all records until the next file."""
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

    def round_failed(self, error: BaseException) -> None:
        self.failure = error


# Interval of the check records, ns. They contain the newest sample and the ledger, with which a replay is compared.
CHECK_NS: Final = NS_PER_S
# Maximum time for the description of devices in one tick, ns, except the last device. One state takes 0.6 ms. The next
# ticks describe the other devices, so that a new recording does not delay samples.
BEGIN_NS: Final = 2_000_000


class RecordFeed:
    """Source of the records of one recording. Synchronization: the event loop's thread only."""

    def __init__(
        self, context: PublisherContext, queue: RecordQueue[Any], devices: Collection[str] | None = None
    ) -> None:
        """`devices` are the names of the recorded devices, None for all."""
        self._context = context
        self._source = context.devices.recording
        self._queue = queue
        self._put: PutRecord = queue.put
        self._devices = devices
        self._ids: dict[str, int] = {}
        self._recorded: set[str] = set()
        self._due: set[str] = set()  # devices with a pending description
        self._checked_ns = 0
        self._dropped = (0, 0)  # number and size of the dropped records that the recording already contains
        self._lost_ns = 0

    # --- devices ------------------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The recording starts with the next `follow`, after the device exists."""
        self._ids[name] = device_id

    def remove_device(self, name: str) -> None:
        """Remove a device that left the configuration or that imud creates again."""
        self._ids.pop(name, None)
        self._recorded.discard(name)
        self._due.discard(name)

    def follow(self) -> None:
        """Start recording new devices, and describe devices with a pending description."""
        now_ns = self._context.clock.now_ns
        end_ns = now_ns() + BEGIN_NS
        for name in self._source.names():
            if (name not in self._recorded or name in self._due) and self.wants(name):
                self._recorded.add(name)
                self._due.discard(name)
                self._source.begin(name, self._put)
                if now_ns() >= end_ns:
                    return

    def describe(self, *, at_once: bool) -> None:
        """Record the clocks of the host and the state of each device. Without `at_once`, the next calls of `follow`
        describe the devices. Use this at a place where a replay still has their earlier state."""
        self._source.begin_host(self._put)
        if not at_once:
            self._due |= self._recorded
            return
        self._due.clear()
        for name in sorted(self._recorded):
            self._source.begin(name, self._put)

    # --- records ------------------------------------------------------------------------------------------------------

    def session(self, number: int, now_ns: int) -> bytes:
        """Return the first record of a file."""
        context = self._context
        host = f"{platform.node()}, {platform.system()} {platform.release()} {platform.machine()}"
        utc_ns = now_ns + context.clock.utc_offset_ns()
        python = platform.python_version()
        session = SessionRecord(
            records.VERSION, __version__, python, host, context.epoch, number, now_ns, utc_ns
        )  # fmt: skip
        return records.encode_object(Kind.SESSION, NO_DEVICE, session)

    def ending(self, reason: str) -> bytes:
        """Return the last record of a file."""
        now_ns = self._context.clock.now_ns()
        end = EndRecord(now_ns, now_ns + self._context.clock.utc_offset_ns(), reason)
        return records.encode_object(Kind.END, NO_DEVICE, end)

    def put(self, record: bytes) -> None:
        """Add another record."""
        self._put(record)

    def event(self, event: Event) -> None:
        """Record an event of a recorded device or of the daemon."""
        if not event.device or self.wants(event.device):
            device = self._ids.get(event.device, NO_DEVICE)
            self._put(records.encode_object(Kind.EVENT, device, event))

    def check(self) -> None:
        """Record the newest sample and the ledger of each device."""
        for name in sorted(self._recorded - self._due):
            self._source.check(name, self._put)

    def check_if_due(self, now_ns: int) -> bool:
        """Call `check` every CHECK_NS. Return whether it was called."""
        if now_ns - self._checked_ns < CHECK_NS:
            return False
        self._checked_ns = now_ns
        self.check()
        return True

    def note_losses(self, now_ns: int) -> int:
        """Record the losses when the queue has room again, then the states. Return the number of dropped records."""
        if self._queue.dropped == self._dropped[0]:
            return 0
        self._lost_ns = self._lost_ns or now_ns
        if not self._queue.is_easy:
            return 0
        lost = self._new_losses(now_ns)
        self._put(records.encode_lost(lost))
        self.describe(at_once=True)
        return lost.records

    def finish(self, reason: str) -> bytes:
        """Record the last checks and stop. Return the last records of the recording, including losses."""
        if self._queue.dropped == self._dropped[0]:
            self.check()
        self.stop()
        lost = self._new_losses(self._context.clock.now_ns())
        return (records.encode_lost(lost) if lost.records else b"") + self.ending(reason)

    def _new_losses(self, now_ns: int) -> LostRecord:
        """Return the new losses and mark them as recorded."""
        queue, (noted, noted_bytes) = self._queue, self._dropped
        lost = LostRecord(queue.dropped - noted, queue.dropped_bytes - noted_bytes, self._lost_ns or now_ns)
        self._dropped, self._lost_ns = (queue.dropped, queue.dropped_bytes), 0
        return lost

    def stop(self) -> None:
        """Stop recording. `follow` starts again."""
        self._source.end(self._put)
        self._recorded.clear()
        self._due.clear()

    def wants(self, name: str) -> bool:
        """Return whether a device is selected."""
        return self._devices is None or name in self._devices
