"""GPIO chips: finds the chip and offset of a configured line. The only importer of gpiod.

Each way in which this can fail has its own error message, which names what to change.
"""

import errno
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, NamedTuple

from imud.contracts.lines import LineSettings
from imud.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.permissions import group_of, user_name

DEVICES: Final = Path("/dev")
GROUP: Final = "gpio"
"""Group of GPIO chips on Raspberry Pi OS; named in messages where the chip belongs to root alone."""
GONE: Final = frozenset({errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EBADF})
"""Errors of a chip that was removed."""


class LineLocation(NamedTuple):
    """Chip and offset of a line."""

    path: str
    """Device node of the chip."""
    offset: int
    """Offset of the line on the chip."""
    name: str
    """Name of the line, empty if it has none."""

    def __str__(self) -> str:
        named = f" ({self.name})" if self.name else ""
        return f"{os.path.basename(self.path)} line {self.offset}{named}"


def load_gpiod() -> Any:
    """Import gpiod. Raises LinkError if it is missing, or is the module of libgpiod 1."""
    try:
        import gpiod
    except ImportError as error:
        raise LinkError("GPIO lines need the Python package gpiod, got none: `pip install 'gpiod>=2.3'`") from error
    if not hasattr(gpiod, "request_lines"):
        raise LinkError(
            f"GPIO lines need gpiod 2.3 or later, got that of libgpiod 1 ({gpiod.__file__}), which is Debian 12's "
            "python3-libgpiod: `pip install 'gpiod>=2.3'` into the environment that imud runs in"
        )
    return gpiod


def find_line(gpiod: Any, settings: LineSettings, devices: Path = DEVICES) -> LineLocation:
    """Find the configured line. Raises LinkMissing, LinkDenied, and LinkError if two lines match."""
    chips, denied = _chips(gpiod, settings.chip, devices)
    found = [
        LineLocation(chip.path, offset, name)
        for chip in chips
        for offset, name in enumerate(chip.names)
        if settings.line in (offset, name)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        matches = " and ".join(map(str, found))
        raise LinkError(f"expected the name {settings.line} on one line, got it on {matches}: give chip and number")
    raise denied or _no_line(settings.line, chips)


def chip_error(error: OSError, path: str) -> LinkError:
    """Return the LinkError for a chip that cannot be used."""
    if error.errno in GONE:
        return LinkMissing(f"{path} is gone, or is no GPIO chip: {os.strerror(error.errno or 0)}")
    if error.errno == errno.EPERM:  # of a group it would be EACCES
        return LinkDenied(
            f"{path} may not be opened: the control group of this process does not allow the device (EPERM, "
            f"not its group); add a line `DeviceAllow={path} rw` to the unit (`systemctl edit imud`), and restart imud"
        )
    if error.errno == errno.EACCES:
        group, user = group_of(path, GROUP), user_name()
        return LinkDenied(
            f"{path} may not be opened by user {user}: it must belong to group {group}, readable and writable, and "
            f"{user} to that group (`sudo usermod -aG {group} {user}` and a new login)"
        )
    return LinkError(f"{path} cannot be used as a GPIO chip: {os.strerror(error.errno or 0)}")


def request_error(gpiod: Any, error: OSError, location: LineLocation) -> LinkError:
    """Return the LinkError for a line whose request the kernel refused."""
    if error.errno == errno.EBUSY:
        holder = ""
        with suppress(OSError), gpiod.Chip(location.path) as chip:  # it may have been removed meanwhile
            holder = chip.get_line_info(location.offset).consumer or ""
        return LinkBusy(f"{location} is in use by {holder or 'a nameless program'}: stop that, or choose another line")
    if error.errno in (errno.ENODEV, errno.ENOENT, errno.EACCES, errno.EPERM):
        return chip_error(error, location.path)
    reason = os.strerror(error.errno or 0)
    return LinkError(f"{location} cannot be requested: {reason}; an input needs a chip that makes interrupts")


class _Chip(NamedTuple):
    path: str
    label: str
    names: tuple[str, ...]
    """Names of the lines by offset; empty for a line without a name."""

    def __str__(self) -> str:
        return f"{os.path.basename(self.path)} ({self.label})"


def _chips(gpiod: Any, wanted: str, devices: Path) -> tuple[Sequence[_Chip], LinkDenied | None]:
    """Return the chips to search, and the error of a chip that may not be opened."""
    node = devices / wanted  # an absolute path stays as it is
    if wanted and node.exists():
        return [_read(gpiod, str(node))], None
    chips: list[_Chip] = []
    denied: LinkDenied | None = None
    for path in _nodes(devices):
        try:
            chips.append(_read(gpiod, path))
        except LinkDenied as error:
            denied = error
        except LinkMissing:
            continue  # removed since the folder was listed
    if not wanted:
        return chips, denied
    found = [chip for chip in chips if chip.label == wanted]
    if len(found) > 1:
        raise LinkError(f"expected the label {wanted} on one GPIO chip, got it on {' and '.join(map(str, found))}")
    if not found:
        there = ", ".join(map(str, chips)) or "none"
        raise denied or LinkMissing(f"GPIO chip {wanted} is not there; there are: {there}")
    return found, None


def _nodes(devices: Path) -> list[str]:
    """Return the nodes of all chips by number, without symbolic links (/dev/gpiochip4 of a Raspberry Pi 5 is one)."""
    nodes = [node for node in devices.glob("gpiochip*") if not node.is_symlink()]
    return [str(node) for node in sorted(nodes, key=lambda node: int(re.sub(r"\D", "", node.name) or 0))]


def _read(gpiod: Any, path: str) -> _Chip:
    try:
        with gpiod.Chip(path) as chip:
            info = chip.get_info()
            return _Chip(path, info.label, tuple(chip.get_line_info(n).name or "" for n in range(info.num_lines)))
    except OSError as error:
        raise chip_error(error, path) from error


def _no_line(line: int | str, chips: Sequence[_Chip]) -> LinkMissing:
    if isinstance(line, int):
        return LinkMissing(f"{chips[0]} has no line {line}: its lines are 0 to {len(chips[0].names) - 1}")
    names = [name for chip in chips for name in chip.names if name]
    near = get_close_matches(line, names, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    where = ", ".join(map(str, chips)) or "any chip, as there is none"
    return LinkMissing(f"no line has the name {line} on {where}{hint} (`gpioinfo` lists names)")
