"""Flight recorder: keeps the data of the last minutes and saves it after an alert.

The flight recorder writes the input of the devices into segments and drops the oldest segments. Alerts are an
acceleration above a limit, a missing device, or a GPIO line. Some time after an alert, imud saves the segments as a
snapshot to the directory of recordings. A client of the socket can request a snapshot at any time. A snapshot is a
normal recording.
"""

import errno
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple

from imud.contracts.lines import Edge, WatchedInput
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import FlightStatus
from imud.formats.recording import HEAD, BlockEncoder, BlockGatherer, is_recording, renumbered
from imud.host.threads import BusThread, StartWorker
from imud.model.errors import ServerError, reason_of
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.recorder.client_stream import FULL_NS, BlockSender
from imud.publishers.recorder.directory import (
    MEGABYTE,
    RETRY_NS,
    SNAPSHOT,
    SUFFIX,
    RecorderOptions,
    RecordingDirectory,
)
from imud.publishers.recorder.writer import FLAGS, WRITE_NS, RecordFeed, RecordQueue

HOUR_NS: Final = 3600 * NS_PER_S


class Alert(NamedTuple):
    """Event that causes a snapshot."""

    t_ns: int  # CLOCK_MONOTONIC
    device: str  # device name; empty if the alert belongs to no device
    reason: str  # cause of the alert, one sentence


class AlertGate:
    """Limit of alerts: one pending alert at a time, and a maximum number per hour. Synchronization: one thread."""

    def __init__(self, after_ns: int, per_hour: int) -> None:
        """`after_ns` is the time from an alert to its snapshot."""
        self.pending: Alert | None = None  # alert that waits for its snapshot
        self.left_out = 0  # number of ignored alerts since the last accepted alert
        self.left_out_total = 0  # number of ignored alerts since the start
        self._after_ns = after_ns
        self._per_hour = per_hour
        self._accepted: deque[int] = deque()  # times of the alerts accepted in the last hour

    def add(self, alert: Alert) -> bool:
        """Add an alert. Return False for the first alert above the limit."""
        if self.pending is not None:
            return True
        accepted = self._accepted
        while accepted and alert.t_ns - accepted[0] >= HOUR_NS:
            accepted.popleft()
        if len(accepted) >= self._per_hour:
            self.left_out += 1
            self.left_out_total += 1
            return self.left_out > 1
        accepted.append(alert.t_ns)
        self.pending = alert
        self.left_out = 0
        return True

    def take_due(self, now_ns: int, *, at_once: bool = False) -> Alert | None:
        """Return the due alert once. With `at_once`, return the pending alert before it is due."""
        alert = self.pending
        if alert is None or (now_ns - alert.t_ns < self._after_ns and not at_once):
            return None
        self.pending = None
        return alert


# Maximum number of segments. Each segment needs a descriptor. The flight recorder uses half of them.
SEGMENTS_MAX: Final = 64


class SegmentBegin(NamedTuple):
    """Mark in the queue at which a segment starts."""

    t_ns: int  # CLOCK_MONOTONIC
    session: bytes  # first record of a recording
    path: Path | None  # path of the segment file; None in memory
    drop_before_ns: int  # CLOCK_MONOTONIC limit: imud drops segments that ended before


