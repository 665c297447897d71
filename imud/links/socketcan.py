"""A CAN bus: a raw SocketCAN socket, or another interface of python-can.

Each device opens its own socket with filters for its frames. Several devices share a bus and do not see the frames of
the others. The system sets bit rate and state of the interface (docs/can.md). imud reads both and changes neither. imud
needs no privilege. With CAP_NET_ADMIN, the receive buffer can be larger than net.core.rmem_max.
"""

import asyncio
import ctypes
import errno
import logging
import os
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import Meta

from imud.contracts.link import CanLink, Claim, HostProblem, LinkType, OnBusNews, OnEnd, OnFrames
from imud.contracts.status import KernelCounters
from imud.formats import kernel
from imud.formats.can import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    FD_DATA_BYTES_MAX,
    RAW_FD_FRAME,
    RAW_FRAME,
    REMOTE_FLAG,
    CanFilter,
    CanFrame,
    CyclicFrame,
    interface_problem,
    pack_filters,
)
from imud.host import netlink
from imud.host.files import user_name
from imud.links.can_backends import backend_problem, check_backend
from imud.links.cyclic_sender import NO_MANAGER, KernelSender, LoopSender, Sender
from imud.model.errors import LinkDenied, LinkError, LinkMissing
from imud.model.options import Options
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

CLASS_CONTROLLER: Final = 0x0004
CLASS_BUS_OFF: Final = 0x0040
CLASS_RESTARTED: Final = 0x0100
# Classes of error frames to receive. Single errors of the bus are excluded: a bad cable causes thousands per second.
WATCHED: Final = CLASS_CONTROLLER | CLASS_BUS_OFF | CLASS_RESTARTED

RECEIVE_OVERFLOW: Final = 0x01
WARNING: Final = 0x04 | 0x08
PASSIVE: Final = 0x10 | 0x20
ACTIVE: Final = 0x40  # bits of the second data byte, for receiver and transmitter


class ControllerState(IntEnum):
    """Error states of a CAN controller, with the numbers of `enum can_state` (linux/can/netlink.h)."""

    ACTIVE = 0  # the controller takes part in all traffic
    WARNING = 1  # an error counter is above 96
    PASSIVE = 2  # An error counter is above 127. The controller does not send active error flags.
    BUS_OFF = 3  # The transmit error counter is above 255. The controller has left the bus.


_WORDS: Final = {
    ControllerState.ACTIVE: "error-active again",
    ControllerState.WARNING: "near its error limit (warning)",
    ControllerState.PASSIVE: "error-passive",
    ControllerState.BUS_OFF: "bus-off",
}
_HELP: Final = {
    ControllerState.PASSIVE: "check that all nodes have the same bit rate, and that the bus is terminated at both ends",
    ControllerState.BUS_OFF: (
        "it left the bus; run `ip link set {name} down`, then `ip link set {name} up type can restart-ms 100` for an "
        "automatic recovery"
    ),
}


class BusState:
    """State of the controller of one interface, with counts of its error-passive and bus-off states."""

    def __init__(self, name: str, state: int | None = None) -> None:
        """`state` is the number of the kernel; None if the driver does not report it (virtual interfaces)."""
        self._name = name
        known = state is not None and state in ControllerState.__members__.values()
        self.state = ControllerState(state) if known else ControllerState.ACTIVE  # type: ignore[arg-type]  # not None
        self.passive_count = 0
        self.bus_off_count = 0
        self.overflows = 0  # number of overflows of the controller's receive buffer
        # Changes of the state, each with the problem of the new state. The owner removes them.
        self.news: list[tuple[str, str]] = []

    @property
    def problem(self) -> str:
        """Return the fault in one sentence; empty in the states error-active and warning."""
        advice = _HELP.get(self.state)
        return f"{self._name} is {_WORDS[self.state]}: {advice.format(name=self._name)}" if advice else ""

    def add_error_frame(self, classes: int, data: bytes) -> bool:
        """Record an error frame. Return whether the controller lost frames."""
        status = data[1] if classes & CLASS_CONTROLLER else 0
        is_overflow = bool(status & RECEIVE_OVERFLOW)
        self.overflows += is_overflow
        state = self._named(classes, status)
        if state is not None and state is not self.state:
            self.passive_count += state is ControllerState.PASSIVE
            self.bus_off_count += state is ControllerState.BUS_OFF
            self.state = state
            self.news.append((self.problem or f"{self._name} is {_WORDS[state]}", self.problem))
        return is_overflow

    def _named(self, classes: int, status: int) -> ControllerState | None:
        """Return the state that an error frame names; None if it names no state."""
        if classes & CLASS_BUS_OFF:
            return ControllerState.BUS_OFF
        if status & PASSIVE:
            return ControllerState.PASSIVE
        if status & WARNING:
            return ControllerState.WARNING
        return ControllerState.ACTIVE if status & ACTIVE or classes & CLASS_RESTARTED else None


