"""A listening UNIX socket in the file system: replaces a dead one's, never a live one's, removes only its own."""

import errno
import logging
import os
import socket
import stat
from pathlib import Path
from typing import Final

from imud.errors import ServerError
from imud.publishers.rights import gid_of

log = logging.getLogger(__name__)

BACKLOG: Final = 128
SOCKET_MODE: Final = 0o660
DIRECTORY_MODE: Final = 0o755
PROBE_TIMEOUT_S: Final = 0.5
"""A live daemon's kernel answers a connect at once; a full backlog waits, and is a sign of life."""


class Listener:
    """Owns the socket file at `path`, mode 0660, group `group` where that exists.

    Raises ServerError, and leaves nothing bound then.
    """

    def __init__(self, path: Path, group: str) -> None:
        self.path = path
        _make_directory(path.parent)
        _clear(path)
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._inode = (0, 0)
        try:
            self.sock.setblocking(False)
            self.sock.bind(os.fspath(path))
            self._inode = _inode_of(path)
            _set_access(path, group)
            self.sock.listen(BACKLOG)  # only now can anybody connect
        except OSError as error:
            self.close()
            raise ServerError(f"cannot serve at {path}: {_reason(error, path)}") from error

    def close(self) -> None:
        """Stop listening and remove the file if it is still ours; may be called twice."""
        if self.sock.fileno() < 0:
            return
        try:
            if self._inode == _inode_of(self.path):
                self.path.unlink()
        except FileNotFoundError:
            pass
        except OSError as error:
            log.warning("cannot remove %s: %s", self.path, error.strerror)
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


def _clear(path: Path) -> None:
    """Remove the socket of a daemon that is dead. Raises ServerError for a live one's and for other files."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise ServerError(f"cannot look at {path}: {error.strerror}") from error
    if not stat.S_ISSOCK(mode):
        raise ServerError(f"{path} is in the way: expected a socket or nothing, found another kind of file")
    if _is_alive(path):
        raise ServerError(
            f"another daemon serves {path}: stop it first (systemctl stop imud), or set another socket.path"
        )
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ServerError(f"cannot replace the stale socket {path}: {error.strerror}") from error
    log.info("replaced the socket that a daemon left behind at %s", path)


def _is_alive(path: Path) -> bool:
    """Whether somebody listens. Raises ServerError where that cannot be told."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PROBE_TIMEOUT_S)
        try:
            probe.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except (TimeoutError, BlockingIOError):
            return True
        except OSError as error:
            raise ServerError(f"cannot tell whether {path} is in use: {_reason(error, path)}") from error
    return True


def _set_access(path: Path, group: str) -> None:
    path.chmod(SOCKET_MODE)
    gid = gid_of(group)
    if gid is None:
        log.warning("no group %r: only root and the daemon's own user can read from %s", group, path)
        return
    try:
        os.chown(path, -1, gid)
    except PermissionError:
        log.warning("cannot give %s to group %r: the daemon's user is not a member of it", path, group)


def _reason(error: OSError, path: Path) -> str:
    if error.errno == errno.EADDRINUSE:
        return "another daemon took it just now"
    if error.errno is None:  # Python's own check of the length
        return f"{error}: a socket path has at most 107 bytes, this one {len(os.fsencode(path))}"
    return error.strerror or str(error)
