"""Samples for chronyd's SOCK reference clock: the error of the system clock at a pulse.

chrony.conf(5), `refclock SOCK /run/chrony.imud.sock`: chronyd creates the socket and receives one datagram per sample,
in host byte order. The layout is that of chrony's `struct sock_sample` with 64-bit time, 40 bytes: accepted by a 64-bit
chronyd, and by a 32-bit one with 64-bit time; since about chrony 4.7 every build converts it.

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

MAGIC: Final = 0x534F434B
SAMPLE: Final = struct.Struct("=qqdiiii")
HALF_NS: Final = NS_PER_S // 2


def encode(system_ns: int, offset_ns: int, *, pulse: bool, leap: int = 0) -> bytes:
    """Encode a sample: at `system_ns` (CLOCK_REALTIME) true time was `offset_ns` more; `pulse`: modulo one second."""
    seconds, rest_ns = divmod(system_ns, NS_PER_S)
    return SAMPLE.pack(seconds, rest_ns // NS_PER_US, offset_ns / NS_PER_S, pulse, leap, 0, MAGIC)


class ChronyFeed:
    """Sender of samples to chronyd. Never blocks. Synchronization: one thread."""

    def __init__(self, path: str, utc_offset_ns: Callable[[], int]) -> None:
        """`path` is chronyd's socket, which may not exist yet; `utc_offset_ns` as `SourceContext.utc_offset_ns`."""
        self.title = f"chronyd at {path}"
        self.problem = ""
        """Why the last sample was not accepted, one sentence; empty if it was."""
        self.sent = 0
        self.refused = 0
        """Samples not accepted: chronyd does not run, or does not keep up."""
        self._path = path
        self._utc_offset_ns = utc_offset_ns
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send_pulse(self, t_ns: int, unix_s: int | None = None) -> bool:
        """Send a pulse at CLOCK_MONOTONIC `t_ns`, the begin of `unix_s` if known; return whether it was accepted.

        Call it soon after the pulse. Without the second chronyd needs another source for it (`lock`).
        """
        system_ns = t_ns + self._utc_offset_ns()
        second_s = (system_ns + HALF_NS) // NS_PER_S if unix_s is None else unix_s
        offset_ns = second_s * NS_PER_S - system_ns
        return self._send(encode(system_ns, offset_ns, pulse=unix_s is None))

    def close(self) -> None:
        """Close the socket; may be called twice."""
        with suppress(OSError):
            self._socket.close()

    def _send(self, sample: bytes) -> bool:
        try:
            self._socket.sendto(sample, self._path)
        except OSError as error:
            self.refused += 1
            self.problem = f"{self.title} refuses samples: {error.strerror or error}; is it running, with this socket?"
            return False
        self.sent += 1
        self.problem = ""
        return True