# Maximum number of frames per read: 8 ms of a full bus at 1 Mbit/s. The next turn of the loop reads the rest.
BATCH_FRAMES: Final = 64
# Socket option and message type of arrival times: two 64-bit integers, s and ns (Linux 5.1, asm-generic).
SO_TIMESTAMPNS_NEW: Final = 64
# Socket option and message type of the number of frames that a full receive buffer dropped: u32.
SO_RXQ_OVFL: Final = 40
# Maximum distance of two clock reads, ns. After a longer distance, imud reads again, at most STEADY_TRIES times.
STEADY_NS: Final = 20 * NS_PER_US
STEADY_TRIES: Final = 3
_COUNT_MASK: Final = 0xFFFF_FFFF
_NO_DATA_FLAGS: Final = ERROR_FLAG | REMOTE_FLAG

_WORD_BYTES: Final = struct.calcsize("P")
_CONTROL_BYTES: Final = 64
_STAMP: Final = f"{_WORD_BYTES + 4}xiqq"  # length, level, type, s, ns
_DROPS: Final = f"{_WORD_BYTES + 4}xiI"  # length, level, type, count
# Layout of the two control messages of the kernel, without lengths and levels.
_CONTROL: Final = struct.Struct(f"={_STAMP}{_DROPS}{_CONTROL_BYTES - struct.calcsize(f'={_STAMP}{_DROPS}')}x")

_Rows = Iterable[tuple[tuple[Any, ...], tuple[Any, ...]]]  # frames and their control messages


libc: Final = ctypes.CDLL(None, use_errno=True)
# `recvmmsg` that keeps the interpreter lock. The calls never block.
_receive: Final = ctypes.PyDLL(None, use_errno=True).recvmmsg


