"""Clocks with a settable time in place of the host's clocks, for a program under callgrind.

Under valgrind, a program needs fifty times as long, and each run has another duration. Ticks and time-outs would occur
at different samples in each run. Call `install` before any import of imud, because its modules bind the clocks by name.
"""

import time
from functools import partial
from typing import Final

from imud.model.units import NS_PER_S

BEGIN_NS: Final = 1000 * NS_PER_S
UTC_AHEAD_NS: Final = 1_795_000_000 * NS_PER_S  # CLOCK_REALTIME minus CLOCK_MONOTONIC

_ns = [BEGIN_NS, BEGIN_NS + UTC_AHEAD_NS]
RAW, BOOTTIME = time.CLOCK_MONOTONIC_RAW, time.CLOCK_BOOTTIME
_by_clock = {RAW: BEGIN_NS, BOOTTIME: BEGIN_NS}
_s = [BEGIN_NS / NS_PER_S]


def install() -> None:
    """Replace the clocks of `time` with C functions, so that reading a clock costs about the same as before."""
    time.monotonic_ns = time.thread_time_ns = partial(_ns.__getitem__, 0)
    time.time_ns = partial(_ns.__getitem__, 1)
    time.monotonic = partial(_s.__getitem__, 0)
    time.clock_gettime_ns = _by_clock.__getitem__


def now_ns() -> int:
    return _ns[0]


def set_now(now_ns: int) -> None:
    _ns[0], _ns[1] = now_ns, now_ns + UTC_AHEAD_NS
    _by_clock[RAW] = _by_clock[BOOTTIME] = now_ns
    _s[0] = now_ns / NS_PER_S
