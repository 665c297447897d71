"""Samples for chronyd's SOCK reference clock: how far the system clock is off at a pulse.

chrony.conf(5), `refclock SOCK /run/chrony/imud.sock`: chronyd makes the socket and takes one datagram for each sample,
in the machine's own byte order. The layout is that of chrony's `struct sock_sample` with 64-bit time, 40 bytes: what a
64-bit chronyd takes, and a 32-bit one with 64-bit time; since chrony 4.7 or so every one converts it.

     0  int64   system time of the sample, whole seconds          24  int32  1: pulse, the second is not known
     8  int64   the rest of it, µs                                28  int32  leap second: 0 none, 1 insert, 2 delete
    16  double  true time minus system time, s                    32  int32  padding
                                                                  36  int32  magic
"""

import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from imud.units import NS_PER_S, NS_PER_US
from imud.utc.adjtimex import realtime_offset_ns

MAGIC: Final = 0x534F434B
SAMPLE: Final = struct.Struct("=qqdiiii")
HALF_NS: Final = NS_PER_S // 2


def encode(system_ns: int, offset_ns: int, *, pulse: bool, leap: int = 0) -> bytes:
    """One datagram: at `system_ns` (CLOCK_REALTIME) true time was `offset_ns` more; `pulse`: give or take seconds."""
    seconds, rest_ns = divmod(system_ns, NS_PER_S)
    return SAMPLE.pack(seconds, rest_ns // NS_PER_US, offset_ns / NS_PER_S, pulse, leap, 0, MAGIC)


class ChronyFeed:
    """The sending side. Never blocks. Synchronization: one thread."""

    def __init__(self, path: str, offset_ns: Callable[[], int] = realtime_offset_ns) -> None:
        """`path` is the socket that chronyd makes; it need not be there yet."""
        self.title = f"chronyd at {path}"
        self.problem = ""
        """Why the last sample was refused, one sentence; empty when it was taken."""
        self.sent = 0
        self.refused = 0
        """Samples that nobody took: chronyd does not run, or does not keep up."""
        self._path = path
        self._offset_ns = offset_ns
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def pulse(self, t_ns: int, unix_s: int | None = None) -> bool:
        """A pulse at CLOCK_MONOTONIC `t_ns`, at the full second `unix_s` if that is known. Call it soon after.

        Without the second chronyd needs another source for it (`lock`). Says whether chronyd was given the sample.
        """
        system_ns = t_ns + self._offset_ns()
        second_s = (system_ns + HALF_NS) // NS_PER_S if unix_s is None else unix_s
        offset_ns = second_s * NS_PER_S - system_ns
        return self._send(encode(system_ns, offset_ns, pulse=unix_s is None))

    def close(self) -> None:
        """Let go of the socket; may be called twice."""
        with suppress(OSError):
            self._socket.close()

    def _send(self, sample: bytes) -> bool:
        try:
            self._socket.sendto(sample, self._path)
        except OSError as error:
            self.refused += 1
            self.problem = f"{self.title} takes no samples: {error.strerror or error}; is it running, with this socket?"
            return False
        self.sent += 1
        self.problem = ""
        return True
