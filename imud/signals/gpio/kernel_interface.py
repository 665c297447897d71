"""The two parts of the kernel's GPIO interface (<linux/gpio.h>) that imud uses without gpiod's objects, for speed.

Edge events are read as `struct gpio_v2_line_event`, 48 bytes in host byte order:

    timestamp_ns u64 | id u32 | offset u32 | seqno u32 | line_seqno u32 | padding 6 × u32

`line_seqno` counts the edges of the line from 1 and is assigned before the edge enters the kernel's buffer; a full
buffer drops its oldest event. A gap in the count is therefore a loss, and its size is the number of lost edges.

An output is set by GPIO_V2_LINE_SET_VALUES_IOCTL, called with the GIL held. The trigger reads the clock before and
after the call, and half the time between is the error of its time stamp: 7 µs on average while another thread
computes, but 0.6 to 1.4 ms where the call releases the GIL and has to wait for it (`python -m tests.bench lines`).
"""

import ctypes
import os
from struct import Struct
from typing import Final

from imud.contracts.lines import Edge

EVENT: Final = Struct("=QIIII24x")
"""struct gpio_v2_line_event."""
RISING: Final = 1
"""`id` of an edge from inactive to active (GPIO_V2_LINE_EVENT_RISING_EDGE); 2 is the falling edge."""
SET_VALUES: Final = 0xC010B40F
"""GPIO_V2_LINE_SET_VALUES_IOCTL. Its argument is two u64: the levels, and the mask of the request's lines to set."""
_SEQNO_MODULUS: Final = 2**32

_ioctl = ctypes.PyDLL(None, use_errno=True).ioctl  # PyDLL: the GIL is kept
_ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)
_LEVELS = {active: (ctypes.c_uint64 * 2)(active, 1) for active in (False, True)}


class LineEventDecoder:
    """Decoder of the edge events of one line; numbers them over all requests of the line, and counts lost ones.

    Synchronization: one thread.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Edges that the kernel dropped."""
        self._number = 0
        self._seqno = 0

    def restart(self) -> None:
        """Begin a new request: the kernel counts from 1 again, the edge numbers continue."""
        self._seqno = 0

    def decode(self, data: bytes) -> list[Edge]:
        """Return the edges in `data`, which holds a whole number of events."""
        found = []
        for t_ns, kind, _offset, _seqno, seqno in EVENT.iter_unpack(data):
            step = (seqno - self._seqno) % _SEQNO_MODULUS
            self._seqno = seqno
            self._number += step
            self.lost += step - 1
            found.append(Edge(t_ns, kind == RISING, self._number))
        return found


def set_line(fd: int, active: bool) -> None:
    """Set the level of the only line of the request `fd`. Raises OSError."""
    if _ioctl(fd, SET_VALUES, _LEVELS[active]) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
