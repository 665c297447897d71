"""CAN interface of a node: a raw CAN socket that never blocks, with a bounded queue.

    messages ─▶ queue ─▶ socket          socket ─▶ node ─▶ replies ─▶ queue

The kernel accepts few frames (`txqueuelen`, usually 10), so a message of 20 frames needs several turns of the event
loop. If the bus accepts nothing for STALE_NS, imud drops the queue: an old heading is wrong. The system sets bit rate
and state of the interface; imud checks both.
"""

import asyncio
import errno
import logging
import socket
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from imud.contracts.status import OutputStatus
from imud.formats.can import EXTENDED_FLAG, EXTENDED_ID_MAX, RAW_FRAME, CanFilter, pack_filters, pack_frame
from imud.formats.j1939 import CLAIMED, REQUEST, TRANSPORT_CONTROL, TRANSPORT_DATA
from imud.host import netlink
from imud.model.errors import LinkError, reason_of
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.nmea2000.address import Message
from imud.publishers.nmea2000.node import Node

log = logging.getLogger(__name__)

BITRATE: Final = 250_000  # bit rate of NMEA 2000, bit/s
QUEUE_FRAMES: Final = 128  # maximum number of queued frames: the replies to all requests of one node
STALE_NS: Final = 250 * NS_PER_MS  # time without an accepted frame after which imud drops the queue, ns
FLUSH_FIRST_S: Final = 0.005  # pause after the kernel accepted no frame, s: about eight frames at 250 kbit/s
FLUSH_MOST_S: Final = 0.2  # it doubles up to this pause, s
TURN_FRAMES: Final = 64  # maximum number of received frames in one turn of the event loop
CHECK_NS: Final = NS_PER_S  # time between two checks of the interface, ns
RETRY_FIRST_NS: Final = NS_PER_S  # pause before imud opens the interface again, ns; it doubles
RETRY_MOST_NS: Final = 30 * NS_PER_S
LOG_NS: Final = 60 * NS_PER_S  # minimum time between two log lines about other nodes of the bus, ns
BUS_OFF: Final = 3  # state of the controller (`enum can_state` of linux/can/netlink.h)
FULL: Final = (errno.ENOBUFS, errno.EAGAIN)
# Received PGNs with any source and any destination. The node checks the destination.
FILTERS: Final = tuple(
    CanFilter(pgn << 8, 0x03FF_0000, True) for pgn in (CLAIMED, REQUEST, TRANSPORT_CONTROL, TRANSPORT_DATA)
)


def open_bus(interface: str, loopback: bool) -> socket.socket:
    """Return a raw CAN socket that does not block. Without `loopback`, no other socket of this host receives its
    frames. Raises OSError."""
    made = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    try:
        made.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(FILTERS))
        made.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_LOOPBACK, int(loopback))
        made.bind((interface,))
    except OSError:
        made.close()
        raise
    return made


def interface_problem(interface: str) -> str:
    """Return why imud cannot send on an interface now; empty if it can."""
    try:
        if reason := netlink.absence(interface):
            return reason
        details = netlink.can_details(interface)
    except LinkError as error:
        return str(error)
    if details.bitrate not in (None, BITRATE):
        return (
            f"{interface}: expected {BITRATE} bit/s, got {details.bitrate}; run `ip link set {interface} down`, then "
            f"`ip link set {interface} up type can bitrate {BITRATE} restart-ms 100`"
        )
    if details.state == BUS_OFF:
        return f"{interface} is bus-off; check the bit rate, the cable and the termination at both ends of the bus"
    return ""


