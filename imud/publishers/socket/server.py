"""UNIX socket output: requests in JSON-RPC 2.0, samples as JSON lines or binary slots (docs/socket.md).

    Listener ──accept──▶ Guard, Quota ──▶ ClientConnection ◀──serve── Scheduler;  line ──▶ handle_line ──▶ Hub
    publish(batch) ──▶ Hub ──▶ DeliveryGroup per form ──the same bytes──▶ Outbox per client ──▶ send, or a bounded queue

`publish` sends samples directly. The scheduler does all other work for clients, in pieces and for a limited time per
turn of the event loop. asyncio streams would cost three times as much per sample.
"""

import asyncio
import errno
import logging
import os
import socket
import stat
import struct
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Final

import msgspec

from imud import __version__
from imud.contracts.publisher import PublisherContext, PublisherType
from imud.formats import kernel
from imud.formats.jsonrpc import DEFAULT_PATH, PROTOCOL, Code, RpcError, encode_error, encode_notification, line_of
from imud.model.errors import ServerError, reason_of
from imud.model.host_object import GroupName, HostObject, names
from imud.model.options import Options, shown
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.socket.admission import (
    Guard,
    Quota,
    RateLimitedLog,
    Rights,
    gid_of,
    peer_of,
    raise_fd_limit,
)
from imud.publishers.socket.client import ClientConnection
from imud.publishers.socket.history import History
from imud.publishers.socket.hub import Hub
from imud.publishers.socket.messages import Greeting
from imud.publishers.socket.methods import handle_line
from imud.publishers.socket.outbox import Limits, Pool
from imud.publishers.socket.scheduler import SERVING_BURST_NS, SERVING_PER_S_NS, Scheduler, TokenBucket

log = logging.getLogger(__name__)

BACKLOG: Final = 128
SOCKET_MODE: Final = 0o660
DIRECTORY_MODE: Final = 0o755
PID_DIGITS: Final = 7
"""Maximum digits of a process number: 4,194,304 (proc(5), pid_max)."""
PATH_MAX_BYTES: Final = 107 - len(".") - PID_DIGITS
"""Maximum length of `socket.path`, bytes. An address has 107 bytes and a zero (unix(7)), and the name that imud binds
has the process number in addition."""
ACL_XATTR: Final = "system.posix_acl_access"
_ACL_HEADER: Final = struct.Struct("<I")
_ACL_ENTRY: Final = struct.Struct("<HHI")
_ACL_VERSION: Final = 2
_USER_OBJ, _GROUP_OBJ, _GROUP, _MASK, _OTHER = 0x01, 0x04, 0x08, 0x10, 0x20
"""Tags of ACL entries (linux/posix_acl.h). The kernel expects the entries in this order."""
_RW: Final = 6
_NO_ID: Final = 0xFFFF_FFFF
PROBE_TIMEOUT_S: Final = 0.5
"""Time limit of a test connection, s. The kernel accepts it immediately unless the backlog is full."""


class Listener:
    """The socket file at `path`: mode 0660, group `group`, an ACL entry for `control_group` if the group exists.

    The kernel refuses other users at connect(2). If `accept` refused them, they could fill the common backlog, and each
    attempt would cost the daemon 20 µs. Raises ServerError, and removes its file, if it cannot listen.
    """

    # imud binds the file as imud.sock.PID and renames it at the end. With the final name, it would refuse clients
    # before `listen`, and have a wrong mode and group for a moment.
    #
    # If two daemons start at the same time, the second sees the socket of the first. If both check before one of them
    # renames, the first sees after its rename that its file was replaced. A window of two system calls remains: if the
    # second renames after the last check of the first, the first serves a socket that no client finds.

    def __init__(self, path: Path, group: str, control_group: GroupName = "") -> None:
        self.path = path
        _check_length(path)
        _make_directory(path.parent)
        _check_free(path)
        _remove_leftovers(path)
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._name = os.fsencode(path)
        self._file = path.with_name(f"{path.name}.{os.getpid()}")
        self._inode = (0, 0)
        try:
            self._listen(group, control_group)
            self._rename_file()
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
        _set_acl(self._file, self.path, gid_of(control_group))
        self.sock.listen(BACKLOG)

    def _rename_file(self) -> None:
        """Rename the file to `path`. Raises ServerError if another daemon serves `path`, before or just after."""
        left_behind = _check_free(self.path)
        self._file.rename(self.path)
        self._file = self.path
        if _inode_of(self.path) != self._inode:
            raise ServerError(f"another daemon has just taken {self.path}; set another socket.path for one of them")
        if left_behind:
            log.info("replaced the socket %s of a daemon that no longer runs", self.path)

    def has_file(self) -> bool:
        """Return whether `path` still names the socket file of this listener."""
        return kernel.is_at(self._name, *self._inode)

    def close(self) -> None:
        """Stop listening, and remove the file if it is still ours. A second call does nothing."""
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
    found = os.lstat(path)
    return found.st_dev, found.st_ino


