"""Who switches the transmitter of an RS-485 port on and off: the kernel's driver with RTS, or the adapter by itself.

TIOCSRS485 (Documentation/driver-api/serial/serial-rs485.rst). Drivers without it, USB adapters and ptys among them, say
ENOTTY; there the adapter must do it. pyserial's own `rs485_mode` is not used: where the driver refuses it, every later
setting of that object fails.
"""

import errno
import fcntl
import struct
from contextlib import suppress
from typing import Final

from imud.errors import LinkError

TIOCGRS485: Final = 0x542E
TIOCSRS485: Final = 0x542F
SERIAL_RS485: Final = struct.Struct("8I")
"""flags, delay_rts_before_send ms, delay_rts_after_send ms, padding (linux/serial.h)."""
ENABLED: Final = 1 << 0
RTS_ON_SEND: Final = 1 << 1
ABSENT: Final = frozenset({errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP})


class Direction:
    """Direction control of one open port."""

    def __init__(self, fd: int, title: str, *, required: bool) -> None:
        """Have the kernel do it, if its driver can. Raises LinkError if `required` and it cannot.

        A port that is so already (device tree) is left as it is.
        """
        self._fd = fd
        self._before: bytes | None = None
        self.by_kernel = False
        """Whether the kernel switches."""
        try:
            before = fcntl.ioctl(fd, TIOCGRS485, bytes(SERIAL_RS485.size))
            if not SERIAL_RS485.unpack(before)[0] & ENABLED:
                fcntl.ioctl(fd, TIOCSRS485, SERIAL_RS485.pack(ENABLED | RTS_ON_SEND, *[0] * 7))
                self._before = before
            self.by_kernel = True
        except OSError as error:
            if required or error.errno not in ABSENT:
                raise LinkError(
                    f"{title}: its driver cannot switch the direction of RS-485 ({error.strerror}); `direction: none` "
                    "if the adapter does it by itself"
                ) from error

    def restore(self) -> None:
        """Leave the port as it was; may be called twice, and on a port that is gone."""
        before, self._before = self._before, None
        if before is not None:
            with suppress(OSError):
                fcntl.ioctl(self._fd, TIOCSRS485, before)
