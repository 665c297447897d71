"""A simulated device on a CAN network interface: `vcan`, or a controller with a real bus.

A frame leaves when it would have crossed the wire of the simulated device. One system call sends all due frames, so
that a stall of this process falls between bursts. The port counts the frames that the queue of the interface does not
accept as lost, as on a bus that is too full.
"""

import ctypes
import errno
import os
import socket
from collections.abc import Callable, Sequence
from typing import Final

from imud.formats.can import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    RAW_FD_FRAME,
    REMOTE_FLAG,
    pack_frame,
)
from imud.host.netlink import can_interfaces
from imud.links.socketcan import MessageBuffers, Vector, libc
from imud.model.errors import LinkError
from imud.sim.can_module import CanModule

READ_BYTES: Final = 4096


class CanPort:
    """One device or several devices (`CanModules`) on one interface. Synchronization: one thread."""

    is_open = True  # always True: a bus needs no reader

    def __init__(
        self, module: CanModule, interface: str, *, open_socket: Callable[[str], socket.socket] | None = None
    ) -> None:
        """`open_socket` is `open_can_socket` or a substitute of a test. Raises the errors of `open_socket`."""
        self.module: CanModule = module  # the device or the devices
        self.interface: str = interface  # name of the interface
        self._unplugged_until_ns = 0
        self.frames_refused: int = 0  # number of frames that the queue of the interface did not accept
        self._socket = (open_socket or open_can_socket)(interface)

    def fileno(self) -> int:
        """Return the descriptor to wait for frames of other nodes."""
        return self._socket.fileno()

    @property
    def node(self) -> "CanPort":
        """Return the object to wait for."""
        return self

    def unplug(self, now_ns: int, duration_ns: int) -> None:
        """Remove the device from the bus and cut its power."""
        self._unplugged_until_ns = now_ns + duration_ns
        self.module.reboot(self._unplugged_until_ns)

    def step(self, now_ns: int, readable: bool) -> None:
        """Pass frames of other nodes to the device, and send due frames."""
        if readable:
            self._receive(now_ns)
        if now_ns >= self._unplugged_until_ns:
            due = [pack_frame(frame.can_id, frame.extended, frame.data) for frame in self.module.advance(now_ns)]
            self.frames_refused += len(send_all(self._socket.fileno(), due))

    def next_ns(self, now_ns: int) -> int:
        """Return the time of the next call of `step`."""
        due_ns = self.module.next_ns()
        return max(self._unplugged_until_ns, now_ns if due_ns is None else due_ns)

    def summary(self) -> dict[str, int]:
        """Return the counters and the zero of the motion, CLOCK_MONOTONIC."""
        counters = {**self.module.counters(), "frames_refused": self.frames_refused}
        return {**counters, "epoch_ns": self.module.epoch_ns}

    def close(self) -> None:
        """Close the socket. A second call does nothing."""
        self._socket.close()

    def _receive(self, now_ns: int) -> None:
        while True:
            try:
                raw = os.read(self._socket.fileno(), RAW_FD_FRAME.size)
            except BlockingIOError:
                return
            except OSError:  # the interface is down; it can return
                return
            can_id, size, _, data = RAW_FD_FRAME.unpack(raw.ljust(RAW_FD_FRAME.size, b"\0"))
            if not can_id & (ERROR_FLAG | REMOTE_FLAG):
                self.module.receive(can_id & EXTENDED_ID_MAX, can_id >= EXTENDED_FLAG, data[:size], now_ns)


def open_can_socket(interface: str) -> socket.socket:
    """Open a raw CAN socket on an interface. Raises LinkError if the interface does not exist or is down."""
    try:
        opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    except OSError as error:
        raise LinkError(f"this kernel has no CAN sockets ({error.strerror}): load the kernel module can_raw") from error
    try:
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)  # no effect without CAN FD
        opened.bind((interface,))
        opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    except OSError as error:
        opened.close()
        hint = f"ip link add {interface} type vcan; ip link set {interface} up"
        raise LinkError(f"{interface}: {error.strerror}: expected a CAN interface that is up ({hint})") from error
    return opened


def default_interface() -> str:
    """Return the first CAN interface that is up. Raises LinkError if there is none."""
    found = can_interfaces()
    if not found:
        raise LinkError(
            "expected a CAN interface that is up, got none; for a virtual one: ip link add vcan0 type vcan; "
            "ip link set vcan0 up"
        )
    return found[0]


def send_all(fd: int, datagrams: Sequence[bytes]) -> list[OSError]:
    """Send datagrams in order with sendmmsg(2), one system call if all are accepted. Return an error for each refused
    datagram.

    No other sender comes between two datagrams, and no stall of this process separates them, unless one is refused.
    """
    count = len(datagrams)
    if not count:
        return []
    content = ctypes.create_string_buffer(b"".join(datagrams))
    vectors, messages, base = (Vector * count)(), (MessageBuffers * count)(), ctypes.addressof(content)
    for vector, message, data in zip(vectors, messages, datagrams, strict=True):
        vector.base, vector.bytes = base, len(data)
        base += len(data)
        message.header.vector, message.header.vector_count = ctypes.addressof(vector), 1
    refused, at, size = list[OSError](), 0, ctypes.sizeof(MessageBuffers)
    while at < count:
        sent = libc.sendmmsg(fd, ctypes.byref(messages, at * size), count - at, 0)
        number = ctypes.get_errno()
        if sent < 0 and number == errno.EINTR:
            continue
        if sent <= 0:
            refused.append(OSError(number, os.strerror(number)))
        at += max(sent, 1)
    return refused
