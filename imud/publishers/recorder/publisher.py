"""The recorder as an output of the daemon: what devices deliver goes to files, always, within a budget of the disk.

A file begins with the host's clocks and the state of every device, so that each can be replayed without the one before.
What is lost because the disk is too slow is counted and stands in the file; the states are written anew after it.
A disk that is full, or fails, ends the recording with an event and is tried again; samples go on in any case.
"""

import logging
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

import msgspec

from imud import __version__
from imud.contracts.control.recording import RecordingSource
from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.settings import Settings
from imud.contracts.status import RecorderStatus
from imud.errors import ServerError, reason_of
from imud.event import Event, EventKind
from imud.formats.recording import records
from imud.formats.recording.records import NO_DEVICE, EndRecord, Kind, LostRecord, SessionRecord
from imud.publishers.recorder.directory import RecordingDirectory
from imud.publishers.recorder.writer import RecordingWriter, RecordQueue
from imud.units import NS_PER_S
from imud.worker import BusThread, StartWorker

log = logging.getLogger(__name__)

CHECK_NS: Final = NS_PER_S
"""The newest sample and the ledger of each device are recorded so often: a replay is compared with them."""
RETRY_NS: Final = 60 * NS_PER_S
"""A disk that was full or failed is tried again after so long."""
MEGABYTE: Final = 1_000_000


class RecorderSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder."""

    enabled: bool = False
    """Whether imud records."""
    directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/recordings"
    """Where the files are; imud makes it where it is missing."""
    devices: list[str] | None = None
    """Names of the devices that are recorded; null for all."""
    keep_gb: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] = 10.0
    """Room for all files together, GB (10⁹ bytes): the oldest are removed before it is exceeded."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """A new file begins at this size, MB (10⁶ bytes), …"""
    file_minutes: Annotated[float, msgspec.Meta(ge=1, le=10_080)] = 60.0
    """… or after this time, whichever comes first."""

    def __post_init__(self) -> None:
        """Raise ValueError for a budget with room for less than two files."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )


