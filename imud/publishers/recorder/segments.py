"""The ring of the flight recorder: segments of a recording, of which the oldest go.

    ┌ segment ──────────────┐┌ segment ──────────────┐┌ segment ─────┐
    │ session │ state, data ││ session │ state, data ││ session │ …  │   snapshot: first session, the rest of all
    └─────────┴─────────────┘└─────────┴─────────────┘└─────────┴────┘

Each begins with a session in a block of its own and with the state of every device, so that a replay can begin with
any. They are files, without a name in memory (memfd_create(2)) or with one in a directory: appended to a block at a
time, so that those of a process that was killed are whole.
"""

import errno
import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from imud.formats.recording.blocks import HEAD, BlockEncoder, is_recording, renumbered
from imud.publishers.recorder.writer import FLAGS

SEGMENTS_MAX: Final = 64
"""Each has a descriptor; the flight recorder makes half as many of the time that it keeps."""


class SegmentBegin(NamedTuple):
    """The mark at which a segment begins."""

    t_ns: int
    """CLOCK_MONOTONIC."""
    session: bytes
    """Record that a recording begins with."""
    path: Path | None
    """Its file; None for one in memory."""
    drop_before_ns: int
    """Segments that ended before this time are not kept any more, CLOCK_MONOTONIC."""


@dataclass(slots=True)
class Segment:
    """A segment of the ring."""

    t_ns: int
    descriptor: int
    path: Path | None
    bytes: int = 0

    def close(self) -> None:
        """Give its room back; no-op if done."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
            if self.path is not None:
                with suppress(OSError):
                    self.path.unlink()


class SegmentRing:
    """The ring. Synchronization: the thread of the flight recorder; the counters are read by any."""

    def __init__(self, bytes_max: int) -> None:
        self.bytes = 0
        """Size of all segments."""
        self.oldest_ns = 0
        """CLOCK_MONOTONIC at the begin of the oldest; 0 without any."""
        self.newest_bytes = 0
        """Size of the newest."""
        self._bytes_max = bytes_max
        self._segments: deque[Segment] = deque()

    def begin(self, mark: SegmentBegin) -> None:
        """Begin a segment, and drop those that are too old. Raises OSError."""
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
        """Append a block to the newest segment; the oldest go where there is no room. Raises OSError without any."""
        segments = self._segments
        while len(segments) > 1 and self.bytes + len(block) > self._bytes_max:
            self._drop_oldest()
        while not self._write(segments[-1], block):
            if len(segments) == 1:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._drop_oldest()

    def _write(self, segment: Segment, block: bytes) -> bool:
        """Append a whole block, or nothing; False where there is no room."""
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
        """Return a reader of what there is now, which goes on when segments are dropped. Raises OSError."""
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
        """`opened` are descriptors of segments with the bytes that are read of each; `ending` is the last record, or
        nothing for a recording without its regular end."""
        self.bytes = sum(size for _, size in opened)
        """What a snapshot takes, about."""
        self._opened = list(opened)
        self._blocks = self._read(ending)

    def next_block(self) -> bytes:
        """Return the next block; nothing at the end. Raises OSError."""
        return next(self._blocks, b"")

    def close(self) -> None:
        """Release the descriptors; may be called twice."""
        while self._opened:
            os.close(self._opened.pop()[0])

    def _read(self, ending: bytes) -> Iterator[bytes]:
        number = 0
        while self._opened:
            descriptor, size = self._opened[0]
            is_first = number == 0
            for index, block in enumerate(_blocks_of(descriptor, size)):
                if index or is_first:  # the first block of a segment is its session
                    yield renumbered(block, number)
                    number += 1
            os.close(self._opened.pop(0)[0])
        if ending and number:
            yield renumbered(BlockEncoder().encode(ending), number)


def left_behind(files: Sequence[Path]) -> SegmentReader:
    """Return a reader of the segments that a process left in files, in their order. Raises OSError."""
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
    """The whole blocks in so many bytes of a file; it may end in a part of one, if its writer was killed."""
    at = 0
    while at + HEAD.size <= size:
        head = os.pread(descriptor, HEAD.size, at)
        stored = HEAD.unpack(head)[4]
        end = at + HEAD.size + stored
        if not is_recording(head) or end > size:
            return
        yield head + os.pread(descriptor, stored, at + HEAD.size)
        at = end
