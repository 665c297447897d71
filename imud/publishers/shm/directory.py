"""The directory that rings are made in: what may be believed of it and of the files in it.

Another user must not be able to stop or mislead the daemon by anything he puts there. In a directory of one's own he
cannot put anything; in a shared one such as /dev/shm (sticky: all may add, owners only may remove) he can. Hence:

- Names are looked up relative to a descriptor of the directory, whose owner and mode are checked once it is open.
- Nothing but a regular file of this user's or root's is opened, never through a symbolic link, never blocking.
- A ring is made whole under a name that nobody can guess, then renamed: whatever has its name gives way, unopened.
- A ring that is in use holds a write lock (open file description, fcntl(2)) until its process ends, however it ends.
  A reader can neither hold that lock nor be taken for its holder. Heartbeat and pid of a header prove nothing.
"""

import fcntl
import logging
import os
import secrets
import stat
import struct
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from imud.errors import ServerError
from imud.formats.ring import DIRECTORY, HEADER_BYTES, OPEN_FLAGS, decode_header, default_directories
from imud.permissions import user_name

log = logging.getLogger(__name__)

LEFTOVERS_MAX: Final = 10_000
"""Entries of the directory that are looked at for leftovers: in a shared directory others may make millions."""

_DIRECTORY_MODE = 0o755
_OPEN_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_CREATE = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_FLOCK = struct.Struct("hhqqi0q")  # struct flock of fcntl(2): type, whence, start, length (0: to the end), pid
_TEMPORARY = ".new"


