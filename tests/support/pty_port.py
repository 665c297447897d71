"""A real pseudo-terminal as a serial port, with its far end in the test's hand."""

import array
import fcntl
import os
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress

NOBODY_UID = 65534
SETTLED_S = 0.05
"""The kernel moves bytes from one of a port's buffers to the next within some ms."""


class PtyPort:
    """The far end is `master`; `path` is what a link opens."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(slave)
        self.slave = slave
        """The near end, held open so that the port has a holder between a close and the next open."""

    def send(self, data: bytes) -> None:
        """Bytes for the link."""
        assert os.write(self.master, data) == len(data)

    def received(self) -> bytes:
        """Bytes that the link sent and that have come so far."""
        try:
            return os.read(self.master, 65536)
        except BlockingIOError:
            return b""

    def fill(self) -> int:
        """Write to the near end until the port has no room left; return how many zeros it took."""
        os.set_blocking(self.slave, False)
        size, full_since_s = 0, time.monotonic()
        while time.monotonic() < full_since_s + SETTLED_S:
            with suppress(BlockingIOError):
                size += os.write(self.slave, bytes(1000))
                full_since_s = time.monotonic()
        return size

    def unplug(self) -> None:
        """Hang up; may be called twice."""
        for name in ("master", "slave"):
            fd = getattr(self, name)
            if fd >= 0:
                os.close(fd)
                setattr(self, name, -1)


def waiting_bytes(fd: int) -> int:
    """Bytes that a read would give now (FIONREAD)."""
    size = array.array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, size)
    return size[0]


@contextmanager
def unprivileged() -> Iterator[None]:
    """Without root's right to open everything; no change for other users."""
    if os.geteuid():
        yield
        return
    os.seteuid(NOBODY_UID)
    try:
        yield
    finally:
        os.seteuid(0)
