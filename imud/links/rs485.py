"""An RS-485 line: a serial port opened once for all devices on it, its direction control, requests and replies.

    silence ▸ request ▸ (echo) ▸ silence ▸ reply ▸ silence …

One request is under way at a time. The silence between frames is kept, counted from when the last byte was read. A
module that did not reply in time owes a reply: before its next request one register is read, whose reply has another
length than the one owed, so that a late reply is never mistaken for the one to the new request.

The transmitter is switched by the kernel's driver with RTS (TIOCSRS485, Documentation/driver-api/serial/
serial-rs485.rst), or by the adapter: drivers without that ioctl, USB adapters and ptys among them, say ENOTTY.
pyserial's own `rs485_mode` is not used: where the driver refuses it, every later setting of that object fails.
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
)
from imud.links.device_node import CABLE, PROC, DeviceNode
from imud.links.serial_port import TtyCounters, hold_ns, open_port, port_problem, request_low_latency
from imud.model.errors import LinkError, LinkMissing, TransferError, Trouble
from imud.model.options import Options, shown
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

READ_BYTES: Final = 4096
BROADCAST_NS: Final = 100 * NS_PER_MS
"""Pause after a broadcast: "MODBUS over Serial Line" 2.4.1 gives 100 to 200 ms."""
ASLEEP_SHARE: Final = 0.9
"""Share of the wire time of the missing bytes that is slept: fewer wake-ups, none late."""
TIOCGRS485: Final = 0x542E
TIOCSRS485: Final = 0x542F
SERIAL_RS485: Final = struct.Struct("8I")
"""flags, delay_rts_before_send ms, delay_rts_after_send ms, padding (linux/serial.h)."""
ENABLED: Final = 1 << 0
RTS_ON_SEND: Final = 1 << 1
UNSUPPORTED: Final = frozenset({errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP})

Echo = Literal["auto", True, False]
DirectionWish = Literal["auto", "kernel", "none"]


class Direction:
    """Direction control of one open port by its driver, where it has it."""

    def __init__(self, fd: int, title: str, *, required: bool) -> None:
        """Enable the driver's direction control. Raises LinkError if it is `required` and the driver has none.

        A port where it is enabled already (device tree) is left as it is.
        """
        self._fd = fd
        self._before: bytes | None = None
        self.by_kernel = False
        """Whether the driver switches the direction."""
        try:
            before = fcntl.ioctl(fd, TIOCGRS485, bytes(SERIAL_RS485.size))
            if not SERIAL_RS485.unpack(before)[0] & ENABLED:
                fcntl.ioctl(fd, TIOCSRS485, SERIAL_RS485.pack(ENABLED | RTS_ON_SEND, *[0] * 7))
                self._before = before
            self.by_kernel = True
        except OSError as error:
            if required or error.errno not in UNSUPPORTED:
                raise LinkError(
                    f"{title}: its driver cannot switch the direction of RS-485 ({error.strerror}); `direction: none` "
                    "if the adapter does it by itself"
                ) from error

    def restore(self) -> None:
        """Leave the port as it was; may be called twice, and on a port that is gone."""
        before, self._before = self._before, None
        if before is not None:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, TIOCSRS485, before)


class PortSetup(NamedTuple):
    """Options that all devices of a line must agree on."""

    path: str
    baud: int
    """Rate in bit/s."""
    direction: DirectionWish = "auto"
    echo: Echo = "auto"

    @property
    def terms(self) -> dict[str, object]:
        """All but the path, by the keys of the configuration."""
        return {"baud": self.baud, "direction": self.direction, "echo": self.echo}


class LineCounters:
    """Traffic on a line other than replies, in bytes unless stated otherwise."""

    __slots__ = ("echoed", "late", "strange", "timeouts")

    def __init__(self) -> None:
        self.echoed = 0
        """Requests whose echo was received."""
        self.late = 0
        """Received while no request was pending."""
        self.strange = 0
        """Received before a reply, or in place of one."""
        self.timeouts = 0
        """Requests without a reply."""


class Rs485Line:
    """An open port. Synchronization: the bus's thread makes the transfers; open and close hold `SharedPorts`' lock."""

    def __init__(self, setup: PortSetup, sys: Path, proc: Path, now_ns: Callable[[], int]) -> None:
        """Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        path, baud = setup.path, setup.baud
        self.setup = setup
        self.counters = LineCounters()
        self.echoes: bool | None = None if setup.echo == "auto" else setup.echo
        """Whether the port receives what it sends; None until that was observed."""
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
        """Errors the kernel counts."""
        return self._tty

    def close(self) -> None:
        """Release the port; may be called twice."""
        port, self._port = self._port, None
        if port is not None:
            if self._direction is not None:
                self._direction.restore()
            self._tty.read()
            with contextlib.suppress(OSError, termios.error):
                port.close()

    def transfer(self, target: int, request: bytes, reply_bytes: int, reply_ns: int) -> bytes:
        """Return the whole reply to a request, damaged or not, or an exception. Raises TransferError, LinkError.

        `reply_ns` is the module's time to begin its reply.
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
        """Read so few registers that the reply differs in length from an outstanding one, which may come before it."""
        first, count = owed[1:3], owed[3:5]
        few = 2 if owed[0] == READ_HOLDING and count == b"\0\1" else 1
        request = bytes([READ_HOLDING]) + first + few.to_bytes(2, "big")
        self._ask(target, request, READ_OVERHEAD_BYTES + 2 * few, reply_ns, owed=owed)

    def _ask(self, target: int, request: bytes, reply_bytes: int, reply_ns: int, owed: bytes = b"") -> bytes:
        frame = framed(target, request)
        finder = ReplyFinder(frame, reply_bytes, echoes=self.echoes)
        self._send(frame)
        wire_ns = (2 * len(frame) + reply_bytes) * self._byte_ns  # an echo comes with the request, not after it
        deadline_ns = self._now_ns() + wire_ns + 2 * self._gap_ns + reply_ns + self._hold_ns
        reply = self._wait(finder, deadline_ns)
        self._note_echo(finder, reply)
        self.counters.strange += finder.strange
        if reply is None and finder.looks_damaged:
            reply = finder.rest()
        if reply is None:
            self._owing[target] = owed or request
            self.counters.timeouts += 1
            self.counters.strange += len(finder.rest())
            raise self._no_reply(target, finder)
        self._owing.pop(target, None)
        return reply

    def _wait(self, finder: ReplyFinder, deadline_ns: int) -> bytes | None:
        """Read until the reply is complete or the deadline has passed."""
        while (left_ns := deadline_ns - self._now_ns()) > 0:
            if not self._poll.poll(left_ns / NS_PER_MS):
                break
            reply = finder.feed(self._read())
            if reply is not None:
                return reply
            if finder.missing > 1:
                time.sleep(finder.missing * self._byte_ns * ASLEEP_SHARE / NS_PER_S)
        return finder.feed(self._read())  # this thread itself may have been late

    def _note_echo(self, finder: ReplyFinder, reply: bytes | None) -> None:
        """An echo behind noise is not seen: only a reply with nothing before it shows that there is none."""
        if finder.echo_seen:
            self.counters.echoed += 1
        if self.echoes is None and (finder.echo_seen or (reply is not None and not finder.strange)):
            self.echoes = finder.echo_seen

    def _no_reply(self, target: int, finder: ReplyFinder) -> TransferError:
        rest = finder.rest()
        if rest or finder.strange:
            message = f"no reply from address {target} on {self._path}, but other bytes: {rest[:16].hex(' ')}"
            return TransferError(Trouble.DISTURBED, f"{message}; is the baud rate right, is an address given twice?")
        # DISTURBED, not ABSENT: a request hit by noise has no reply either; three in a row mean that the module is lost
        return TransferError(
            Trouble.DISTURBED,
            f"no reply from address {target} on {self._path}: is it powered, are A and B not swapped?",
        )

    def _send(self, frame: bytes) -> None:
        """Write a frame after the silence that must be before it. Raises TransferError, LinkError."""
        self._await_silence()
        try:
            sent = os.write(self._fd, frame)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise port_problem(error, self._path, self._proc) from error
        if sent != len(frame):
            raise TransferError(Trouble.STUCK, f"{self._path} does not send: is the port stuck?")
        self._quiet_ns = self._now_ns() + len(frame) * self._byte_ns

    def _await_silence(self) -> None:
        """Return when the line was silent for a frame gap; bytes received until then are counted as late."""
        limit_ns = self._now_ns() + 2 * ADU_BYTES_MAX * self._byte_ns + self._gap_ns
        while True:
            late = len(self._read())
            self.counters.late += late
            now_ns = self._now_ns()
            if not late and now_ns >= self._quiet_ns + self._gap_ns:
                return
            if now_ns > limit_ns:
                raise TransferError(Trouble.STUCK, f"{self._path} is never silent: does another master speak there?")
            self._sleep_until(self._quiet_ns + self._gap_ns)

    def _read(self) -> bytes:
        """The bytes received so far. Raises LinkMissing when the port is gone."""
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
        return LinkMissing(f"{self._path} is gone ({why}): was the cable or the adapter pulled out?")

    def _sleep_until(self, deadline_ns: int) -> None:
        left_ns = deadline_ns - self._now_ns()
        if left_ns > 0:
            time.sleep(left_ns / NS_PER_S)


class SharedPorts:
    """The lines that are open, by path. Synchronization: any thread."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, Rs485Line] = {}
        self._users: dict[Rs485Line, int] = {}
        self._now_ns = now_ns

    def share(self, setup: PortSetup, sys: Path = Path("/sys"), proc: Path = PROC) -> Rs485Line:
        """The line of that path, opened if it is not open. Raises LinkError, also for another rate or setting."""
        with self._lock:
            line = self._open.get(setup.path)
            if line is None:
                line = self._open[setup.path] = Rs485Line(setup, sys, proc, self._now_ns)
            _check_agreement(line.setup, setup)
            self._users[line] = self._users.get(line, 0) + 1
            return line

    def discard(self, line: Rs485Line) -> None:
        """Forget a line whose port is gone: the next `share` opens it anew."""
        with self._lock:
            if self._open.get(line.setup.path) is line:
                del self._open[line.setup.path]

    def release(self, line: Rs485Line) -> None:
        """Remove one user; the last one closes the port."""
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


