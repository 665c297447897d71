"""The node of a bus in /dev: waiting for it, and what the system says of it as errors of imud."""

import asyncio
import errno
import os
from pathlib import Path
from typing import Final

from imud.errors import LinkBusy, LinkDenied, LinkError, LinkMissing, TransferError, Trouble
from imud.links.inotify import wait_until
from imud.links.port_owner import group_of
from imud.permissions import user_name

GONE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.ENOTDIR, errno.ESHUTDOWN, errno.EBADF})
REFUSED: Final = frozenset({errno.EACCES, errno.EPERM})
ABSENT: Final = frozenset({errno.ENXIO, errno.EREMOTEIO})
"""No acknowledgement: Documentation/i2c/fault-codes.rst has ENXIO; the Raspberry Pi's controller says EREMOTEIO."""
STUCK: Final = frozenset({errno.ETIMEDOUT})
ACCESS_WAIT_S: Final = 1.0
"""How long to wait for access after a refusal: udev sets a node's group within some ms of its making."""


async def node_present(path: str, *, denied: bool) -> None:
    """Return when the node is there; after a refused open, when access is given or after ACCESS_WAIT_S."""
    node = Path(path)
    await wait_until(node, node.exists)
    if not denied:
        return
    try:
        async with asyncio.timeout(ACCESS_WAIT_S):
            await wait_until(node, lambda: os.access(node, os.R_OK | os.W_OK, effective_ids=True))
    except TimeoutError:
        return


def open_problem(error: OSError, path: str, how: str) -> LinkError:
    """The LinkError for an `open` that failed; `how` says how such a bus is switched on."""
    if error.errno in GONE or error.errno == errno.ENXIO:
        return LinkMissing(f"{path} is not there: {how}")
    if error.errno in REFUSED:
        group = group_of(path)
        return LinkDenied(
            f"{path} may not be opened by user {user_name()}: it belongs to group {group}; "
            f"`sudo usermod -aG {group} {user_name()}` and a new login give access"
        )
    if error.errno == errno.EBUSY:
        return LinkBusy(f"{path} is in use by another program or by a driver of the kernel: stop that first")
    return LinkError(f"{path} cannot be used: {error}")


def transfer_problem(error: OSError, path: str, place: str) -> LinkError | TransferError:
    """What a failed transfer means: the bus is gone, or this transfer only."""
    if error.errno in GONE:
        return LinkMissing(f"{path} is gone ({os.strerror(error.errno or 0)}): was an adapter pulled out?")
    if error.errno in ABSENT:
        return TransferError(Trouble.ABSENT, f"no acknowledgement at {place} on {path}: is it powered, is it wired?")
    if error.errno in STUCK:
        return TransferError(Trouble.STUCK, f"{path} timed out at {place}: is a line of the bus held low?")
    return TransferError(Trouble.DISTURBED, f"transfer failed at {place} on {path}: {os.strerror(error.errno or 0)}")
