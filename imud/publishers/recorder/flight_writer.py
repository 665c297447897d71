"""The thread of the flight recorder: records into segments, and snapshots of them to files and to clients.

feed ──put──▶ queue ──▶ thread: block, compress ──▶ SegmentRing ──┬─ Save ──▶ a file of the directory of recordings
                                                                  └─ Send ──▶ the socket of a client, piece by piece
"""

import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from imud.errors import reason_of
from imud.formats.recording.file import BlockGatherer
from imud.publishers.recorder.directory import RecordingDirectory
from imud.publishers.recorder.segments import SegmentBegin, SegmentReader, SegmentRing, left_behind
from imud.publishers.recorder.stream import FULL_NS, BlockSender
from imud.publishers.recorder.writer import FLAGS, WRITE_NS, RecordQueue
from imud.worker import StartWorker


class Save(NamedTuple):
    """The mark at which a snapshot is to be saved."""

    path: Path
    ending: bytes
    """Record that it ends with."""


class Rescue(NamedTuple):
    """The mark at which what another process left is to be saved, and then removed."""

    path: Path
    files: Sequence[Path]
    """Its segments in their order."""


class Send(NamedTuple):
    """The mark at which a snapshot is to be sent to a client."""

    sock: socket.socket
    ending: bytes


class Saved(NamedTuple):
    """What became of a snapshot."""

    path: Path
    bytes: int
    problem: str
    """Why it was not saved, one sentence; empty if it was."""


Mark = SegmentBegin | Save | Rescue | Send


class FlightWriter:
    """The thread. Synchronization: attributes are written by the thread and read by any."""

    def __init__(
        self,
        queue: RecordQueue[Mark],
        ring: SegmentRing,
        directory: RecordingDirectory,
        now_ns: Callable[[], int],
        start_worker: StartWorker,
    ) -> None:
        self.problem = ""
        """Why nothing is kept any more, until a new segment begins; empty while all is well."""
        self.saved: deque[Saved] = deque()
        """What became of snapshots; the loop takes it."""
        self.failure: BaseException | None = None
        """The exception that ended the thread, which is an internal error."""
        self._queue = queue
        self._ring = ring
        self._directory = directory
        self._now_ns = now_ns
        self._gatherer = BlockGatherer()
        self._is_open = False
        self.sends_ended = 0
        """Clients that have their snapshot, or have gone."""
        self._sends: list[tuple[BlockSender, SegmentReader]] = []
        self._worker = start_worker("flight", self._round, self._failed)
        queue.ring = self._worker.ring

    def close(self) -> None:
        """Do what is asked for still, and end the thread; may be called twice."""
        self._queue.ring = lambda: None
        self._worker.end()
        self._round()
        for sender, reader in self._sends:
            sender.close()
            reader.close()
        self._sends.clear()
        self._ring.clear()

    # --- the thread's side -------------------------------------------------------------------------------------------

    def _round(self) -> int:
        """Do all that waits; return the time until the next round, ns."""
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
        """Save what was left, and remove it; where that is not possible, it is there at the next start."""
        saved = self._save(mark.path, lambda: left_behind(mark.files))
        self.saved.append(saved)
        for file in mark.files if not saved.problem else ():
            with suppress(OSError):
                file.unlink()

    def _send(self, mark: Send) -> None:
        sender = BlockSender(mark.sock, self._now_ns)
        try:
            self._sends.append((sender, self._ring.reader(mark.ending)))
        except OSError:  # no descriptors are left: the client sees an end without a recording
            sender.close()
            self.sends_ended += 1

    def _finish_block(self) -> None:
        if self._is_open:
            self._append(self._gatherer.finish())

    def _append(self, block: bytes) -> None:
        if block:
            self._ring.append(block)

    def _save(self, path: Path, make_reader: Callable[[], SegmentReader]) -> Saved:
        """Write the file, and leave nothing where that is not possible."""
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

    def _failed(self, error: BaseException) -> None:
        self.failure = error


def _write(reader: SegmentReader, path: Path) -> int:
    """Write a snapshot; return its size. Leaves no file for an empty one, or where it raises OSError."""
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
    """Send to a client as far as it takes something; return whether that is over, with everything closed then."""
    block = b""
    while not sender.ended and sender.send(block):
        try:
            block = reader.next_block()
        except OSError:  # what was sent before is whole
            block = b""
        if not block:
            sender.close()
    if not sender.ended and sender.is_stuck:
        sender.close()
    if sender.ended:
        reader.close()
    return sender.ended