class MessageHeader(ctypes.Structure):
    """`struct msghdr` (recvmsg(2))."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_bytes", ctypes.c_uint32),
        ("vector", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class MessageBuffers(ctypes.Structure):
    """`struct mmsghdr` (recvmmsg(2), sendmmsg(2))."""

    _fields_ = (("header", MessageHeader), ("received_bytes", ctypes.c_uint))


class Vector(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("bytes", ctypes.c_size_t))


_MESSAGE_BYTES: Final = ctypes.sizeof(MessageBuffers)
_NO_WAIT: Final = int(socket.MSG_DONTWAIT)
# Constructor of `CanFrame` at a third of the usual cost.
_new_frame: Final[Callable[[tuple[int, bool, bytes, int, bool]], CanFrame]] = partial(tuple.__new__, CanFrame)


# Minimum change of the clock offset that counts as a step, ns. A smaller change can be an error of the two readings.
STEP_NS: Final = 100 * NS_PER_US
# Maximum time from the time stamp of a frame to its arrival in the queue of the socket, ns
BACKLOG_NS: Final = 5 * NS_PER_MS


class FrameReader:
    """Receiving side of a socket with messages `struct canfd_frame` or `struct can_frame`. The caller closes it."""

    def __init__(
        self, receiver: socket.socket, state: BusState, now_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:  # fmt: skip
        """Enable time stamps and the drop counter of the socket. `state` records error frames."""
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS_NEW, 1)
        receiver.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self.dropped = 0  # number of frames that the kernel dropped because the receive buffer was full
        self._state = state
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._frames = bytearray(RAW_FD_FRAME.size * BATCH_FRAMES)
        self._control = bytearray(_CONTROL_BYTES * BATCH_FRAMES)
        self._vectors = (Vector * BATCH_FRAMES)()
        self._headers = bytearray(_MESSAGE_BYTES * BATCH_FRAMES)
        self._messages = (MessageBuffers * BATCH_FRAMES).from_buffer(self._headers)
        self._assign_buffers()
        self._fresh_headers = bytes(self._headers)
        self._fd = receiver.fileno()
        self._empty_ns = self._newest_ns = now_ns()
        self._empty_offset_ns = self._clocks()[0]  # of the last read that emptied the queue, ns
        self._lost = False

    def read(self) -> list[CanFrame]:
        """Return the waiting data frames, at most BATCH_FRAMES, oldest first. Raises OSError of the kernel."""
        begun_ns, module = self._now_ns(), kernel.present.module
        count: int = self._receive() if module is None else module.receive(self._fd, self._frames, self._control)
        if count < 0:
            return self._failed(-count, begun_ns)
        offset_ns, now_ns = self._clocks()
        frames = None if module is None or self._lost else self._usual(module, count, offset_ns, now_ns)
        if frames is None and count == 1:  # usual on a quiet bus: saves two iterators
            only = RAW_FD_FRAME.unpack_from(self._frames), _CONTROL.unpack_from(self._control)
            frames = self._decoded((only,), offset_ns, now_ns)
        elif frames is None:
            raw = memoryview(self._frames)[: count * RAW_FD_FRAME.size]
            control = memoryview(self._control)[: count * _CONTROL_BYTES]
            rows = zip(RAW_FD_FRAME.iter_unpack(raw), _CONTROL.iter_unpack(control), strict=True)
            frames = self._decoded(rows, offset_ns, now_ns)
        if count < BATCH_FRAMES:
            self._empty_ns, self._empty_offset_ns = begun_ns, offset_ns
        return frames

    def _receive(self) -> int:
        """Do `receive` of the kernel in C."""
        count: int = _receive(self._fd, self._messages, BATCH_FRAMES, _NO_WAIT, None)
        if count < 0:
            return -ctypes.get_errno()
        self._headers[: count * _MESSAGE_BYTES] = self._fresh_headers[: count * _MESSAGE_BYTES]
        return count

    def _step_ns(self, offset_ns: int) -> int:
        """Return the step of CLOCK_REALTIME since the queue was empty, ns; 0 without a step."""
        step_ns = offset_ns - self._empty_offset_ns
        return 0 if -STEP_NS < step_ns < STEP_NS else step_ns

    def _usual(self, module: Any, count: int, offset_ns: int, now_ns: int) -> list[CanFrame] | None:
        """Return the result of `_decoded` from the kernel in C; None if Python must decode the frames."""
        newest_ns = self._newest_ns if self._newest_ns > self._empty_ns else self._empty_ns
        frames: list[CanFrame] | None = module.can_frames(
            CanFrame, self._frames, self._control, count, self.dropped & _COUNT_MASK, offset_ns,
            self._step_ns(offset_ns), now_ns, newest_ns,
        )  # fmt: skip
        if frames is not None:
            self._newest_ns = frames[-1].t_rx_ns
        return frames

    def _decoded(self, rows: _Rows, offset_ns: int, now_ns: int) -> list[CanFrame]:
        frames: list[CanFrame] = []
        newest_ns, empty_ns, dropped, lost = self._newest_ns, self._empty_ns, self.dropped & _COUNT_MASK, self._lost
        newest_ns, stepped_ns = newest_ns if newest_ns > empty_ns else empty_ns, self._step_ns(offset_ns)
        for (can_id, size, _, data), (kind, seconds, ns, drop_kind, drops) in rows:
            if drop_kind == SO_RXQ_OVFL and drops != dropped:
                self.dropped += (drops - dropped) & _COUNT_MASK
                dropped, lost = drops, True
            if can_id & _NO_DATA_FLAGS:
                if can_id & ERROR_FLAG:
                    lost |= self._state.add_error_frame(can_id ^ ERROR_FLAG, data)
                continue
            t_ns = seconds * NS_PER_S + ns - offset_ns if kind == SO_TIMESTAMPNS_NEW else now_ns
            if stepped_ns and not newest_ns < t_ns <= now_ns and newest_ns < t_ns + stepped_ns <= now_ns:
                t_ns += stepped_ns
            if t_ns > newest_ns:
                newest_ns = t_ns
            elif t_ns < newest_ns - BACKLOG_NS:
                newest_ns = now_ns
            if newest_ns > now_ns:  # noqa: PLR1730
                newest_ns = now_ns
            whole = data if size == FD_DATA_BYTES_MAX else data[:size]  # the buffer can contain older bytes after it
            frames.append(_new_frame((can_id & EXTENDED_ID_MAX, can_id >= EXTENDED_FLAG, whole, newest_ns, lost)))
            lost = False
        self._newest_ns, self._lost = newest_ns, lost
        return frames

    def _clocks(self) -> tuple[int, int]:
        """Return CLOCK_REALTIME minus CLOCK_MONOTONIC, and CLOCK_MONOTONIC, ns."""
        before_ns, wall_ns, now_ns = self._now_ns(), self._wall_ns(), self._now_ns()
        best_ns, offset_ns, tries = now_ns - before_ns, wall_ns - (before_ns + now_ns) // 2, 1
        while best_ns > STEADY_NS and tries < STEADY_TRIES:
            before_ns, wall_ns, now_ns = self._now_ns(), self._wall_ns(), self._now_ns()
            tries += 1
            if now_ns - before_ns < best_ns:
                best_ns, offset_ns = now_ns - before_ns, wall_ns - (before_ns + now_ns) // 2
        return offset_ns, now_ns

    def _failed(self, number: int, begun_ns: int) -> list[CanFrame]:
        if number in (errno.EAGAIN, errno.EINTR):
            self._empty_ns = begun_ns
            return []
        raise OSError(number, os.strerror(number))

    def _assign_buffers(self) -> None:
        """Give each message the bytes of one frame and its part of the control buffer."""
        frames = ctypes.addressof(ctypes.c_char.from_buffer(self._frames))
        control = ctypes.addressof(ctypes.c_char.from_buffer(self._control))
        vector = ctypes.addressof(self._vectors)
        for i, message in enumerate(self._messages):
            self._vectors[i].base = frames + i * RAW_FD_FRAME.size
            self._vectors[i].bytes = RAW_FD_FRAME.size
            header = message.header
            header.vector, header.vector_count = vector + i * ctypes.sizeof(Vector), 1
            header.control, header.control_bytes = control + i * _CONTROL_BYTES, _CONTROL_BYTES


NATIVE: Final = "socketcan"
# Memory that the kernel charges for one queued frame, bytes, about (222 frames fit the usual 208 KiB).
FRAME_BUFFER_BYTES: Final = 960
# Length of a data frame of six bytes without stuff bits, bit. A full bus of these frames fills half the buffer during a
# hold.
FRAME_BITS: Final = 95
HIGHEST_BITRATE: Final = 1_000_000
TURN_FRAMES: Final = 1024  # maximum number of frames in one turn of the event loop
CAN_RAW_ERR_FILTER: Final = 2  # option of SOL_CAN_RAW: classes of error frames to receive (linux/can/raw.h)
SO_RCVBUFFORCE: Final = 33  # socket option: receive buffer above net.core.rmem_max, with CAP_NET_ADMIN (asm-generic)

log = logging.getLogger(__name__)


class SocketCanOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a CAN bus."""

    interface: Annotated[str, Meta(min_length=1, max_length=63)]
    """Network interface, for example `can0` (`ip link` lists them). For another backend: its channel."""
    receive_buffer_bytes: Annotated[int, Meta(ge=4096, le=1 << 26)] = 1 << 20
    """Kernel memory for waiting frames, bytes; a frame needs about 960. The system can allow less."""
    backend: Annotated[str, Meta(min_length=1)] = NATIVE
    """`socketcan`, or another interface of python-can, for example `virtual` or `slcan`."""
    bitrate: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    """Bit rate that imud sets for another backend, bit/s; 0: unchanged. The system sets the rate of a network
    interface."""
    data_bitrate: Annotated[int, Meta(ge=0, le=8_000_000)] = 0
    """Bit rate of the data phase of CAN FD that imud sets for another backend, bit/s; 0: classical CAN."""

    def __post_init__(self) -> None:
        """Raises ValueError for an unknown backend, an invalid interface, and keys that exclude each other."""
        if self.backend != NATIVE:
            check_backend(self.backend)
        elif reason := interface_problem(self.interface):
            raise ValueError(f"interface: {reason}")
        for key in ("bitrate", "data_bitrate"):
            if getattr(self, key) and self.backend == NATIVE:
                raise ValueError(f"{key}: expected no value with backend socketcan; the system sets it (docs/can.md)")


