"""A listening UNIX socket in the file system: replaces a dead one's, never a live one's, removes only its own.

The file appears whole. Bound in its place, it would refuse clients that connect before `listen`, and have the wrong
mode and group for a moment. So it is bound beside its place, as `imud.sock.PID`, and renamed when all is done.

Of two daemons that start at the same moment the second sees the first's socket, before its rename at the latest; if
both looked before either renamed, the one whose file was replaced sees that after its own rename. What remains: the
second's rename comes after both looks of the second and the first. The first then serves a socket that no client finds.
No system call renames over dead sockets only; the window is that of two system calls.
"""

import errno
import logging
import os
import socket
import stat
import struct
from contextlib import suppress
from pathlib import Path
from typing import Final

from imud.errors import ServerError
from imud.publishers.socket.rights import gid_of

log = logging.getLogger(__name__)

BACKLOG: Final = 128
SOCKET_MODE: Final = 0o660
DIRECTORY_MODE: Final = 0o755
PID_DIGITS: Final = 7
"""The kernel's largest limit of process numbers is 4,194,304 (proc(5), pid_max)."""
PATH_MAX_BYTES: Final = 107 - len(".") - PID_DIGITS
"""An address has room for 107 bytes and a zero (unix(7)); the name it is bound by is longer by the process number."""
ACL_XATTR: Final = "system.posix_acl_access"
_ACL_HEADER: Final = struct.Struct("<I")
_ACL_ENTRY: Final = struct.Struct("<HHI")
_ACL_VERSION: Final = 2
_USER_OBJ, _GROUP_OBJ, _GROUP, _MASK, _OTHER = 0x01, 0x04, 0x08, 0x10, 0x20
"""Tags of entries (linux/posix_acl.h), which stand in this order."""
_RW: Final = 6
_NO_ID: Final = 0xFFFF_FFFF
PROBE_TIMEOUT_S: Final = 0.5
"""A live daemon's kernel answers a connect at once; a full backlog waits, and is a sign of life."""


class Listener:
    """Owns the socket file at `path`, mode 0660, group `group` and an ACL entry for `control_group` where these exist.

    The kernel refuses all others when they connect. A file open to every user, with the check left to `accept`, would
    let them fill the backlog, which is one for all, and cost the daemon some 20 µs for each attempt.
    Raises ServerError, and leaves nothing bound then.
    """

    def __init__(self, path: Path, group: str, control_group: str = "") -> None:
        self.path = path
        _check_length(path)
        _make_directory(path.parent)
        _check_free(path)
        _remove_leftovers(path)
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._file = path.with_name(f"{path.name}.{os.getpid()}")
        self._inode = (0, 0)
        try:
            self._listen(group, control_group)
            self._take_place()
        except OSError as error:
            self.close()
            raise ServerError(f"cannot serve at {path}: {_reason(error, self._file)}") from error
        except ServerError:
            self.close()
            raise

    def _listen(self, group: str, control_group: str) -> None:
        self.sock.setblocking(False)
        self.sock.bind(os.fspath(self._file))
        self._inode = _inode_of(self._file)
        _set_access(self._file, self.path, group)
        _admit(self._file, self.path, gid_of(control_group))
        self.sock.listen(BACKLOG)

    def _take_place(self) -> None:
        """Rename the file to its place. Raises ServerError when another daemon is there, before or right after."""
        left_behind = _check_free(self.path)
        self._file.rename(self.path)
        self._file = self.path
        if _inode_of(self.path) != self._inode:
            raise ServerError(f"another daemon took {self.path} just now: give each a socket.path of its own")
        if left_behind:
            log.info("replaced the socket that a daemon left behind at %s", self.path)

    def close(self) -> None:
        """Stop listening and remove the file if it is still ours; may be called twice."""
        if self.sock.fileno() < 0:
            return
        try:
            if self._inode == _inode_of(self._file):
                self._file.unlink()
        except FileNotFoundError:
            pass
        except OSError as error:
            log.warning("cannot remove %s: %s", self._file, error.strerror)
        self.sock.close()


