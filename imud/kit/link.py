"""What a link of bytes is: it owns one port, tells of bytes with their time of arrival, and of its own end."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from imud.errors import LinkError
from imud.kit.settings import Settings
from imud.kit.status import KernelCounters

OnData = Callable[[bytes, int], None]
"""Called with bytes as read and CLOCK_MONOTONIC (ns) right after the read."""
OnEnd = Callable[[LinkError | None], None]
"""Called once when the link ends by itself: with the error, or None for the regular end of a replay."""


class StreamLink(Protocol):
    """A source of bytes, driven by the asyncio loop. Synchronization: the loop's thread only.

    Order of calls: `wait_present`, `open`, `start`, then `write`/`set_baud` at will, `close`; then again from the
    beginning with the same object.
    """

    title: str
    """The link for people, for example `/dev/ttyUSB0`."""
    baud: int
    """Present rate in bit/s; 0 where there is no such thing."""
    auto_baud: bool
    """Whether the rate is to be found by detection."""
    writable: bool
    """Whether a device listens at the far end (a replay has none)."""
    hold_ns: int
    """How long the adapter may hold bytes back before it hands them over (USB latency timer), 0 if it does not."""

    async def wait_present(self) -> None:
        """Return when the port is there; at once if it is. Waits on inotify, never polls busily."""
        ...

    def open(self) -> None:
        """Open and set up the port, exclusively. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        ...

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Deliver bytes from now on. Needs a running loop and an open port."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; they are queued (bounded) when the port is full. Raises LinkError."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the rate and throw away bytes received at the old one. Raises LinkError."""
        ...

    def kernel_counters(self) -> KernelCounters:
        """Errors the kernel counted since `open`."""
        ...

    def close(self) -> None:
        """Release the port; may be called twice. `on_end` is not called."""
        ...


@dataclass(frozen=True, slots=True)
class LinkType:
    """The row a link file ends with."""

    name: str
    """The key under a device in the configuration."""
    settings: type[Settings]
    make: Callable[[Any], StreamLink]
    """Makes a closed link from its settings."""