class RingDirectory:
    """An open directory of rings. Synchronization: one thread."""

    def __init__(self, path: str) -> None:
        """Open `path` and remove what a daemon left there that died while it made a ring.

        Raises ServerError when it is missing, when others may replace files in it, or when this user may not make any.
        """
        self.path = path
        self._fd = _open(path)
        try:
            self._identity = _identity(_checked(self._fd, path))
        except BaseException:  # whatever ended it, the descriptor does not stay open
            os.close(self._fd)
            raise
        self._remove_leftovers()

    @property
    def current(self) -> bool:
        """Whether `path` still names this directory; False after it was removed, renamed or mounted over."""
        try:
            return _identity(os.stat(self.path, follow_symlinks=False)) == self._identity
        except OSError:
            return False

    def names(self, name: str, file: os.stat_result) -> bool:
        """Whether `name` here is `file`."""
        try:
            return _identity(os.stat(name, dir_fd=self._fd, follow_symlinks=False)) == _identity(file)
        except OSError:
            return False

    def refuse_second_writer(self, name: str) -> None:
        """Raise ServerError when another daemon of this user's or root's writes the ring `name`.

        Whatever else has that name is left for `make` to replace.
        """
        try:
            found = os.stat(name, dir_fd=self._fd, follow_symlinks=False)
        except OSError:
            return
        if not _credible(found):
            return
        try:
            descriptor = os.open(name, OPEN_FLAGS, dir_fd=self._fd)
        except OSError:
            return
        try:
            if _credible(os.fstat(descriptor)) and _is_locked(descriptor):
                path = os.path.join(self.path, name)
                raise ServerError(f"{path} is written by another imud, {_process(descriptor)}: stop that one first")
        finally:
            os.close(descriptor)

    def make(self, name: str, size_bytes: int, head: bytes, mode: int, group_id: int | None) -> int:
        """Make the file `name`, locked and whole before it appears, `head` and zeros in it; return its descriptor.

        What has that name is replaced, if this user may. The group is given where this user may. Raises ServerError.
        """
        temporary = f".{name}.{secrets.token_hex(8)}{_TEMPORARY}"
        path = os.path.join(self.path, name)
        try:
            descriptor = os.open(temporary, _CREATE, 0o600, dir_fd=self._fd)
        except OSError as error:
            raise ServerError(f"{path} cannot be made: {error.strerror}; may imud write to {self.path}?") from error
        try:
            _lock(descriptor)
            os.posix_fallocate(descriptor, 0, size_bytes)  # a write into a page that does not fit would raise SIGBUS
            os.pwrite(descriptor, head, 0)
            if group_id is not None:
                with suppress(PermissionError):  # not in the group: the caller sees it by the file's group
                    os.fchown(descriptor, -1, group_id)
            os.fchmod(descriptor, mode)
            self._rename(temporary, name)
        except OSError as error:
            os.close(descriptor)
            with suppress(OSError):
                os.unlink(temporary, dir_fd=self._fd)
            raise ServerError(
                f"{path} cannot be made, {size_bytes} bytes: {error.strerror};"
                f" look at what has its name (ls -ld {path}), at the free space (df {self.path}), or set fewer `slots`"
            ) from error
        return descriptor

    def remove(self, name: str, file: os.stat_result) -> None:
        """Remove `name` if it is `file`; without the right to do so it stays."""
        if self.names(name, file):
            with suppress(OSError):
                os.unlink(name, dir_fd=self._fd)

    def close(self) -> None:
        """Release the descriptor; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _rename(self, temporary: str, name: str) -> None:
        try:
            os.rename(temporary, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except IsADirectoryError:
            os.rmdir(name, dir_fd=self._fd)
            os.rename(temporary, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def _remove_leftovers(self) -> None:
        with os.scandir(self._fd) as entries:
            seen = [entry.name for entry in islice(entries, LEFTOVERS_MAX)]
        for name in seen:
            if name.startswith(".imud.") and name.endswith(_TEMPORARY):
                with suppress(OSError):  # of another user: unlink is refused
                    self._remove_leftover(name)

    def _remove_leftover(self, name: str) -> None:
        if not _credible(os.stat(name, dir_fd=self._fd, follow_symlinks=False)):
            return
        descriptor = os.open(name, OPEN_FLAGS, dir_fd=self._fd)
        try:
            if not _is_locked(descriptor):
                os.unlink(name, dir_fd=self._fd)
        finally:
            os.close(descriptor)


def open_directory(configured: str, environment: Mapping[str, str]) -> RingDirectory:
    """Open the configured directory; instead of the default one, where it cannot be used, the user's own.

    The default ones are made if they are missing. Raises ServerError.
    """
    if configured != DIRECTORY:
        return RingDirectory(configured)
    first, *others = default_directories(environment)
    try:
        return _made(first)
    except ServerError as error:
        for other in others:
            directory = _made(other)
            log.warning("shm: %s; rings are in %s", error, other)
            return directory
        raise


def _made(path: str) -> RingDirectory:
    for level in (Path(path).parent, Path(path)):
        with suppress(OSError):  # it is there, or opening it says what is wrong
            level.mkdir(_DIRECTORY_MODE)
            level.chmod(_DIRECTORY_MODE)  # whatever the umask
    return RingDirectory(path)


def _open(path: str) -> int:
    try:
        return os.open(path, _OPEN_DIRECTORY)
    except PermissionError:
        raise ServerError(f"{path} may not be opened by user {user_name()}; `ls -ld {path}` shows who may") from None
    except OSError as error:
        reason = "a symbolic link" if os.path.islink(path) else error.strerror
        hint = "make it, or set shm.directory"
        raise ServerError(f"{path}: expected a directory for shared memory ({reason}); {hint}") from error


def _checked(descriptor: int, path: str) -> os.stat_result:
    """Status of the directory. Raises ServerError."""
    status = os.fstat(descriptor)
    if status.st_uid not in (0, os.geteuid()):
        raise ServerError(
            f"{path} belongs to user {status.st_uid}, who may replace the rings in it:"
            f" expected root or {user_name()} as its owner; set shm.directory"
        )
    if status.st_mode & _OTHERS_WRITE and not status.st_mode & stat.S_ISVTX:
        raise ServerError(
            f"{path} has mode {stat.S_IMODE(status.st_mode):04o}: others may replace the rings in it; chmod go-w {path}"
        )
    if not os.access(".", os.W_OK | os.X_OK, dir_fd=descriptor):
        raise ServerError(f"{path}: user {user_name()} may not make files there; `ls -ld {path}` shows who may")
    return status


def _credible(status: os.stat_result) -> bool:
    """Whether a daemon of this user's, or root's, can have made the file."""
    return stat.S_ISREG(status.st_mode) and status.st_uid in (0, os.geteuid())


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _lock(descriptor: int) -> None:
    fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))


def _is_locked(descriptor: int) -> bool:
    """Whether a process has a write lock on the file, for which it must have opened it for writing."""
    asked = _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0)
    answer = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, asked)
    assert isinstance(answer, bytes)
    return bool(_FLOCK.unpack(answer)[0] == fcntl.F_WRLCK)


def _process(descriptor: int) -> str:
    try:
        return f"process {decode_header(os.pread(descriptor, HEADER_BYTES, 0), '').pid}"
    except ServerError:
        return "of another version"
