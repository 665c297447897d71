"""Device nodes in /dev: waiting for one, and imud's errors for a failed open or transfer.

A node is missing until its driver makes it, and refused until udev sets its group. Messages name its group and the
processes that have it open, read from the file system and /proc.
"""

import asyncio
import ctypes
import errno
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from imud.host.files import GROUP_ACCESS, group_of, user_name
from imud.host.log import printable
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing, TransferError, Trouble, reason_of

IN_ATTRIB: Final = 0x0004
IN_MOVED_TO: Final = 0x0080
IN_CREATE: Final = 0x0100
IN_DELETE: Final = 0x0200
IN_DELETE_SELF: Final = 0x0400
IN_MOVE_SELF: Final = 0x0800
IN_ONLYDIR: Final = 0x0100_0000
WATCH_MASK: Final = IN_ATTRIB | IN_MOVED_TO | IN_CREATE | IN_DELETE | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR
"""IN_ATTRIB because udev sets group and mode of a fresh node after the kernel made it."""

EVENT_BUFFER_BYTES: Final = 4096
"""Room for at least 15 events: 16 bytes and a name of at most 256 each (inotify(7))."""
LINKS_MAX: Final = 40
"""Symbolic links followed, as the kernel does (path_resolution(7))."""

libc = ctypes.CDLL(None, use_errno=True)


class DirectoryWatch:
    """An inotify descriptor that watches some directories. Synchronization: the loop's thread only."""

    def __init__(self) -> None:
        """Raises LinkError when the user's inotify instances are used up."""
        self._fd: int = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise LinkError(
                f"inotify: {os.strerror(ctypes.get_errno())}; look at /proc/sys/fs/inotify/max_user_instances"
            )

    def add(self, directory: Path) -> bool:
        """Watch a directory; False when it is gone or may not be read."""
        return int(libc.inotify_add_watch(self._fd, os.fsencode(directory), WATCH_MASK)) >= 0

    async def changed(self) -> None:
        """Return when something happened in a watched directory since it was added, or since the last call."""
        loop = asyncio.get_running_loop()
        readable = loop.create_future()
        loop.add_reader(self._fd, lambda: None if readable.done() else readable.set_result(None))
        try:
            await readable
        finally:
            loop.remove_reader(self._fd)
        os.read(self._fd, EVENT_BUFFER_BYTES)

    def close(self) -> None:
        """Release the descriptor; may be called twice. A thread does it: the kernel needs 8 ms and more."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            asyncio.get_running_loop().run_in_executor(None, os.close, fd)


async def wait_until(path: Path, ready: Callable[[], bool]) -> None:
    """Return as soon as `ready()` holds; it is asked again after every change on the way to `path`.

    The watch is set before `ready` is asked, so no change is missed. Raises LinkError when inotify is not to be had,
    LinkDenied when the directory may not be read.
    """
    if ready():
        return
    watch = DirectoryWatch()
    try:
        while True:
            directories = directories_of(path)
            watched = [watch.add(directory) for directory in directories]
            if directories_of(path) != directories:
                await asyncio.sleep(0)  # it changed while the watches were set: look again
                continue
            if not any(watched):
                raise LinkDenied(f"cannot watch {directories[0]} for {path.name}: may this user read that directory?")
            if ready():
                return
            await watch.changed()
    finally:
        watch.close()


def directories_of(path: Path) -> list[Path]:
    """The directories whose changes can make `path` appear, vanish, or become another file."""
    directories: list[Path] = []
    for _ in range(LINKS_MAX):
        directory = _nearest_directory(path.parent)
        if directory not in directories:
            directories.append(directory)
        if not path.is_symlink():
            break
        try:
            path = path.parent / path.readlink()
        except OSError:  # the link went away in between
            break
    return directories


def _nearest_directory(directory: Path) -> Path:
    while not directory.is_dir() and directory != directory.parent:
        directory = directory.parent
    return directory


MISSING: Final = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ENOTDIR, errno.ESHUTDOWN})
"""Errors of `open` without a device behind the path."""
REFUSED: Final = frozenset({errno.EACCES, errno.EPERM})
HELD: Final = frozenset({errno.EBUSY, errno.EAGAIN})
"""Errors of `open` and of the locks after it where another process or a kernel driver has the device."""
GONE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.ENOTDIR, errno.ESHUTDOWN, errno.EBADF})
"""Errors of a transfer after the adapter was removed."""
NOT_ACKNOWLEDGED: Final = frozenset({errno.ENXIO, errno.EREMOTEIO})
"""Documentation/i2c/fault-codes.rst has ENXIO; the Raspberry Pi's controller returns EREMOTEIO."""
STUCK: Final = frozenset({errno.ETIMEDOUT})

ACCESS_WAIT_S: Final = 1.0
"""Time to wait for access before a refusal counts: udev sets a node's group some ms after it makes the node."""
SERIAL_GROUP: Final = "dialout"
"""Group of serial ports on Debian and its relatives; named where the node cannot be looked at."""
PROC: Final = Path("/proc")
OWN_PROCESS: Final = "this imud"
COMMAND_BYTES: Final = 1024
"""Of a command line that are looked at."""
CABLE: Final = "is the cable plugged in, and is the path right?"
"""Question to a user whose serial port is absent."""