class Recorder:
    """The recorder. Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: RecorderSettings, context: PublisherContext, start_worker: StartWorker = BusThread
    ) -> None:
        self._settings = settings
        self._context = context
        self._source: RecordingSource = context.recording
        self._start_worker = start_worker
        keep_bytes = round(settings.keep_gb * 1000 * MEGABYTE)
        self._directory = RecordingDirectory(Path(settings.directory), keep_bytes)
        self._file_bytes = round(settings.file_mb * MEGABYTE)
        self._file_ns = round(settings.file_minutes * 60 * NS_PER_S)
        self._queue = RecordQueue()
        self._put: Callable[[bytes], None] = self._queue.put
        self._writer: RecordingWriter | None = None
        self._recorded: set[str] = set()
        self._ids: dict[str, int] = {}
        self._number = 0
        self._begun_ns = self._checked_ns = 0
        self._path = Path()
        self._dropped = (0, 0)
        """Records and bytes that were dropped and stand in the file as such."""
        self._lost_ns = 0
        self._problem = ""
        self._due_ns = 0

    # --- the publisher -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Make the directory and begin a file. Raises ServerError."""
        try:
            self._directory.make()
            self._directory.make_room(self._file_bytes, "")
        except OSError as error:
            raise ServerError(f"recordings in {self._settings.directory}: {reason_of(error)}") from error
        self._writer = RecordingWriter(self._queue, self._context.now_ns, self._start_worker)
        self._begin_file()
        self._context.recorder_sources.append(self.status)
        log.info("recording to %s", self._settings.directory)

    def add_device(self, name: str, device_id: int) -> None:
        """Note the device: it is recorded from the next tick on, when it is there."""
        self._ids[name] = device_id

    def remove_device(self, name: str) -> None:
        """Forget a device that left the configuration."""
        self._ids.pop(name, None)
        self._recorded.discard(name)

    def publish(self, batch: Batch) -> None:
        """No-op: what samples are made of is recorded."""

    def event(self, event: Event) -> None:
        """Record an event."""
        if not self._problem and self._writer is not None:
            device = self._ids.get(event.device, NO_DEVICE)
            self._put(records.encode_object(Kind.EVENT, device, event))

    def tick(self, now_ns: int) -> None:
        """Record devices that are new, checks, losses; begin a file that is due; look after the disk."""
        writer = self._writer
        if writer is None:
            return
        if writer.failure is not None:
            raise writer.failure
        if self._problem:
            if now_ns >= self._due_ns:
                self._try_again(now_ns)
            return
        if writer.problem:
            self._stop_recording(writer.problem, now_ns)
            return
        for name in self._source.names():
            if name not in self._recorded and self._wants(name):
                self._recorded.add(name)
                self._source.begin(name, self._put)
        self._note_losses(now_ns)
        if now_ns - self._checked_ns >= CHECK_NS:
            self._checked_ns = now_ns
            self._check()
            if writer.file_bytes >= self._file_bytes or now_ns - self._begun_ns >= self._file_ns:
                self._next_file(now_ns)

    def close(self) -> None:
        """End the file regularly; may be called twice."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if self.status in self._context.recorder_sources:
            self._context.recorder_sources.remove(self.status)
        if not self._problem:
            self._check()
            self._end_file("imud stopped")
        self._source.end(self._put)
        writer.close()

    def status(self) -> RecorderStatus:
        """Return the state of the recorder."""
        writer, queue = self._writer, self._queue
        return RecorderStatus(
            file=self._path.name if not self._problem else "",
            problem=self._problem,
            written_bytes=writer.written_bytes if writer is not None else 0,
            records=writer.records if writer is not None else 0,
            records_dropped=queue.dropped,
            waiting_bytes=queue.waiting_bytes,
            files_removed=self._directory.removed,
        )

    # --- files -------------------------------------------------------------------------------------------------------

    def _wants(self, name: str) -> bool:
        return self._settings.devices is None or name in self._settings.devices

    def _begin_file(self) -> None:
        """Begin a file with what all records after it need."""
        context, now_ns = self._context, self._context.now_ns()
        utc_ns = now_ns + context.utc_offset_ns()
        self._path = self._directory.new_file(utc_ns, context.epoch, self._number)
        self._queue.begin_file(self._path)
        host = f"{platform.node()}, {platform.system()} {platform.release()} {platform.machine()}"
        session = SessionRecord(
            records.VERSION, __version__, platform.python_version(), host, context.epoch, self._number, now_ns, utc_ns
        )
        self._put(records.encode_object(Kind.SESSION, NO_DEVICE, session))
        self._number += 1
        self._begun_ns = now_ns
        self._describe()

    def _describe(self) -> None:
        """Record the host's clocks and the state of each device as they are now."""
        self._source.begin_host(self._put)
        for name in sorted(self._recorded):
            self._source.begin(name, self._put)

    def _next_file(self, now_ns: int) -> None:
        self._end_file("a new file begins")
        self._begin_file()
        try:
            removed = self._directory.make_room(self._file_bytes, self._path.name)
        except OSError as error:
            self._stop_recording(reason_of(error), now_ns)
            return
        if removed:
            log.info("recordings removed to keep within %g GB: %s", self._settings.keep_gb, ", ".join(removed))

    def _end_file(self, reason: str) -> None:
        now_ns = self._context.now_ns()
        end = EndRecord(now_ns, now_ns + self._context.utc_offset_ns(), reason)
        self._put(records.encode_object(Kind.END, NO_DEVICE, end))

    def _check(self) -> None:
        for name in sorted(self._recorded):
            self._source.check(name, self._put)

    # --- what goes wrong ---------------------------------------------------------------------------------------------

    def _note_losses(self, now_ns: int) -> None:
        """Record what was dropped as soon as there is room again, and the states after it."""
        queue, (noted, noted_bytes) = self._queue, self._dropped
        if queue.dropped == noted:
            return
        self._lost_ns = self._lost_ns or now_ns
        if not queue.is_easy:
            return
        lost = LostRecord(queue.dropped - noted, queue.dropped_bytes - noted_bytes, self._lost_ns)
        self._dropped, self._lost_ns = (queue.dropped, queue.dropped_bytes), 0
        self._put(records.encode_lost(lost))
        self._describe()
        self._raise(now_ns, f"the disk is too slow: {lost.records} records were not recorded")

    def _stop_recording(self, problem: str, now_ns: int) -> None:
        self._source.end(self._put)
        self._recorded.clear()
        self._due_ns = now_ns + RETRY_NS
        if problem != self._problem:
            self._problem = problem
            self._raise(now_ns, f"nothing is recorded: {self._settings.directory}: {problem}; samples go on")

    def _try_again(self, now_ns: int) -> None:
        problem = self._problem
        self._due_ns = now_ns + RETRY_NS
        try:
            self._directory.make()
            self._directory.make_room(self._file_bytes, "")
            free = os.statvfs(self._directory.path)
            if free.f_bavail * free.f_frsize < MEGABYTE:
                return
        except OSError:
            return
        self._problem = ""
        self._begin_file()
        self._raise(now_ns, f"recording again; it was not possible before: {problem}")

    def _raise(self, now_ns: int, message: str) -> None:
        log.warning("%s", message)
        self._context.raise_event(Event(now_ns, "", EventKind.RECORDER, message))


PUBLISHER = PublisherType("recorder", RecorderSettings, Recorder, required=False)
