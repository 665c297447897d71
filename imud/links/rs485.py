"""An RS-485 bus: one serial port for all its devices, direction control, requests and replies.

    silence ▸ request ▸ (echo) ▸ silence ▸ reply ▸ silence …

One request is in progress at a time. The link keeps the silence between frames, measured from the last received byte. A
late reply must not count as the reply to the next request. After a timeout, the link therefore first reads one register
of the device. The length of this reply differs from the length of the missing reply.

The driver of the kernel switches the transmitter with RTS (TIOCSRS485,
Documentation/driver-api/serial/serial-rs485.rst), or the adapter does. A driver without this ioctl returns ENOTTY, for
example of a USB adapter or a pty. imud does not use `rs485_mode` of pyserial: if the driver refuses the mode, all later
settings of the object fail.
"""

import contextlib
import errno
import fcntl
import os
import select
import struct
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

import serial
from msgspec import Meta

from imud.contracts.link import Claim, LinkType, differing_terms
from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters, SerialLineCounters
from imud.formats.modbus import (
    ADU_BYTES_MAX,
    BROADCAST,
    READ_HOLDING,
    READ_OVERHEAD_BYTES,
    ReplyFinder,
    frame_gap_ns,
    framed,
    late_sender,
)
from imud.links.device_node import CABLE, PROC, DeviceNode
from imud.links.serial_port import TtyCounters, hold_ns, open_port, port_problem, request_low_latency
from imud.model.errors import LinkError, LinkMissing, TransferError, Trouble
from imud.model.host_object import SerialPort
from imud.model.options import Options, shown
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

READ_BYTES: Final = 4096
BROADCAST_NS: Final = 100 * NS_PER_MS  # pause after a broadcast, ns: 100 to 200 ms in "MODBUS over Serial Line" 2.4.1
# Share of the wire time of the missing bytes for which the thread sleeps. It saves wake-ups and is never late.
ASLEEP_SHARE: Final = 0.9
TIOCGRS485: Final = 0x542E
TIOCSRS485: Final = 0x542F
# `struct serial_rs485`: flags, delay_rts_before_send ms, delay_rts_after_send ms, padding (linux/serial.h).
SERIAL_RS485: Final = struct.Struct("8I")
ENABLED: Final = 1 << 0
RTS_ON_SEND: Final = 1 << 1
UNSUPPORTED: Final = frozenset({errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP})

Echo = Literal["auto", True, False]
DirectionWish = Literal["auto", "kernel", "none"]


class Direction:
    """Direction control of one open port by its driver, if the driver supports it."""

    def __init__(self, fd: int, title: str, *, required: bool) -> None:
        """Enable the direction control of the driver. Raises LinkError if it is `required` and the driver does not
        support it.

        If the direction control is already enabled (device tree), the port stays unchanged.
        """
        self._fd = fd
        self._before: bytes | None = None
        self.by_kernel = False  # True if the driver switches the direction
        try:
            before = fcntl.ioctl(fd, TIOCGRS485, bytes(SERIAL_RS485.size))
            if not SERIAL_RS485.unpack(before)[0] & ENABLED:
                fcntl.ioctl(fd, TIOCSRS485, SERIAL_RS485.pack(ENABLED | RTS_ON_SEND, *[0] * 7))
                self._before = before
            self.by_kernel = True
        except OSError as error:
            if required or error.errno not in UNSUPPORTED:
                raise LinkError(
                    f"the driver of {title} cannot switch the direction of RS-485 ({error.strerror}); set "
                    "`direction: none` if the adapter switches it"
                ) from error

    def restore(self) -> None:
        """Restore the state of the port. A second call, or a call after the port was removed, does nothing."""
        before, self._before = self._before, None
        if before is not None:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, TIOCSRS485, before)


PATIENCE_NS: Final = 3 * NS_PER_S  # maximum time until a device starts its reply, by the observed replies, ns
PATIENCE_FACTOR: Final = 2  # this time as a multiple of the slowest reply
DECAY: Final = 8  # each faster reply reduces the slowest reply by this share of it, so that a stall has a short effect