def _make_directory(directory: Path) -> None:
    try:
        directory.mkdir(DIRECTORY_MODE, parents=True, exist_ok=True)
    except OSError as error:
        raise ServerError(
            f"cannot make the directory {directory} for the socket: {error.strerror}; run imud as a service "
            f"(RuntimeDirectory= makes the directory), or set socket.path to a writable directory"
        ) from error


def _check_length(path: Path) -> None:
    size_bytes = len(os.fsencode(path))
    if size_bytes > PATH_MAX_BYTES:
        raise ServerError(f"socket.path: expected at most {PATH_MAX_BYTES} bytes, got {size_bytes}: {path}")


def _check_free(path: Path) -> bool:
    """Return whether `path` is the socket of a dead daemon. Raises ServerError for other files and live daemons."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ServerError(f"cannot check {path}: {error.strerror}") from error
    if not stat.S_ISSOCK(mode):
        raise ServerError(
            f"cannot make the socket {path}: another kind of file has this name; remove it, or set another socket.path"
        )
    if _is_alive(path):
        raise ServerError(f"another daemon serves {path}; stop it (systemctl stop imud), or set another socket.path")
    return True


def _remove_leftovers(path: Path) -> None:
    """Remove temporary sockets of daemons that died during their start."""
    for file in path.parent.glob("*"):
        stem, _, number = file.name.rpartition(".")
        if stem == path.name and number.isdecimal() and _is_leftover(file, int(number)):
            with suppress(OSError):  # harmless; if it has our process number, `bind` reports it
                file.unlink()
                log.info("removed %s of a daemon that died during its start", file)


def _is_leftover(file: Path, pid: int) -> bool:
    """Return whether the process of a socket is dead. In a container, a dead process often had our process number."""
    # a daemon in another container is invisible: between its `bind` and `listen`, its start fails
    if pid != os.getpid() and Path(f"/proc/{pid}").exists():
        return False
    try:
        return file.is_socket() and not _is_alive(file)
    except ServerError:  # no permission
        return False


def _is_alive(path: Path) -> bool:
    """Return whether a process listens. Raises ServerError if a connection is impossible for another reason."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PROBE_TIMEOUT_S)
        try:
            probe.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except (TimeoutError, BlockingIOError):  # the backlog is full, so a daemon runs
            return True
        except OSError as error:
            raise ServerError(f"cannot check whether a daemon serves {path}: {_reason(error, path)}") from error
    return True


def _set_access(file: Path, path: Path, group: str) -> None:
    """Set mode and group of `file`, which becomes `path`."""
    file.chmod(SOCKET_MODE)
    gid = gid_of(group)
    if gid is None:
        log.warning(
            "group %r (socket.group) does not exist: only root and the daemon's own user can read from %s; "
            "make it with `sudo groupadd --system %s`, then restart imud",
            group, path, group,
        )  # fmt: skip
        return
    try:
        os.chown(file, -1, gid)
    except PermissionError:
        log.warning("cannot give %s to group %r: the daemon's user is not a member of it", path, group)


def _set_acl(file: Path, path: Path, gid: int | None) -> None:
    """Let the members of another group connect, by an ACL (acl(5)). Do nothing if `gid` is None."""
    if gid is None:
        return
    entries = ((_USER_OBJ, _RW, _NO_ID), (_GROUP_OBJ, _RW, _NO_ID), (_GROUP, _RW, gid), (_MASK, _RW, _NO_ID),
               (_OTHER, 0, _NO_ID))  # fmt: skip
    acl = _ACL_HEADER.pack(_ACL_VERSION) + b"".join(_ACL_ENTRY.pack(*entry) for entry in entries)
    try:
        os.setxattr(file, ACL_XATTR, acl)
    except OSError as error:
        log.warning(
            "cannot set the ACL of %s: %s; add the members of socket.control_group to socket.group",
            path, error.strerror,
        )  # fmt: skip


def _reason(error: OSError, file: Path) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"the file {file} exists; remove it"
    return error.strerror or str(error)


ACCEPTS_PER_TURN: Final = 16
ACCEPT_NS: Final = 300_000
"""Maximum time of accepting clients in one turn of the event loop, ns: three clients with their greetings."""
MIB: Final = 1 << 20
CHECK_NS: Final = NS_PER_S - 50 * NS_PER_MS
"""Minimum time between two checks of the socket file, ns: each second tick in a quiet state."""


class SocketOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the UNIX socket."""

    enabled: bool = True
    """Whether imud serves the socket."""
    path: Annotated[
        str,
        msgspec.Meta(pattern="^/.*[^/]$", extra={"words": "an absolute path"} | names(HostObject.SERVER_SOCKET)),
    ] = DEFAULT_PATH
    """Absolute path of the socket."""
    group: GroupName = "imud"
    """Group that may read. The socket file belongs to it."""
    control_group: GroupName = "imud-control"
    """Group that may also control devices: commands, settings, calibrations, recordings."""
    clients_max: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 256
    """Maximum number of clients. imud refuses more clients with an error."""
    clients_per_user: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 128
    """Maximum number of clients of one user. It does not apply to root and the daemon's own user."""
    memory_mb: Annotated[int, msgspec.Meta(ge=8, le=4096)] = 64
    """Maximum memory for all clients, MiB: queues, requests, and unfinished replies."""
    queue_samples: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 4096
    """Maximum queue of a client that does not read, samples: 4096 are 4 s at 1 kHz. imud drops the oldest samples."""
    queue_bytes: Annotated[int, msgspec.Meta(ge=4096, le=1 << 30)] = 4 << 20
    """Maximum queue of a client that does not read, bytes."""
    history: bool | None = None
    """Whether imud keeps minimum and maximum of each second of the last hour for the plots of `imud web`: 0.7 MB for
    each device, at most 64 MB. Default: only with the C kernel, because Python code needs 35 % more CPU time."""

    def __post_init__(self) -> None:
        """Raise ValueError if the path is too long for a socket."""
        if len(os.fsencode(self.path)) > PATH_MAX_BYTES:
            size = len(os.fsencode(self.path))
            raise ValueError(f"path: expected at most {PATH_MAX_BYTES} bytes, got {size}: {shown(self.path)}")


