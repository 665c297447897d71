"""The flight recorder: the last minutes are kept, and saved when something happens.

What devices deliver goes into segments (`segments.py`), of which the oldest go. An alert, which is an acceleration over
a bound, a device that is lost, or a GPIO line, has them saved to the directory of recordings after a while; a client of
the socket gets them at once. A snapshot is a recording like any other.
"""

import logging
import socket
from collections.abc import Sequence
from math import sqrt
from pathlib import Path
from typing import Final

from imud.contracts.lines import Edge, WatchedInput
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import FlightStatus
from imud.errors import ServerError, reason_of
from imud.event import Event, EventKind
from imud.publishers.recorder.alerts import Alert, AlertGate
from imud.publishers.recorder.directory import RETRY_NS, SNAPSHOT, SUFFIX, RecordingDirectory
from imud.publishers.recorder.feed import RecordFeed
from imud.publishers.recorder.flight_writer import FlightWriter, Mark, Rescue, Save, Saved, Send
from imud.publishers.recorder.segments import SEGMENTS_MAX, SegmentBegin, SegmentRing
from imud.publishers.recorder.settings import MEGABYTE, RecorderSettings
from imud.publishers.recorder.writer import RecordQueue
from imud.units import NS_PER_S
from imud.worker import BusThread, StartWorker

log = logging.getLogger(__name__)

SEGMENT_NS_MIN: Final = 5 * NS_PER_S
"""A segment begins with the state of every device, which is 17 kB of one at 1 kHz: a twentieth of 5 s of its data."""
SEGMENTS_OF_BYTES: Final = 16
"""A new segment begins at such a part of the room, so that little more than that is dropped at once."""
SENDS_MAX: Final = 4
"""Clients that get a snapshot at the same time; each keeps the room of segments that were dropped meanwhile."""