# Rounds of a search in which each address gets SEARCH_NS once. A round over all addresses lasts about 8 s longer.
SEARCH_ROUNDS: Final = 16
SEARCH_NS: Final = NS_PER_S // 2


class ReplyTimes:
    """Times of the replies on one bus.

    Before the first reply on the bus, the first device gets PATIENCE_NS. Other addresses do not get this time: a search
    over all addresses would take minutes. From the second request on, an address gets SEARCH_NS in one of SEARCH_ROUNDS
    requests. An address with a late reply gets PATIENCE_NS until it replies in time. After its first reply, a device
    gets a multiple of its slowest reply. The other devices get a multiple of the slowest reply on the bus.
    """

    __slots__ = ("_asked", "_first", "_late", "_slowest_ns")

    def __init__(self) -> None:
        self._first: int | None = None  # address of the first request on the bus
        self._asked: dict[int, int] = {}  # number of requests by address, before the first reply on the bus
        self._late: set[int] = set()  # addresses with a late reply
        self._slowest_ns: dict[int, int] = {}  # time of the slowest reply by address, ns

    def wait_ns(self, target: int, reply_ns: int) -> int:
        """Return the maximum time until a device starts its reply, at least `reply_ns`."""
        if self._first is None:
            self._first = target
        slowest = self._slowest_ns
        if target in self._late or (not slowest and target == self._first):
            patience_ns = PATIENCE_NS
        elif slowest:
            patience_ns = PATIENCE_FACTOR * slowest.get(target, max(slowest.values()))
        else:
            asked = self._asked[target] = self._asked.get(target, -1) + 1
            patience_ns = SEARCH_NS if asked and (target + asked) % SEARCH_ROUNDS == 0 else 0
        return max(reply_ns, min(patience_ns, PATIENCE_NS))

    def add(self, target: int, duration_ns: int) -> None:
        """Note the time of a reply."""
        self._late.discard(target)
        slowest_ns = self._slowest_ns.get(target, 0)
        self._slowest_ns[target] = max(duration_ns, slowest_ns - slowest_ns // DECAY, 1)

    def add_late(self, target: int) -> None:
        """Note a reply after its timeout."""
        self._late.add(target)


class PortSetup(NamedTuple):
    """Options that all devices of a bus share."""

    path: str
    baud: int  # baud rate, bit/s
    direction: DirectionWish = "auto"
    echo: Echo = "auto"

    @property
    def terms(self) -> dict[str, object]:
        """Return all options except the path, by the keys of the configuration."""
        return {"baud": self.baud, "direction": self.direction, "echo": self.echo}


class LineCounters:
    """Traffic on a bus except for replies, bytes if not stated otherwise."""

    __slots__ = ("echoed", "late", "strange", "timeouts")

    def __init__(self) -> None:
        self.echoed = 0  # number of requests whose echo was received
        self.late = 0  # bytes received without a pending request
        self.strange = 0  # bytes received before a reply or in place of a reply
        self.timeouts = 0  # number of requests without a reply


class Rs485Line:
    """An open port. Synchronization: the thread of the bus makes the transfers; open and close hold the lock of
    `SharedPorts`."""

    def __init__(self, setup: PortSetup, sys: Path, proc: Path, now_ns: Callable[[], int]) -> None:
        """Open the port. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        path, baud = setup.path, setup.baud
        self.setup = setup
        self.counters = LineCounters()
        # True if the port receives its own transmission; None until imud has observed it.
        self.echoes: bool | None = None if setup.echo == "auto" else setup.echo
        self._path = path
        self._now_ns = now_ns
        self._port: serial.Serial | None = open_port(path, baud, proc)
        self._proc = proc
        self._fd = self._port.fileno()
        request_low_latency(self._port, path, sys)
        self._tty = TtyCounters(self._fd)
        self._hold_ns = hold_ns(path, sys)
        self._byte_ns, self._gap_ns = uart_byte_ns(baud), frame_gap_ns(baud)
        self._quiet_ns = now_ns()
        self._owing: dict[int, bytes] = {}
        self._times = ReplyTimes()
        self._stray = b""  # newest bytes outside of replies, which can contain a late reply
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        try:
            required = setup.direction == "kernel"
            self._direction = None if setup.direction == "none" else Direction(self._fd, path, required=required)
        except LinkError:
            self._port.close()
            raise

    @property
    def counted(self) -> TtyCounters:
        """Return the errors that the kernel counts."""
        return self._tty

    def close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            if self._direction is not None:
                self._direction.restore()
            self._tty.read()
            with contextlib.suppress(OSError, termios.error):
                port.close()

    def transfer(self, target: int, request: bytes, reply_bytes: int, reply_ns: int) -> bytes:
        """Return the complete reply to a request, also a damaged reply or a Modbus exception. Raises TransferError or
        LinkError.

        `reply_ns` is the maximum time until the device starts its reply, ns.
        """
        if self._port is None:
            raise LinkError(f"{self._path} is not open")
        if target == BROADCAST or not reply_bytes:
            self._send(framed(target, request))
            self._sleep_until(self._now_ns() + (len(request) + 3) * self._byte_ns + BROADCAST_NS)
            self._read()
            return b""
        owed = self._owing.get(target)
        if owed is not None or (self.echoes is None and request[0] != READ_HOLDING):
            self._settle(target, owed or request, reply_ns)
        return self._ask(target, request, reply_bytes, reply_ns)

    def _settle(self, target: int, owed: bytes, reply_ns: int) -> None:
        """Read a register with a reply of another length than the missing reply, which can arrive first."""
        first, count = owed[1:3], owed[3:5]
        few = 2 if owed[0] == READ_HOLDING and count == b"\0\1" else 1
        request = bytes([READ_HOLDING]) + first + few.to_bytes(2, "big")
        self._ask(target, request, READ_OVERHEAD_BYTES + 2 * few, reply_ns, owed=owed)

    def _ask(self, target: int, request: bytes, reply_bytes: int, reply_ns: int, owed: bytes = b"") -> bytes:
        frame = framed(target, request)
        finder = ReplyFinder(frame, reply_bytes, echoes=self.echoes)
        self._send(frame)
        wire_ns = (
            2 * len(frame) + reply_bytes
        ) * self._byte_ns  # wire time of the request and of its echo, which the port receives at the same time
        sent_ns = self._now_ns()
        overhead_ns = wire_ns + 2 * self._gap_ns + self._hold_ns
        reply = self._wait(finder, sent_ns + overhead_ns + self._times.wait_ns(target, reply_ns))
        self._note_echo(finder, reply)
        self.counters.strange += finder.strange
        if reply is None and finder.looks_damaged:
            reply = finder.rest()
        if reply is None:
            self._owing[target] = owed or request
            self.counters.timeouts += 1
            self.counters.strange += len(finder.rest())
            self._note_stray(finder.rest())
            raise self._no_reply(target, finder)
        self._owing.pop(target, None)
        self._times.add(target, self._now_ns() - sent_ns - overhead_ns)
        return reply

    def _wait(self, finder: ReplyFinder, deadline_ns: int) -> bytes | None:
        """Read until the reply is complete or the deadline has passed. Return None after the deadline."""
        while (left_ns := deadline_ns - self._now_ns()) > 0:
            if not self._poll.poll(left_ns / NS_PER_MS):
                break
            reply = finder.feed(self._read())
            if reply is not None:
                return reply
            if finder.missing > 1:
                time.sleep(finder.missing * self._byte_ns * ASLEEP_SHARE / NS_PER_S)
        return finder.feed(self._read())  # this thread may be late: read once more

    def _note_stray(self, data: bytes) -> None:
        """Look for the late reply of a device in bytes outside of replies."""
        if not data or not self._owing:
            return
        self._stray = (self._stray + data)[-ADU_BYTES_MAX:]
        sender = late_sender(self._stray, self._owing)
        if sender is not None:
            self._times.add_late(sender)
            self._stray = b""

    def _note_echo(self, finder: ReplyFinder, reply: bytes | None) -> None:
        """Store whether the port echoes."""
        if finder.echo_seen:
            self.counters.echoed += 1
        # noise can hide an echo: only a reply without bytes before it shows that there is no echo
        if self.echoes is None and (finder.echo_seen or (reply is not None and not finder.strange)):
            self.echoes = finder.echo_seen

    def _no_reply(self, target: int, finder: ReplyFinder) -> TransferError:
        rest = finder.rest()
        if rest or finder.strange:
            message = f"no reply from address {target} on {self._path}, but other bytes: {rest[:16].hex(' ')}"
            return TransferError(Trouble.DISTURBED, f"{message}; check the baud rate and the addresses")
        # DISTURBED, not ABSENT: noise can destroy a request; after three failures in a row the device counts as lost
        return TransferError(
            Trouble.DISTURBED,
            f"no reply from address {target} on {self._path}; check the power of the device and the wires A and B",
        )

    def _send(self, frame: bytes) -> None:
        """Write a frame after the required silence. Raises TransferError or LinkError."""
        self._await_silence()
        try:
            sent = os.write(self._fd, frame)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise port_problem(error, self._path, self._proc) from error
        if sent != len(frame):
            raise TransferError(Trouble.STUCK, f"{self._path} does not accept bytes: is the port stuck?")
        self._quiet_ns = self._now_ns() + len(frame) * self._byte_ns

    def _await_silence(self) -> None:
        """Return after a silence of one frame gap. Count the bytes received before it as late."""
        limit_ns = self._now_ns() + 2 * ADU_BYTES_MAX * self._byte_ns + self._gap_ns
        while True:
            data = self._read()
            self.counters.late += len(data)
            self._note_stray(data)
            now_ns = self._now_ns()
            if not data and now_ns >= self._quiet_ns + self._gap_ns:
                return
            if now_ns > limit_ns:
                raise TransferError(Trouble.STUCK, f"{self._path} is never silent: is there another master on the bus?")
            self._sleep_until(self._quiet_ns + self._gap_ns)

    def _read(self) -> bytes:
        """Return the received bytes. Raises LinkMissing if the port was removed."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._gone(os.strerror(error.errno or 0)) from error
        if not data:
            raise self._gone("hung up")
        self._quiet_ns = self._now_ns()
        return data

    def _gone(self, why: str) -> LinkMissing:
        return LinkMissing(f"{self._path} is missing ({why}): was the cable or the adapter unplugged?")

    def _sleep_until(self, deadline_ns: int) -> None:
        left_ns = deadline_ns - self._now_ns()
        if left_ns > 0:
            time.sleep(left_ns / NS_PER_S)


class SharedPorts:
    """Open buses by path. Synchronization: any thread."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, Rs485Line] = {}
        self._users: dict[Rs485Line, int] = {}
        self._now_ns = now_ns

    def share(self, setup: PortSetup, sys: Path = Path("/sys"), proc: Path = PROC) -> Rs485Line:
        """Return the bus of a path; open it if necessary. Raises LinkError, also for options other than its own."""
        with self._lock:
            line = self._open.get(setup.path)
            if line is None:
                line = self._open[setup.path] = Rs485Line(setup, sys, proc, self._now_ns)
            _check_agreement(line.setup, setup)
            self._users[line] = self._users.get(line, 0) + 1
            return line

    def discard(self, line: Rs485Line) -> None:
        """Remove a bus whose port was removed. The next `share` opens it again."""
        with self._lock:
            if self._open.get(line.setup.path) is line:
                del self._open[line.setup.path]

    def release(self, line: Rs485Line) -> None:
        """Remove one user. The last user closes the port."""
        with self._lock:
            self._users[line] -= 1
            if self._users[line]:
                return
            del self._users[line]
            if self._open.get(line.setup.path) is line:
                del self._open[line.setup.path]
            line.close()


def _check_agreement(first: PortSetup, other: PortSetup) -> None:
    terms, others = first.terms, other.terms
    for key in differing_terms(terms, others):
        got = f"{shown(terms[key])} and {shown(others[key])}"
        raise LinkError(f"{first.path}: expected the same {key} for all its devices, got {got}")


SHARED_PORTS: Final = SharedPorts()  # open buses of this process


class Rs485Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on an RS-485 bus. `address`, `rate_hz` and `reply_ms` can differ on the same bus."""

    line: SerialPort
    """Path of the port. Several devices can have the same path."""
    baud: Annotated[int, Meta(ge=300, le=4_000_000)] = 115200
    """Baud rate of the bus, bit/s."""
    address: Annotated[int, Meta(ge=1, le=247)] | Literal["auto"] = "auto"
    """Modbus address. `auto`: imud tries each address. Set it if the bus has more than one device."""
    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """Rate of the reads, Hz. 0: as often as the bus allows, in turns with the other devices."""
    reply_ms: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Minimum timeout for the start of a reply, ms, without the time on the wire. imud waits up to twice the slowest
    reply, at most 3 s."""
    direction: Literal["auto", "kernel", "none"] = "auto"
    """Direction control: `kernel` by the driver (RTS), `none` by the adapter, `auto` by the driver if it supports
    it."""
    echo: Literal["auto"] | bool = "auto"
    """True if the adapter receives its own transmission. `auto`: imud detects it."""


class Rs485Link:
    """A `PolledLink` on a serial port that devices can share."""

    def __init__(
        self,
        settings: Rs485Options,
        *,
        ports: SharedPorts = SHARED_PORTS,
        sys: Path = Path("/sys"),
        proc: Path = PROC,
    ) -> None:
        self._settings = settings
        self._ports, self._sys, self._proc = ports, sys, proc
        self._line: Rs485Line | None = None
        self._node = DeviceNode(settings.line, CABLE)
        self._address = 0
        self._reply_ns = settings.reply_ms * NS_PER_MS
        self.title = settings.line
        self.writable = True
        self.bus = settings.line
        self.target: int | None = None if settings.address == "auto" else settings.address
        self.shared = True
        self.rate_hz = settings.rate_hz
        self.bit_rate = settings.baud

    @property
    def heard(self) -> LineCounters:
        """Return the traffic on the bus except for replies, since the port was opened."""
        return self._line.counters if self._line else LineCounters()

    def absence(self) -> str:
        return self._node.absence()

    async def wait_present(self) -> None:
        await self._node.wait_present()

    def open(self) -> None:
        """Open the port exclusively, or share an open port. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        self._line = self._ports.share(_setup(self._settings), self._sys, self._proc)

    def select(self, target: int) -> None:
        """Set the address of the next transfers. 0 is a broadcast, which has no reply."""
        self._address = target

    def place(self, target: int) -> str:
        """Return an address in the notation of the vendor's documents and programs."""
        return f"address {target}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Return the reply to a request, also if damaged or a Modbus exception. Raises TransferError or LinkError."""
        line, (request,) = self._line, transfer.sends
        if line is None:
            raise LinkError(f"{self.title} is not open")
        try:
            reply_ns = max(self._reply_ns, transfer.reply_ms * NS_PER_MS)
            return line.transfer(self._address, request, transfer.read_bytes, reply_ns)
        except LinkMissing:
            self._ports.discard(line)
            raise

    def write(self, data: bytes) -> None:
        """Raises LinkError: the link sends bytes in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Return the errors that the kernel counted since the port was opened."""
        return self._line.counted.read() if self._line else KernelCounters()

    def serial_line(self) -> SerialLineCounters:
        """Return the traffic on the bus except for replies, for all devices, since the port was opened."""
        heard = self.heard
        return SerialLineCounters(heard.timeouts, heard.late, heard.strange, heard.echoed)

    def close(self) -> None:
        """Leave the bus. The last device closes the port. A second call does nothing."""
        line, self._line = self._line, None
        if line is not None:
            self._ports.release(line)


def _claims(settings: Rs485Options) -> list[Claim]:
    address = None if settings.address == "auto" else settings.address
    terms = _setup(settings).terms
    return [Claim(place=settings.line, key="line", shared=True, part=address, part_key="address", terms=terms)]


def _setup(settings: Rs485Options) -> PortSetup:
    return PortSetup(settings.line, settings.baud, settings.direction, settings.echo)


LINK = LinkType("rs485", Rs485Options, make_polled=Rs485Link, claims=_claims, bus_of=lambda settings: settings.line)
