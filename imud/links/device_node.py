"""Device nodes in /dev: waiting for a node, and the errors of imud for a failed open or transfer.

The driver of the kernel makes the node; udev sets its group later. Error messages name the group of the node and the
processes that hold the node, from the file system and /proc.
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
# Events to watch. IN_ATTRIB: udev sets group and mode after the kernel made the node.
WATCH_MASK: Final = IN_ATTRIB | IN_MOVED_TO | IN_CREATE | IN_DELETE | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR

# Size of the event buffer: at least 15 events of 16 bytes plus a name of at most 256 bytes (inotify(7)).
EVENT_BUFFER_BYTES: Final = 4096
LINKS_MAX: Final = 40  # maximum number of symbolic links to follow, as in the kernel (path_resolution(7))

libc = ctypes.CDLL(None, use_errno=True)


class DirectoryWatch:
    """An inotify descriptor that watches some directories. Synchronization: the loop's thread only."""

    def __init__(self) -> None:
        """Raises LinkError if the user has no inotify instance left."""
        self._fd: int = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise LinkError(
                f"cannot watch /dev: {os.strerror(ctypes.get_errno())}; raise fs.inotify.max_user_instances (sysctl)"
            )

    def add(self, directory: Path) -> bool:
        """Watch a directory. Return False if the directory does not exist or the user may not read it."""
        return int(libc.inotify_add_watch(self._fd, os.fsencode(directory), WATCH_MASK)) >= 0

    async def changed(self) -> None:
        """Return after a change in a watched directory since the call of `add` or since the last call."""
        loop = asyncio.get_running_loop()
        readable = loop.create_future()
        loop.add_reader(self._fd, lambda: None if readable.done() else readable.set_result(None))
        try:
            await readable
        finally:
            loop.remove_reader(self._fd)
        os.read(self._fd, EVENT_BUFFER_BYTES)

    def close(self) -> None:
        """Release the descriptor. A second call does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            asyncio.get_running_loop().run_in_executor(None, os.close, fd)  # the kernel needs 8 ms or more


async def wait_until(path: Path, ready: Callable[[], bool]) -> None:
    """Return as soon as `ready()` is true. imud calls `ready` again after each change of a directory of `path`.

    imud sets the watch before the first call of `ready`, so that no change is lost. Raises LinkError if inotify is not
    available, LinkDenied if the user may not read the directory.
    """
    if ready():
        return
    watch = DirectoryWatch()
    try:
        while True:
            directories = directories_of(path)
            watched = [watch.add(directory) for directory in directories]
            if directories_of(path) != directories:
                await asyncio.sleep(0)  # a directory changed while imud set the watches: check again
                continue
            if not any(watched):
                raise LinkDenied(f"cannot wait for {path}: user {user_name()} may not read {directories[0]}")
            if ready():
                return
            await watch.changed()
    finally:
        watch.close()


def directories_of(path: Path) -> list[Path]:
    """Return the directories whose changes can create, remove or replace `path`."""
    directories: list[Path] = []
    for _ in range(LINKS_MAX):
        directory = _nearest_directory(path.parent)
        if directory not in directories:
            directories.append(directory)
        try:
            path = path.parent / path.readlink()
        except OSError:  # not a link, or removed in the meantime
            break
    return directories


def _nearest_directory(directory: Path) -> Path:
    while not directory.is_dir() and directory != directory.parent:
        directory = directory.parent
    return directory


# Error numbers of `open` if no device exists at the path.
MISSING: Final = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ENOTDIR, errno.ESHUTDOWN})
REFUSED: Final = frozenset({errno.EACCES, errno.EPERM})
# Error numbers of `open` and of its locks if another process or a kernel driver uses the device.
HELD: Final = frozenset({errno.EBUSY, errno.EAGAIN})
# Errors of a transfer after the adapter was removed.
GONE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.ENOTDIR, errno.ESHUTDOWN, errno.EBADF})
# Error numbers of a missing acknowledgement: ENXIO (Documentation/i2c/fault-codes.rst), EREMOTEIO (Raspberry Pi).
NOT_ACKNOWLEDGED: Final = frozenset({errno.ENXIO, errno.EREMOTEIO})
STUCK: Final = frozenset({errno.ETIMEDOUT})

# Time to wait for access, s. udev sets the group of a node some milliseconds after the kernel made it.
ACCESS_WAIT_S: Final = 1.0
# Group of serial ports on Debian. Error messages name it if imud cannot read the group of the node.
SERIAL_GROUP: Final = "dialout"
PROC: Final = Path("/proc")
OWN_PROCESS: Final = "this imud"
CABLE: Final = "is the cable plugged in, and is the path right?"  # hint for a user whose serial port does not exist


class DeviceNode:
    """The device node of one link. Synchronization: the loop's thread only."""

    def __init__(self, path: str, missing: str) -> None:
        """`missing` is the hint for a user whose node does not exist."""
        self._path = Path(path)
        self._missing = missing

    def absence(self) -> str:
        """Return an error text if the node does not exist, otherwise an empty text."""
        return "" if self._path.exists() else f"{self._path} does not exist: {self._missing}"

    async def wait_present(self) -> None:
        """Return when the node exists and the user may open it, at the latest ACCESS_WAIT_S after the node appeared.

        Raises LinkError if inotify is not available, LinkDenied if the user may not read the directory.
        """
        await wait_until(self._path, self._path.exists)
        try:
            async with asyncio.timeout(ACCESS_WAIT_S):
                await wait_until(self._path, self._accessible)
        except TimeoutError:
            return

    def _accessible(self) -> bool:
        return os.access(self._path, os.R_OK | os.W_OK, effective_ids=True)


