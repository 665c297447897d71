"""Output `recorder`: continuous files, the flight recorder, or both, within one limit of disk space."""

import logging
import os
from pathlib import Path

from imud.contracts.lines import LineOptions
from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.status import RecorderStatus
from imud.host.threads import BusThread, StartWorker
from imud.model.errors import ServerError, reason_of
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.recorder.directory import MEGABYTE, RETRY_NS, RecorderOptions, RecordingDirectory
from imud.publishers.recorder.flight import FlightRecorder
from imud.publishers.recorder.writer import RecordFeed, RecordingWriter, RecordQueue

log = logging.getLogger(__name__)


class Recorder:
    """Continuous recorder. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        settings: RecorderOptions,
        context: PublisherContext,
        directory: RecordingDirectory,
        start_worker: StartWorker = BusThread,
    ) -> None:
        self._settings = settings
        self._context = context
        self._start_worker = start_worker
        self._directory = directory
        self._file_bytes = round(settings.file_mb * MEGABYTE)
        self._file_ns = round(settings.file_minutes * 60 * NS_PER_S)
        self._queue = RecordQueue[Path]()
        self._feed = RecordFeed(context, self._queue, settings.devices)
        self._writer: RecordingWriter | None = None
        self._number = 0
        self._begun_ns = 0
        self._path = Path()
        self._problem = ""
        self._due_ns = 0

    # --- publisher ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Create the directory and start a file. Raises ServerError."""
        try:
            self._directory.make()
            self._number = self._directory.begin_run(self._context.epoch)
            self._directory.make_room(self._file_bytes)
        except OSError as error:
            raise ServerError(
                f"cannot use {self._settings.directory}: {reason_of(error)}; expected a directory that imud can write; "
                f"set recorder.directory"
            ) from error
        self._writer = RecordingWriter(self._queue, self._context.clock.now_ns, self._start_worker)
        self._begin_file()
        self._context.outputs.recorders.append(self.status)
        log.info("recording to %s", self._settings.directory)

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The recording starts in the next tick, after the device exists."""
        self._feed.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        self._feed.remove_device(name)

    def publish(self, batch: Batch) -> None:
        """Do nothing: the recording contains the input of the devices, not samples."""

    def event(self, event: Event) -> None:
        if not self._problem and self._writer is not None:
            self._feed.event(event)

    def tick(self, now_ns: int) -> None:
        """Record new devices, checks and losses. Start a new file if it is due. Check the disk."""
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
        self._feed.follow()
        if lost := self._feed.note_losses(now_ns):
            self._raise(now_ns, f"the disk is too slow: {lost} records were dropped")
        is_full = writer.file_bytes >= self._file_bytes or now_ns - self._begun_ns >= self._file_ns
        if self._feed.check_if_due(now_ns):
            if is_full:
                self._next_file(now_ns)
            elif now_ns >= self._due_ns:  # the disk can have been full at the start
                self._due_ns = now_ns + RETRY_NS
                self._directory.note_run()

    def close(self) -> None:
        """End the file with its end record. A second call does nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if self.status in self._context.outputs.recorders:
            self._context.outputs.recorders.remove(self.status)
        if not self._problem:
            self._feed.check()
            self._end_file("imud stopped")
        self._feed.stop()
        writer.close()
        self._directory.in_use.discard(self._path.name)

    def status(self) -> RecorderStatus:
        writer, queue = self._writer, self._queue
        return RecorderStatus(
            file=self._path.name if not self._problem else "",
            problem=self._problem,
            written_bytes=writer.written_bytes if writer is not None else 0,
            records=writer.records if writer is not None else 0,
            records_dropped=queue.dropped,
            waiting_bytes=queue.waiting_bytes,
            files_removed=self._directory.removed,
            disk_bytes=self._directory.kept_bytes + (writer.file_bytes if writer is not None else 0),
        )

    # --- files --------------------------------------------------------------------------------------------------------

    def _begin_file(self, end_of_last: str = "") -> None:
        """Start a file with the state that a replay needs. `end_of_last`: reason to end the previous file first."""
        context, now_ns = self._context, self._context.clock.now_ns()
        utc_ns = now_ns + context.clock.utc_offset_ns()
        self._directory.in_use.discard(self._path.name)
        self._path = self._directory.new_file(utc_ns, context.epoch, self._number)
        self._directory.in_use.add(self._path.name)
        session = self._feed.session(self._number, now_ns)
        if end_of_last:  # after all reads of clocks, because a read can make a record
            self._end_file(end_of_last)
        self._queue.mark(self._path)
        self._feed.put(session)
        self._number += 1
        self._begun_ns = now_ns
        self._feed.describe(at_once=True)

    def _next_file(self, now_ns: int) -> None:
        self._begin_file("start of a new file")
        try:
            self._directory.make_room(self._file_bytes)
        except OSError as error:
            self._stop_recording(reason_of(error), now_ns)

    def _end_file(self, reason: str) -> None:
        self._feed.put(self._feed.ending(reason))

    # --- problems -----------------------------------------------------------------------------------------------------

    def _stop_recording(self, problem: str, now_ns: int) -> None:
        self._feed.stop()
        self._due_ns = now_ns + RETRY_NS
        if problem != self._problem:
            self._problem = problem
            self._raise(now_ns, f"cannot record to {self._settings.directory}: {problem}; the other outputs continue")

    def _try_again(self, now_ns: int) -> None:
        problem = self._problem
        self._due_ns = now_ns + RETRY_NS
        try:
            self._directory.make()
            self._directory.make_room(self._file_bytes)
            free = os.statvfs(self._directory.path)
            if free.f_bavail * free.f_frsize < MEGABYTE:
                return
        except OSError:
            return
        self._problem = ""
        self._begin_file()
        self._raise(now_ns, f"recording again after: {problem}")

    def _raise(self, now_ns: int, message: str) -> None:
        log.warning("%s", message)
        self._context.owner.send_event(Event(now_ns, "", EventKind.RECORDER, message))


