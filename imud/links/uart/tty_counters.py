"""Errors that the kernel's serial driver counts: TIOCGICOUNT (ioctl_tty(2), linux/serial.h)."""

import array
import fcntl
from typing import Final

from imud.contracts.status import KernelCounters

TIOCGICOUNT: Final = 0x545D

ICOUNTER_INTS: Final = 20
"""struct serial_icounter_struct: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun reserved[9], all int."""
FRAME, OVERRUN, PARITY, BREAK, BUFFER_OVERRUN = 6, 7, 8, 9, 10


class TtyCounters:
    """The counters of one open port relative to when this object was made; zeros where the driver has none (ptys)."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._start = read_counters(fd)
        self._newest = self._start

    def read(self) -> KernelCounters:
        """Counted since the start; the last known state once the port is gone."""
        now = read_counters(self._fd)
        if now is not None:
            self._newest = now
        return relative(self._start, self._newest)


def read_counters(fd: int) -> tuple[int, ...] | None:
    """The driver's ICOUNTER_INTS counters since boot, or None where it has none."""
    buffer = array.array("i", [0] * ICOUNTER_INTS)
    try:
        fcntl.ioctl(fd, TIOCGICOUNT, buffer)
    except OSError:
        return None
    return tuple(buffer)


def relative(start: tuple[int, ...] | None, now: tuple[int, ...] | None) -> KernelCounters:
    """What was counted from `start` to `now`; differences modulo 2³², because the kernel's ints wrap."""
    if start is None or now is None:
        return KernelCounters()
    counted = [(b - a) & 0xFFFF_FFFF for a, b in zip(start, now, strict=True)]
    return KernelCounters(
        overrun=counted[OVERRUN] + counted[BUFFER_OVERRUN],
        framing=counted[FRAME],
        parity=counted[PARITY],
        break_=counted[BREAK],
    )
