"""A link inside the process, for tests: they feed its bytes, and its writes and rates are kept.

A fault is a subclass of three lines, for example::

    class Stuck(MemoryLink):
        def write(self, data: bytes) -> None:
            raise LinkError("memory does not send")
"""

import asyncio
from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from imud.contracts.link import LinkType, OnBusNews, OnData, OnEnd, OnFrames
from imud.contracts.status import KernelCounters
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.model.errors import LinkBusy, LinkError, LinkMissing
from imud.model.options import Options


class MemoryOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a link inside the process."""

    name: str = "memory"
    """Title of the link."""
    baud: Annotated[int, Meta(ge=0)] | Literal["auto"] = 0
    """Rate it pretends to have, in bit/s; 0 is none."""
    hold_ns: Annotated[int, Meta(ge=0)] = 0
    """Simulated hold time of an adapter, ns."""
    waiting_bytes: Annotated[int, Meta(ge=0)] = 0
    """Bytes that may wait while it is paused; 0: it cannot be."""
    writable: bool = True
    """Whether it pretends that a device listens."""


class MemoryPort:
    """Common part of both links. Synchronization: the loop's thread only."""

    def __init__(self, settings: MemoryOptions) -> None:
        self.title = settings.name
        self.baud: int = 0 if settings.baud == "auto" else settings.baud
        self.writable = settings.writable
        self.written: list[bytes] = []
        """Every `write`, in order."""
        self.counters = KernelCounters()
        """Result of `kernel_counters`; a test may set it."""
        self.is_open = False
        self._present = asyncio.Event()
        self._present.set()
        self._on_end: OnEnd | None = None

    def appear(self) -> None:
        """Make the port present, as it is at the beginning."""
        self._present.set()

    def disappear(self) -> None:
        """Make the port absent: `wait_present` waits, and a running link ends with LinkMissing."""
        self._present.clear()
        self.end(LinkMissing(f"{self.title} is gone: the test pulled it out"))

    def end(self, error: LinkError | None = None) -> None:
        """End the link by itself: with an error, or None for the regular end."""
        on_end, self._on_end = self._on_end, None
        self._stop()
        if on_end is not None:
            on_end(error)

    def absence(self) -> str:
        """Why the port is not there; empty when it is."""
        return "" if self._present.is_set() else f"{self.title} is not there: the test pulled it out"

    async def wait_present(self) -> None:
        """Return when the port is there."""
        await self._present.wait()

    def open(self) -> None:
        """Raises LinkMissing after `disappear`, LinkBusy when it is open already."""
        if reason := self.absence():
            raise LinkMissing(reason)
        if self.is_open:
            raise LinkBusy(f"{self.title} is open already")
        self.is_open = True

    def write(self, data: bytes) -> None:
        """Keep the bytes in `written`. Raises LinkError when closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open: nothing can be sent")
        self.written.append(data)

    def kernel_counters(self) -> KernelCounters:
        """Counters set by the test."""
        return self.counters

    def close(self) -> None:
        """Stop delivering; may be called twice."""
        self.is_open = False
        self._on_end = None
        self._stop()

    def _stop(self) -> None:
        """Forget the receiver."""


class MemoryLink(MemoryPort):
    """A `StreamLink` whose far end is the test."""

    def __init__(self, settings: MemoryOptions) -> None:
        super().__init__(settings)
        self.auto_baud = settings.baud == "auto"
        self.hold_ns = settings.hold_ns
        self.bauds: list[int] = []
        """Every `set_baud`, in order."""
        self.waiting_bytes = settings.waiting_bytes
        self.paused = False
        """Whether what is fed waits."""
        self._waiting = b""
        self._on_data: OnData | None = None

    @property
    def listening(self) -> bool:
        """Whether `start` was called and the link did not end since."""
        return self._on_data is not None

    def feed(self, data: bytes, t_rx_ns: int) -> bool:
        """Deliver bytes as if read at `t_rx_ns`, or keep them while paused; False, and lost, when it is not started."""
        if self._on_data is None:
            return False
        if self.paused:
            self._waiting += data
        else:
            self._on_data(data, t_rx_ns)
        return True

    def pause(self) -> None:
        """Keep what is fed."""
        self.paused = True

    def take(self) -> bytes:
        """Return what was fed since `pause`."""
        data, self._waiting = self._waiting, b""
        return data

    def resume(self) -> None:
        """Deliver what is fed from now on."""
        self.paused = False

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Deliver what is fed from now on."""
        self._on_data, self._on_end = on_data, on_end

    def set_baud(self, baud: int) -> None:
        """Keep the rate in `bauds`. Raises LinkError when closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open: its rate cannot be set")
        self.bauds.append(baud)
        self.baud = baud

    def _stop(self) -> None:
        self._on_data = None
        self.paused, self._waiting = False, b""


class MemoryCanLink(MemoryPort):
    """A `CanLink` whose far end is the test."""

    def __init__(self, settings: MemoryOptions) -> None:
        super().__init__(settings)
        self.bus = settings.name
        self.bitrate = self.baud
        self.filters: Sequence[CanFilter] = ()
        self.gather_ns = 0
        """Time for which frames may gather; nothing does here."""
        self.cyclic: Sequence[CyclicFrame] = ()
        """Frames passed to `send_cyclic`; empty when closed."""
        self._on_frames: OnFrames | None = None
        self._on_news: OnBusNews | None = None

    @property
    def listening(self) -> bool:
        """Whether `start` was called and the link did not end since."""
        return self._on_frames is not None

    def feed(self, frames: Sequence[CanFrame]) -> bool:
        """Deliver those frames that pass the filters; False when the link is not started, and then they are lost."""
        if self._on_frames is None:
            return False
        passed = [f for f in frames if any(wanted.matches(f.can_id, f.extended) for wanted in self.filters)]
        if passed:
            self._on_frames(passed)
        return True

    def news(self, news: str, problem: str) -> None:
        """Report a change of the state of the bus."""
        assert self._on_news is not None
        self._on_news(news, problem)

    def absence(self) -> str:
        """Why the bus is not there; empty when it is."""
        return f"{self.title} is down: the test took it down" if super().absence() else ""

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Deliver what is fed from now on."""
        self._on_frames, self._on_news, self._on_end = on_frames, on_news, on_end

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Keep the frames in `cyclic`. Raises LinkError when closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open: nothing can be sent")
        self.cyclic = frames

    def close(self) -> None:
        """Stop delivering and sending; may be called twice."""
        super().close()
        self.cyclic = ()

    def _stop(self) -> None:
        self._on_frames = self._on_news = None


LINK = LinkType("memory", MemoryOptions, MemoryLink, MemoryCanLink)
