"""A link inside the process, for tests: the test feeds bytes; the link stores writes and rates.

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
    """Simulated baud rate, bit/s; 0: the link has no rate."""
    hold_ns: Annotated[int, Meta(ge=0)] = 0
    """Simulated latency timer of an adapter, ns."""
    waiting_bytes: Annotated[int, Meta(ge=0)] = 0
    """Maximum number of bytes that wait while the link is paused; 0: the link cannot pause."""
    writable: bool = True
    """True if a simulated device listens."""


class MemoryPort:
    """Common part of both links. Synchronization: the loop's thread only."""

    def __init__(self, settings: MemoryOptions) -> None:
        self.title = settings.name
        self.baud: int = 0 if settings.baud == "auto" else settings.baud
        self.writable = settings.writable
        self.written: list[bytes] = []  # all writes, in order
        self.counters = KernelCounters()  # Result of `kernel_counters`. A test can set it.
        self.is_open = False
        self._present = asyncio.Event()
        self._present.set()
        self._on_end: OnEnd | None = None

    def appear(self) -> None:
        """Make the port present, as at the start."""
        self._present.set()

    def disappear(self) -> None:
        """Remove the port: `wait_present` waits, and an open link ends with LinkMissing."""
        self._present.clear()
        self.end(LinkMissing(f"{self.title} is missing: the test unplugged it"))

    def end(self, error: LinkError | None = None) -> None:
        """End the link with an error, or regularly if `error` is None."""
        on_end, self._on_end = self._on_end, None
        self._stop()
        if on_end is not None:
            on_end(error)

    def absence(self) -> str:
        return "" if self._present.is_set() else f"{self.title} does not exist: the test unplugged it"

    async def wait_present(self) -> None:
        await self._present.wait()

    def open(self) -> None:
        """Open the port. Raises LinkMissing after `disappear`, LinkBusy if the port is already open."""
        if reason := self.absence():
            raise LinkMissing(reason)
        if self.is_open:
            raise LinkBusy(f"{self.title} is already open")
        self.is_open = True

    def write(self, data: bytes) -> None:
        """Store the bytes in `written`. Raises LinkError if the port is closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open and cannot send")
        self.written.append(data)

    def kernel_counters(self) -> KernelCounters:
        return self.counters

    def close(self) -> None:
        self.is_open = False
        self._on_end = None
        self._stop()

    def _stop(self) -> None: ...


class MemoryLink(MemoryPort):
    """A `StreamLink`. The test is the device."""

    def __init__(self, settings: MemoryOptions) -> None:
        super().__init__(settings)
        self.auto_baud = settings.baud == "auto"
        self.hold_ns = settings.hold_ns
        self.bauds: list[int] = []  # all rates of `set_baud`, in order
        self.waiting_bytes = settings.waiting_bytes
        self.paused = False  # True while fed bytes wait
        self._waiting = b""
        self._on_data: OnData | None = None

    @property
    def listening(self) -> bool:
        """Return whether the link was started and has not ended."""
        return self._on_data is not None

    def feed(self, data: bytes, t_rx_ns: int) -> bool:
        """Deliver bytes as if read at `t_rx_ns`, or store them while paused. Return False if the link is not started;
        the bytes are lost."""
        if self._on_data is None:
            return False
        if self.paused:
            self._waiting += data
        else:
            self._on_data(data, t_rx_ns)
        return True

    def pause(self) -> None:
        self.paused = True

    def take(self) -> bytes:
        """Return the bytes that were fed since `pause`."""
        data, self._waiting = self._waiting, b""
        return data

    def resume(self) -> None:
        self.paused = False

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        self._on_data, self._on_end = on_data, on_end

    def deliver_to(self, on_data: OnData) -> None:
        if self.listening:
            self._on_data = on_data

    def set_baud(self, baud: int) -> None:
        """Store the rate in `bauds`. Raises LinkError if the port is closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open; cannot set its baud rate")
        self.bauds.append(baud)
        self.baud = baud

    def _stop(self) -> None:
        self._on_data = None
        self.paused, self._waiting = False, b""


class MemoryCanLink(MemoryPort):
    """A `CanLink`. The test is the bus."""

    def __init__(self, settings: MemoryOptions) -> None:
        super().__init__(settings)
        self.bus = settings.name
        self.bitrate = self.baud
        self.filters: Sequence[CanFilter] = ()
        self.gather_ns = 0  # Time for which the link holds frames, ns. This link ignores it.
        self.cyclic: Sequence[CyclicFrame] = ()  # frames of the last `send_cyclic`; empty if the link is closed
        self._on_frames: OnFrames | None = None
        self._on_news: OnBusNews | None = None

    @property
    def listening(self) -> bool:
        """Return whether the link was started and has not ended."""
        return self._on_frames is not None

    def feed(self, frames: Sequence[CanFrame]) -> bool:
        """Deliver the frames that pass the filters. Return False if the link is not started; the frames are lost."""
        if self._on_frames is None:
            return False
        passed = [f for f in frames if any(wanted.matches(f.can_id, f.extended) for wanted in self.filters)]
        if passed:
            self._on_frames(passed)
        return True

    def news(self, news: str, problem: str) -> None:
        """Report a change of the bus state."""
        assert self._on_news is not None
        self._on_news(news, problem)

    def absence(self) -> str:
        return f"{self.title} is down: the test took it down" if super().absence() else ""

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        self._on_frames, self._on_news, self._on_end = on_frames, on_news, on_end

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Store the frames in `cyclic`. Raises LinkError if the link is closed."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open and cannot send")
        self.cyclic = frames

    def close(self) -> None:
        super().close()
        self.cyclic = ()

    def _stop(self) -> None:
        self._on_frames = self._on_news = None


LINK = LinkType("memory", MemoryOptions, MemoryLink, MemoryCanLink)
