"""The file of a replay: settings, waiting for it, opening and closing it, for both kinds of replay."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, BinaryIO, Literal

from msgspec import Meta

from imud.contracts.settings import Settings
from imud.contracts.status import KernelCounters
from imud.errors import LinkDenied, LinkError, LinkMissing
from imud.files import NotRegularFile
from imud.files import open_regular as open_file
from imud.links.inotify import wait_until


class ReplaySettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a replayed capture."""

    path: Annotated[str, Meta(min_length=1)]
    """Raw or stamped capture file."""
    speed: Literal["recorded", "real", "maximum"] = "recorded"
    """`recorded`: by the stamps in the file; `real`: by wire time at `baud`; `maximum`: as fast as possible."""
    baud: Annotated[int, Meta(ge=0, le=4_000_000)] = 0
    """Rate of the wire in bit/s; 0 for that of the capture. A raw capture at speed `real` needs it."""
    repeat: bool = False
    """Start again at the end of the file; not at speed `maximum`."""

    def __post_init__(self) -> None:
        """Raises ValueError for keys that exclude each other."""
        if self.repeat and self.speed == "maximum":
            raise ValueError("repeat: expected false at speed maximum, whose time would run into the future, got true")


class FileReplay:
    """Common part of both kinds of replay. Synchronization: the loop's thread only.

    `close` drops the timer and the file: a turn that finds another file in `_file` than at its begin has ended.
    """

    writable = False

    def __init__(self, settings: ReplaySettings, now_ns: Callable[[], int]) -> None:
        self.title = settings.path
        self._settings = settings
        self._now_ns = now_ns
        self._file: BinaryIO | None = None
        self._timer: asyncio.Handle | None = None

    def absence(self) -> str:
        """Return that the file is missing; empty when it is there."""
        return "" if Path(self.title).exists() else f"{self.title} is not there: expected a capture file"

    async def wait_present(self) -> None:
        """Return when the file is there."""
        path = Path(self.title)
        await wait_until(path, path.exists)

    def write(self, data: bytes) -> None:
        """Raises LinkError: a file has no far end."""
        raise LinkError(f"{self.title} is a replay: nothing can be sent to it")

    def kernel_counters(self) -> KernelCounters:
        """Zeros: the kernel counts no errors of a file."""
        return KernelCounters()

    def close(self) -> None:
        """Release the file; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        file, self._file = self._file, None
        if file is not None:
            file.close()


def open_regular(path: str) -> BinaryIO:
    """Open a capture for reading. Raises LinkMissing, LinkDenied, LinkError."""
    try:
        return open_file(path)
    except FileNotFoundError as error:
        raise LinkMissing(f"{path} is not there: expected a capture file") from error
    except PermissionError as error:
        raise LinkDenied(f"{path} may not be read by this user") from error
    except NotRegularFile as error:
        raise LinkError(f"{path} is not a regular file: a replay reads a capture file") from error
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: str, error: OSError) -> LinkError:
    """Format the error for a file that cannot be read."""
    return LinkError(f"{path} cannot be read: {error.strerror}")
