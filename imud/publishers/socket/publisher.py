"""The UNIX socket publisher: JSON-RPC 2.0 for questions, samples as JSON lines or binary slots (docs/socket.md).

    Listener ──accept──▶ Guard, Quota ──▶ Connection ◀──its turn── Scheduler;  line ──▶ rpc.handle_line ──▶ Hub
    publish(batch) ──▶ Hub ──▶ DeliveryGroup per form ──the same bytes──▶ Outbox per client ──▶ send, or a bounded queue

Samples go out while they are published; everything else that clients cause is done by the scheduler (serving.py), in
pieces and in a limited time per turn of the event loop. No asyncio streams: measured elsewhere, they cost three times
as much per sample.
"""

import asyncio
import logging
import os
import socket
from pathlib import Path
from typing import Annotated, Final

import msgspec

from imud.contracts.publisher import PublisherContext, PublisherType
from imud.contracts.settings import Settings, shown
from imud.errors import reason_of
from imud.event import Event
from imud.formats.jsonrpc import DEFAULT_PATH, Code, RpcError, encode_error, line_of
from imud.publishers.socket.connection import Connection, ServerSide
from imud.publishers.socket.hub import Hub
from imud.publishers.socket.listener import PATH_MAX_BYTES, Listener
from imud.publishers.socket.outbox import Limits, Pool
from imud.publishers.socket.quota import Quota, Seldom, Shares, raise_fd_limit
from imud.publishers.socket.rights import Guard, Peer, Rights, gid_of, peer_of
from imud.publishers.socket.rpc import handle_line, hello
from imud.publishers.socket.serving import SERVING_BURST_NS, SERVING_PER_S_NS, Scheduler, TokenBucket

log = logging.getLogger(__name__)

ACCEPTS_PER_TURN: Final = 16
ACCEPT_NS: Final = 300_000
"""Accepting in one turn of the event loop, three clients with their greetings."""
MIB: Final = 1 << 20


class SocketSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the UNIX socket."""

    enabled: bool = True
    """Whether imud serves the socket."""
    path: Annotated[str, msgspec.Meta(pattern="^/.*[^/]$", extra={"words": "an absolute path"})] = DEFAULT_PATH
    """Where the socket is, an absolute path."""
    group: str = "imud"
    """Members of this group may read; the socket file belongs to it."""
    control_group: str = "imud-control"
    """Members of this group may also change things."""
    clients_max: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 256
    """At most so many clients at a time; one more gets an error and is disconnected."""
    clients_per_user: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 128
    """At most so many of them belong to one user; not for root and the daemon's own user."""
    memory_mb: Annotated[int, msgspec.Meta(ge=8, le=4096)] = 64
    """At most so much memory for all that clients make imud hold: what waits for them, and what they have sent."""
    queue_samples: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 4096
    """At most so many samples wait for a client that does not read; 4096 are 4 s at 1 kHz. The oldest are dropped."""
    queue_bytes: Annotated[int, msgspec.Meta(ge=4096, le=1 << 30)] = 4 << 20
    """At most so many bytes of samples wait for a client that does not read."""

    def __post_init__(self) -> None:
        """Raise ValueError for a path that no socket can have."""
        if len(os.fsencode(self.path)) > PATH_MAX_BYTES:
            size = len(os.fsencode(self.path))
            raise ValueError(f"path: expected at most {PATH_MAX_BYTES} bytes, got {size}: {shown(self.path)}")


