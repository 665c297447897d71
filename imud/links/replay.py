"""A capture file as a source of bytes, through the same path as a port.

The key `speed` selects the arrival times `t_rx_ns`. They never decrease and are never in the future:

- `recorded`: each read of a capture with time stamps arrives with its recorded distance from the first read. `t_rx_ns`
  is this due time, so that the clock sees the recorded jitter of the arrivals, not the jitter of this process.
- `real`: bytes arrive at the speed of the wire at `baud`, PIECE_NS at a time. `t_rx_ns` is the due time.
- `maximum`: bytes arrive as fast as the receiver decodes them. `t_rx_ns` is the recorded time or the time on the wire,
  shifted so that the end of the capture is the start of the replay. It is one constant if neither time is known. It can
  be negative if the capture is longer than the uptime of the host.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Annotated, BinaryIO, Final, Literal

from msgspec import Meta

from imud.contracts.link import LinkType, OnBusNews, OnData, OnEnd, OnFrames
from imud.contracts.status import KernelCounters
from imud.formats.can import CandumpReader, CanFilter, CanFrame, CyclicFrame
from imud.formats.capture import CaptureReader
from imud.host.files import NotRegularFile, user_name
from imud.host.files import open_regular as open_file
from imud.links.device_node import wait_until
from imud.model.errors import BadArgument, ImudError, LinkDenied, LinkError, LinkMissing
from imud.model.options import Options
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns


class ReplayOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a replayed capture."""

    path: Annotated[str, Meta(min_length=1)]
    """Path of a capture file, raw or with time stamps."""
    speed: Literal["recorded", "real", "maximum"] = "recorded"
    """`recorded`: by the time stamps of the file. `real`: by the time on the wire at `baud`. `maximum`: as fast as
    possible."""
    baud: Annotated[int, Meta(ge=0, le=4_000_000)] = 0
    """Rate of the wire, bit/s; 0: the rate of the capture. A raw capture at speed `real` needs this key."""
    repeat: bool = False
    """Start again at the end of the file. Not possible at speed `maximum`."""
    interface: str = ""
    """Interface in a log of a CAN bus, for example can0. A log with one interface does not need this key."""

    def __post_init__(self) -> None:
        """Raises ValueError for keys that exclude each other."""
        if self.repeat and self.speed == "maximum":
            raise ValueError("repeat: expected false at speed maximum, or times would be in the future, got true")


class FileReplay:
    """Common part of both kinds of replay. Synchronization: the loop's thread only.

    `close` drops the timer and the file. A turn has ended if `_file` is another file than at the start of the turn.
    """

    writable = False

    def __init__(self, settings: ReplayOptions, now_ns: Callable[[], int]) -> None:
        self.title = settings.path
        self._settings = settings
        self._now_ns = now_ns
        self._file: BinaryIO | None = None
        self._timer: asyncio.Handle | None = None

    def absence(self) -> str:
        return "" if Path(self.title).exists() else f"{self.title} does not exist: expected a capture file"

    async def wait_present(self) -> None:
        path = Path(self.title)
        await wait_until(path, path.exists)

    def write(self, data: bytes) -> None:
        """Raises LinkError: a file cannot receive data."""
        raise LinkError(f"{self.title} is a replay and cannot receive data")

    def kernel_counters(self) -> KernelCounters:
        """Return zeros: the kernel does not count errors of a file."""
        return KernelCounters()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        file, self._file = self._file, None
        if file is not None:
            file.close()


def open_regular(path: str) -> BinaryIO:
    """Open a capture for reading. Raises LinkMissing, LinkDenied or LinkError."""
    try:
        return open_file(path)
    except FileNotFoundError as error:
        raise LinkMissing(f"{path} does not exist: expected a capture file") from error
    except PermissionError as error:
        raise LinkDenied(f"cannot read {path}: user {user_name()} lacks the permission") from error
    except NotRegularFile as error:
        raise LinkError(f"{path} is not a regular file: expected a capture file") from error
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: str, error: OSError) -> LinkError:
    """Return the error of a file that cannot be read."""
    return LinkError(f"cannot read {path}: {error.strerror}")


TURN_FRAMES: Final = 512  # maximum number of frames in one turn of the event loop: 1 ms of decoding

log = logging.getLogger(__name__)


