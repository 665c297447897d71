"""A serial port: exclusive raw access, verified baud rate, low latency of the adapter, counted errors.

pyserial lacks four settings that imud makes: TIOCEXCL in addition to flock, so that programs without locks are refused
too. No BRKINT: a wrong baud rate looks like a break, and BRKINT would discard all received bytes. No HUPCL: DTR keeps
its state between close and open, so that boards with a reset on DTR keep running. imud reads the baud rate back.

USB adapters like FTDI send a packet after 62 bytes or when the latency timer ends (16 ms by default). ASYNC_LOW_LATENCY
(linux/serial.h) or `latency_timer` in sysfs sets it to 1 ms. Native UARTs and ptys do not hold bytes. CDC ACM devices
reply to the polls of the host, one per 1 ms (USB full-speed frame).
"""

import array
import contextlib
import errno
import fcntl
import os
import termios
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import serial

from imud.contracts.status import KernelCounters
from imud.host.library_call import LibraryCall
from imud.links.device_node import CABLE, PROC, errno_of, open_problem
from imud.model.errors import LinkBusy, LinkError, reason_of
from imud.model.units import NS_PER_MS

TCGETS2: Final = 0x802C542A  # ioctl: struct termios2, with the baud rate as a number (asm-generic/termbits.h)
TERMIOS2_INTS: Final = 11
# Place of the output rate in termios2: c_iflag c_oflag c_cflag c_lflag, c_line and c_cc[19] in five words, c_ispeed,
# c_ospeed.
OSPEED_INDEX: Final = 10
# Maximum relative error of the baud rate. A receiver samples 8N1 until 9.5 bits after the start edge: half a bit is 5
# %, and the device can use a part of it.
BAUD_TOLERANCE: Final = 0.03
# Assumed latency timer of USB adapters whose driver does not report it, ns: the longest usual value.
UNKNOWN_USB_HOLD_NS: Final = 16 * NS_PER_MS
ACM_HOLD_NS: Final = 1 * NS_PER_MS
TIOCGICOUNT: Final = 0x545D  # ioctl: error counters of the serial driver (ioctl_tty(2))
# Number of integers in serial_icounter_struct: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun reserved[9].
ICOUNTER_INTS: Final = 20
FRAME, OVERRUN, PARITY, BREAK, BUFFER_OVERRUN = 6, 7, 8, 9, 10


# Exceptions of a port that imud explains. All other exceptions of pyserial become a LinkError too.
EXPECTED: Final = (OSError, ValueError, termios.error)
# Attributes of pyserial for its two pipes, with which another thread can end a wait in `read` or `write`.
PIPE_ENDS: Final = ("pipe_abort_read_r", "pipe_abort_read_w", "pipe_abort_write_r", "pipe_abort_write_w")


class DescriptorPort(serial.Serial):
    """A port without the pipes of pyserial: one descriptor instead of five."""

    # values of a port that pyserial could not construct: the interpreter closes such a port too
    fd: int | None = None
    is_open: bool = False

    def open(self) -> None:
        """Open the port. Raises OSError, ValueError or termios.error."""
        super().open()
        for name in PIPE_ENDS:
            descriptor = getattr(self, name, None)
            if descriptor is not None:
                os.close(descriptor)
                setattr(self, name, None)

    def close(self) -> None:
        """Release the exclusive mode and close the port. The kernel keeps this mode while another program has the port
        open, and a pseudo-terminal keeps it until its program ends."""
        descriptor = self.fd
        if descriptor is not None:
            self.fd, self.is_open = None, False
            with contextlib.suppress(OSError):  # the port was removed
                fcntl.ioctl(descriptor, termios.TIOCNXCL)
            with contextlib.suppress(OSError):  # the kernel closes the descriptor also after an error
                os.close(descriptor)