OpenSocket = Callable[[SocketCanOptions, Sequence[CanFilter]], socket.socket]


def open_raw(settings: SocketCanOptions, filters: Sequence[CanFilter]) -> socket.socket:
    """Open a raw CAN socket on the interface, with filters, the error frames WATCHED and CAN FD. Raises OSError."""
    opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    try:
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(filters))
        opened.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, struct.pack("=I", WATCHED))
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)  # no effect without CAN FD
        _enlarge(opened, settings)
        opened.bind((settings.interface,))
    except OSError:
        opened.close()
        raise
    return opened


def _enlarge(opened: socket.socket, settings: SocketCanOptions) -> None:
    """Enlarge the receive buffer as far as permitted. The kernel doubles the value and reports the doubled value."""
    wanted = settings.receive_buffer_bytes
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, wanted // 2)
    except PermissionError:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted // 2)
    got = opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    if got < wanted:
        log.info(
            "%s: receive buffer of %d bytes, requested %d (sysctl net.core.rmem_max): room for about %d frames",
            settings.interface, got, wanted, got // FRAME_BUFFER_BYTES,
        )  # fmt: skip


class SocketCanLink:
    """A CAN network interface as a `CanLink`. Synchronization: the loop's thread only."""

    def __init__(
        self, settings: SocketCanOptions, *, sys: Path = netlink.SYS, open_socket: OpenSocket = open_raw
    ) -> None:
        """`open_socket` returns a bound, non-blocking socket with messages `struct can_frame`."""
        self._settings = settings
        self._open_socket = open_socket
        self._gather_wanted_ns = self._gather_most_ns = self._gather_ns = 0
        self._timer: asyncio.TimerHandle | None = None
        self._sys = sys
        self._socket: socket.socket | None = None
        self._reader: FrameReader | None = None
        self._state = BusState(settings.interface)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_frames: OnFrames = _ignore
        self._on_news: OnBusNews = _ignore
        self._on_end: OnEnd = _ignore
        self._filters: Sequence[CanFilter] = ()
        self._sender: Sender | None = None
        self.title = self.bus = settings.interface
        self.bitrate = 0
        self.writable = True

    @property
    def filters(self) -> Sequence[CanFilter]:
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[CanFilter]) -> None:
        self._filters = filters
        if self._socket is not None:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(filters))

    @property
    def gather_ns(self) -> int:
        """Time for which the link holds frames before a read, ns; 0: the link reads immediately."""
        return self._gather_ns

    @gather_ns.setter
    def gather_ns(self, gather_ns: int) -> None:
        self._gather_wanted_ns = gather_ns
        self._gather_ns = min(gather_ns, self._gather_most_ns)
        if not self._gather_ns and self._timer is not None:
            self._timer.cancel()
            self._read_on_time()

    def absence(self) -> str:
        """Return why the interface cannot be used now; empty if it can. Raises LinkError for other interfaces."""
        return netlink.absence(self._settings.interface, self._sys)

    async def wait_present(self) -> None:
        await netlink.wait_until(lambda: not self.absence())

    def open(self) -> None:
        """Open a socket on the interface. Raises LinkMissing, LinkDenied or LinkError."""
        if reason := self.absence():
            raise LinkMissing(reason)
        details = netlink.can_details(self._settings.interface)
        self.bitrate = details.bitrate or 0
        self._state = BusState(self._settings.interface, details.state)
        try:
            self._socket = self._open_socket(self._settings, self._filters)
            self._reader = FrameReader(self._socket, self._state)
            room_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        except OSError as error:
            self.close()
            raise self._explained(error) from error
        frame_ns = FRAME_BITS * NS_PER_S // (self.bitrate or HIGHEST_BITRATE)
        self._gather_most_ns = room_bytes // FRAME_BUFFER_BYTES // 2 * frame_ns
        self._gather_ns = min(self._gather_wanted_ns, self._gather_most_ns)

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Start the delivery of frames. The link reports a present problem of the bus immediately."""
        assert self._socket is not None
        self._on_frames, self._on_news, self._on_end = on_frames, on_news, on_end
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._socket.fileno(), self._read)
        if problem := self._state.problem:
            on_news(problem, problem)

    def write(self, data: bytes) -> None:
        """Send frames (`struct can_frame`), one system call each. Raises LinkError."""
        if self._socket is None:
            raise LinkError(f"{self.title} is not open and cannot send")
        try:
            for at in range(0, len(data), RAW_FRAME.size):
                self._socket.send(data[at : at + RAW_FRAME.size])
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                raise LinkError(f"{self.title} cannot send, its queue is full: is another node on the bus?") from error
            raise self._explained(error) from error

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send frames cyclically from the kernel, or from the event loop without CAN_BCM. Raises LinkError."""
        self._end_sender()
        try:
            self._sender = KernelSender(self._settings.interface, frames)
        except OSError as error:
            if error.errno not in NO_MANAGER:
                raise self._explained(error) from error
            log.info("%s: this kernel has no CAN_BCM (kernel module can_bcm): cyclic frames are less exact", self.title)
            self._sender = LoopSender(self, frames)

    def sender_failed(self, error: LinkError) -> None:
        self._on_end(error)

    def kernel_counters(self) -> KernelCounters:
        """Return the frames that kernel and controller dropped, and the states of the controller, since `open`."""
        dropped = self._reader.dropped if self._reader else 0
        state = self._state
        return KernelCounters(dropped + state.overflows, error_passive=state.passive_count, bus_off=state.bus_off_count)

    def close(self) -> None:
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
        """Read one batch. The event loop calls again for the rest, or after `gather_ns` with a hold."""
        loop, opened = self._loop, self._socket
        count = self._read_batch()
        if self._gather_ns and count and loop is not None and opened is not None and opened is self._socket:
            loop.remove_reader(opened.fileno())
            self._timer = loop.call_later(self._gather_ns / NS_PER_S, self._read_on_time)

    def _read_on_time(self) -> None:
        """Read all held frames. Watch the socket again if no frame was waiting."""
        self._timer = None
        loop, opened = self._loop, self._socket
        count = total = self._read_batch()
        while count >= BATCH_FRAMES // 2 and total < TURN_FRAMES:  # the batch can contain error frames
            count = self._read_batch()
            total += count
        if loop is None or opened is None or opened is not self._socket or count < 0:  # the link ended or was closed
            return
        if total and self._gather_ns:
            self._timer = loop.call_later(self._gather_ns / NS_PER_S, self._read_on_time)
        else:
            loop.add_reader(opened.fileno(), self._read)

    def _read_batch(self) -> int:
        """Read and deliver one batch. Return the number of frames; -1 if the bus ended."""
        if self._reader is None:
            return -1
        try:
            frames = self._reader.read()
        except OSError as error:
            self._end(error)
            return -1
        while self._state.news:
            self._on_news(*self._state.news.pop(0))
        if frames:
            self._on_frames(frames)
        return len(frames)

    def _end(self, error: OSError) -> None:
        if self._loop is not None and self._socket is not None:
            self._loop.remove_reader(self._socket.fileno())
        self._on_end(self._explained(error))

    def _explained(self, error: OSError) -> LinkError:
        name = self.title
        if error.errno in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            reason = "is down" if error.errno == errno.ENETDOWN else "is missing"
            return LinkMissing(f"{name} {reason}: imud waits until it is up")
        if error.errno == errno.EAFNOSUPPORT:
            return LinkError(f"{name}: this kernel has no CAN sockets; load the kernel module can_raw")
        if isinstance(error, PermissionError):
            return LinkDenied(f"cannot open {name}: user {user_name()} lacks the permission")
        return LinkError(f"{name}: {os.strerror(error.errno or 0)}")