class FlightRecorder:
    """The flight recorder. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        settings: RecorderSettings,
        context: PublisherContext,
        directory: RecordingDirectory,
        start_worker: StartWorker = BusThread,
    ) -> None:
        flight = settings.flight
        self._settings = flight
        self._context = context
        self._start_worker = start_worker
        self._directory = directory
        self._keep_ns = round(flight.minutes * 60 * NS_PER_S)
        after_ns = round(flight.after_s * NS_PER_S)
        self._segment_ns = max(SEGMENT_NS_MIN, (self._keep_ns + after_ns) // (SEGMENTS_MAX // 2))
        self._bytes_max = round(flight.memory_mb * MEGABYTE)
        self._own = RecordingDirectory(Path(flight.directory), self._bytes_max) if flight.directory else None
        """Where segments are; None in memory."""
        self._ring = SegmentRing(self._bytes_max)
        self._queue = RecordQueue[Mark]()
        self._feed = RecordFeed(context, self._queue, settings.devices)
        self._gate = AlertGate(after_ns, flight.per_hour)
        self._saving: dict[Path, Alert] = {}
        """Alerts whose snapshots are written at present."""
        bound = flight.acceleration_m_s2
        self._bound_2 = float("inf") if bound is None else bound * bound
        self._line: WatchedInput | None = None
        self._writer: FlightWriter | None = None
        self._begun_ns = 0
        self._segments = self._snapshots = self._sends = 0
        """Counts since the start."""
        self._saved = self._failed = 0
        """Snapshots, by what became of them."""
        self._problem = ""

    # --- the publisher -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to keep what devices deliver. Raises ServerError."""
        try:
            self._directory.make()
            self._directory.measure()
            if self._own is not None:
                self._own.make()
                self._own.make_room(0)
            left = self._left_behind()
        except OSError as error:
            raise ServerError(f"flight recorder: {error.filename or ''}: {reason_of(error)}") from error
        context = self._context
        self._writer = FlightWriter(self._queue, self._ring, self._directory, context.now_ns, self._start_worker)
        for mark in left:
            self._queue.mark(mark)
        self._begin_segment(context.now_ns())
        if self._settings.line is not None:
            self._line = context.watch_line(self._settings.line, "flight recorder", self._on_edges, self._on_line)
        context.snapshots.append(self.snapshot)
        context.flight_sources.append(self.status)
        where = f"in {self._settings.directory}" if self._own is not None else "in memory"
        log.info("flight recorder: the last %g minutes are kept %s", self._settings.minutes, where)

    def add_device(self, name: str, device_id: int) -> None:
        """Note the device: it is kept from the next tick on, when it is there."""
        self._feed.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """Forget a device that left the configuration."""
        self._feed.remove_device(name)

    def publish(self, batch: Batch) -> None:
        """Look for an acceleration over the bound."""
        bound_2 = self._bound_2
        if bound_2 == float("inf") or self._gate.pending is not None or not self._feed.wants(batch.device):
            return
        for sample in batch.samples:
            if (a := sample.accel_m_s2) is not None and a[0] * a[0] + a[1] * a[1] + a[2] * a[2] > bound_2:
                size = sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
                self._alert(batch.device, f"|a| of {batch.device} was {size:.1f} m/s²")
                return

    def event(self, event: Event) -> None:
        """Keep an event; a device that is lost is an alert."""
        if self._writer is None:
            return
        self._feed.event(event)
        if event.kind is EventKind.DOWN and self._settings.device_lost and self._feed.wants(event.device):
            self._alert(event.device, f"{event.device} is lost: {event.message}")

    def tick(self, now_ns: int) -> None:
        """Keep devices that are new, checks, losses; begin a segment, save a snapshot that is due."""
        writer = self._writer
        if writer is None:
            return
        if writer.failure is not None:
            raise writer.failure
        if self._line is not None:
            self._line.tick(now_ns)
        self._feed.follow()
        if lost := self._feed.note_losses(now_ns):
            self._raise(now_ns, f"flight recorder: this machine is too slow: {lost} records were not kept")
        is_full = self._ring.newest_bytes >= self._bytes_max // SEGMENTS_OF_BYTES
        pause_ns = RETRY_NS if writer.problem else self._segment_ns
        if (self._feed.check_if_due(now_ns) and is_full) or now_ns - self._begun_ns >= pause_ns:
            self._begin_segment(now_ns)
        self._save_due(now_ns)
        while writer.saved:
            self._tell(writer.saved.popleft(), now_ns)
        self._look_after(writer.problem, now_ns)

    def close(self) -> None:
        """Save a snapshot that is to be, and drop the rest; may be called twice."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        self._context.snapshots.remove(self.snapshot)
        self._context.flight_sources.remove(self.status)
        if self._line is not None:
            self._line.close()
        now_ns = self._context.now_ns()
        self._save_due(now_ns, at_once=True)
        self._feed.stop()
        writer.close()
        while writer.saved:
            self._tell(writer.saved.popleft(), now_ns)

    def snapshot(self, sock: socket.socket) -> float:
        """Send what there is to a client's socket, which is closed then; return its length, s. Raises ServerError."""
        writer, oldest_ns = self._writer, self._ring.oldest_ns
        if writer is None or not oldest_ns:
            raise ServerError(f"nothing is kept: {self._problem or 'the flight recorder has just begun'}")
        if self._sends - writer.sends_ended >= SENDS_MAX:
            raise ServerError(f"{SENDS_MAX} clients get a snapshot at present; try again")
        self._sends += 1
        self._feed.check()
        self._queue.mark(Send(sock, self._feed.ending("a snapshot for a client")))
        return (self._context.now_ns() - oldest_ns) / NS_PER_S

    def status(self) -> FlightStatus:
        """Return the state of the flight recorder."""
        oldest_ns = self._ring.oldest_ns
        kept_ns = self._context.now_ns() - oldest_ns if oldest_ns and not self._problem else 0
        return FlightStatus(
            self._problem, kept_ns, self._ring.bytes, self._queue.dropped, self._saved, self._failed,
            self._gate.left_out_total, self._sends, self._directory.kept_bytes,
        )  # fmt: skip

    # --- segments and snapshots --------------------------------------------------------------------------------------

    def _begin_segment(self, now_ns: int) -> None:
        context, pending = self._context, self._gate.pending
        path = None
        if self._own is not None:
            path = self._own.new_file(now_ns + context.utc_offset_ns(), context.epoch, self._segments)
        keep_from_ns = (now_ns if pending is None else pending.t_ns) - self._keep_ns
        self._queue.mark(SegmentBegin(now_ns, self._feed.session(0, now_ns), path, keep_from_ns))
        self._segments += 1
        self._begun_ns = now_ns
        self._feed.describe(at_once=False)
        self._feed.follow()

    def _left_behind(self) -> list[Rescue]:
        """What a daemon that was killed left: a snapshot of each run. Raises OSError."""
        runs: dict[str, list[Path]] = {}
        for file in self._own.files() if self._own is not None else ():
            assert self._own is not None
            runs.setdefault(file.name.split("-")[1], []).append(self._own.path / file.name)
        return [
            Rescue(self._directory.path / files[0].name.replace(SUFFIX, SNAPSHOT + SUFFIX), files)
            for files in runs.values()
        ]

    def _alert(self, device: str, reason: str) -> None:
        now_ns = self._context.now_ns()
        if not self._gate.add(Alert(now_ns, device, reason)):
            self._raise(now_ns, f"not saved: {reason}; {self._settings.per_hour} snapshots were within an hour", device)

    def _save_due(self, now_ns: int, *, at_once: bool = False) -> None:
        alert = self._gate.take_due(now_ns, at_once=at_once)
        if alert is None:
            return
        context = self._context
        begun_ns = (self._ring.oldest_ns or now_ns) + context.utc_offset_ns()
        path = self._directory.new_file(begun_ns, context.epoch, self._snapshots, SNAPSHOT)
        self._snapshots += 1
        self._saving[path] = alert
        self._feed.check()
        self._queue.mark(Save(path, self._feed.ending(alert.reason)))

    def _tell(self, saved: Saved, now_ns: int) -> None:
        alert = self._saving.pop(saved.path, None)
        device, reason = ("", "an imud that was killed left it") if alert is None else (alert.device, alert.reason)
        self._failed += bool(saved.problem)
        self._saved += not saved.problem
        if saved.problem:
            self._raise(now_ns, f"a snapshot was not saved: {saved.path}: {saved.problem}: {reason}", device)
        else:
            self._raise(now_ns, f"saved {saved.path}: {reason}", device, file=str(saved.path), bytes=saved.bytes)

    def _look_after(self, problem: str, now_ns: int) -> None:
        if problem == self._problem:
            return
        before, self._problem = self._problem, problem
        words = f"nothing is kept: {problem}" if problem else f"keeping again; it was not possible before: {before}"
        self._raise(now_ns, f"flight recorder: {words}")

    # --- the line ----------------------------------------------------------------------------------------------------

    def _on_edges(self, edges: Sequence[Edge]) -> None:
        if any(edge.rising for edge in edges):
            self._alert("", "the line of the flight recorder became active")

    def _on_line(self, problem: str) -> None:
        self._raise(self._context.now_ns(), f"flight recorder: its line: {problem}")

    def _raise(self, now_ns: int, message: str, device: str = "", **detail: str | int) -> None:
        log.warning("%s", message)
        self._context.raise_event(Event(now_ns, device, EventKind.RECORDER, message, dict(detail)))
