"""Requests of GPIO lines: inputs and outputs of GPIO chips.

gpiod requests a line. imud then reads the edge events from the descriptor of the request as structs of the kernel,
which needs less than half of the CPU time of gpiod's objects. imud does not debounce, because a debounced edge has the
time of its acceptance. With detection of both edges, the kernel reads the level only when its interrupt thread runs,
and a short pulse can become one edge. If only rising edges carry information, imud requests only rising edges.
"""

import asyncio
import ctypes
import errno
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from struct import Struct
from typing import Any, Final, NamedTuple

from imud.contracts.lines import Edge, InputOptions, LineFactory, LineOptions, OnEdges, OnLineEnd, OutputOptions
from imud.host.files import group_of, user_name
from imud.host.installation import install_command
from imud.host.library_call import LibraryCall
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing

DEVICES: Final = Path("/dev")
GPIOD: Final = "gpiod>=2.3"  # requirement of the package
GROUP: Final = "gpio"  # group of GPIO chips on Raspberry Pi OS, for messages about a chip that belongs to root
GONE: Final = frozenset({errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EBADF})  # errors of a removed chip


class LineLocation(NamedTuple):
    """Chip and offset of a line."""

    path: str  # device node of the chip
    offset: int  # offset of the line on the chip
    name: str  # name of the line; empty without a name

    def __str__(self) -> str:
        named = f" ({self.name})" if self.name else ""
        return f"{os.path.basename(self.path)} line {self.offset}{named}"


def load_gpiod() -> Any:
    """Import gpiod. Raises LinkError if it is not installed, or if it is the module of libgpiod 1."""
    try:
        with LibraryCall("import gpiod", ImportError):
            import gpiod
    except ImportError as error:
        raise LinkError(
            f"GPIO lines need the Python package gpiod, got none; run `{install_command(GPIOD)}`"
        ) from error
    if not hasattr(gpiod, "request_lines"):
        raise LinkError(
            f"GPIO lines need gpiod 2.3 or later, got the module of libgpiod 1 ({gpiod.__file__}) of Debian 12; "
            f"run `{install_command(GPIOD)}`"
        )
    return gpiod


