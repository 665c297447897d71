"""Reads and writes of regular files, without waiting for FIFOs or devices and without following replaced paths.

Opening a FIFO waits for its other end, a read of /dev/zero never ends, and opening a serial port changes its modem
lines. imud therefore checks the type before it opens a path. It checks the type again after opening, because another
program may replace the file in between.
"""

import errno
import grp
import logging
import os
import pwd
import queue
import select
import stat
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

import msgspec

from imud.model.errors import reason_of

# Names of file types other than regular files
KINDS: Final = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
    (stat.S_ISSOCK, "a socket"),
)
READ_FLAGS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
WRITE_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


# `errno` of an error that only imud reports. `reason_of` shows the text of such an error.
NO_ERRNO: Final = 0


class NotRegularFile(OSError):
    """Path of a file that is not regular. Example: a FIFO, /dev/zero, a directory."""


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading. Raises OSError; NotRegularFile for other types."""
    try:
        _check_regular(os.stat(path), path)
        descriptor = os.open(path, READ_FLAGS)
    except ValueError as error:  # a path with a null character
        raise OSError(NO_ERRNO, str(error), "…") from None
    try:
        _check_regular(os.fstat(descriptor), path)
    except OSError:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")


def open_stream(path: str | os.PathLike[str], wait_ms: int) -> BinaryIO:
    """Open a regular file, or a FIFO with a writer, for reading. Raises OSError, NotRegularFile. Rejects a FIFO without
    data and without a writer after `wait_ms`. Otherwise opening it would wait forever."""
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
    """Return at most `bytes_max` bytes of a regular file. Raises the errors of `open_regular`."""
    with open_regular(path) as file:
        return file.read(bytes_max)


class FileTooLong(OSError):
    """Regular file that is longer than expected."""


def read_regular_file(path: str | os.PathLike[str], bytes_max: int) -> bytes:
    """Return the complete content of a regular file. Raises FileTooLong if it is longer than `bytes_max`, and the
    errors of `open_regular`. It never waits for a FIFO or a device: use it for each file that a user names."""
    content = read_regular(path, bytes_max + 1)
    if len(content) > bytes_max:
        raise FileTooLong(NO_ERRNO, f"expected at most {bytes_max} bytes, got more", os.fspath(path))
    return content


def replace_file(path: Path, content: bytes, *, mode: int = 0o640, owner: tuple[int, int] | None = None) -> None:
    """Replace a file atomically: after a crash, the path contains the complete old or the complete new file.

    With `owner` (uid, gid), the file has this owner and exactly `mode`. Without `owner`, the umask reduces `mode`.
    Raises OSError and keeps the old file. Removes a file with the temporary name and does not follow it.
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
    """Set owner and mode only if they differ: a file system without owners (vfat) rejects every change."""
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
        raise NotRegularFile(NO_ERRNO, f"is {kind}, expected a regular file", os.fspath(path))


_OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH


def can_replace(status: os.stat_result, path: str | os.PathLike[str], content: str) -> str:
    """Return why other users can replace the files of a directory; empty if only root and this user can. `content`
    names the files. In a directory with the sticky bit, other users can create files, but not replace them."""
    if status.st_uid not in (0, os.geteuid()):
        wanted = " or ".join(dict.fromkeys(("root", user_name())))
        return (
            f"{os.fspath(path)} belongs to user {status.st_uid}, who can replace {content}: expected {wanted} as its "
            "owner"
        )
    if status.st_mode & _OTHERS_WRITE and not status.st_mode & stat.S_ISVTX:
        mode = f"{stat.S_IMODE(status.st_mode):04o}"
        return f"{os.fspath(path)} has mode {mode}: other users can replace {content}; chmod go-w {os.fspath(path)}"
    return ""


GROUP_ACCESS: Final = stat.S_IRGRP | stat.S_IWGRP  # bits of a mode that let the group read and write


def group_of(path: str, otherwise: str) -> str:
    """Return the name of the node's group; `otherwise` for the group root or an unknown group."""
    try:
        gid = os.stat(path).st_gid
        return grp.getgrgid(gid).gr_name if gid else otherwise
    except (OSError, KeyError):
        return otherwise


def user_name() -> str:
    """Return the name of the user of this process, or the number of a user without a name."""
    uid = os.geteuid()
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


log = logging.getLogger(__name__)

FILE_BYTES_MAX = 1 << 20  # maximum size of a state file, bytes. 256 devices need about 20 kB.
SAVE_LIMIT_S = 1.0  # maximum time that the daemon waits at its end for a slow disk, s

T = TypeVar("T")


class StateFile:
    """JSON file. Errors are logged and lose only the content. Synchronization: the thread of the event loop."""

    def __init__(self, file: Path | None, thread: str, without: str, *, mode: int = 0o640) -> None:
        """`file` None: no reads and writes. `without` describes the next start without the content, for messages.
        `mode`: permissions of the file, which the umask reduces."""
        self._file = file
        self._without = without
        self._mode = mode
        self._contents: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._problem = ""  # reported reason why imud cannot write the file; empty if it can
        if file is not None:
            self._thread = threading.Thread(target=self._save, args=(file,), name=thread, daemon=True)
            self._thread.start()

    def read(self, content_type: type[dict[str, T]]) -> dict[str, T]:
        """Return the content; empty if there is no valid file."""
        if self._file is None:
            return {}
        try:
            return msgspec.json.decode(read_regular(self._file, FILE_BYTES_MAX), type=content_type)
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.DecodeError, UnicodeError, RecursionError) as error:
            reason = reason_of(error) if isinstance(error, OSError) else "it does not contain the JSON that imud writes"
            log.warning("cannot use %s: %s; %s", self._file, reason, self._without)
            return {}

    def write(self, content: object) -> None:
        """Queue the content for the thread, which writes only the newest content."""
        if self._thread is not None:
            self._contents.put(msgspec.json.encode(content))

    def close(self) -> None:
        """Wait up to SAVE_LIMIT_S until the file is written. A second call does nothing."""
        if self._thread is not None:
            self._contents.put(None)
            self._thread.join(SAVE_LIMIT_S)
            self._thread = None

    def _save(self, file: Path) -> None:
        """Check the directory, then write the newest content of the queue. Runs in the thread."""
        self._try(file, lambda: tempfile.TemporaryFile(dir=file.parent).close())
        while (content := self._contents.get()) is not None:
            ended = False
            while not ended and not self._contents.empty():
                newer = self._contents.get()
                ended, content = newer is None, newer or content
            self._try(file, partial(replace_file, file, content, mode=self._mode))
            if ended:
                return

    def _try(self, file: Path, write: Callable[[], None]) -> None:
        """Create the directory and write. Report each new problem once."""
        before, self._problem = self._problem, ""
        try:
            file.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
            write()
        except OSError as error:
            self._problem = reason_of(error)
        if self._problem and self._problem != before:
            log.warning(
                "cannot write %s: %s; after the next start %s; set state_dir to a directory that this user can write",
                file, self._problem, self._without,
            )  # fmt: skip
