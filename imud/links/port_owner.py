"""Who may use a port and who does, for messages to people."""

import os
from pathlib import Path
from typing import Final

from imud import permissions

SERIAL_GROUP: Final = "dialout"
"""Group of serial ports on Debian and its relatives; named where a port's own group is of no help."""


def group_of(path: str) -> str:
    """Name of the group that may use the port, `dialout` where only root may or nothing is known."""
    return permissions.group_of(path, SERIAL_GROUP)


def holders_of(path: str, proc: Path) -> str:
    """`minicom (pid 123)` for each process that has the port open, as far as /proc lets this user see; else empty."""
    target = os.path.realpath(path)
    holders = []
    for process in sorted(proc.glob("[0-9]*")):
        if _has_open(process, target):
            holders.append(f"{_name(process)} (pid {process.name})")
    return ", ".join(holders)


def _has_open(process: Path, target: str) -> bool:
    try:
        descriptors = os.listdir(process / "fd")
    except OSError:  # another user's process, or one that just ended
        return False
    return any(_target(process / "fd" / descriptor) == target for descriptor in descriptors)


def _target(descriptor: Path) -> str:
    try:
        return os.readlink(descriptor)
    except OSError:  # closed in between
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"
