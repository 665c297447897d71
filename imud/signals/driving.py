"""Sets the level of an output: an ioctl that keeps the GIL.

Whoever drives a line looks at the clock before and after, and half the time between is the error of its stamp. With
another thread computing that is 7 µs on average; where the ioctl gives the GIL away and has to wait for it, 0.6 to
1.4 ms (`python -m tests.bench lines`).
"""

import ctypes
import os
from typing import Final

SET_VALUES: Final = 0xC010B40F
"""GPIO_V2_LINE_SET_VALUES_IOCTL (<linux/gpio.h>): two u64, the levels and which lines of the request they are for."""

_ioctl = ctypes.PyDLL(None, use_errno=True).ioctl  # PyDLL: the GIL is kept
_ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)
_LEVELS = {active: (ctypes.c_uint64 * 2)(active, 1) for active in (False, True)}


def drive_line(fd: int, active: bool) -> None:
    """Set the only line of a request. Raises OSError."""
    if _ioctl(fd, SET_VALUES, _LEVELS[active]) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
