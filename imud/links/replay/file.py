"""What a replayed file of any kind needs: the settings of the link, and a file that is one."""

import os
import stat
from typing import Annotated, BinaryIO, Literal

from msgspec import Meta

from imud.contracts.settings import Settings
from imud.errors import LinkDenied, LinkError, LinkMissing


class ReplaySettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a replayed capture."""

    path: Annotated[str, Meta(min_length=1)]
    """Raw or stamped capture file."""
    speed: Literal["recorded", "real", "maximum"] = "recorded"
    """`recorded`: by the stamps in the file; `real`: by wire time at `baud`; `maximum`: as fast as possible."""
    baud: Annotated[int, Meta(ge=0, le=4_000_000)] = 0
    """Rate of the wire in bit/s; 0 means as the capture says. A raw capture at speed `real` needs it."""
    repeat: bool = False
    """Start again at the end of the file; not at speed `maximum`."""

    def __post_init__(self) -> None:
        """Raises ValueError for keys that exclude each other."""
        if self.repeat and self.speed == "maximum":
            raise ValueError("repeat needs speed recorded or real: virtual time would run into the future")


def open_regular(path: str) -> BinaryIO:
    """Open a capture for reading. Raises LinkMissing, LinkDenied, LinkError."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise LinkError(f"{path} is not a regular file: a replay reads a capture file")
        return open(path, "rb")
    except FileNotFoundError as error:
        raise LinkMissing(f"{path} is not there: expected a capture file") from error
    except PermissionError as error:
        raise LinkDenied(f"{path} may not be read by this user") from error
    except OSError as error:
        raise LinkError(f"{path} cannot be read: {error.strerror}") from error