class NodePort:
    """Interface of a node. Synchronization: the event loop's thread only."""

    def __init__(self, node: Node, interface: str, now_ns: Callable[[], int], *, loopback: bool = True) -> None:
        """`loopback`: whether other programs on this host receive the frames."""
        self._node, self._interface, self._now_ns, self._loopback = node, interface, now_ns, loopback
        self._socket: socket.socket | None = None
        self._queue: deque[tuple[bytes, bool]] = deque()  # frames, each with whether it ends a message
        self._timer: asyncio.TimerHandle | None = None
        self._flush_s = FLUSH_FIRST_S
        self._full_ns: int | None = None  # time since which the kernel accepts no frame; None if it accepts frames
        self._due_ns = 0  # time of the next check of the interface, or of the next try to open it
        self._wait_ns = RETRY_FIRST_NS
        self._sent = self._dropped = 0
        self._log_ns = 0  # earliest time of the next log line about other nodes
        self._logged_problem = ""  # last logged problem of the node
        self._logged_malformed = 0  # last logged number of frames with an invalid length
        self._problem = "not open yet"

    def put(self, messages: Iterable[Message | None]) -> None:
        """Queue messages, or drop and count them. None: a message that the node cannot send without an address."""
        for message in messages:
            if message is None or self._socket is None or len(self._queue) + len(message) > QUEUE_FRAMES:
                self._dropped += 1
                continue
            last = len(message) - 1
            self._queue += [(pack_frame(one.can_id, True, one.data), at == last) for at, one in enumerate(message)]
        if self._queue and self._timer is None:
            self._flush()

    def tick(self, now_ns: int) -> None:
        """Open or check the interface if this is due. Send the due messages of the node."""
        if now_ns >= self._due_ns:
            self._check(now_ns)
        if self._full_ns is not None and now_ns - self._full_ns > STALE_NS:
            self._drop_queue()
            self._note(
                "the interface accepts no frames; expected another node on the bus, and terminators at both ends"
            )
        if self._socket is not None:
            self.put(self._node.tick(now_ns))
        if now_ns >= self._log_ns:
            self._log_nodes(now_ns)

    def status(self) -> OutputStatus:
        node = self._node
        problem = self._problem or node.problem or node.peer_problem(self._now_ns())
        is_sending = not self._problem and node.claimed is not None
        name = f"can {self._interface}"
        return OutputStatus(name, self._sent, self._dropped + node.refused, int(is_sending), problem, node.ignored)

    def close(self) -> None:
        """Close the socket. A second call does nothing."""
        opened, self._socket = self._socket, None
        if opened is not None:
            asyncio.get_running_loop().remove_reader(opened)
            opened.close()
        self._drop_queue()

    def _check(self, now_ns: int) -> None:
        self._due_ns = now_ns + CHECK_NS
        problem = interface_problem(self._interface)
        if problem:
            self._lose(problem)
        elif self._socket is None:
            try:
                opened = open_bus(self._interface, self._loopback)
            except OSError as error:
                self._lose(f"cannot open {self._interface}: {reason_of(error)}")
                return
            self._socket, self._wait_ns, self._problem = opened, RETRY_FIRST_NS, ""
            asyncio.get_running_loop().add_reader(opened, self._read)
            log.info("nmea2000: sending on %s", self._interface)
            self.put(self._node.start(now_ns))

    def _read(self) -> None:
        """Read at most TURN_FRAMES frames. The event loop calls again for the rest."""
        self._read_turn(self._now_ns())
        self._node.end_turn()

    def _read_turn(self, now_ns: int) -> None:
        for _ in range(TURN_FRAMES):
            opened = self._socket
            if opened is None:
                return
            try:
                frame = opened.recv(RAW_FRAME.size)
            except BlockingIOError:
                return
            except OSError as error:
                self._lose(f"{self._interface}: {reason_of(error)}")
                return
            if len(frame) != RAW_FRAME.size:
                continue
            flagged_id, size, data = RAW_FRAME.unpack(frame)
            if flagged_id & ~EXTENDED_ID_MAX == EXTENDED_FLAG:
                self.put(self._node.receive(flagged_id & EXTENDED_ID_MAX, data[:size], now_ns))

    def _flush(self) -> None:
        """Send queued frames while the kernel accepts them."""
        self._timer = None
        while self._queue and self._socket is not None:
            frame, is_last = self._queue[0]
            try:
                self._socket.send(frame)
            except OSError as error:
                if error.errno in FULL:
                    self._wait()
                else:
                    self._lose(f"{self._interface}: {reason_of(error)}")
                return
            self._queue.popleft()
            self._sent += is_last
            self._full_ns, self._flush_s, self._problem = None, FLUSH_FIRST_S, ""

    def _wait(self) -> None:
        if self._full_ns is None:
            self._full_ns = self._now_ns()
        self._timer = asyncio.get_running_loop().call_later(self._flush_s, self._flush)
        self._flush_s = min(2 * self._flush_s, FLUSH_MOST_S)

    def _drop_queue(self) -> None:
        self._dropped += sum(is_last for _, is_last in self._queue)
        self._queue.clear()
        self._full_ns = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _lose(self, problem: str) -> None:
        self.close()
        self._note(problem)
        self._due_ns = self._now_ns() + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, RETRY_MOST_NS)

    def _log_nodes(self, now_ns: int) -> None:
        """Log changes that other nodes cause. The caller limits the rate."""
        node = self._node
        problem = node.problem or node.peer_problem(now_ns)
        if bool(problem) is not bool(self._logged_problem):
            self._logged_problem = problem
            self._log_ns = now_ns + LOG_NS
            if problem:
                log.warning("nmea2000: %s: %s", self._interface, problem)
            else:
                log.info("nmea2000: %s: no problem with other nodes", self._interface)
        if node.malformed != self._logged_malformed:
            self._logged_malformed = node.malformed
            self._log_ns = now_ns + LOG_NS
            log.info("nmea2000: %s: ignored frames with an invalid length: %d", self._interface, node.malformed)

    def _note(self, problem: str) -> None:
        if problem != self._problem:
            log.warning("nmea2000: %s; trying again", problem)
        self._problem = problem
