"""What a link is: it owns one port, tells what came with its time of arrival, and of its own end."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from imud.contracts.can import CanDriver
from imud.contracts.driver import Driver, StreamDriver
from imud.contracts.polling import PolledDriver, Transfer
from imud.contracts.settings import Settings
from imud.contracts.status import KernelCounters, SerialLineCounters
from imud.errors import LinkError
from imud.formats.can import CanFilter, CanFrame, CyclicFrame

OnData = Callable[[bytes, int], None]
"""Called with bytes as read and CLOCK_MONOTONIC (ns) right after the read."""
OnEnd = Callable[[LinkError | None], None]
"""Called once when the link ends by itself: with the error, or None for the regular end of a replay."""
OnFrames = Callable[[Sequence[CanFrame]], None]
"""Called with frames of a CAN bus, oldest first."""
OnBusNews = Callable[[str, str], None]
"""Called when the state of a bus changes: one sentence of news, and what is wrong from now on (empty: nothing)."""


class Link(Protocol):
    """What all links have. Synchronization: the loop's thread only.

    Order of calls: `wait_present`, `open`, `start` (of its kind), then others at will, `close`; then again from the
    beginning with the same object.
    """

    title: str
    """The link for people, for example `/dev/ttyUSB0`."""
    writable: bool
    """Whether a device listens at the far end (a replay has none)."""

    async def wait_present(self) -> None:
        """Return when the port is there; at once if it is. Waits on the kernel's events, never polls busily."""
        ...

    def open(self) -> None:
        """Open and set up the port. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes, on CAN whole `struct can_frame`; queued (bounded) when the port is full. Raises LinkError."""
        ...

    def kernel_counters(self) -> KernelCounters:
        """Errors the kernel counted since `open`."""
        ...

    def close(self) -> None:
        """Release the port; may be called twice. `on_end` is not called."""
        ...


class StreamLink(Link, Protocol):
    """A source of bytes, opened exclusively, driven by the asyncio loop."""

    baud: int
    """Present rate in bit/s; 0 where there is no such thing."""
    auto_baud: bool
    """Whether the rate is to be found by detection."""
    hold_ns: int
    """How long the adapter may hold bytes back before it hands them over (USB latency timer), 0 if it does not."""

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Deliver bytes from now on. Needs a running loop and an open port."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the rate and throw away bytes received at the old one. Raises LinkError."""
        ...


class CanLink(Link, Protocol):
    """A CAN bus as one device sees it; several devices share a bus, each by a link of its own."""

    bus: str
    """What it shares with others: links of the same bus hear the same frames."""
    filters: Sequence[CanFilter]
    """Frames to deliver; holds from the moment it is set. Others may come all the same."""
    bitrate: int
    """Rate of the bus in bit/s, known once open; 0 where there is none (virtual buses) or nobody says."""

    def absence(self) -> str:
        """Why `wait_present` would wait now, one sentence; empty when it would not."""
        ...

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Deliver frames from now on. Needs a running loop and an open bus."""
        ...

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send these and no others again and again, until `close`. Needs what `start` needs. Raises LinkError."""
        ...


class PolledLink(Link, Protocol):
    """A bus as one device sees it; the bus's thread makes the transfers of all its devices.

    `select`, `transfer` and `close` are called by the bus's thread once the device has joined the bus, the rest by the
    loop's. `write` is of no use here and raises LinkError.
    """

    bus: str
    """What it shares with others: links of the same bus are served by one thread."""
    target: int | None
    """Address or mode as configured; None for `auto`."""
    shared: bool
    """Whether targets tell the devices of one bus apart (I2C), so that none may be taken twice."""
    rate_hz: float
    """Polls per second."""

    def select(self, target: int) -> None:
        """Speak to this address, or in this mode, from now on. Raises LinkError."""
        ...

    def place(self, target: int) -> str:
        """A target for people, for example `address 0x18`."""
        ...

    def transfer(self, transfer: Transfer) -> bytes:
        """Make a transfer and return all bytes read. Raises TransferError; LinkMissing and LinkError for the bus."""
        ...

    def serial_line(self) -> SerialLineCounters | None:
        """What was heard besides replies since `open`; None for buses with a clock, where the host alone speaks."""
        ...


def _no_bytes(_settings: Any) -> StreamLink:
    raise LinkError("expected a link of bytes, got one that has none")


def _no_frames(_settings: Any) -> CanLink:
    raise LinkError("expected a link to a CAN bus, got one that is none")


def _no_transfers(_settings: Any) -> PolledLink:
    raise LinkError("expected a link to a bus that is polled, got one that is none")


@dataclass(frozen=True, slots=True)
class LinkType:
    """The row a link file ends with. It says by its makers what kinds of drivers can use it."""

    name: str
    """The key under a device in the configuration."""
    settings: type[Settings]
    make: Callable[[Any], StreamLink] = _no_bytes
    """Makes a closed link of bytes from its settings."""
    make_can: Callable[[Any], CanLink] = _no_frames
    """Makes a closed link to a CAN bus from its settings."""
    make_polled: Callable[[Any], PolledLink] = _no_transfers
    """Makes a closed link to a polled bus from its settings."""

    @property
    def polled(self) -> bool:
        """Whether devices on it speak only when they are asked."""
        return self.make_polled is not _no_transfers

    @property
    def searchable(self) -> bool:
        """Whether `driver: auto` finds out what talks on it."""
        return self.make is not _no_bytes or self.polled or self.frames_only

    @property
    def frames_only(self) -> bool:
        """Whether every device on it stands on a CAN bus."""
        return self.make_can is not _no_frames and self.make is _no_bytes

    def fits(self, driver: Driver) -> bool:
        """Whether a driver can use such a link."""
        if isinstance(driver, StreamDriver):
            return self.make is not _no_bytes
        if isinstance(driver, PolledDriver):
            return driver.link == self.name
        return isinstance(driver, CanDriver) and self.make_can is not _no_frames