class DeviceNode:
    """The node of one link: waits until it can be opened. Synchronization: the loop's thread only."""

    def __init__(self, path: str, missing: str) -> None:
        """`missing` is the question to a user whose node is absent."""
        self._path = Path(path)
        self._missing = missing

    def absence(self) -> str:
        """Return that the node is not there, one sentence; empty when it is."""
        return "" if self._path.exists() else f"{self._path} is not there: {self._missing}"

    async def wait_present(self) -> None:
        """Return when the node exists and may be opened, ACCESS_WAIT_S after it exists at the latest.

        Raises LinkError when inotify cannot be had, LinkDenied when the directory may not be read.
        """
        await wait_until(self._path, self._path.exists)
        if self._accessible():
            return
        try:
            async with asyncio.timeout(ACCESS_WAIT_S):
                await wait_until(self._path, self._accessible)
        except TimeoutError:
            return

    def _accessible(self) -> bool:
        return os.access(self._path, os.R_OK | os.W_OK, effective_ids=True)


def open_problem(error: Exception, path: str, missing: str, proc: Path = PROC) -> LinkError | None:
    """The LinkError for an `open` whose node is absent, refused or held; None for any other error.

    `missing` is the question to a user whose node is absent. Holders are looked up in `proc`.
    """
    number = errno_of(error)
    if number in MISSING:
        return LinkMissing(f"{path} is not there: {missing}")
    if number == errno.EPERM:  # of a group it would be EACCES
        return LinkDenied(
            f"{path} may not be opened: the control group of this process does not allow the device (EPERM, "
            f"not its group); add a line `DeviceAllow={path} rw` to the unit (`systemctl edit imud`), and restart imud"
        )
    if number in REFUSED:
        return LinkDenied(f"{path} may not be opened by user {user_name()}: {_refusal(path)}")
    if number in HELD:
        holders = holders_of(path, proc) or "another program or by a driver of the kernel"
        return LinkBusy(f"{path} is in use by {holders}: stop that first")
    return None


def _refusal(path: str) -> str:
    """Whose the node is, and what gives access: its group, or a udev rule where no group may open it."""
    with suppress(OSError):
        node = os.stat(path)
        if node.st_gid == 0 or node.st_mode & GROUP_ACCESS != GROUP_ACCESS:
            mode = f"{stat.S_IMODE(node.st_mode):04o}"
            return f"it is for no group (mode {mode}, group {group_of(path, 'root')}); `imud doctor` has the udev rule"
    group = group_of(path, SERIAL_GROUP)
    return f"it belongs to group {group}; `sudo usermod -aG {group} {user_name()}` and a new login give access"


def bus_open_problem(error: OSError, path: str, missing: str) -> LinkError:
    """The LinkError for an I2C or SPI bus that cannot be opened; `missing` as for `open_problem`."""
    return open_problem(error, path, missing) or LinkError(f"{path} cannot be used: {reason_of(error)}")


def errno_of(error: Exception) -> int | None:
    """The error number of an OSError, or of a termios.error, which has it among its arguments."""
    if isinstance(error, OSError):
        return error.errno
    return next((argument for argument in error.args if isinstance(argument, int)), None)


def transfer_problem(error: OSError, path: str, place: str) -> LinkError | TransferError:
    """The error for a failed transfer: LinkMissing when the bus is gone, TransferError for this transfer only."""
    if error.errno in GONE:
        return LinkMissing(f"{path} is gone ({os.strerror(error.errno or 0)}): was an adapter pulled out?")
    if error.errno in NOT_ACKNOWLEDGED:
        return TransferError(Trouble.ABSENT, f"no acknowledgement at {place} on {path}: is it powered, is it wired?")
    if error.errno in STUCK:
        return TransferError(Trouble.STUCK, f"{path} timed out at {place}: is a line of the bus held low?")
    return TransferError(Trouble.DISTURBED, f"transfer failed at {place} on {path}: {os.strerror(error.errno or 0)}")


def holders_of(path: str, proc: Path = PROC) -> str:
    """List the processes that have the node open, as `minicom (pid 123)`, as far as /proc lets this user see."""
    target = os.path.realpath(path)
    holders = []
    for process in sorted(proc.glob("[0-9]*")):
        if _has_open(process, target):
            holders.append(f"{_name(process)} (pid {process.name})")
    return ", ".join(holders)


def _words(process: Path) -> list[str]:
    """Return the command line of a process, its first words; empty where that cannot be read."""
    try:
        return (process / "cmdline").read_bytes()[:COMMAND_BYTES].decode("utf-8", "replace").split("\0")
    except OSError:
        return []


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
    if process.name == str(os.getpid()):
        return OWN_PROCESS
    words = _words(process)
    for place, word in enumerate(words[:-1]):
        if os.path.basename(word) == "imud":  # an interpreter may stand before it, and its options
            return f"imud {printable(words[place + 1])}"
    try:
        return printable((process / "comm").read_text("utf-8", "backslashreplace").strip())
    except OSError:
        return "a process"