def open_problem(error: Exception, path: str, missing: str, proc: Path = PROC) -> LinkError | None:
    """Return the LinkError of a failed `open`; None if the node is not the cause of the error.

    `missing` is the hint for a missing node. `proc` is searched for the processes that use the node.
    """
    number = errno_of(error)
    if number in MISSING:
        return LinkMissing(f"{path} does not exist: {missing}")
    if number == errno.EPERM:  # EPERM: a device cgroup refuses the node; missing group rights would be EACCES
        return LinkDenied(
            f"cannot open {path}: the control group of this process does not allow the device (EPERM, "
            f"not its group); add a line `DeviceAllow={path} rw` to the unit (`systemctl edit imud`), and restart imud"
        )
    if number in REFUSED:
        return LinkDenied(f"cannot open {path}: user {user_name()} lacks the permission; {_refusal(path)}")
    if number in HELD:
        holders = holders_of(path, proc) or "another program or a driver of the kernel"
        return LinkBusy(f"{path} is in use by {holders}; stop it first")
    return None


def _refusal(path: str) -> str:
    """Return the owner of a node and how to get access: its group, or a udev rule if no group may open the node."""
    with suppress(OSError):
        node = os.stat(path)
        if node.st_gid == 0 or node.st_mode & GROUP_ACCESS != GROUP_ACCESS:
            mode = f"{stat.S_IMODE(node.st_mode):04o}"
            return (
                f"no group may open it (mode {mode}, group {group_of(path, 'root')}); `imud doctor` prints a udev rule"
            )
    group = group_of(path, SERIAL_GROUP)
    return f"it belongs to group {group}; run `sudo usermod -aG {group} {user_name()}` and log in again"


def bus_open_problem(error: OSError, path: str, missing: str) -> LinkError:
    """Return the LinkError of an I2C or SPI bus that cannot be opened. `missing` as in `open_problem`."""
    return open_problem(error, path, missing) or LinkError(f"cannot use {path}: {reason_of(error)}")


def errno_of(error: Exception) -> int | None:
    """Return the error number of an OSError or of a termios.error."""
    if isinstance(error, OSError):
        return error.errno
    return next((argument for argument in error.args if isinstance(argument, int)), None)


def transfer_problem(error: OSError, path: str, place: str) -> LinkError | TransferError:
    """Return the error of a failed transfer: LinkMissing if the bus was removed, otherwise TransferError."""
    if error.errno in GONE:
        return LinkMissing(f"{path} is missing ({os.strerror(error.errno or 0)}): was its adapter unplugged?")
    if error.errno in NOT_ACKNOWLEDGED:
        return TransferError(Trouble.ABSENT, f"no acknowledgement at {place} on {path}; check power and wires")
    if error.errno in STUCK:
        return TransferError(Trouble.STUCK, f"{path} timed out at {place}: is a wire of the bus held low?")
    return TransferError(Trouble.DISTURBED, f"transfer failed at {place} on {path}: {os.strerror(error.errno or 0)}")


def holders_of(path: str, proc: Path = PROC) -> str:
    """Return the processes that use the node and that this user may see, for example `minicom (pid 123)`."""
    target = os.path.realpath(path)
    holders = []
    for process in sorted(proc.glob("[0-9]*")):
        if _has_open(process, target):
            holders.append(f"{_name(process)} (pid {process.name})")
    return ", ".join(holders)


def _words(process: Path) -> list[str]:
    """Return the first words of the command line of a process; empty if it cannot be read."""
    try:
        return (process / "cmdline").read_text("utf-8", "replace").split("\0")
    except OSError:
        return []


def _has_open(process: Path, target: str) -> bool:
    try:
        descriptors = os.listdir(process / "fd")
    except OSError:  # a process of another user, or an ended process
        return False
    return any(_target(process / "fd" / descriptor) == target for descriptor in descriptors)


def _target(descriptor: Path) -> str:
    try:
        return os.readlink(descriptor)
    except OSError:  # closed in the meantime
        return ""


def _name(process: Path) -> str:
    if process.name == str(os.getpid()):
        return OWN_PROCESS
    words = _words(process)
    for place, word in enumerate(words[:-1]):
        if os.path.basename(word) == "imud":  # the word can follow an interpreter and its options
            return f"imud {printable(words[place + 1])}"
    try:
        return printable((process / "comm").read_text("utf-8", "backslashreplace").strip())
    except OSError:
        return "a process"
