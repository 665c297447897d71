"""Pseudo-terminals as serial ports. The test controls the far end, or a simulated RS-485 bus is connected to it.

`ModbusBench` is such a bus without a port, in simulated time. Transfer scripts run on it.
"""

import array
import fcntl
import os
import select
import termios
import threading
import time
import tty
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from imud.contracts.command import Target
from imud.contracts.script import Transfer, TransferScript
from imud.drivers.hipnuc.modbus.codec import HipnucModbusOptions
from imud.formats.modbus import BROADCAST, SLAVES, ReplyFinder, frame_gap_ns, framed
from imud.model.errors import TransferError, Trouble
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sim.hipnuc.modbus import ModbusLine, Slave, SlaveSettings, SlaveVariant
from imud.sim.ports.arrival import BARE_UART
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort
from imud.sim.sensor import StreamModule

T = TypeVar("T")

NOBODY_UID = 65534
SETTLED_S = 0.05  # time in which the kernel moves bytes from one buffer of a port to the next, s


class PtyPort:
    """A pseudo-terminal: the test uses `master`, a link opens `path`."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(slave)
        self.slave = slave  # The near end. It stays open, so that the port exists between a close and the next open.

    def send(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    def received(self) -> bytes:
        try:
            return os.read(self.master, 65536)
        except BlockingIOError:
            return b""

    def fill(self) -> int:
        """Write zeros to the near end until the port is full. Return their number."""
        os.set_blocking(self.slave, False)
        size, full_since_s = 0, time.monotonic()
        while time.monotonic() < full_since_s + SETTLED_S:
            with suppress(BlockingIOError):
                size += os.write(self.slave, bytes(1000))
                full_since_s = time.monotonic()
        return size

    def unplug(self) -> None:
        for name in ("master", "slave"):
            fd = getattr(self, name)
            if fd >= 0:
                os.close(fd)
                setattr(self, name, -1)


def waiting_bytes(fd: int) -> int:
    """Return the number of bytes that a read would return now (FIONREAD)."""
    size = array.array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, size)
    return size[0]


@contextmanager
def unprivileged() -> Iterator[None]:
    """Remove the right of root to open every file. No effect for other users."""
    if os.geteuid():
        yield
        return
    os.seteuid(NOBODY_UID)
    try:
        yield
    finally:
        os.seteuid(0)


LIMIT_S = 60.0
BAUD = 921600


def serial_of(number: int) -> bytes:
    return (0xA000_0000_0000_0000 + number).to_bytes(8, "big")


def slave(address: int, *, baud: int = BAUD, serial: int = 0, **more: object) -> Slave:
    assert address in SLAVES
    return Slave(serial_of(serial or address), SlaveSettings(address, baud), **more)  # type: ignore[arg-type]  # passed on


@contextmanager
def wired(folder: Path, *slaves: Slave, echo: bool = False, chunk_bytes: int = 0) -> Iterator[tuple[Path, ModbusLine]]:
    line = ModbusLine(time.monotonic_ns(), slaves, echo=echo, chunk_bytes=chunk_bytes)
    with plugged(folder / "line", line) as path:
        yield path, line


@contextmanager
def plugged(path: Path, module: StreamModule) -> Iterator[Path]:
    now_ns = time.monotonic_ns()
    node = PtyNode(path)
    port = SimulatedPort(module, node, Adapter(BARE_UART, now_ns))
    ended = threading.Event()
    failed: list[BaseException] = []

    def run() -> None:
        try:
            while not ended.is_set():
                now_ns = time.monotonic_ns()
                port.step(now_ns)
                wait_s = min(max(port.next_ns(now_ns) - time.monotonic_ns(), 0) / NS_PER_S, 0.05)
                if node.is_open:
                    select.select([node.fileno()], [], [], wait_s)
                else:
                    ended.wait(min(wait_s, 0.002))
        except BaseException as error:  # noqa: BLE001 - reported to the test below
            failed.append(error)

    thread = threading.Thread(target=run, name="line", daemon=True)
    thread.start()
    try:
        yield node.path
    finally:
        ended.set()
        thread.join(LIMIT_S)
        port.close()
        assert not failed, failed


# --- without a port, in simulated time --------------------------------------------------------------------------------

REPLY_MS = 20  # limit for a reply of a simulated device
LINE_BAUD = 115200
BEGIN_NS = 5 * NS_PER_S


def wait_for_reply(
    line: ModbusLine, finder: ReplyFinder, baud: int, now_ns: int, end_ns: int
) -> tuple[bytes | None, int]:
    """Run a bus until a reply arrives, or until `end_ns`. Return the reply (None if it is missing) and the time."""
    while (next_ns := line.next_ns()) is not None and next_ns <= end_ns:
        now_ns = max(next_ns, now_ns)
        for burst in line.advance(now_ns):
            reply = finder.feed(burst.data if line.baud == baud else b"")
            if reply is not None:
                return reply, now_ns
    line.advance(end_ns)
    return None, end_ns


class ModbusBench:
    """A bus with a baud rate of its own, and the address of the script's device."""

    def __init__(self, *slaves: Slave, at: int = 7, baud: int = LINE_BAUD) -> None:
        self.line = ModbusLine(BEGIN_NS, slaves or [modbus_slave(7)])
        self.now_ns = BEGIN_NS
        self.at = at
        self.baud = baud
        self.sent: list[tuple[int, bytes]] = []

    @property
    def slave(self) -> Slave:
        return self.line.slaves[0]

    @property
    def target(self) -> Target:
        return Target(HipnucModbusOptions(), self.baud, places=tuple(dict.fromkeys((self.at, 7))))

    def run(self, script: TransferScript[T]) -> T:
        return _run_transfers(script, self)

    def transfer(self, transfer: Transfer) -> bytes:
        address = self.at if transfer.at is None else transfer.at
        try:
            return self._ask(address, transfer)
        finally:
            if transfer.then_at is not None:
                self.at = transfer.then_at

    def _ask(self, address: int, transfer: Transfer) -> bytes:
        (request,) = transfer.sends
        self.sent.append((address, request))
        frame = framed(address, request)
        self.now_ns += frame_gap_ns(self.baud)
        self.line.receive(frame, self.now_ns)
        finder = ReplyFinder(frame, transfer.read_bytes, echoes=False)
        wire_ns = (len(frame) + transfer.read_bytes) * uart_byte_ns(self.baud) + 2 * frame_gap_ns(self.baud)
        end_ns = self.now_ns + wire_ns + max(REPLY_MS, transfer.reply_ms) * NS_PER_MS
        reply, self.now_ns = wait_for_reply(self.line, finder, self.baud, self.now_ns, end_ns)
        if reply is not None:
            return reply
        if address == BROADCAST:
            return b""
        raise TransferError(Trouble.DISTURBED, f"no reply from address {address}")


def modbus_slave(address: int = 7, serial: int = 0, variant: SlaveVariant | None = None, **more: Any) -> Slave:
    number = (0xA000_0000_0000_0000 + (serial or address)).to_bytes(8, "big")
    return Slave(number, SlaveSettings(address, LINE_BAUD), variant=variant or SlaveVariant(), **more)


def _run_transfers(script: Generator[Transfer, bytes, T], bench: ModbusBench) -> T:
    try:
        wanted = next(script)
        while True:
            try:
                data = bench.transfer(wanted)
            except TransferError as error:
                wanted = script.throw(error)
            else:
                wanted = script.send(data)
    except StopIteration as end:
        value: T = end.value
        return value