class RecorderOutput:
    """Recorders that the configuration enables. Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: RecorderOptions, context: PublisherContext, start_worker: StartWorker = BusThread
    ) -> None:
        directory = RecordingDirectory(Path(settings.directory), settings.keep_bytes)
        self._flight = FlightRecorder(settings, context, directory, start_worker) if settings.flight.enabled else None
        self._parts: list[FlightRecorder | Recorder] = [self._flight] if self._flight is not None else []
        if settings.enabled:
            self._parts.append(Recorder(settings, context, directory, start_worker))

    def start(self) -> None:
        """Start all recorders. Raises ServerError; then no recorder is running."""
        try:
            for part in self._parts:
                part.start()
        except BaseException:
            self.close()
            raise

    def add_device(self, name: str, device_id: int) -> None:
        for part in self._parts:
            part.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        for part in self._parts:
            part.remove_device(name)

    def publish(self, batch: Batch) -> None:
        """Search for alerts. The recorders do not need the samples themselves."""
        if self._flight is not None:
            self._flight.publish(batch)

    def event(self, event: Event) -> None:
        for part in self._parts:
            part.event(event)

    def tick(self, now_ns: int) -> None:
        """Call `tick` of all recorders."""
        for part in self._parts:
            part.tick(now_ns)

    def close(self) -> None:
        """Close all recorders. A second call does nothing."""
        for part in self._parts:
            part.close()


def _wanted(settings: RecorderOptions) -> bool:
    return settings.enabled or settings.flight.enabled


def _lines(settings: RecorderOptions) -> list[tuple[tuple[str, ...], LineOptions]]:
    line = settings.flight.line if settings.flight.enabled else None
    return [] if line is None else [(("flight", "line"), line)]


PUBLISHER = PublisherType("recorder", RecorderOptions, RecorderOutput, _wanted, used_lines=_lines)
