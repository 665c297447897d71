"""Wakes one client after batches of one device: it gets a descriptor to poll and read, the daemon sends a byte.

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
from typing import Final

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
        self._sock.shutdown(socket.SHUT_RD)  # the client cannot send bytes, or descriptors, that nobody would take
        self._send = self._sock.send

    @property
    def client_end(self) -> int:
        """The descriptor for the client, -1 once it is handed over."""
        return self._theirs.fileno()

    def handed_over(self) -> None:
        """The client has its end: the daemon's copy goes, so that it shows when the client closes its own."""
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
        """The client reads what waits, then the end; may be called twice."""
        self._sock.close()
        self._theirs.close()
