"""Reads and writes the regular files that imud uses: never waits for a FIFO or a device, never follows a surprise.

Opening a FIFO waits for its other end, reading /dev/zero never ends, and opening a serial port moves its lines: the
type is looked at before opening, and again afterwards, because the file may have been exchanged in between.
"""

import errno
import os
import select
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

KINDS: Final = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
    (stat.S_ISSOCK, "a socket"),
)
"""What a path may be other than a regular file."""
READ_FLAGS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
WRITE_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


class NotRegularFile(OSError):
    """What stands at a path is no regular file. Example: a FIFO, /dev/zero, a directory."""


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading. Raises OSError, NotRegularFile for what is none."""
    try:
        _check_regular(os.stat(path), path)
        descriptor = os.open(path, READ_FLAGS)
    except ValueError as error:  # a path with a null character
        raise OSError(errno.EINVAL, str(error), "…") from None
    try:
        _check_regular(os.fstat(descriptor), path)
    except OSError:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")


def open_stream(path: str | os.PathLike[str], wait_ms: int) -> BinaryIO:
    """Open a regular file, or a FIFO that a program writes to, which is waited for. Raises OSError, NotRegularFile.

    A FIFO without data and without a writer for `wait_ms` is refused: opening it otherwise would wait without end.
    """
    if not stat.S_ISFIFO(os.stat(path).st_mode):
        return open_regular(path)
    descriptor = os.open(path, READ_FLAGS)
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    if not poll.poll(wait_ms):
        os.close(descriptor)
        raise NotRegularFile(errno.EAGAIN, "is a FIFO that no program writes to", os.fspath(path))
    os.set_blocking(descriptor, True)
    return open(descriptor, "rb")


def read_regular(path: str | os.PathLike[str], bytes_max: int) -> bytes:
    """Return the content of a regular file, `bytes_max` bytes at most. Raises OSError as `open_regular`."""
    with open_regular(path) as file:
        return file.read(bytes_max)


def replace_file(path: Path, content: bytes, *, mode: int = 0o640, owner: tuple[int, int] | None = None) -> None:
    """Write a file that is the old one or the new one, whole, whenever the process or the machine stops.

    With `owner` (uid, gid) it is given to them, and has exactly `mode`; without, the umask takes its bits from `mode`.
    Raises OSError; the old file is left then. What stands at the temporary name is removed, not followed.
    """
    temporary = path.with_name(path.name + ".new")
    with suppress(FileNotFoundError):
        temporary.unlink()
    try:
        with open(os.open(temporary, WRITE_FLAGS, mode), "wb") as file:
            file.write(content)
            if owner is not None:
                _own(file.fileno(), mode, owner)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise


def _own(descriptor: int, mode: int, owner: tuple[int, int]) -> None:
    """Set owner and mode where they differ: a file system without them (vfat) refuses even to keep them."""
    now = os.fstat(descriptor)
    if (now.st_uid, now.st_gid) != owner:
        os.fchown(descriptor, *owner)
    if stat.S_IMODE(now.st_mode) != mode:
        os.fchmod(descriptor, mode)


def _check_regular(status: os.stat_result, path: str | os.PathLike[str]) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise NotRegularFile(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for is_kind, name in KINDS if is_kind(status.st_mode)), "something else")
        raise NotRegularFile(errno.EINVAL, f"is {kind}, expected a regular file", os.fspath(path))
