"""Recordings that clients of the socket asked for, and snapshots of the flight recorder for them (docs/recording.md).

A client gets a descriptor with the reply and reads a recording from it, to end of file. It ends with `record.stop`,
with the connection, when the client closes the descriptor, and when imud stops.
"""

import logging
import socket
from collections.abc import Callable, Collection, Sequence
from typing import Final

from imud.contracts.publisher import PublisherContext
from imud.errors import ImudError, reason_of
from imud.event import Event
from imud.formats.jsonrpc import Code, RpcError
from imud.publishers.recorder.stream import ClientRecording, stream_pair
from imud.publishers.socket.connection import Connection

log = logging.getLogger(__name__)

RECORDINGS_MAX: Final = 4
"""At a time, of all clients: each has a thread and up to 16 MiB of records that wait."""

CheckFds = Callable[[Sequence[int]], None]
"""Raises RpcError where clients may not use these descriptors."""


class ClientRecordings:
    """The recordings of all clients. Synchronization: the event loop's thread only."""

    def __init__(self, context: PublisherContext, check_fds: CheckFds) -> None:
        self._context = context
        self._check_fds = check_fds
        self._ids: dict[str, int] = {}
        self._running: dict[int, ClientRecording] = {}
        """By number of the connection."""
        self._ending: list[ClientRecording] = []
        """Those that still send what waited when they were stopped."""

    # --- the clients' side -------------------------------------------------------------------------------------------

    def start(self, connection: Connection, devices: Collection[str] | None) -> int:
        """Record for a client; return the descriptor for it, which goes with the reply. Raises RpcError."""
        if connection.number in self._running:
            raise RpcError(Code.UNAVAILABLE, "record.start: this connection records already; record.stop ends that")
        count = len(self._running) + len(self._ending)
        if count >= RECORDINGS_MAX:
            raise RpcError(
                Code.UNAVAILABLE, f"record.start: {count} recordings run already, as many as there may be at a time"
            )
        ours, fd = self._lend(connection, "record.start")
        try:
            made = ClientRecording(self._context, devices, ours)
        except RuntimeError as error:  # no thread can be started
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.start: the daemon cannot record: {error}") from None
        for name, device_id in self._ids.items():
            made.add_device(name, device_id)
        self._running[connection.number] = made
        log.info("client %d (pid %d, uid %d) records", connection.number, connection.peer.pid, connection.peer.uid)
        return fd

    def stop(self, connection: Connection) -> tuple[bool, int]:
        """End the recording of a client regularly; return whether there was one, and the records that it lost."""
        made = self._running.pop(connection.number, None)
        if made is None:
            return False, 0
        made.stop("it was stopped")
        self._ending.append(made)
        return True, made.records_dropped

    def snapshot(self, connection: Connection) -> tuple[float, int]:
        """Send a client what the flight recorder has: its length, s, and the descriptor. Raises RpcError."""
        if not self._context.snapshots:
            raise RpcError(
                Code.UNAVAILABLE,
                "record.snapshot: there is no flight recorder; `recorder: {flight: {enabled: true}}` in the "
                "configuration makes one",
            )
        ours, fd = self._lend(connection, "record.snapshot")
        try:
            return self._context.snapshots[0](ours), fd
        except ImudError as error:
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.snapshot: {error}") from None

    def remove(self, connection: Connection) -> None:
        """End the recording of a client that has gone; no-op if absent."""
        made = self._running.pop(connection.number, None)
        if made is not None:
            made.close()
            log.info("client %d records no more: its connection has ended", connection.number)

    def _lend(self, connection: Connection, method: str) -> tuple[socket.socket, int]:
        """Make a pair of sockets; return the daemon's, and the client's descriptor. Raises RpcError."""
        try:
            ours, theirs = stream_pair()
        except OSError as error:
            message = f"{method}: the daemon cannot make a descriptor: {reason_of(error)}"
            raise RpcError(Code.UNAVAILABLE, message) from None
        try:
            self._check_fds((ours.fileno(), theirs.fileno()))
            return ours, connection.wakers.lend(theirs)
        except RpcError:
            ours.close()
            theirs.close()
            raise

    # --- the daemon's side -------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """A device appears."""
        self._ids[name] = device_id
        for made in self._running.values():
            made.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """A device leaves, or is made anew."""
        self._ids.pop(name, None)
        for made in self._running.values():
            made.remove_device(name)

    def event(self, event: Event) -> None:
        """Record an event."""
        for made in self._running.values():
            made.event(event)

    def tick(self, now_ns: int) -> None:
        """Record checks and losses, and forget what is over."""
        for number, made in list(self._running.items()):
            made.tick(now_ns)
            if made.ended:
                self._running.pop(number).close()
                log.info("client %d records no more: it has closed its descriptor", number)
        for made in list(self._ending):
            made.tick(now_ns)
            if made.ended:
                self._ending.remove(made)
                made.close()

    def close(self) -> None:
        """End all recordings regularly; may be called twice."""
        for made in self._running.values():
            made.stop("imud stopped")
        for made in (*self._running.values(), *self._ending):
            made.close(flush=True)
        self._running.clear()
        self._ending.clear()