class SocketServer:
    """Serves clients on a UNIX socket. Synchronization: the event loop's thread."""

    def __init__(self, settings: SocketOptions, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        own_uid = os.geteuid()
        self._quota = Quota(
            settings.clients_max, settings.clients_per_user, own_uid, raise_fd_limit(), context.clock.now_ns
        )  # fmt: skip
        self._time = TokenBucket(SERVING_PER_S_NS, SERVING_BURST_NS, context.clock.now_ns(), SERVING_BURST_NS)
        limits = Limits(settings.queue_samples, settings.queue_bytes)
        pool = Pool(settings.memory_mb * MIB, limits)
        self.hub = Hub(settings.path, context, self._quota, self._time, pool, handle_line)
        has_history = kernel.present.module is not None if settings.history is None else settings.history
        if has_history:  # a reload of the section `socket` makes a new server, which continues the history
            self.hub.history = context.kept.setdefault("history", History(context.devices))
        else:
            context.kept.pop("history", None)
        # direct references: a method of this class would cost one more call per batch
        self.publish: Final = self.hub.publish
        self.event: Final = self.hub.event
        self.add_device: Final = self.hub.add_device
        self.remove_device: Final = self.hub.remove_device
        self._scheduler: Scheduler | None = None
        self._listener: Listener | None = None
        self._guard = Guard(own_uid, None, None)
        self._needs_ticks = False  # whether a client or the pause needs the next tick within 100 ms
        self._paused = False  # whether imud accepts no client until the next tick
        self._pauses = RateLimitedLog(context.clock.now_ns)
        self._file_problem = ""  # why imud cannot create the removed socket file again
        self._check_ns = 0  # CLOCK_MONOTONIC of the next check of the socket file

    def start(self) -> None:
        """Listen. Raises ServerError, and leaves no file behind, if that is not possible."""
        settings = self._settings
        self._guard = Guard(os.geteuid(), gid_of(settings.group), gid_of(settings.control_group))
        self._name_control_group(settings.control_group)
        if self.hub.history is not None:
            self.hub.history.retain(self.hub.devices)
        self._listener = self._listen()
        self._scheduler = Scheduler(self._context.clock.now_ns, self._context.clock.cpu_ns, self._time)
        asyncio.get_running_loop().add_reader(self._listener.sock, self._accept)
        self._context.outputs.clients.append(self.hub.clients)

    def _listen(self) -> Listener:
        return Listener(Path(self._settings.path), self._settings.group, self._settings.control_group)

    def _replace_file(self, listener: Listener) -> None:
        """Create a removed socket file again. Connected clients are not affected."""
        try:
            new = self._listen()
        except ServerError as error:
            if str(error) != self._file_problem:
                log.error("socket: the file %s was removed or replaced: %s; trying again", listener.path, error)
            self._file_problem = str(error)
            return
        self._accept()  # clients that connected before the removal
        loop = asyncio.get_running_loop()
        loop.remove_reader(listener.sock)
        listener.close()
        self._listener, self._paused, self._file_problem = new, False, ""
        loop.add_reader(new.sock, self._accept)
        log.warning("socket: the file %s was removed or replaced; created it again", new.path)

    def _name_control_group(self, group: str) -> None:
        """Set the name of the group for error messages. Warn if the group does not exist."""
        self.hub.control_group = f"group {group!r}"
        if self._guard.control_gid is None:
            hint = f"make it with `sudo groupadd --system {group}`, then restart imud"
            self.hub.control_group += f", which does not exist on this host; {hint}"
            log.warning("group %r (socket.control_group) does not exist: only root can change things; %s", group, hint)

    def tick(self, now_ns: int) -> None:
        """Close lingering clients, fill allowances, and accept clients again after a pause. The limits of clients count
        ticks of 100 ms: request them while a client lingers or waits for its allowance. Otherwise once per second."""
        hub, scheduler, listener, is_due = self.hub, self._scheduler, self._listener, now_ns >= self._check_ns
        if scheduler is None or listener is None:
            return
        if not (is_due or self._needs_ticks or hub.ending or hub.recordings.running or scheduler.parked):
            return
        needs_ticks = hub.tick(now_ns)
        self._needs_ticks = needs_ticks = scheduler.tick() or needs_ticks
        hub.pool.trim()
        if needs_ticks:
            self._context.owner.tick_soon()
        self._quota.tick()
        if is_due:
            self._check_ns = now_ns + CHECK_NS
            if hub.history is not None:
                hub.history.tick()
            if not listener.has_file():
                self._replace_file(listener)
        if self._paused:
            self._paused = False
            asyncio.get_running_loop().add_reader(listener.sock, self._accept)

    def close(self) -> None:
        """Stop listening, close every client, remove the socket file if it is ours. A second call does nothing."""
        if self._listener is None or self._scheduler is None:
            return
        asyncio.get_running_loop().remove_reader(self._listener.sock)
        self._listener.close()
        self._listener = None
        self.hub.close()
        self._scheduler.close()
        self._context.outputs.clients.remove(self.hub.clients)

    # --- clients ----------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        now_ns = self._context.clock.now_ns
        end_ns = now_ns() + ACCEPT_NS
        for _ in range(ACCEPTS_PER_TURN):
            if self._listener is None or now_ns() > end_ns:
                return
            try:
                sock, _address = self._listener.sock.accept()
            except BlockingIOError:
                return
            except OSError as error:
                self._pause(error)
                return
            sock.setblocking(False)
            self._let_in(sock)

    def _pause(self, error: OSError) -> None:
        """Accept no client until the next tick. Without a pause, a lack of descriptors would cause a busy loop."""
        assert self._listener is not None
        count = self._pauses.count()
        if count:
            log.warning("cannot accept a client: %s (%d times since the last report)", error.strerror, count)
        asyncio.get_running_loop().remove_reader(self._listener.sock)
        self._paused = self._needs_ticks = True
        self._context.owner.tick_soon()

    def _let_in(self, sock: socket.socket) -> None:
        """Greet a new client, or refuse it. Do nothing if it has already left."""
        hub = self.hub
        connection: ClientConnection | None = None
        try:
            try:
                peer = peer_of(sock)
            except OSError:  # the client has left
                sock.close()
                return
            rights = self._guard.rights_of(peer)
            if Rights.READ not in rights:
                message = f"uid {peer.uid} may not read: expected root or a member of group {self._settings.group!r}"
                raise RpcError(Code.DENIED, message)
            places = list(map(attrgetter("place"), hub.connections.values()))
            place = self._quota.admit(peer, rights, sock.fileno(), places)
            assert self._scheduler is not None
            connection = ClientConnection(sock, peer, rights, place, hub, self._scheduler)
            hub.connections[connection.number] = connection
            names = str(rights.name).lower().split("|")  # the name of two rights is READ|CONTROL
            greeting = Greeting(PROTOCOL, __version__, hub.context.epoch, names)
            connection.post(encode_notification("hello", greeting))
        except RpcError as refusal:
            hub.refused += 1
            _refuse(sock, refusal)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            if connection is not None:
                connection.on_failure(error)
            else:
                hub.count_failed(error)
                sock.close()


def _refuse(sock: socket.socket, error: RpcError) -> None:
    """Send the reason and close. The buffer of a new socket has room for the line."""
    try:
        sock.send(line_of(encode_error(error)))
    except OSError as problem:
        log.debug("a refused client left before the reply: %s", reason_of(problem))
    sock.close()


PUBLISHER = PublisherType("socket", SocketOptions, SocketServer, required=True)