def _inode_of(path: Path) -> tuple[int, int]:
    found = path.lstat()
    return found.st_dev, found.st_ino


def _make_directory(directory: Path) -> None:
    try:
        directory.mkdir(DIRECTORY_MODE, parents=True, exist_ok=True)
    except OSError as error:
        raise ServerError(
            f"cannot make the directory {directory} for the socket: {error.strerror}; run imud as a service, whose "
            f"RuntimeDirectory= makes it, or give socket.path a place this user may write to"
        ) from error


def _check_length(path: Path) -> None:
    size_bytes = len(os.fsencode(path))
    if size_bytes > PATH_MAX_BYTES:
        raise ServerError(f"a socket path has at most {PATH_MAX_BYTES} bytes, this one has {size_bytes}: {path}")


def _check_free(path: Path) -> bool:
    """Whether a dead daemon left a socket there. Raises ServerError for a live one's and for other files."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ServerError(f"cannot look at {path}: {error.strerror}") from error
    if not stat.S_ISSOCK(mode):
        raise ServerError(f"{path} is in the way: expected a socket or nothing, found another kind of file")
    if _is_alive(path):
        raise ServerError(
            f"another daemon serves {path}: stop it first (systemctl stop imud), or set another socket.path"
        )
    return True


def _remove_leftovers(path: Path) -> None:
    """Remove what daemons that died while they started have left beside `path`."""
    for file in path.parent.glob("*"):
        stem, _, number = file.name.rpartition(".")
        if stem == path.name and number.isdecimal() and _is_leftover(file, int(number)):
            with suppress(OSError):  # harmless, unless it has our own number; then `bind` reports it
                file.unlink()
                log.info("removed %s, left behind by a daemon that died while it started", file)


def _is_leftover(file: Path, pid: int) -> bool:
    """Whether a socket's process is dead, or has died and passed its number on to us, as in a container's every start.

    Another container's processes cannot be seen from here; if it is between its `bind` and `listen`, it has to start
    again.
    """
    if pid != os.getpid() and Path(f"/proc/{pid}").exists():
        return False
    try:
        return file.is_socket() and not _is_alive(file)
    except ServerError:  # not accessible to us
        return False


def _is_alive(path: Path) -> bool:
    """Whether a process listens. Raises ServerError where that cannot be determined."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PROBE_TIMEOUT_S)
        try:
            probe.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except (TimeoutError, BlockingIOError):
            return True
        except OSError as error:
            raise ServerError(f"cannot determine whether {path} is in use: {_reason(error, path)}") from error
    return True


def _set_access(file: Path, path: Path, group: str) -> None:
    """Mode and group of `file`, which is to become `path`."""
    file.chmod(SOCKET_MODE)
    gid = gid_of(group)
    if gid is None:
        log.warning(
            "no group %r (socket.group): only root and the daemon's own user can read from %s; "
            "`sudo groupadd --system %s` makes it, then imud has to be restarted",
            group, path, group,
        )  # fmt: skip
        return
    try:
        os.chown(file, -1, gid)
    except PermissionError:
        log.warning("cannot give %s to group %r: the daemon's user is not a member of it", path, group)


def _admit(file: Path, path: Path, gid: int | None) -> None:
    """Let members of a further group connect, by an ACL (acl(5)); no-op for None."""
    if gid is None:
        return
    entries = ((_USER_OBJ, _RW, _NO_ID), (_GROUP_OBJ, _RW, _NO_ID), (_GROUP, _RW, gid), (_MASK, _RW, _NO_ID),
               (_OTHER, 0, _NO_ID))  # fmt: skip
    acl = _ACL_HEADER.pack(_ACL_VERSION) + b"".join(_ACL_ENTRY.pack(*entry) for entry in entries)
    try:
        os.setxattr(file, ACL_XATTR, acl)
    except OSError as error:
        log.warning(
            "cannot give %s an ACL (%s): members of the control group must be members of the read group too",
            path, error.strerror,
        )  # fmt: skip


def _reason(error: OSError, file: Path) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"{file} is in the way, remove it"
    return error.strerror or str(error)
