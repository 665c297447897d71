"""A capture file as a source of bytes, through the same path as a port.

Speeds, and what `t_rx_ns` is (it never decreases and never lies in the future):

- `recorded`: each read of a stamped capture comes as long after the first as it did then; `t_rx_ns` is that due time,
  so the recorded arrival jitter is what the clock sees, not the jitter of this process.
- `real`: bytes come as fast as the wire at `baud` carries them, PIECE_NS at a time; `t_rx_ns` is the due time.
- `maximum`: as fast as the receiver decodes. Time is virtual: recorded stamps, or wire time at `baud` (all the same
  instant where neither is known), shifted so that the end of the capture is the moment of the start. It can be negative
  where the capture is longer than the machine is up.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import chain
from typing import Final

from imud.contracts.link import LinkType, OnData, OnEnd
from imud.errors import ImudError, LinkError, LinkMissing
from imud.formats.candump import CandumpReader
from imud.formats.capture import CaptureReader
from imud.links.replay.can import CanReplayLink, no_log
from imud.links.replay.file import FileReplay, ReplaySettings, open_regular, unreadable
from imud.units import NS_PER_MS, NS_PER_S, uart_byte_ns

PIECE_NS: Final = 2 * NS_PER_MS
"""Wire time of one piece at speed `real`; a native UART hands over about as much at a time."""
PIECE_BYTES_MAX: Final = 65536
"""Bytes per chunk of a capture without times: the size of a read from a port."""
TURN_BYTES: Final = 16384
"""Delivered in one turn of the event loop, 0.5 ms of decoding: others get their turn between."""

LOOKED_AT_BYTES: Final = 65536
"""Begin of a log in which the check of a configuration looks for a frame."""

log = logging.getLogger(__name__)


class ReplayLink(FileReplay):
    """A capture as a `StreamLink`. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReplaySettings, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(settings, now_ns)
        self._player: Iterator[tuple[bytes, int]] = iter(())
        self._span_ns = 0
        self.baud = settings.baud
        self.auto_baud = False
        self.hold_ns = 0
        self.waiting_bytes = 0

    def pause(self) -> None:
        """No-op: a recording is not paused, for nothing wakes up for it but itself."""

    def take(self) -> bytes:
        """Nothing waits."""
        return b""

    def resume(self) -> None:
        """No-op, as `pause`."""

    def open(self) -> None:
        """Open and check the capture. Raises LinkMissing, LinkDenied, LinkError."""
        path, settings = self.title, self._settings
        self._file = open_regular(path)
        try:
            reader = self._reader()
            self.baud = settings.baud or reader.baud
            self.hold_ns = PIECE_NS if settings.speed == "real" else reader.hold_ns
            if unplayable := _unplayable(settings, reader):
                raise LinkError(unplayable)
            self._span_ns = self._measure(reader) if settings.speed == "maximum" else 0
        except LinkError:
            self.close()
            raise
        except OSError as error:
            self.close()
            raise unreadable(path, error) from error

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Play from the beginning."""
        self._player = self._play(self._now_ns() - self._span_ns)
        self._timer = asyncio.get_running_loop().call_soon(self._turn, on_data, on_end, None)

    def set_baud(self, baud: int) -> None:
        """Raises LinkError: a recording has the rate it has."""
        raise LinkError(f"{self.title} is a replay: its rate cannot be changed")

    def _turn(self, on_data: OnData, on_end: OnEnd, waiting: tuple[bytes, int] | None) -> None:
        """Deliver what is due, at most TURN_BYTES, then give way."""
        loop, file, room, now_ns = asyncio.get_running_loop(), self._file, TURN_BYTES, self._now_ns()
        while self._file is file:  # until the receiver closes it
            data, due_ns = item = waiting or next(self._player, (b"", 0))
            waiting = None
            if not data:
                self.close()
                on_end(None)
                return
            if due_ns > now_ns and due_ns > (now_ns := self._now_ns()):
                delay_s = (due_ns - now_ns) / NS_PER_S
                self._timer = loop.call_later(delay_s, self._turn, on_data, on_end, item)
                return
            if room <= 0:
                self._timer = loop.call_soon(self._turn, on_data, on_end, item)
                return
            room -= len(data)
            on_data(data, due_ns)

    def _play(self, origin_ns: int) -> Iterator[tuple[bytes, int]]:
        """Pieces with the CLOCK_MONOTONIC at which each is due."""
        while True:
            offset_ns = pieces = 0
            reader = self._reader()
            for data, offset_ns in self._pieces(reader):
                yield data, origin_ns + offset_ns
                pieces += 1
            if reader.problem:
                log.warning("%s: %s", self.title, reader.problem)
            if not self._settings.repeat or not pieces:
                return
            origin_ns += offset_ns + max(offset_ns // pieces, NS_PER_MS)

    def _pieces(self, reader: CaptureReader) -> Iterator[tuple[bytes, int]]:
        """Pieces of bounded size with the time each was complete, from 0."""
        if reader.stamped and self._settings.speed != "real":
            return self._stamped_pieces(reader)
        return self._wire_pieces(reader)

    def _stamped_pieces(self, reader: CaptureReader) -> Iterator[tuple[bytes, int]]:
        chunks = iter(reader)
        first = next(chunks, None)
        if first is None:
            return
        for t_ns, data in chain((first,), chunks):
            offset_ns = (t_ns or 0) - (first.t_ns or 0)
            for start in range(0, len(data), PIECE_BYTES_MAX):
                yield data[start : start + PIECE_BYTES_MAX], offset_ns

    def _wire_pieces(self, reader: CaptureReader) -> Iterator[tuple[bytes, int]]:
        byte_ns = uart_byte_ns(self.baud)
        real = self._settings.speed == "real"
        size = min(max(PIECE_NS // byte_ns, 1), PIECE_BYTES_MAX) if real and byte_ns else PIECE_BYTES_MAX
        sent = 0
        for _, data in reader:
            for start in range(0, len(data), size):
                piece = data[start : start + size]
                sent += len(piece)
                yield piece, sent * byte_ns

    def _measure(self, reader: CaptureReader) -> int:
        """Duration of the capture in its own time, ns."""
        if self._file is not None and not reader.stamped:
            return os.fstat(self._file.fileno()).st_size * uart_byte_ns(self.baud)
        return max((offset_ns for _, offset_ns in self._pieces(reader)), default=0)

    def _reader(self) -> CaptureReader:
        if self._file is None:
            raise LinkError(f"{self.title} is not open")
        self._file.seek(0)
        try:
            return CaptureReader(self._file)
        except ImudError as error:
            raise LinkError(f"{self.title}: {error}") from error


def _unplayable(settings: ReplaySettings, reader: CaptureReader) -> str:
    """Return why a capture cannot be played at the speed of the settings; empty if it can."""
    if settings.speed == "recorded" and not reader.stamped:
        return f"{settings.path} is a raw capture without times: use speed real with a baud, or maximum"
    if settings.speed == "real" and not (settings.baud or reader.baud):
        return f"{settings.path} does not say its baud rate: speed real needs the key baud"
    return ""


def _problem(settings: ReplaySettings, frames: bool) -> str:
    """Return why the file cannot be played; empty if it can, or if it is not there now."""
    try:
        with open_regular(settings.path) as file:
            if frames:
                return _without_frames(settings.path, file.read(LOOKED_AT_BYTES))
            return _unplayable(settings, CaptureReader(file))
    except LinkMissing:
        return ""
    except ImudError as error:
        return str(error)


def _without_frames(path: str, begin: bytes) -> str:
    """Return that a log has no frames, if its begin is all of it."""
    found = len(begin) == LOOKED_AT_BYTES or next(iter(CandumpReader(BytesIO(begin))), None) is not None
    return "" if found else no_log(path)


LINK = LinkType("replay", ReplaySettings, ReplayLink, CanReplayLink, problem=_problem)