def open_port(path: str, baud: int, proc: Path) -> serial.Serial:
    """Open `path` exclusively, raw 8N1, no flow control. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
    try:
        # inter_byte_timeout=0 sets VMIN=1: a read without data then gives EAGAIN, and 0 bytes always mean a hang-up
        with LibraryCall(f"open {path}", *EXPECTED):
            port = DescriptorPort(path, baud, exclusive=True, timeout=0, write_timeout=0, inter_byte_timeout=0)
    except EXPECTED as error:
        raise port_problem(error, path, proc) from error
    try:
        with LibraryCall(f"open {path}", *EXPECTED):
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
            _finish_raw(port.fileno())
            _check_rate(port, path, baud)
    except EXPECTED as error:
        port.close()
        raise port_problem(error, path, proc) from error
    except LinkError:
        port.close()
        raise
    return port


def change_baud(port: serial.Serial, path: str, baud: int, proc: Path) -> None:
    """Set another rate and discard the bytes of the old rate. Raises LinkError for an unsupported rate."""
    try:
        with LibraryCall(f"set {baud} baud on {path}", *EXPECTED):
            port.baudrate = baud
            termios.tcflush(port.fileno(), termios.TCIFLUSH)
            _check_rate(port, path, baud)
    except EXPECTED as error:
        raise port_problem(error, path, proc) from error


def baud_of(fd: int) -> int:
    """Return the rate that the driver has set, bit/s (TCGETS2)."""
    settings = array.array("I", [0] * (TERMIOS2_INTS + 5))
    fcntl.ioctl(fd, TCGETS2, settings)
    return settings[OSPEED_INDEX]


def port_problem(error: Exception, path: str, proc: Path = PROC) -> LinkError:
    """Return the LinkError of an error of a serial port, with the next step for the user."""
    if known := open_problem(error, path, CABLE, proc):
        if errno_of(error) == errno.EBUSY and os.path.realpath(path).startswith("/dev/pts/"):
            return LinkBusy(f"{known}, or start the program again that made the pseudo-terminal (for example socat)")
        return known
    if errno_of(error) == errno.EIO:
        return LinkError(f"{path} exists without hardware; check the name of the port, and that it is enabled")
    reason = reason_of(error)
    if (os.path.exists(path) and not Path(path).is_char_device()) or reason == os.strerror(errno.ENOTTY):
        return LinkError(f"{path} is not a serial port: expected a port such as /dev/ttyUSB0")
    return LinkError(f"cannot use {path} as a serial port: {reason}")


def _finish_raw(fd: int) -> None:
    attributes = termios.tcgetattr(fd)
    attributes[0] &= ~(termios.BRKINT | termios.IGNBRK | termios.IGNPAR)
    attributes[2] &= ~termios.HUPCL
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _check_rate(port: serial.Serial, path: str, baud: int) -> None:
    real = baud_of(port.fileno())
    if abs(real - baud) > baud * BAUD_TOLERANCE:
        raise LinkError(f"{path} does not support {baud} baud: its driver set {real} baud")


def request_low_latency(port: serial.Serial, path: str, sys: Path) -> None:
    """Request low latency from driver and adapter. Many drivers and ptys do not support it."""
    # ValueError of pyserial: the driver has no TIOCSSERIAL. LinkError: any other exception of pyserial
    with contextlib.suppress(ValueError, LinkError), LibraryCall(f"request low latency of {path}", ValueError):
        port.set_low_latency_mode(True)
    timer_ms = read_latency_timer_ms(path, sys)
    if timer_ms is not None and timer_ms > 1:
        with contextlib.suppress(OSError):  # only root can write the file
            _timer(path, sys).write_text("1")


def hold_ns(path: str, sys: Path) -> int:
    """Return the latency timer of the adapter of `path`, ns; 0 without a timer."""
    timer_ms = read_latency_timer_ms(path, sys)
    if timer_ms is not None:
        return timer_ms * NS_PER_MS
    name = _node(path)
    if name.startswith("ttyUSB"):
        return UNKNOWN_USB_HOLD_NS
    return ACM_HOLD_NS if name.startswith("ttyACM") else 0


def read_latency_timer_ms(path: str, sys: Path) -> int | None:
    """Return the latency timer of the adapter, ms; None without a timer."""
    try:
        return int(_timer(path, sys).read_text())
    except (OSError, ValueError):
        return None


def _timer(path: str, sys: Path) -> Path:
    return sys / "class" / "tty" / _node(path) / "device" / "latency_timer"


def _node(path: str) -> str:
    return os.path.basename(os.path.realpath(path))


def read_counters(fd: int) -> tuple[int, ...] | None:
    """Return the ICOUNTER_INTS counters of the driver since boot; None if the driver has no counters."""
    buffer = array.array("i", [0] * ICOUNTER_INTS)
    try:
        fcntl.ioctl(fd, TIOCGICOUNT, buffer)
    except OSError:
        return None
    return tuple(buffer)


def relative(start: tuple[int, ...] | None, now: tuple[int, ...] | None) -> KernelCounters:
    """Return the difference of two sets of counters, modulo 2³², because the integers of the kernel wrap."""
    if start is None or now is None:
        return KernelCounters()
    counted = [(b - a) & 0xFFFF_FFFF for a, b in zip(start, now, strict=True)]
    return KernelCounters(
        overrun=counted[OVERRUN] + counted[BUFFER_OVERRUN],
        framing=counted[FRAME],
        parity=counted[PARITY],
        break_=counted[BREAK],
    )


class TtyCounters:
    """Error counters of one open port since this object was made; zeros if the driver has no counters (ptys)."""

    def __init__(self, fd: int, read: Callable[[int], tuple[int, ...] | None] = read_counters) -> None:
        """`read` returns the counters of a descriptor; None if the driver has no counters."""
        self._fd = fd
        self._read_counters = read
        self._start = read(fd)
        self._newest = self._start

    def read(self) -> KernelCounters:
        """Return the counters since the start; the last known values after the port was removed."""
        now = self._read_counters(self._fd)
        if now is not None:
            self._newest = now
        return relative(self._start, self._newest)


# Names of nodes: USB adapters, USB virtual ports, PL011 (Raspberry Pi), 8250 and mini-UART, SC16IS7xx, Tegra, i.MX,
# OMAP.
NODE_KINDS: Final = ("ttyUSB", "ttyACM", "ttyAMA", "ttyS", "ttySC", "ttyTHS", "ttymxc", "ttyO")
UNKNOWN_TYPE: Final = "0"  # PORT_UNKNOWN of linux/serial_core.h: the driver made a node (ttyS4…) but found no UART
ALIAS_DIRECTORIES: Final = ("by-id", "by-path")


@dataclass(frozen=True, slots=True)
class SerialPort:
    path: str  # path for the configuration: the by-id name if it is unique, otherwise by-path, otherwise the node
    node: str  # device node, for example `/dev/ttyUSB0`
    title: str  # manufacturer, product and serial number of a USB adapter; empty for other ports


def list_ports(dev: Path = Path("/dev"), sys: Path = Path("/sys")) -> list[SerialPort]:
    """List all ports with hardware, by node name in natural order.

    Equal adapters without serial numbers have the same by-id name. The adapter that it names depends on the order of
    plugging. For such adapters the path is the name of the USB socket.
    """
    ids, paths = (_aliases(dev / "serial" / directory) for directory in ALIAS_DIRECTORIES)
    nodes = sorted(_nodes(dev, sys), key=lambda node: (node.name.rstrip("0123456789"), len(node.name), node.name))
    titles = {node.name: _usb_title(sys, node.name) for node in nodes}
    nameless = {title for name, title in titles.items() if title and name not in ids}
    found = []
    for node in nodes:
        title = titles[node.name]
        names = (paths, ids) if title in nameless else (ids, paths)
        path = next((known[node.name] for known in names if node.name in known), str(node))
        found.append(SerialPort(path, str(node), title))
    return found


def _nodes(dev: Path, sys: Path) -> Iterator[Path]:
    for entry in (sys / "class" / "tty").glob("tty*"):
        if entry.name.rstrip("0123456789") in NODE_KINDS and (dev / entry.name).exists() and _is_real(entry):
            yield dev / entry.name


def _is_real(entry: Path) -> bool:
    """Return whether the driver found hardware. USB ports exist only with hardware; other ports have `type` in /sys."""
    kind = _text(entry / "type")
    return kind != UNKNOWN_TYPE if kind else (entry / "device").exists()


def _aliases(directory: Path) -> dict[str, str]:
    """Return stable names by node name."""
    found: dict[str, str] = {}
    for link in sorted(directory.glob("*")):
        found.setdefault(os.path.basename(os.path.realpath(link)), str(link))
    return found


def _usb_title(sys: Path, node: str) -> str:
    """Return the title of the USB device of a port: the nearest parent in /sys with a product name."""
    device = (sys / "class" / "tty" / node / "device").resolve()
    for parent in (device, *device.parents):
        if product := _text(parent / "product"):
            words = (_text(parent / "manufacturer"), product, _text(parent / "serial"))
            return " ".join(word for word in words if word)
        if parent == sys:
            break
    return ""


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