class SocketServer:
    """Serves clients on a UNIX socket. Synchronization: the event loop's thread."""

    def __init__(self, settings: SocketSettings, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        shares = Shares(settings.clients_max, settings.clients_per_user)
        self._quota = Quota(shares, os.geteuid(), raise_fd_limit(), context.now_ns)
        self.pool = Pool(settings.memory_mb * MIB)
        """What is held for clients."""
        self._time = TokenBucket(SERVING_PER_S_NS, SERVING_BURST_NS, context.now_ns())
        self.hub = Hub(settings.path, context, self._quota, self._time, self.pool)
        self.publish: Final = self.hub.publish
        self._side: ServerSide | None = None
        self._listener: Listener | None = None
        self._guard = Guard(os.geteuid(), None, None)
        self._paused = False
        self._pauses = Seldom(context.now_ns)

    def start(self) -> None:
        """Listen. Raises ServerError and leaves nothing behind when that is not possible."""
        settings = self._settings
        self._guard = Guard(os.geteuid(), gid_of(settings.group), gid_of(settings.control_group))
        self._name_control_group(settings.control_group)
        self._listener = Listener(Path(settings.path), settings.group, settings.control_group)
        self._side = ServerSide(
            self._on_line,
            self.hub.remove,
            self.hub.count_evicted,
            self.hub.count_failed,
            Limits(settings.queue_samples, settings.queue_bytes),
            self.pool,
            Scheduler(self._context.now_ns, self._context.cpu_ns, self._time),
        )
        asyncio.get_running_loop().add_reader(self._listener.sock, self._accept)
        self._context.client_sources.append(self.hub.clients)

    def _name_control_group(self, group: str) -> None:
        """Name the group in refusals, and say what to do where it does not exist."""
        self.hub.control_group = f"group {group!r}"
        if self._guard.control_gid is None:
            hint = f"`sudo groupadd --system {group}` makes it, then imud has to be restarted"
            self.hub.control_group += f", which does not exist on this machine: {hint}"
            log.warning("no group %r (socket.control_group): only root can change things; %s", group, hint)

    def add_device(self, name: str, device_id: int) -> None:
        """A device appears."""
        self.hub.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """A device leaves."""
        self.hub.remove_device(name)

    def event(self, event: Event) -> None:
        """Send the event to the clients that asked for it."""
        self.hub.event(event)

    def tick(self, now_ns: int) -> None:
        """Close what lingered long enough, fill allowances; accept again after a pause."""
        self.hub.tick()
        if self._side is not None:
            self._side.scheduler.tick()
            self.pool.trim()
        self._quota.tick()
        self.hub.recordings.tick(now_ns)
        if self._paused and self._listener is not None:
            self._paused = False
            asyncio.get_running_loop().add_reader(self._listener.sock, self._accept)

    def close(self) -> None:
        """Stop listening, close every client, remove the socket file if it is ours; may be called twice."""
        if self._listener is None or self._side is None:
            return
        asyncio.get_running_loop().remove_reader(self._listener.sock)
        self._listener.close()
        self._listener = None
        self.hub.close()
        self._side.scheduler.close()
        self._context.client_sources.remove(self.hub.clients)

    # --- clients ----------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        now_ns = self._context.now_ns
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
            self._welcome(sock)

    def _pause(self, error: OSError) -> None:
        """Stop accepting until the next tick: out of descriptors or memory, an immediate retry would be a busy loop."""
        assert self._listener is not None
        count = self._pauses.count()
        if count:
            log.warning("cannot accept a client: %s (%d times since the last report)", error.strerror, count)
        asyncio.get_running_loop().remove_reader(self._listener.sock)
        self._paused = True

    def _welcome(self, sock: socket.socket) -> None:
        """Let a client in or refuse it. Whatever it meets ends that client, not the daemon."""
        before = self.hub.accepted
        try:
            self._let_in(sock)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            made = self.hub.connections.get(before + 1)
            if made is not None:
                made.on_failure(error)
            else:
                self.hub.count_failed(error)
                sock.close()

    def _let_in(self, sock: socket.socket) -> None:
        try:
            peer = peer_of(sock)
        except OSError:  # gone already
            sock.close()
            return
        rights = self._guard.rights_of(peer)
        try:
            reserved = self._admit(peer, rights, sock.fileno())
        except RpcError as refusal:
            self.hub.count_refused()
            _refuse(sock, refusal)
            return
        assert self._side is not None
        connection = Connection(self.hub.next_number(), sock, peer, rights, self._side, reserved)
        self.hub.add(connection)
        connection.post(hello(self.hub, connection))

    def _admit(self, peer: Peer, rights: Rights, fd: int) -> bool:
        """Return whether the client's place is a reserved one. Raises RpcError when it is refused."""
        if Rights.READ not in rights:
            message = f"uid {peer.uid} may not read: expected root or a member of group {self._settings.group!r}"
            raise RpcError(Code.DENIED, message)
        return self._quota.admit(peer, rights, fd, self.hub.connections.values())

    def _on_line(self, connection: Connection, line: bytes) -> None:
        handle_line(self.hub, connection, line)


def _refuse(sock: socket.socket, error: RpcError) -> None:
    """Send the reason and close. The socket is new, so its buffer has room for the line."""
    try:
        sock.send(line_of(encode_error(error)))
    except OSError as problem:
        log.debug("a refused client left first: %s", reason_of(problem))
    sock.close()


PUBLISHER = PublisherType("socket", SocketSettings, SocketServer)
