"""Opening a serial port so that it is imud's alone, raw, and as quick as it can be; every failure as a LinkError.

What pyserial leaves undone is done here: TIOCEXCL beside its flock (programs that do not lock are refused too), no
BRKINT (with it, a break, which is what a wrong baud rate looks like, throws away everything received), no HUPCL (DTR
stays as it is between close and open, and a board that resets on DTR is left alone), and the rate is read back.
"""

import array
import errno
import fcntl
import os
import termios
from pathlib import Path
from typing import Final

import serial

from imud.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.links.port_owner import group_of, holders_of
from imud.permissions import user_name

TCGETS2: Final = 0x802C542A
"""ioctl: struct termios2, which has the rate as a number (asm-generic/termbits.h)."""
TERMIOS2_INTS: Final = 11
OSPEED_INDEX: Final = 10
"""c_iflag c_oflag c_cflag c_lflag, c_line and c_cc[19] in five words, c_ispeed, c_ospeed."""
BAUD_TOLERANCE: Final = 0.03
"""8N1 is sampled 9.5 bits after its start edge: half a bit there is 5 %, of which the far end may use some."""

GONE: Final = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ENOTDIR})
REFUSED: Final = frozenset({errno.EACCES, errno.EPERM})
HELD: Final = frozenset({errno.EBUSY, errno.EAGAIN})


def open_port(path: str, baud: int, proc: Path) -> serial.Serial:
    """Open `path` exclusively as raw 8N1 without flow control. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
    try:
        # inter_byte_timeout=0 gives VMIN=1: then a read without data is EAGAIN, and 0 bytes always means hung up.
        port = serial.Serial(path, baud, exclusive=True, timeout=0, write_timeout=0, inter_byte_timeout=0)
    except (OSError, ValueError, termios.error) as error:
        raise explain(error, path, proc) from error
    try:
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        _finish_raw(port.fileno())
        _check_rate(port, path, baud)
    except (OSError, termios.error) as error:
        port.close()
        raise explain(error, path, proc) from error
    except LinkError:
        port.close()
        raise
    return port


def change_baud(port: serial.Serial, path: str, baud: int, proc: Path) -> None:
    """Set another rate and throw away what was received at the old one. Raises LinkError if the port cannot do it."""
    try:
        port.baudrate = baud
        termios.tcflush(port.fileno(), termios.TCIFLUSH)
        _check_rate(port, path, baud)
    except (OSError, ValueError, termios.error) as error:
        raise explain(error, path, proc) from error


def baud_of(fd: int) -> int:
    """The rate the driver really set, in bit/s (TCGETS2)."""
    settings = array.array("I", [0] * (TERMIOS2_INTS + 5))
    fcntl.ioctl(fd, TCGETS2, settings)
    return settings[OSPEED_INDEX]


def explain(error: Exception, path: str, proc: Path = Path("/proc")) -> LinkError:
    """The LinkError for what the system said of `path`, with what to look at."""
    number = error.errno if isinstance(error, OSError) else next((a for a in error.args if isinstance(a, int)), None)
    if number in GONE:
        return LinkMissing(f"{path} is not there: is the cable plugged in, and is the path right?")
    if number in REFUSED:
        group = group_of(path)
        return LinkDenied(
            f"{path} may not be opened by user {user_name()}: it belongs to group {group}; "
            f"`sudo usermod -aG {group} {user_name()}` and a new login give access"
        )
    if number in HELD:
        return LinkBusy(f"{path} is in use by {holders_of(path, proc) or 'another program'}: stop that first")
    if number == errno.EIO:
        return LinkError(f"{path} has a node but no hardware behind it: is this the right port, is it enabled?")
    if os.path.exists(path) and not Path(path).is_char_device():
        return LinkError(f"{path} is not a serial port: expected a character device such as /dev/ttyUSB0")
    return LinkError(f"{path} cannot be used as a serial port: {error}")


def _finish_raw(fd: int) -> None:
    attributes = termios.tcgetattr(fd)
    attributes[0] &= ~(termios.BRKINT | termios.IGNBRK | termios.IGNPAR)
    attributes[2] &= ~termios.HUPCL
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _check_rate(port: serial.Serial, path: str, baud: int) -> None:
    real = baud_of(port.fileno())
    if abs(real - baud) > baud * BAUD_TOLERANCE:
        raise LinkError(f"{path} cannot do {baud} baud: asked for it, its driver set {real}")