@dataclass(slots=True)
class Segment:
    """Segment of the ring."""

    t_ns: int
    descriptor: int
    path: Path | None
    bytes: int = 0

    def close(self) -> None:
        """Close the segment and remove its file. A second call does nothing."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
            if self.path is not None:
                with suppress(OSError):
                    self.path.unlink()


class SegmentRing:
    """Ring of segments. Synchronization: the thread of the flight recorder; any thread may read the counters."""

    def __init__(self, bytes_max: int) -> None:
        self.bytes = 0  # size of all segments
        self.oldest_ns = 0  # CLOCK_MONOTONIC at the start of the oldest segment; 0 without segments
        self.newest_bytes = 0  # size of the newest segment
        self._bytes_max = bytes_max
        self._segments: deque[Segment] = deque()

    def begin(self, mark: SegmentBegin) -> None:
        """Start a segment and drop old segments. Raises OSError."""
        segments = self._segments
        while len(segments) > 1 and segments[1].t_ns <= mark.drop_before_ns:
            self._drop_oldest()
        while len(segments) >= SEGMENTS_MAX:
            self._drop_oldest()
        if mark.path is None:
            descriptor = os.memfd_create("imud flight recorder", os.MFD_CLOEXEC)
        else:
            descriptor = os.open(mark.path, FLAGS & ~os.O_WRONLY | os.O_RDWR, 0o640)
        segments.append(Segment(mark.t_ns, descriptor, mark.path))
        self.oldest_ns, self.newest_bytes = segments[0].t_ns, 0

    def append(self, block: bytes) -> None:
        """Append a block. Drop the oldest segments if there is no room. Raises OSError if all are dropped."""
        segments = self._segments
        while len(segments) > 1 and self.bytes + len(block) > self._bytes_max:
            self._drop_oldest()
        while not self._write(segments[-1], block):
            if len(segments) == 1:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._drop_oldest()

    def _write(self, segment: Segment, block: bytes) -> bool:
        """Append the complete block or nothing. Return False if there is no room."""
        try:
            written = os.write(segment.descriptor, block)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.ENOMEM, errno.EDQUOT):
                raise
            written = 0
        if written < len(block):
            os.ftruncate(segment.descriptor, segment.bytes)
            os.lseek(segment.descriptor, segment.bytes, os.SEEK_SET)
            return False
        segment.bytes += written
        self.bytes += written
        self.newest_bytes = segment.bytes
        return True

    def _drop_oldest(self) -> None:
        segment = self._segments.popleft()
        self.bytes -= segment.bytes
        segment.close()
        self.oldest_ns = self._segments[0].t_ns if self._segments else 0

    def clear(self) -> None:
        """Drop all segments."""
        while self._segments:
            self._drop_oldest()
        self.newest_bytes = 0

    def reader(self, ending: bytes) -> "SegmentReader":
        """Return a reader of the present data. It stays valid after imud drops segments. Raises OSError."""
        opened: list[tuple[int, int]] = []
        try:
            for segment in self._segments:
                opened.append((os.dup(segment.descriptor), segment.bytes))
        except OSError:
            for descriptor, _ in opened:
                os.close(descriptor)
            raise
        return SegmentReader(opened, ending)


class SegmentReader:
    """Reader of the blocks of a snapshot. It closes its descriptors at the end. Synchronization: one thread."""

    def __init__(self, opened: Sequence[tuple[int, int]], ending: bytes) -> None:
        """`opened` are descriptors of segments with the number of bytes to read. `ending` is the last record; empty for
        a recording without an end record."""
        self.bytes = sum(size for _, size in opened)  # approximate size of the snapshot
        self._opened = list(opened)
        self._blocks = self._read(ending)

    def next_block(self) -> bytes:
        """Return the next block; empty at the end. Raises OSError."""
        return next(self._blocks, b"")

    def close(self) -> None:
        """Close the descriptors. A second call does nothing."""
        while self._opened:
            os.close(self._opened.pop()[0])

    def _read(self, ending: bytes) -> Iterator[bytes]:
        number = 0
        while self._opened:
            descriptor, size = self._opened[0]
            is_first = number == 0
            for index, block in enumerate(_blocks_of(descriptor, size)):
                if index or is_first:  # the first block of a segment is its session record
                    yield renumbered(block, number)
                    number += 1
            os.close(self._opened.pop(0)[0])
        if ending and number:
            yield renumbered(BlockEncoder().encode(ending), number)


def left_behind(files: Sequence[Path]) -> SegmentReader:
    """Return a reader of the segment files of another process, in their order. Raises OSError."""
    opened: list[tuple[int, int]] = []
    try:
        for path in files:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            opened.append((descriptor, os.fstat(descriptor).st_size))
    except OSError:
        for descriptor, _ in opened:
            os.close(descriptor)
        raise
    return SegmentReader(opened, b"")


def _blocks_of(descriptor: int, size: int) -> Iterator[bytes]:
    """Yield the complete blocks of a segment. The last block is incomplete if the writer was killed."""
    at = 0
    while at + HEAD.size <= size:
        head = os.pread(descriptor, HEAD.size, at)
        stored = HEAD.unpack(head)[4]
        end = at + HEAD.size + stored
        if not is_recording(head) or end > size:
            return
        yield head + os.pread(descriptor, stored, at + HEAD.size)
        at = end


class Save(NamedTuple):
    """Mark in the queue at which imud saves a snapshot."""

    path: Path
    ending: bytes  # last record of the snapshot


class Rescue(NamedTuple):
    """Mark in the queue at which imud saves and removes the segments of another process."""

    path: Path
    files: Sequence[Path]  # segment files in their order


class Send(NamedTuple):
    """Mark in the queue at which imud sends a snapshot to a client."""

    sock: socket.socket
    ending: bytes


class Saved(NamedTuple):
    """Result of a snapshot."""

    path: Path
    bytes: int
    problem: str  # cause of the failure, one sentence; empty after a success


Mark = SegmentBegin | Save | Rescue | Send


class FlightWriter:
    """Thread of the flight recorder. Synchronization: the thread writes the attributes, any thread reads them."""

    def __init__(
        self,
        queue: RecordQueue[Mark],
        ring: SegmentRing,
        directory: RecordingDirectory,
        now_ns: Callable[[], int],
        start_worker: StartWorker,
    ) -> None:
        self.problem = ""  # cause of a failed segment, until the next segment starts; empty if there is no problem
        self.saved: deque[Saved] = deque()  # Results of snapshots. The event loop removes them.
        self.failure: BaseException | None = None  # internal error that ended the thread
        self._queue = queue
        self._ring = ring
        self._directory = directory
        self._now_ns = now_ns
        self._gatherer = BlockGatherer()
        self._is_open = False
        self.sends_ended = 0  # number of finished snapshots for clients
        self._sends: list[tuple[BlockSender, SegmentReader]] = []
        self._worker = start_worker("flight", self)
        queue.ring = self._worker.ring

    def close(self) -> None:
        """Do the queued work and end the thread. A second call does nothing."""
        self._queue.ring = lambda: None
        self._worker.end()
        self.do_round()
        for sender, reader in self._sends:
            sender.close()
            reader.close()
        self._sends.clear()
        self._ring.clear()

    # --- thread -------------------------------------------------------------------------------------------------------

    def do_round(self) -> int:
        """Process the queue. Return the time until the next round, ns."""
        while (item := self._queue.take()) is not None:
            try:
                if isinstance(item, bytes):
                    self._append(self._gatherer.add(item) if self._is_open else b"")
                else:
                    self._mark(item)
            except OSError as error:
                self._fail(error)
        try:
            self._finish_block()
        except OSError as error:
            self._fail(error)
        sending = [one for one in self._sends if not _is_sent(*one)]
        self.sends_ended += len(self._sends) - len(sending)
        self._sends = sending
        return FULL_NS if self._sends else WRITE_NS

    def _mark(self, mark: Mark) -> None:
        if isinstance(mark, SegmentBegin):
            self._finish_block()
            self._gatherer = BlockGatherer()
            self._ring.begin(mark)
            self._is_open, self.problem = True, ""
            self._gatherer.add(mark.session)
            self._finish_block()
            return
        self._finish_block()
        if isinstance(mark, Send):
            self._send(mark)
        elif isinstance(mark, Save):
            self.saved.append(self._save(mark.path, lambda: self._ring.reader(mark.ending)))
        else:
            self._rescue(mark)

    def _rescue(self, mark: Rescue) -> None:
        """Save and remove the segments of another process. After an error, the next start tries again."""
        saved = self._save(mark.path, lambda: left_behind(mark.files))
        self.saved.append(saved)
        for file in mark.files if not saved.problem else ():
            with suppress(OSError):
                file.unlink()

    def _send(self, mark: Send) -> None:
        sender = BlockSender(mark.sock, self._now_ns)
        try:
            self._sends.append((sender, self._ring.reader(mark.ending)))
        except OSError:  # out of descriptors: the client reads an empty file
            sender.close()
            self.sends_ended += 1

    def _finish_block(self) -> None:
        if self._is_open:
            self._append(self._gatherer.finish())

    def _append(self, block: bytes) -> None:
        if block:
            self._ring.append(block)

    def _save(self, path: Path, make_reader: Callable[[], SegmentReader]) -> Saved:
        """Save a snapshot. Remove the file after an error."""
        self._directory.in_use.add(path.name)
        try:
            reader = make_reader()
            try:
                self._directory.make()
                self._directory.make_room(reader.bytes)
                size = _write(reader, path)
                self._directory.add(size)
                return Saved(path, size, "" if size else "nothing was kept")
            finally:
                reader.close()
        except OSError as error:
            return Saved(path, 0, reason_of(error))
        finally:
            self._directory.in_use.discard(path.name)

    def _fail(self, error: OSError) -> None:
        self._ring.clear()
        self._gatherer = BlockGatherer()
        self._is_open = False
        self.problem = reason_of(error)

    def round_failed(self, error: BaseException) -> None:
        self.failure = error


def _write(reader: SegmentReader, path: Path) -> int:
    """Write a snapshot. Return its size. Remove the file if it is empty or after OSError."""
    size, descriptor = 0, os.open(path, FLAGS, 0o640)
    try:
        while block := reader.next_block():
            rest = memoryview(block)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            size += len(block)
        if not size:
            path.unlink()
        os.fdatasync(descriptor)
    except OSError:
        with suppress(OSError):
            path.unlink()
        raise
    finally:
        os.close(descriptor)
    return size


def _is_sent(sender: BlockSender, reader: SegmentReader) -> bool:
    """Send blocks until the socket is full. Return whether the snapshot has ended; everything is then closed."""
    block = b""
    while not sender.ended and sender.send(block):
        try:
            block = reader.next_block()
        except OSError:  # the blocks sent before are complete
            block = b""
        if not block:
            sender.close()
    if not sender.ended and sender.is_stuck:
        sender.close()
    if sender.ended:
        reader.close()
    return sender.ended


log = logging.getLogger(__name__)

# Minimum length of a segment, ns. A segment starts with the state of each device, 17 kB at 1 kHz: a twentieth of the
# data of 5 s.
SEGMENT_NS_MIN: Final = 5 * NS_PER_S
# Number of segments in the maximum size. imud drops not much more than a sixteenth at a time.
SEGMENTS_OF_BYTES: Final = 16
# Maximum number of clients that receive a snapshot at a time. Each keeps the memory of dropped segments.
SENDS_MAX: Final = 4


class FlightRecorder:
    """Flight recorder. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        settings: RecorderOptions,
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
        # directory of the segments; None in memory
        self._own = (
            RecordingDirectory(Path(flight.directory), self._bytes_max, own_only=True) if flight.directory else None
        )
        self._ring = SegmentRing(self._bytes_max)
        self._queue = RecordQueue[Mark]()
        self._feed = RecordFeed(context, self._queue, settings.devices)
        self._gate = AlertGate(after_ns, flight.per_hour)
        self._saving: dict[Path, Alert] = {}  # alerts of the snapshots that are being saved
        bound = flight.acceleration_m_s2
        self._bound_2 = float("inf") if bound is None else bound * bound
        self._line: WatchedInput | None = None
        self._writer: FlightWriter | None = None
        self._begun_ns = 0
        self._segments = self._snapshots = self._sends = 0  # numbers since the start
        self._saved = self._failed = 0  # snapshots by result
        self._problem = ""
        self._own_problem = ""  # why the flight recorder does not use its directory

    # --- publisher ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start recording. Raises ServerError."""
        try:
            self._directory.make()
            self._snapshots = self._directory.begin_run(self._context.epoch, SNAPSHOT)
            self._directory.measure()
            left = self._left_behind()
        except OSError as error:
            raise ServerError(
                f"flight recorder: cannot use {error.filename or ''}: {reason_of(error)}; expected a directory that "
                f"imud can write; set recorder.directory or recorder.flight.directory"
            ) from error
        context = self._context
        self._writer = FlightWriter(self._queue, self._ring, self._directory, context.clock.now_ns, self._start_worker)
        for mark in left:
            self._queue.mark(mark)
        self._begin_segment(context.clock.now_ns())
        if self._settings.line is not None:
            self._line = context.watch_line(self._settings.line, "flight recorder", self)
        context.outputs.snapshots.append(self.snapshot)
        context.outputs.flights.append(self.status)
        where = f"in {self._settings.directory}" if self._own is not None and not self._own_problem else "in memory"
        log.info("flight recorder: keeping the last %g minutes %s", self._settings.minutes, where)

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The recording starts in the next tick, after the device exists."""
        self._feed.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        self._feed.remove_device(name)

    def publish(self, batch: Batch) -> None:
        """Search for an acceleration above the limit."""
        bound_2 = self._bound_2
        if bound_2 == float("inf") or self._gate.pending is not None or not self._feed.wants(batch.device):
            return
        for sample in batch.samples:
            if (a := sample.accel_m_s2) is not None and a[0] * a[0] + a[1] * a[1] + a[2] * a[2] > bound_2:
                size = sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
                self._alert(batch.device, f"|a| of {batch.device} was {size:.1f} m/s²")
                return

    def event(self, event: Event) -> None:
        """Record an event. A missing device or a rule with `snapshot` is an alert."""
        if self._writer is None:
            return
        self._feed.event(event)
        if event.kind is EventKind.RULE and event.detail.get("snapshot"):
            self._alert(event.device, event.message)
        if event.kind is EventKind.DOWN and self._settings.device_lost and self._feed.wants(event.device):
            self._alert(event.device, f"{event.device} is lost: {event.message}")

    def tick(self, now_ns: int) -> None:
        """Record new devices, checks and losses. Start a due segment, and save a due snapshot."""
        writer = self._writer
        if writer is None:
            return
        if writer.failure is not None:
            raise writer.failure
        if self._line is not None:
            self._line.tick(now_ns)
        self._feed.follow()
        if lost := self._feed.note_losses(now_ns):
            self._raise(now_ns, f"flight recorder: the host is too slow: {lost} records were dropped")
        is_full = self._ring.newest_bytes >= self._bytes_max // SEGMENTS_OF_BYTES
        pause_ns = RETRY_NS if writer.problem else self._segment_ns
        if (self._feed.check_if_due(now_ns) and is_full) or now_ns - self._begun_ns >= pause_ns:
            self._begin_segment(now_ns)
        self._save_due(now_ns)
        while writer.saved:
            self._report(writer.saved.popleft(), now_ns)
        self._report_problem(writer.problem, now_ns)

    def close(self) -> None:
        """Save a pending snapshot and drop all segments. A second call does nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        self._context.outputs.snapshots.remove(self.snapshot)
        self._context.outputs.flights.remove(self.status)
        if self._line is not None:
            self._line.close()
        now_ns = self._context.clock.now_ns()
        self._save_due(now_ns, at_once=True)
        self._feed.stop()
        writer.close()
        while writer.saved:
            self._report(writer.saved.popleft(), now_ns)

    def snapshot(self, sock: socket.socket) -> float:
        """Send a snapshot to the socket of a client and close the socket. Return the length, s. Raises ServerError."""
        writer, oldest_ns = self._writer, self._ring.oldest_ns
        if writer is None or not oldest_ns:
            raise ServerError(f"the flight recorder has no data: {self._problem or 'it has just started'}")
        if self._sends - writer.sends_ended >= SENDS_MAX:
            raise ServerError(f"the limit of {SENDS_MAX} clients with a snapshot at a time is reached; try again later")
        self._sends += 1
        self._feed.check()
        self._queue.mark(Send(sock, self._feed.ending("a snapshot for a client")))
        return (self._context.clock.now_ns() - oldest_ns) / NS_PER_S

    def status(self) -> FlightStatus:
        oldest_ns = self._ring.oldest_ns
        kept_ns = self._context.clock.now_ns() - oldest_ns if oldest_ns and not self._problem else 0
        return FlightStatus(
            self._problem, kept_ns, self._ring.bytes, self._queue.dropped, self._saved, self._failed,
            self._gate.left_out_total, self._sends, self._directory.kept_bytes,
        )  # fmt: skip

    # --- segments and snapshots ---------------------------------------------------------------------------------------

    def _begin_segment(self, now_ns: int) -> None:
        context, pending = self._context, self._gate.pending
        path = None
        if self._own is not None and not self._check_own(self._own, now_ns):
            path = self._own.new_file(now_ns + context.clock.utc_offset_ns(), context.epoch, self._segments)
        keep_from_ns = (now_ns if pending is None else pending.t_ns) - self._keep_ns
        self._queue.mark(SegmentBegin(now_ns, self._feed.session(0, now_ns), path, keep_from_ns))
        self._segments += 1
        self._begun_ns = now_ns
        self._feed.describe(at_once=False)
        self._feed.follow()

    def _check_own(self, own: RecordingDirectory, now_ns: int) -> str:
        """Return why other users can replace the segments; empty if they cannot. Report each change."""
        before, self._own_problem = self._own_problem, own.problem()
        if before != self._own_problem:
            words = (
                f"{self._own_problem}; it keeps the data in memory"
                if self._own_problem
                else f"it uses {own.path} again"
            )
            self._raise(now_ns, f"flight recorder: {words}")
        return self._own_problem

    def _left_behind(self) -> list[Rescue]:
        """Return the segments of killed daemons, one snapshot for each run. Raises OSError."""
        runs, own = dict[str, list[Path]](), self._own
        if own is not None:
            own.make()
            if not own.problem():
                own.make_room(0)
                for file in own.files():
                    runs.setdefault(file.run, []).append(own.path / file.name)
        return [
            Rescue(self._directory.path / files[0].name.replace(SUFFIX, SNAPSHOT + SUFFIX), files)
            for files in runs.values()
        ]

    def _alert(self, device: str, reason: str) -> None:
        now_ns = self._context.clock.now_ns()
        if not self._gate.add(Alert(now_ns, device, reason)):
            self._raise(
                now_ns,
                f"no snapshot of an alert: {reason}; the limit of {self._settings.per_hour} per hour is reached",
                device,
            )

    def _save_due(self, now_ns: int, *, at_once: bool = False) -> None:
        alert = self._gate.take_due(now_ns, at_once=at_once)
        if alert is None:
            return
        context = self._context
        begun_ns = (self._ring.oldest_ns or now_ns) + context.clock.utc_offset_ns()
        path = self._directory.new_file(begun_ns, context.epoch, self._snapshots, SNAPSHOT)
        self._snapshots += 1
        self._saving[path] = alert
        self._feed.check()
        self._queue.mark(Save(path, self._feed.ending(alert.reason)))

    def _report(self, saved: Saved, now_ns: int) -> None:
        alert = self._saving.pop(saved.path, None)
        device, reason = (
            ("", "data of an imud process that was killed") if alert is None else (alert.device, alert.reason)
        )
        self._failed += bool(saved.problem)
        self._saved += not saved.problem
        if saved.problem:
            self._raise(now_ns, f"cannot save the snapshot {saved.path}: {saved.problem}; alert: {reason}", device)
        else:
            self._raise(now_ns, f"saved {saved.path}: {reason}", device, file=str(saved.path), bytes=saved.bytes)

    def _report_problem(self, problem: str, now_ns: int) -> None:
        if problem == self._problem:
            return
        before, self._problem = self._problem, problem
        words = f"cannot record: {problem}" if problem else f"recording again after: {before}"
        self._raise(now_ns, f"flight recorder: {words}")

    # --- GPIO line ----------------------------------------------------------------------------------------------------

    def on_edges(self, _key: str, edges: Sequence[Edge]) -> None:
        if any(edge.rising for edge in edges):
            self._alert("", "the line of the flight recorder became active")

    def on_level(self, _key: str, _active: bool | None) -> None:
        """Ignore the level: only an edge is an alert."""

    def on_line_report(self, _key: str, message: str) -> None:
        self._raise(self._context.clock.now_ns(), f"flight recorder: GPIO line: {message}")

    def _raise(self, now_ns: int, message: str, device: str = "", **detail: str | int) -> None:
        log.warning("%s", message)
        self._context.owner.send_event(Event(now_ns, device, EventKind.RECORDER, message, dict(detail)))
