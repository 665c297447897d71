"""A CAN bus: a raw SocketCAN socket, or any other interface of python-can.

Every device opens its own socket with filters for its frames, so that several share a bus without seeing the
frames of the others. Bit rate and state of the interface belong to the system (docs/can.md): imud reads them and
changes nothing. It needs no privilege, only the receive buffer may be larger than net.core.rmem_max with CAP_NET_ADMIN.
"""

import asyncio
import errno
import logging
import os
import socket
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from imud.contracts.claims import Claim
from imud.contracts.link import CanLink, LinkType, OnBusNews, OnEnd, OnFrames
from imud.contracts.settings import Settings
from imud.contracts.status import KernelCounters
from imud.errors import LinkDenied, LinkError, LinkMissing
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME, REMOTE_FLAG, CanFilter, CyclicFrame
from imud.links.can import netlink
from imud.links.can.bus_state import WATCHED, BusState
from imud.links.can.cyclic_sender import NO_MANAGER, KernelSender, LoopSender, Sender
from imud.links.can.frame_reader import BATCH_FRAMES, FrameReader
from imud.units import NS_PER_S

NATIVE: Final = "socketcan"
FRAME_BUFFER_BYTES: Final = 960
"""Bytes that the kernel charges a socket for one queued frame, about (222 fit the usual 208 KiB)."""
FRAME_BITS: Final = 95
"""A data frame of six bytes, without stuff bits: a full bus of these fills half the buffer while frames gather."""
HIGHEST_BITRATE: Final = 1_000_000
TURN_FRAMES: Final = 1024
"""Frames that are read in one turn of the event loop at most."""
CAN_RAW_ERR_FILTER: Final = 2
"""Option of SOL_CAN_RAW: classes of error frames to receive (linux/can/raw.h)."""
SO_RCVBUFFORCE: Final = 33
"""Receive buffer above net.core.rmem_max, with CAP_NET_ADMIN (asm-generic)."""

log = logging.getLogger(__name__)


class SocketCanSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a CAN bus."""

    interface: Annotated[str, Meta(min_length=1, max_length=63)]
    """Network interface, for example `can0` (`ip link` lists them); for another backend its channel."""
    receive_buffer_bytes: Annotated[int, Meta(ge=4096, le=1 << 26)] = 1 << 20
    """Kernel memory for frames that wait to be read, about 960 bytes each. The system may allow less."""
    backend: Annotated[str, Meta(min_length=1)] = NATIVE
    """`socketcan`, or the name of another interface of python-can, for example `virtual` or `slcan`."""
    bitrate: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    """Bit rate that another backend is to set, bit/s; 0 leaves it alone. For a network interface the system sets it."""

    def __post_init__(self) -> None:
        """Raises ValueError for keys that exclude each other."""
        if self.bitrate and self.backend == NATIVE:
            raise ValueError("bitrate: expected none with backend socketcan, the system sets it (docs/can.md)")


OpenSocket = Callable[[SocketCanSettings, Sequence[CanFilter]], socket.socket]


def open_raw(settings: SocketCanSettings, filters: Sequence[CanFilter]) -> socket.socket:
    """A raw CAN socket bound to the interface, with filters and the error frames to watch. Raises OSError."""
    opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    try:
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(filters))
        opened.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, struct.pack("=I", WATCHED))
        _enlarge(opened, settings)
        opened.bind((settings.interface,))
    except OSError:
        opened.close()
        raise
    return opened


def _enlarge(opened: socket.socket, settings: SocketCanSettings) -> None:
    """Enlarge the receive buffer as far as permitted; the kernel doubles the value and reports the double."""
    wanted = settings.receive_buffer_bytes
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, wanted // 2)
    except PermissionError:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted // 2)
    got = opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    if got < wanted:
        log.info(
            "%s: receive buffer of %d bytes, wanted %d (sysctl net.core.rmem_max): room for about %d frames",
            settings.interface, got, wanted, got // FRAME_BUFFER_BYTES,
        )  # fmt: skip


def pack_filters(filters: Sequence[CanFilter]) -> bytes:
    """Filters as `struct can_filter`: data frames only, and only of the named length of identifier."""
    flags = EXTENDED_FLAG | REMOTE_FLAG
    return b"".join(struct.pack("=II", f.can_id | EXTENDED_FLAG * f.extended, f.mask | flags) for f in filters)


class SocketCanLink:
    """A CAN network interface as a `CanLink`. Synchronization: the loop's thread only."""

    def __init__(
        self, settings: SocketCanSettings, *, sys: Path = netlink.SYS, open_socket: OpenSocket = open_raw
    ) -> None:
        """`open_socket` makes a bound, non-blocking socket whose messages are `struct can_frame`."""
        self._settings = settings
        self._open_socket = open_socket
        self._gather_wanted_ns = self._gather_most_ns = self._gather_ns = 0
        self._timer: asyncio.TimerHandle | None = None
        self._sys = sys
        self._socket: socket.socket | None = None
        self._reader: FrameReader | None = None
        self._state = BusState(settings.interface)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_frames: OnFrames = _ignore_frames
        self._on_news: OnBusNews = _ignore_news
        self._on_end: OnEnd = _ignore_end
        self._filters: Sequence[CanFilter] = ()
        self._sender: Sender | None = None
        self.title = self.bus = settings.interface
        self.bitrate = 0
        self.writable = True

    @property
    def filters(self) -> Sequence[CanFilter]:
        """Frames to deliver."""
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[CanFilter]) -> None:
        self._filters = filters
        if self._socket is not None:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(filters))

    @property
    def gather_ns(self) -> int:
        """Time for which frames gather before they are read, ns; 0: they are read at once."""
        return self._gather_ns

    @gather_ns.setter
    def gather_ns(self, gather_ns: int) -> None:
        self._gather_wanted_ns = gather_ns
        self._gather_ns = min(gather_ns, self._gather_most_ns)
        if not self._gather_ns and self._timer is not None:
            self._timer.cancel()
            self._read_on_time()

    def absence(self) -> str:
        """Return why the interface cannot be used now; empty when it can. Raises LinkError if it is not of kind CAN."""
        return netlink.absence(self._settings.interface, self._sys)

    async def wait_present(self) -> None:
        """Return when the interface is there and up."""
        await netlink.wait_until(lambda: not self.absence())

    def open(self) -> None:
        """Open a socket on the interface. Raises LinkMissing, LinkDenied, LinkError."""
        if reason := self.absence():
            raise LinkMissing(reason)
        details = netlink.can_details(self._settings.interface)
        self.bitrate = details.bitrate or 0
        self._state = BusState(self._settings.interface, details.state)
        try:
            self._socket = self._open_socket(self._settings, self._filters)
            self._reader = FrameReader(self._socket, self._on_error_frame)
            room_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        except OSError as error:
            self.close()
            raise self._explained(error) from error
        frame_ns = FRAME_BITS * NS_PER_S // (self.bitrate or HIGHEST_BITRATE)
        self._gather_most_ns = room_bytes // FRAME_BUFFER_BYTES // 2 * frame_ns
        self._gather_ns = min(self._gather_wanted_ns, self._gather_most_ns)

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Deliver frames from now on; a present problem of the bus is reported at once."""
        assert self._socket is not None
        self._on_frames, self._on_news, self._on_end = on_frames, on_news, on_end
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._socket.fileno(), self._read)
        if problem := self._state.problem:
            on_news(problem, problem)

    def write(self, data: bytes) -> None:
        """Send frames (`struct can_frame`), one system call each. Raises LinkError."""
        if self._socket is None:
            raise LinkError(f"{self.title} is not open: nothing can be sent")
        try:
            for at in range(0, len(data), RAW_FRAME.size):
                self._socket.send(data[at : at + RAW_FRAME.size])
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                raise LinkError(f"{self.title} does not send, its queue is full: is it alone on the bus?") from error
            raise self._explained(error) from error

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Have the kernel send these; by the event loop, less exactly, where it cannot. Raises LinkError."""
        self._end_sender()
        try:
            self._sender = KernelSender(self._settings.interface, frames)
        except OSError as error:
            if error.errno not in NO_MANAGER:
                raise self._explained(error) from error
            log.info("%s: this kernel has no CAN_BCM (module can_bcm): cyclic frames are less exact", self.title)
            self._sender = LoopSender(self.write, self._on_end, frames)

    def kernel_counters(self) -> KernelCounters:
        """Frames that the kernel or the controller dropped, and states of the controller, since `open`."""
        dropped = self._reader.dropped if self._reader else 0
        state = self._state
        return KernelCounters(dropped + state.overflows, error_passive=state.passive_count, bus_off=state.bus_off_count)

    def close(self) -> None:
        """Release the socket; may be called twice."""
        self._end_sender()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._loop is not None and self._socket is not None:
            self._loop.remove_reader(self._socket.fileno())
        self._loop = None
        self._reader = None
        opened, self._socket = self._socket, None
        if opened is not None:
            opened.close()

    def _end_sender(self) -> None:
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.close()

    def _read(self) -> None:
        """Read one batch; the loop calls again for the rest. Where frames may gather, those that follow do."""
        loop, opened = self._loop, self._socket
        count = self._read_batch()
        if self._gather_ns and count and loop is not None and opened is not None and opened is self._socket:
            loop.remove_reader(opened.fileno())
            self._timer = loop.call_later(self._gather_ns / NS_PER_S, self._read_on_time)

    def _read_on_time(self) -> None:
        """Read all that has gathered. A bus without frames is watched again."""
        self._timer = None
        loop, opened = self._loop, self._socket
        count = total = self._read_batch()
        while count >= BATCH_FRAMES // 2 and total < TURN_FRAMES:  # some of the batch may be no data frames
            count = self._read_batch()
            total += count
        if loop is None or opened is None or opened is not self._socket or count < 0:  # ended, or was closed
            return
        if total and self._gather_ns:
            self._timer = loop.call_later(self._gather_ns / NS_PER_S, self._read_on_time)
        else:
            loop.add_reader(opened.fileno(), self._read)

    def _read_batch(self) -> int:
        """Read and deliver one batch; returns its number of frames, -1 when the bus ended."""
        if self._reader is None:
            return -1
        try:
            frames = self._reader.read()
        except OSError as error:
            self._end(error)
            return -1
        if frames:
            self._on_frames(frames)
        return len(frames)

    def _on_error_frame(self, classes: int, data: bytes) -> bool:
        state = self._state
        overflows = state.overflows
        if news := state.add_error_frame(classes, data):
            self._on_news(news, state.problem)
        return state.overflows > overflows

    def _end(self, error: OSError) -> None:
        if self._loop is not None and self._socket is not None:
            self._loop.remove_reader(self._socket.fileno())
        self._on_end(self._explained(error))

    def _explained(self, error: OSError) -> LinkError:
        name = self.title
        if error.errno in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            reason = "was taken down" if error.errno == errno.ENETDOWN else "is gone"
            return LinkMissing(f"{name} {reason}: waiting for it to come up")
        if error.errno == errno.EAFNOSUPPORT:
            return LinkError(f"{name}: this kernel has no CAN (expected AF_CAN; is the module can_raw there?)")
        if isinstance(error, PermissionError):
            return LinkDenied(f"{name} may not be opened by this user")
        return LinkError(f"{name}: {os.strerror(error.errno or 0)}")


def _ignore_frames(_frames: object) -> None:
    """The receiver before `start`."""


def _ignore_news(_news: str, _problem: str) -> None:
    """The receiver before `start`."""


def _ignore_end(_error: LinkError | None) -> None:
    """The receiver before `start`."""


def make(settings: SocketCanSettings) -> CanLink:
    """The link for the backend that the settings name."""
    if settings.backend == NATIVE:
        return SocketCanLink(settings)
    from imud.links.can.python_can import PythonCanLink

    return PythonCanLink(settings.backend, settings.interface, settings.bitrate)


def _claims(settings: SocketCanSettings) -> list[Claim]:
    """A bus, which devices share; the port of a serial adapter (`slcan` and others) is for one of them."""
    name, port = settings.interface, settings.interface.startswith("/")
    place = name if port or settings.backend == NATIVE else f"{name} ({settings.backend})"
    return [Claim(place=place, key="interface", shared=not port, terms={"bitrate": settings.bitrate})]


LINK = LinkType("socketcan", SocketCanSettings, make_can=make, claims=_claims)