def _ignore(*_news: object) -> None: ...


def make(settings: SocketCanOptions) -> CanLink:
    """Return the link for the backend of the options."""
    if settings.backend == NATIVE:
        return SocketCanLink(settings)
    from imud.links.python_can import PythonCanLink

    return PythonCanLink(settings.backend, settings.interface, settings.bitrate, settings.data_bitrate)


def _host_problems(settings: SocketCanOptions) -> Iterator[HostProblem]:
    """Yield the reason why this host has no such interface, or lacks the library of the backend."""
    if settings.backend == NATIVE:
        # no note about an absent interface: adapters often appear later, and the device reports its state
        if (misfit := netlink.misfit(settings.interface)) and misfit[1]:
            yield HostProblem("interface", *misfit)
    elif problem := backend_problem(settings.backend):
        yield HostProblem("backend", *problem)


def _claims(settings: SocketCanOptions) -> list[Claim]:
    """Return the claim of a device: a shared bus, or the port of a serial adapter (`slcan`) for one device."""
    name, port = settings.interface, settings.interface.startswith("/")
    place = name if port or settings.backend == NATIVE else f"{name} ({settings.backend})"
    rates = {"bitrate": settings.bitrate, "data_bitrate": settings.data_bitrate}
    return [Claim(place=place, key="interface", shared=not port, terms=rates)]


LINK = LinkType("socketcan", SocketCanOptions, make_can=make, claims=_claims, host_problems=_host_problems)
