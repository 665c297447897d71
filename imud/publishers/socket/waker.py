"""Wakes a client after batches of a device: it gets a descriptor to poll and read, the daemon sends a byte.

Nothing the client does with its descriptor may make the daemon wait. That rules out

- an eventfd: both sides share one open file description, so a client that clears O_NONBLOCK and fills it blocks the
  daemon's next write;
- a pipe: its ends have descriptions of their own, but a read holds the pipe's lock while it copies to the reader's
  memory, and a write waits for that lock, O_NONBLOCK or not. A client decides how long that takes, by reading into
  memory whose page fault it answers itself (userfaultfd(2), a file of its own FUSE file system).

A UNIX socket has neither: each end has its own description, MSG_DONTWAIT belongs to the call, and a reader holds no
lock that a sender needs while it copies. The daemon keeps one end, which takes nothing in.
"""

import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from imud.formats.jsonrpc import Code, RpcError
from imud.publishers.socket.outbox import NO_FD

BYTE: Final = b"\1"
FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
BUFFER_BYTES: Final = 1
"""The kernel makes its minimum of this: a few wake-ups may wait, and one is as good as a thousand."""


class Waker:
    """The daemon's end. Raises OSError when it cannot be made. Synchronization: the event loop's thread."""

    __slots__ = ("_send", "_sock", "_theirs")

    def __init__(self) -> None:
        self._sock, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._theirs.setblocking(False)  # a convenience of the client's, which may change it
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._sock.shutdown(socket.SHUT_RD)  # the client cannot send bytes or descriptors, which would not be read
        self._send = self._sock.send

    @property
    def client_end(self) -> int:
        """The descriptor for the client, NO_FD once it is handed over."""
        return self._theirs.fileno()

    @property
    def fds(self) -> tuple[int, int]:
        """Both descriptors."""
        return self._sock.fileno(), self._theirs.fileno()

    def handed_over(self) -> None:
        """Close the daemon's copy of the client's end, so that it shows when the client closes its own."""
        self._theirs.close()

    def wake(self) -> bool:
        """Make the client's end readable, at once whatever the client does. False when the client closed it."""
        try:
            self._send(BYTE, FLAGS)
        except BlockingIOError:  # full, so it is readable
            return True
        except OSError:
            return False
        return True

    def close(self) -> None:
        """End the descriptor: the client reads what waits, then end of file; may be called twice."""
        self._sock.close()
        self._theirs.close()


class ClientWakers:
    """The wakers of one client, at most one per device. Synchronization: the event loop's thread."""

    def __init__(self) -> None:
        self._wakers: dict[str, Waker] = {}
        self._lent: list[socket.socket] = []
        """Other descriptors of the client's whose replies wait to be sent."""

    def __contains__(self, device: object) -> bool:
        return device in self._wakers

    def __iter__(self) -> Iterator[str]:
        return iter(self._wakers)

    def __len__(self) -> int:
        return len(self._wakers)

    @property
    def client_ends(self) -> int:
        """Descriptors of the client's that the daemon still holds because their replies wait to be sent."""
        return sum(waker.client_end != NO_FD for waker in self._wakers.values()) + len(self._lent)

    def lend(self, sock: socket.socket) -> int:
        """Take a socket whose descriptor is for the client, to be sent with the next reply, and close it then.

        Raises RpcError while one before still waits to be sent, as `make`.
        """
        if self._lent:
            message = "the reply with the descriptor before still waits for this client; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        self._lent.append(sock)
        return sock.fileno()

    def make(self, device: str, check: Callable[[Sequence[int]], None]) -> int:
        """Make a descriptor for the client, to be sent with the next reply; it replaces the one of `device` before.

        `check` is given the numbers of the new descriptors and raises RpcError when clients may not use them.
        Raises RpcError also when none can be made, or while the one before still waits to be sent: a client that never
        reads would gather descriptors in the daemon.
        """
        old = self._wakers.get(device)
        if old is not None and old.client_end != NO_FD:
            message = "notify: the reply to the one before still waits for this client; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        try:
            waker = Waker()
        except OSError as error:
            raise RpcError(Code.UNAVAILABLE, f"notify: the daemon cannot make a descriptor: {error.strerror}") from None
        try:
            check(waker.fds)
        except RpcError:
            waker.close()
            raise
        if old is not None:
            old.close()
        self._wakers[device] = waker
        return waker.client_end

    def wake(self, device: str) -> bool:
        """Wake the client if it asked for that; False, once, when it has closed its descriptor, which ends it."""
        waker = self._wakers.get(device)
        if waker is None or waker.wake():
            return True
        self._wakers.pop(device).close()
        return False

    def handed_over(self) -> None:
        """All replies are sent, and their descriptors with them."""
        for waker in self._wakers.values():
            waker.handed_over()
        self._close_lent()

    def close(self) -> None:
        """End all descriptors; may be called twice."""
        for waker in self._wakers.values():
            waker.close()
        self._wakers.clear()
        self._close_lent()

    def _close_lent(self) -> None:
        while self._lent:
            self._lent.pop().close()
