"""What the kernel says of the system clock: adjtimex(2), asked without changing anything.

A daemon that keeps the clock (chronyd, ntpd, systemd-timesyncd) clears STA_UNSYNC and gives its estimate of the error
and a bound for it; the kernel lets the bound grow by 500 µs each second and sets STA_UNSYNC at 16 s.
"""

import ctypes
import os
from collections.abc import Callable
from math import sqrt
from time import monotonic_ns, time_ns
from typing import Final, NamedTuple

from imud.contracts.timing import UtcReference
from imud.units import NS_PER_US

STA_UNSYNC: Final = 0x40
TIME_ERROR: Final = 5
READINGS: Final = 5
"""Of so many readings of both clocks the one that took the shortest time counts."""


class Timex(ctypes.Structure):
    """struct timex of linux/timex.h. The C library fills it in with the machine's `long`."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long), ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long), ("status", ctypes.c_int), ("constant", ctypes.c_long),
        ("precision", ctypes.c_long), ("tolerance", ctypes.c_long), ("time", ctypes.c_long * 2),
        ("tick", ctypes.c_long), ("ppsfreq", ctypes.c_long), ("jitter", ctypes.c_long), ("shift", ctypes.c_int),
        ("stabil", ctypes.c_long), ("jitcnt", ctypes.c_long), ("calcnt", ctypes.c_long), ("errcnt", ctypes.c_long),
        ("stbcnt", ctypes.c_long), ("tai", ctypes.c_int), ("padding", ctypes.c_int * 11),
    )  # fmt: skip


class KernelClock(NamedTuple):
    """State of the system clock."""

    synchronised: bool
    """Whether something keeps it."""
    estimated_error_us: int
    """One-sigma error as that something estimates it; 0 where it does not say (systemd-timesyncd)."""
    most_error_us: int
    """Bound of the error."""

    @property
    def error_ns(self) -> int:
        """One-sigma error of the clock, honest: an error anywhere within the bound is as likely as any other."""
        return round(max(self.estimated_error_us, self.most_error_us / sqrt(3)) * NS_PER_US)


def ask_kernel(timex: Timex) -> int:
    """adjtimex(2): fills `timex`, returns the state of the clock. Raises OSError."""
    state: int = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return state


def kernel_clock(ask: Callable[[Timex], int] = ask_kernel) -> KernelClock:
    """Ask the kernel. One that does not answer (a container's filter) vouches for nothing."""
    timex = Timex()
    try:
        state = ask(timex)
    except OSError:
        return KernelClock(False, 0, 0)
    synchronised = state != TIME_ERROR and not timex.status & STA_UNSYNC
    return KernelClock(synchronised, max(timex.esterror, 0), max(timex.maxerror, 0))


def realtime_offset_ns() -> int:
    """CLOCK_REALTIME less CLOCK_MONOTONIC now."""
    best_ns, offset_ns = 1 << 63, 0
    for _ in range(READINGS):
        before_ns = monotonic_ns()
        real_ns = time_ns()
        after_ns = monotonic_ns()
        if after_ns - before_ns < best_ns:
            best_ns, offset_ns = after_ns - before_ns, real_ns - (before_ns + after_ns) // 2
    return offset_ns


def system_reference(clock: KernelClock, offset_ns: int) -> UtcReference | None:
    """What the system clock says of UTC, None while nothing keeps it."""
    return UtcReference(offset_ns, clock.error_ns) if clock.synchronised else None