def find_line(gpiod: Any, settings: LineOptions, devices: Path = DEVICES) -> LineLocation:
    """Find the configured line. Raises LinkMissing, LinkDenied, or LinkError if two lines match."""
    chips, denied = _chips(gpiod, settings.chip, devices)
    found = [
        LineLocation(chip.path, offset, name)
        for chip in chips
        for offset, name in enumerate(chip.names)
        if settings.line in (offset, name)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        matches = " and ".join(map(str, found))
        raise LinkError(f"expected the name {settings.line} on one line, got it on {matches}: give chip and number")
    raise denied or _no_line(settings.line, chips)


def chip_error(error: OSError, path: str) -> LinkError:
    """Return the LinkError for a chip that imud cannot use."""
    if error.errno in GONE:
        return LinkMissing(f"{path} is missing, or is not a GPIO chip: {os.strerror(error.errno or 0)}")
    if error.errno == errno.EPERM:  # EPERM: the control group; the group of the node would cause EACCES
        return LinkDenied(
            f"cannot open {path}: the control group of this process does not allow the device (EPERM, not its "
            f"group); add a line `DeviceAllow={path} rw` to the unit (`systemctl edit imud`), and restart imud"
        )
    if error.errno == errno.EACCES:
        group, user = group_of(path, GROUP), user_name()
        return LinkDenied(
            f"cannot open {path}: user {user} lacks the permission; the node must belong to group {group}, with read "
            f"and write access, and {user} to that group; run `sudo usermod -aG {group} {user}` and log in again"
        )
    return LinkError(f"cannot use {path} as a GPIO chip: {os.strerror(error.errno or 0)}")


def request_error(gpiod: Any, error: OSError, location: LineLocation) -> LinkError:
    """Return the LinkError for a line request that the kernel refused."""
    if error.errno == errno.EBUSY:
        holder = ""
        # the chip may be removed by now
        with suppress(OSError, LinkError), LibraryCall("read", OSError), gpiod.Chip(location.path) as chip:
            holder = chip.get_line_info(location.offset).consumer or ""
        return LinkBusy(f"{location} is in use by {holder or 'an unknown program'}: stop it, or choose another line")
    if error.errno in (errno.ENODEV, errno.ENOENT, errno.EACCES, errno.EPERM):
        return chip_error(error, location.path)
    reason = os.strerror(error.errno or 0)
    return LinkError(f"{location} cannot be requested: {reason}; an input needs a chip with interrupts")


class _Chip(NamedTuple):
    path: str
    label: str
    names: tuple[str, ...]  # names of the lines by offset; empty for a line without a name

    def __str__(self) -> str:
        return f"{os.path.basename(self.path)} ({self.label})"


def _chips(gpiod: Any, wanted: str, devices: Path) -> tuple[Sequence[_Chip], LinkDenied | None]:
    """Return the chips to search, and the error of a chip that imud may not open."""
    node = devices / wanted  # an absolute path stays unchanged
    if wanted and node.exists():
        return [_read(gpiod, str(node))], None
    chips: list[_Chip] = []
    denied: LinkDenied | None = None
    for path in _nodes(devices):
        try:
            chips.append(_read(gpiod, path))
        except LinkDenied as error:
            denied = error
        except LinkMissing:
            continue  # removed after `_nodes`
    if not wanted:
        return chips, denied
    found = [chip for chip in chips if chip.label == wanted]
    if len(found) > 1:
        raise LinkError(f"expected the label {wanted} on one GPIO chip, got it on {' and '.join(map(str, found))}")
    if not found:
        there = ", ".join(map(str, chips)) or "none"
        raise denied or LinkMissing(f"GPIO chip {wanted} does not exist; existing chips: {there}")
    return found, None


def _nodes(devices: Path) -> list[str]:
    """Return the nodes of all chips by number, without symbolic links (/dev/gpiochip4 of a Raspberry Pi 5)."""
    nodes = [node for node in devices.glob("gpiochip*") if not node.is_symlink()]
    return [str(node) for node in sorted(nodes, key=lambda node: int(re.sub(r"\D", "", node.name) or 0))]


def _read(gpiod: Any, path: str) -> _Chip:
    try:
        with LibraryCall(f"use {path} as a GPIO chip", OSError), gpiod.Chip(path) as chip:
            info = chip.get_info()
            return _Chip(path, info.label, tuple(chip.get_line_info(n).name or "" for n in range(info.num_lines)))
    except OSError as error:
        raise chip_error(error, path) from error


def _no_line(line: int | str, chips: Sequence[_Chip]) -> LinkMissing:
    if isinstance(line, int):
        return LinkMissing(f"{chips[0]} has no line {line}: its lines are 0 to {len(chips[0].names) - 1}")
    names = [name for chip in chips for name in chip.names if name]
    from difflib import get_close_matches  # as in `unknown_name`

    near = get_close_matches(line, names, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    where = ", ".join(map(str, chips)) or "any chip: no chip exists"
    return LinkMissing(f"no line has the name {line} on {where}{hint} (`gpioinfo` lists names)")


EVENT: Final = Struct("=QIIII24x")  # struct gpio_v2_line_event
RISING: Final = 1  # `id` of an edge from inactive to active (GPIO_V2_LINE_EVENT_RISING_EDGE). 2 is the falling edge.
# GPIO_V2_LINE_SET_VALUES_IOCTL. The argument is two u64: the levels, and the mask of the request's lines to set.
SET_VALUES: Final = 0xC010B40F
_SEQNO_MODULUS: Final = 2**32

ioctl = ctypes.PyDLL(None, use_errno=True).ioctl  # PyDLL keeps the GIL
ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)
_LEVELS = {active: (ctypes.c_uint64 * 2)(active, 1) for active in (False, True)}


class LineEventDecoder:
    """Decoder of the edge events of one line. It numbers them over all requests of the line, and counts lost edges.

    Synchronization: one thread.
    """

    def __init__(self) -> None:
        self.lost = 0  # number of edges that the kernel dropped
        self._number = 0
        self._seqno = 0

    def restart(self) -> None:
        """Start a new request: the kernel restarts its count at 1, the edge numbers continue."""
        self._seqno = 0

    def decode(self, data: bytes) -> list[Edge]:
        """Return the edges in `data`, which contains complete events."""
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
    if ioctl(fd, SET_VALUES, _LEVELS[active]) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


# capacity of the kernel's event buffer of a line, its maximum: one second of SOUT at 1 kHz
KERNEL_EVENTS: Final = 1024
READ_EVENTS: Final = 64  # number of events in one read
CONSUMER_CHARACTERS: Final = 31  # maximum length of a consumer name in the kernel (GPIO_MAX_NAME_SIZE - 1)


class _Line:
    def __init__(self, settings: LineOptions, purpose: str, devices: Path) -> None:
        """`purpose` follows `imud` in the consumer name, which other programs display."""
        self._settings = settings
        self._purpose = purpose
        self._devices = devices
        self._request: Any = None
        self._location = LineLocation(settings.chip, -1, "")
        self._fd = -1
        self.title = f"{settings.chip} line {settings.line}".lstrip()

    def _open(self, config: Callable[[Any], Any], events: int | None) -> None:
        """Find and request the line. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        gpiod = load_gpiod()
        location = find_line(gpiod, self._settings, self._devices)
        consumer = f"imud {self._purpose}".strip()[:CONSUMER_CHARACTERS]
        try:
            with LibraryCall(f"request {location}", OSError):
                self._request = gpiod.request_lines(
                    location.path, {location.offset: config(gpiod)}, consumer, event_buffer_size=events
                )
        except OSError as error:
            raise request_error(gpiod, error, location) from error
        self._location, self._fd = location, self._request.fd
        self.title = str(location)

    def _release(self) -> None:
        request, self._request, self._fd = self._request, None, -1
        if request is not None:
            with suppress(OSError, LinkError), LibraryCall(f"release {self.title}", OSError):  # the chip was removed
                request.release()

    def _error(self, error: OSError) -> LinkError:
        if error.errno in GONE:
            return LinkMissing(f"{self.title} is missing ({os.strerror(error.errno or 0)}): was its adapter unplugged?")
        return LinkError(f"{self.title} cannot be used: {os.strerror(error.errno or 0)}")


class GpioInput(_Line):
    """Input line of a GPIO chip (contract `InputLine`). Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: InputOptions, purpose: str = "", rising_only: bool = False, *, devices: Path = DEVICES
    ) -> None:
        super().__init__(settings, purpose, devices)
        self._edges = "RISING" if rising_only else "BOTH"
        self._bias = settings.bias.replace("-", "_").upper()
        self._decoder = LineEventDecoder()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_edges: OnEdges | None = None
        self._on_end: OnLineEnd | None = None

    @property
    def edges_lost(self) -> int:
        """Return the number of edges that the kernel dropped, because imud did not read them in time."""
        return self._decoder.lost

    def open(self) -> None:
        """Request the line. The kernel then buffers its edges. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._open(self._config, KERNEL_EVENTS)
        os.set_blocking(self._fd, False)
        self._decoder.restart()

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver the edges since `open` and each new edge. Without `watch`, deliver edges only in `drain`."""
        self._on_edges, self._on_end = on_edges, on_end
        self._loop = asyncio.get_running_loop()
        if watch:
            self._loop.add_reader(self._fd, self.drain)

    def fileno(self) -> int:
        """Return the descriptor of the request; -1 while the line is closed."""
        return self._fd

    def drain(self) -> None:
        """Read and deliver the buffered edges. Do not block. Without edges, this is one system call."""
        if self._on_edges is None:
            return
        for _ in range(KERNEL_EVENTS // READ_EVENTS):  # limited: a floating wire must not block the loop
            try:
                data = os.read(self._fd, READ_EVENTS * EVENT.size)
            except BlockingIOError:
                return
            except OSError as error:
                self._end(self._error(error))
                return
            self._on_edges(self._decoder.decode(data))
            if len(data) < READ_EVENTS * EVENT.size or self._on_edges is None:
                return

    def level(self) -> bool:
        """Return whether the line is active. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            with LibraryCall(f"read {self.title}", OSError):
                return bool(self._request.get_value(self._location.offset))
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Release the line. A second call does nothing."""
        if self._loop is not None:
            self._loop.remove_reader(self._fd)
        self._loop = self._on_edges = self._on_end = None
        self._release()

    def _end(self, error: LinkError) -> None:
        on_end = self._on_end
        self.close()
        if on_end is not None:
            on_end(error)

    def _config(self, gpiod: Any) -> Any:
        line = gpiod.line
        return gpiod.LineSettings(
            direction=line.Direction.INPUT,
            edge_detection=getattr(line.Edge, self._edges),
            event_clock=line.Clock.MONOTONIC,
            bias=getattr(line.Bias, self._bias),
            active_low=self._settings.active_low,
        )


class GpioOutput(_Line):
    """Output line of a GPIO chip (contract `OutputLine`). Synchronization: one thread at a time."""

    def __init__(
        self,
        settings: OutputOptions,
        purpose: str = "",
        *,
        devices: Path = DEVICES,
        drive: Callable[[int, bool], None] | None = None,
    ) -> None:
        """`drive` sets the level of the line with the descriptor of its request; None for `set_line`."""
        super().__init__(settings, purpose, devices)
        self._open_drain = settings.open_drain
        self._drive = drive or set_line

    def open(self) -> None:
        """Request the line as an output with inactive level. Raises as `GpioInput.open`."""
        self._open(self._config, None)

    def set(self, active: bool) -> None:
        """Set the level of the line. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            self._drive(self._fd, active)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Set the line inactive and release it. A second call does nothing."""
        with suppress(OSError):  # the chip was removed
            if self._request is not None:
                self._drive(self._fd, False)
        self._release()

    def _config(self, gpiod: Any) -> Any:
        line = gpiod.line
        return gpiod.LineSettings(
            direction=line.Direction.OUTPUT,
            output_value=line.Value.INACTIVE,
            drive=line.Drive.OPEN_DRAIN if self._open_drain else line.Drive.PUSH_PULL,
            active_low=self._settings.active_low,
        )


__all__ = ["GPIO_LINES", "GpioInput", "GpioOutput"]

GPIO_LINES: Final = LineFactory(GpioInput, GpioOutput)
