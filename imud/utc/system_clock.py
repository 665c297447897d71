"""System clock: its state in the kernel, and RMC sentences with its time while it is synchronized.

A daemon that controls the clock (chronyd, ntpd, systemd-timesyncd) clears STA_UNSYNC and sets its estimate and a bound
of the error. The kernel increases the bound by 500 µs per second, and sets STA_UNSYNC at 16 s. adjtimex(2) reads these
values.
"""

import asyncio
import ctypes
import os
from collections.abc import Callable
from functools import cache
from math import sqrt
from typing import Final, NamedTuple

from imud.contracts.lines import UtcReference
from imud.formats.nmea0183 import build
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.utc.receivers import OnSentence, RmcOptions, SourceContext

STA_UNSYNC: Final = 0x40
TIME_ERROR: Final = 5
# Delay of a sentence after its time, ns. It is longer than the allowed error of the clock (60 ms, three sigma), so that
# a sentence never precedes the pulse of its second.
AFTER_NS: Final = 200 * NS_PER_MS
# Latest time in a second to send a sentence, ns. The device could assign a later sentence to the next second.
LATEST_NS: Final = 800 * NS_PER_MS
# Maximum delay of a due sentence, ns. After that, imud skips it, because the next sentence follows soon.
LATE_NS: Final = 50 * NS_PER_MS


class Timex(ctypes.Structure):
    """struct timex of <linux/timex.h>, with the host's `long`."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long), ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long), ("status", ctypes.c_int), ("constant", ctypes.c_long),
        ("precision", ctypes.c_long), ("tolerance", ctypes.c_long), ("time", ctypes.c_long * 2),
        ("tick", ctypes.c_long), ("ppsfreq", ctypes.c_long), ("jitter", ctypes.c_long), ("shift", ctypes.c_int),
        ("stabil", ctypes.c_long), ("jitcnt", ctypes.c_long), ("calcnt", ctypes.c_long), ("errcnt", ctypes.c_long),
        ("stbcnt", ctypes.c_long), ("tai", ctypes.c_int), ("padding", ctypes.c_int * 11),
    )  # fmt: skip


class KernelClock(NamedTuple):
    """State of the system clock in the kernel."""

    synchronised: bool  # whether a daemon synchronizes the clock
    # One-sigma error according to the daemon, µs; 0 if the daemon sets none (systemd-timesyncd).
    estimated_error_us: int
    most_error_us: int  # bound of the error, µs

    @property
    def error_ns(self) -> int:
        """Return the one-sigma error, ns: the estimate, or the error from the bound (uniform) if larger."""
        return round(max(self.estimated_error_us, self.most_error_us / sqrt(3)) * NS_PER_US)


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)  # takes longer than the call of adjtimex(2)


def ask_kernel(timex: Timex) -> int:
    """Call adjtimex(2): fill `timex` and return the state of the clock. Raises OSError."""
    state: int = _libc().adjtimex(ctypes.byref(timex))
    if state < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return state


def kernel_clock(ask: Callable[[Timex], int] = ask_kernel) -> KernelClock:
    """Read the state of the clock. If the call is refused (filter of a container), the clock is not synchronized."""
    timex = Timex()
    try:
        state = ask(timex)
    except OSError:
        return KernelClock(False, 0, 0)
    synchronised = state != TIME_ERROR and not timex.status & STA_UNSYNC
    return KernelClock(synchronised, max(timex.esterror, 0), max(timex.maxerror, 0))


def system_reference(clock: KernelClock, offset_ns: int) -> UtcReference | None:
    """Return the system clock as a reference of UTC; None if it is not synchronized."""
    return UtcReference(offset_ns, clock.error_ns) if clock.synchronised else None


class SystemClockSource:
    """Source of one or more sentences per second of the system clock. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        settings: RmcOptions,
        now_ns: Callable[[], int],
        utc_offset_ns: Callable[[], int],
        ask: Callable[[], KernelClock] = kernel_clock,
    ) -> None:
        """`now_ns` and `utc_offset_ns`: see `SourceContext`. `ask` reads the state of the clock."""
        self.title = "the system clock"
        self.problem = ""
        self.sentences = 0
        self._step_ns = NS_PER_S // settings.rate_hz
        self._most_ns = round(settings.error_ms * NS_PER_MS)
        self._ask, self._utc_offset_ns, self._now_ns = ask, utc_offset_ns, now_ns
        self._on_sentence: OnSentence = lambda _sentence, _t_rx_ns: None
        self._timer: asyncio.TimerHandle | None = None

    def start(self, on_sentence: OnSentence) -> None:
        self._on_sentence = on_sentence
        self._schedule()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def tick(self) -> None:
        """Deliver the due sentence if the clock is accurate enough."""
        now_ns = self._now_ns()
        utc_ns = now_ns + self._utc_offset_ns()
        named_ns = self._named_ns(utc_ns)
        if utc_ns % NS_PER_S < AFTER_NS or utc_ns % NS_PER_S >= LATEST_NS:
            return
        if not 0 <= utc_ns - AFTER_NS - named_ns < LATE_NS:
            return
        self.problem = self._complaint()
        if not self.problem:
            self.sentences += 1
            self._on_sentence(build(named_ns), now_ns)

    def wait_ns(self) -> int:
        """Return the time until the next due sentence, ns."""
        now_ns = self._now_ns()
        utc_ns = now_ns + self._utc_offset_ns()
        named_ns = self._named_ns(utc_ns)
        next_second_ns = (named_ns // NS_PER_S + 1) * NS_PER_S
        return min(named_ns + self._step_ns, next_second_ns) + AFTER_NS - utc_ns

    def _named_ns(self, utc_ns: int) -> int:
        """Return the last instant that a sentence describes, ns."""
        second, rest_ns = divmod(utc_ns - AFTER_NS, NS_PER_S)
        return second * NS_PER_S + rest_ns // self._step_ns * self._step_ns

    def _schedule(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(self.wait_ns() / NS_PER_S, self._on_time)

    def _on_time(self) -> None:
        self._schedule()
        self.tick()

    def _complaint(self) -> str:
        clock = self._ask()
        if not clock.synchronised:
            return "the system clock is not synchronized: is chronyd or another NTP client running?"
        if clock.error_ns > self._most_ns:
            error_ms, most_ms = clock.error_ns / NS_PER_MS, self._most_ns / NS_PER_MS
            return f"the system clock may be wrong by {error_ms:.1f} ms, the maximum is {most_ms:g} ms (error_ms)"
        return ""


def make(settings: RmcOptions, context: SourceContext) -> SystemClockSource:
    return SystemClockSource(settings, context.now_ns, context.utc_offset_ns)