SHARED_PORTS: Final = SharedPorts()
"""The open lines of this process."""


class Rs485Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an RS-485 line. All but `address`, `rate_hz` and `reply_ms` must be the same for all its devices."""

    line: Annotated[str, Meta(min_length=1)]
    """Path of the port. Several devices may have the same one."""
    baud: Annotated[int, Meta(ge=300, le=4_000_000)] = 115200
    """Rate in bit/s of the line."""
    address: Annotated[int, Meta(ge=1, le=247)] | Literal["auto"] = "auto"
    """Modbus address, or `auto`: ask at every address. Give it where a line has more than one device."""
    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """Rate of reads, per second; 0 for as often as the line allows, in turns with the other devices."""
    reply_ms: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Longest delay of the device before it answers. Time on the wire is added."""
    direction: Literal["auto", "kernel", "none"] = "auto"
    """Control of the direction: `kernel` by its driver (RTS), `none` by the adapter, `auto` by the driver if
    it can."""
    echo: Literal["auto"] | bool = "auto"
    """Whether the adapter receives what it sends; `auto` detects it."""


class Rs485Link:
    """A `PolledLink` on a serial port that others may share."""

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
        """Bytes other than replies, received on the line since it was opened."""
        return self._line.counters if self._line else LineCounters()

    def absence(self) -> str:
        """Return why the port cannot be opened now; empty when it is there."""
        return self._node.absence()

    async def wait_present(self) -> None:
        """Return when the port is there."""
        await self._node.wait_present()

    def open(self) -> None:
        """Open the port exclusively, or share it. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._line = self._ports.share(_setup(self._settings), self._sys, self._proc)

    def select(self, target: int) -> None:
        """Address the next transfers; 0 is a broadcast, which has no reply."""
        self._address = target

    def place(self, target: int) -> str:
        """An address in messages, as the vendor's documents and programs write it."""
        return f"address {target}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Return the whole reply to a request, an exception or a damaged reply. Raises TransferError, LinkError."""
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
        """Raises LinkError: bytes are sent in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Errors the kernel counted on the line since it was opened."""
        return self._line.counted.read() if self._line else KernelCounters()

    def serial_line(self) -> SerialLineCounters:
        """Bytes other than replies, received on the line since it was opened, for any of its devices."""
        heard = self.heard
        return SerialLineCounters(heard.timeouts, heard.late, heard.strange, heard.echoed)

    def close(self) -> None:
        """Leave the line, whose last user closes the port; may be called twice."""
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
