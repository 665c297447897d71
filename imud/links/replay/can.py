"""A CAN log (`candump -L`) as a bus: the frames of a file, through the same path as those of an interface.

Speeds as in `imud.links.replay.link`: `recorded` and `real` play by the stamps in the file, `maximum` as fast as the
receiver decodes, in virtual time that ends at the moment of the start. `baud` has no effect.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from imud.contracts.link import OnBusNews, OnEnd, OnFrames
from imud.errors import LinkError
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.formats.candump import CandumpReader
from imud.links.replay.file import FileReplay, ReplaySettings, open_regular, unreadable
from imud.units import NS_PER_MS, NS_PER_S

TURN_FRAMES: Final = 512
"""Delivered in one turn of the event loop, 1 ms of decoding: others get their turn between."""

log = logging.getLogger(__name__)


def no_log(path: str) -> str:
    """Format the error for a file without frames."""
    return f"{path} is no CAN log: expected frames as `candump -L` writes them, found none"


class CanReplayLink(FileReplay):
    """A log as a `CanLink`. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReplaySettings, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(settings, now_ns)
        self._span_ns = 0
        self._frames: Iterator[CanFrame] = iter(())
        self.filters: Sequence[CanFilter] = ()
        self.bus = settings.path
        self.bitrate = 0
        self.gather_ns = 0
        """No-op: the recording decides what is delivered together."""

    def open(self) -> None:
        """Open the log and check that it has frames. Raises LinkMissing, LinkDenied, LinkError."""
        self._file = open_regular(self.title)
        reader = CandumpReader(self._file)
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
        if first_ns < 0:
            self.close()
            raise LinkError(no_log(self.title))
        self._span_ns = newest_ns - first_ns

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Play from the beginning."""
        self._frames = self._play(self._now_ns() - self._span_ns)
        self._timer = asyncio.get_running_loop().call_soon(self._turn, on_frames, on_end, None)

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Raises LinkError: a file has no far end."""
        raise LinkError(f"{self.title} is a replay: nothing can be sent to it")

    def _turn(self, on_frames: OnFrames, on_end: OnEnd, waiting: CanFrame | None) -> None:
        """Deliver what is due, at most TURN_FRAMES, then give way."""
        file, frames, now_ns = self._file, list[CanFrame](), self._now_ns()
        while (frame := waiting or next(self._frames, None)) is not None:
            waiting = frame if frame.t_rx_ns > now_ns or len(frames) >= TURN_FRAMES else None
            if waiting:
                break
            frames.append(frame)
        if frames:
            on_frames(frames)
        if self._file is not file:  # closed by the receiver
            return
        if waiting is None:
            self.close()
            on_end(None)
            return
        delay_s = max(0, waiting.t_rx_ns - self._now_ns()) / NS_PER_S
        self._timer = asyncio.get_running_loop().call_later(delay_s, self._turn, on_frames, on_end, waiting)

    def _play(self, origin_ns: int) -> Iterator[CanFrame]:
        """Frames that pass the filters, with the CLOCK_MONOTONIC at which each is due."""
        while self._file is not None:
            self._file.seek(0)
            reader = CandumpReader(self._file)
            first_ns, count, due_ns = None, 0, origin_ns
            for frame in reader:
                first_ns = frame.t_rx_ns if first_ns is None else first_ns
                due_ns = origin_ns + frame.t_rx_ns - first_ns
                count += 1
                if any(wanted.matches(frame.can_id, frame.extended) for wanted in self.filters):
                    yield frame._replace(t_rx_ns=due_ns)
            if reader.problem:
                log.warning("%s: %s", self.title, reader.problem)
            if not self._settings.repeat:
                return
            origin_ns = due_ns + max((due_ns - origin_ns) // max(count, 1), NS_PER_MS)