def no_log(path: str) -> str:
    """Return the error text of a file without frames."""
    return f"{path} is not a CAN log: expected frames in the format of `candump -L`, got none"


class CanReplayLink(FileReplay):
    """A log of CAN frames as a `CanLink`. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReplayOptions, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(settings, now_ns)
        self._span_ns = 0
        self._interface = settings.interface
        self._frames: Iterator[CanFrame] = iter(())
        self.filters: Sequence[CanFilter] = ()
        self.bus = settings.path
        self.bitrate = 0
        self.gather_ns = 0  # Time for which the link holds frames, ns. This link ignores it: the recording decides.

    def open(self) -> None:
        """Open the log and check that it contains frames. Raises LinkMissing, LinkDenied or LinkError."""
        self._file = open_regular(self.title)
        reader = CandumpReader(self._file, self._settings.interface)
        first_ns = newest_ns = -1
        try:
            for frame in reader:
                newest_ns = frame.t_rx_ns
                first_ns = newest_ns if first_ns < 0 else first_ns
                if self._settings.speed != "maximum":
                    break
        except OSError as error:
            self.close()
            raise unreadable(self.title, error) from error
        except BadArgument as error:
            self.close()
            raise LinkError(f"{self.title}: {error}") from error
        if first_ns < 0:
            self.close()
            raise LinkError(no_log(self.title))
        self._interface = reader.interface
        self._span_ns = newest_ns - first_ns

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        self._frames = self._play(self._now_ns() - self._span_ns)
        self._timer = asyncio.get_running_loop().call_soon(self._turn, on_frames, on_end, None)

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Raises LinkError: a file cannot receive data."""
        raise LinkError(f"{self.title} is a replay and cannot receive data")

    def _turn(self, on_frames: OnFrames, on_end: OnEnd, waiting: CanFrame | None) -> None:
        """Deliver the due frames, at most TURN_FRAMES, then return to the event loop."""
        file, frames, now_ns = self._file, list[CanFrame](), self._now_ns()
        while (frame := waiting or next(self._frames, None)) is not None:
            waiting = frame if frame.t_rx_ns > now_ns or len(frames) >= TURN_FRAMES else None
            if waiting:
                break
            frames.append(frame)
        if frames:
            on_frames(frames)
        if self._file is not file:  # the receiver closed the link
            return
        if waiting is None:
            self.close()
            on_end(None)
            return
        delay_s = max(0, waiting.t_rx_ns - self._now_ns()) / NS_PER_S
        self._timer = asyncio.get_running_loop().call_later(delay_s, self._turn, on_frames, on_end, waiting)

    def _play(self, origin_ns: int) -> Iterator[CanFrame]:
        """Yield the frames that pass the filters, each with its due time in CLOCK_MONOTONIC."""
        while self._file is not None:
            self._file.seek(0)
            reader = CandumpReader(self._file, self._interface)
            first_ns, count, due_ns, after_loss = None, 0, origin_ns, False
            for frame in reader:
                first_ns = frame.t_rx_ns if first_ns is None else first_ns
                due_ns = origin_ns + frame.t_rx_ns - first_ns
                count += 1
                after_loss |= frame.after_loss
                if any(wanted.matches(frame.can_id, frame.extended) for wanted in self.filters):
                    yield frame._replace(t_rx_ns=due_ns, after_loss=after_loss)
                    after_loss = False
            if reader.problem:
                log.warning("%s: %s", self.title, reader.problem)
            if not self._settings.repeat:
                return
            origin_ns = due_ns + max((due_ns - origin_ns) // max(count, 1), NS_PER_MS)


# Time on the wire of one piece at speed `real`, ns. A native UART delivers pieces of about this size.
PIECE_NS: Final = 2 * NS_PER_MS
# Maximum size of a piece of a capture without times, bytes: the size of a read from a port.
PIECE_BYTES_MAX: Final = 65536
TURN_BYTES: Final = 16384  # maximum number of bytes in one turn of the event loop: 0.5 ms of decoding

# Number of bytes at the start of a log in which the check of a configuration looks for a frame.
LOOKED_AT_BYTES: Final = 65536


class ReplayLink(FileReplay):
    """A capture as a `StreamLink`. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReplayOptions, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(settings, now_ns)
        self._player: Iterator[tuple[bytes, int]] = iter(())
        self._on_data: OnData
        self._span_ns = 0
        self.baud = settings.baud
        self.auto_baud = False
        self.hold_ns = 0
        self.waiting_bytes = 0

    def pause(self) -> None:
        """Do nothing: a recording needs no wake-ups that a pause could save."""

    def take(self) -> bytes:
        """Return no bytes: a replay holds no bytes back."""
        return b""

    def resume(self) -> None: ...

    def open(self) -> None:
        """Open and check the capture. Raises LinkMissing, LinkDenied or LinkError."""
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
        self._player = self._play(self._now_ns() - self._span_ns)
        self._on_data = on_data
        self._timer = asyncio.get_running_loop().call_soon(self._turn, on_end, None)

    def deliver_to(self, on_data: OnData) -> None:
        self._on_data = on_data

    def set_baud(self, baud: int) -> None:
        """Raises LinkError: the rate of a recording is fixed."""
        raise LinkError(f"{self.title} is a replay with a fixed baud rate")

    def _turn(self, on_end: OnEnd, waiting: tuple[bytes, int] | None) -> None:
        """Deliver the due bytes, at most TURN_BYTES, then return to the event loop."""
        loop, file, room, now_ns = asyncio.get_running_loop(), self._file, TURN_BYTES, self._now_ns()
        while self._file is file:  # False after the receiver closed the link
            data, due_ns = item = waiting or next(self._player, (b"", 0))
            waiting = None
            if not data:
                self.close()
                on_end(None)
                return
            if due_ns > now_ns and due_ns > (now_ns := self._now_ns()):
                delay_s = (due_ns - now_ns) / NS_PER_S
                self._timer = loop.call_later(delay_s, self._turn, on_end, item)
                return
            if room <= 0:
                self._timer = loop.call_soon(self._turn, on_end, item)
                return
            room -= len(data)
            self._on_data(data, due_ns)

    def _play(self, origin_ns: int) -> Iterator[tuple[bytes, int]]:
        """Yield pieces of bytes, each with its due time in CLOCK_MONOTONIC."""
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
        """Yield pieces of limited size, each with the time of its last byte from the start of the capture, ns."""
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
        """Return the duration of the capture in its own time, ns."""
        if self._file is not None and not reader.stamped:
            return os.fstat(self._file.fileno()).st_size * uart_byte_ns(self.baud)
        return max((offset_ns for _, offset_ns in self._pieces(reader)), default=0)

    def _reader(self) -> CaptureReader:
        assert self._file is not None
        self._file.seek(0)
        try:
            return CaptureReader(self._file)
        except ImudError as error:
            raise LinkError(f"{self.title}: {error}") from error


def _unplayable(settings: ReplayOptions, reader: CaptureReader) -> str:
    """Return why a capture cannot be played at the configured speed; empty if it can."""
    if settings.speed == "recorded" and not reader.stamped:
        return f"{settings.path} is a raw capture without times: use speed real with the key baud, or speed maximum"
    if settings.speed == "real" and not (settings.baud or reader.baud):
        return f"{settings.path} does not contain its baud rate: speed real needs the key baud"
    return ""


def _problem(settings: ReplayOptions, frames: bool) -> str:
    """Return why the file cannot be played; empty if it can be played or does not exist now."""
    try:
        with open_regular(settings.path) as file:
            if frames:
                return _without_frames(settings, file.read(LOOKED_AT_BYTES))
            if settings.interface:
                return f"interface: expected a log of a CAN bus, got {settings.path} for a driver of bytes"
            return _unplayable(settings, CaptureReader(file))
    except LinkMissing:
        return ""
    except ImudError as error:
        return str(error)


def _without_frames(settings: ReplayOptions, begin: bytes) -> str:
    """Return an error text if `begin` is the whole log and contains no frame, or if it has several interfaces."""
    if len(begin) == LOOKED_AT_BYTES and settings.interface:
        return ""  # the frames of the interface can follow
    found = next(iter(CandumpReader(BytesIO(begin), settings.interface)), None) is not None
    return "" if found or len(begin) == LOOKED_AT_BYTES else no_log(settings.path)


LINK = LinkType("replay", ReplayOptions, ReplayLink, CanReplayLink, problem=_problem)
