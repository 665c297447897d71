"""A simulated device behind a real pseudo-terminal, with a port to open, a baud rate to set, and a cable to remove.

    module ──▶ faults ──▶ adapter ──▶ line (rate) ──▶ master │ slave ◀── the program under test, through a stable link
    module ◀───────────── line (rate) ◀────────────── master │

The port reads the baud rate of the program at each write. If it differs from the rate of the device, both sides receive
invalid bytes. A pty stores few bytes. Without a reader, or with a slow reader, the port counts the bytes that do not
fit as lost. `unplug` closes the pseudo-terminal and removes the link. A plug makes a new pseudo-terminal with the same
name and switches the power of the device on.
"""

import fcntl
import os
import select
import struct
import termios
import tty
from collections import deque
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, TextIO

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports.arrival import ArrivalProfile
from imud.sim.ports.faults import Faults
from imud.sim.ports.uart_wire import heard
from imud.sim.sensor import Burst, StreamModule

TCGETS2: Final = 0x802C542A
TCSETS2: Final = 0x402C542B
# `struct termios2`: c_iflag c_oflag c_cflag c_lflag, c_line with c_cc[19], c_ispeed c_ospeed (asm-generic/termbits.h).
TERMIOS2: Final = struct.Struct("4I20s2I")
BOTHER: Final = 0o010000
CBAUD: Final = 0o010017
READ_BYTES: Final = 4096
# Interval of the checks whether a program has opened the port, ns. A pty does not report this event.
LOOK_NS: Final = 20 * NS_PER_MS


@dataclass(slots=True)
class PtyCounters:
    """Numbers of sent and lost bytes of the device."""

    bytes_written: int = 0  # number of bytes that the terminal accepted
    bytes_unheard: int = 0  # number of bytes that were lost because no program had opened the port
    bytes_lost_full: int = 0  # number of bytes that were lost because the reader was too slow
    bursts_wrong_baud: int = 0  # number of bursts that were sent while the reader had another baud rate
    unplugs: int = 0  # number of calls of `SimulatedPort.unplug`, also by faults


class PtyNode:
    """A pseudo-terminal with a name that stays the same after each plug."""

    def __init__(self, path: Path) -> None:
        self.path: Path = path  # name of the port
        self._master = -1
        self._poll = select.poll()

    def plug(self, baud: int) -> None:
        """Make the terminal in raw mode at `baud`, and its link. Raises OSError."""
        self._master, slave = os.openpty()
        try:
            os.set_blocking(self._master, False)
            self._poll = select.poll()
            self._poll.register(self._master, 0)
            tty.setraw(slave)
            set_baud(slave, baud)
            fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(os.ttyname(slave))
            fresh.rename(self.path)
        finally:
            os.close(slave)  # now POLLHUP means that no program has opened the terminal

    def unplug(self) -> None:
        """Remove the terminal. A second call does nothing."""
        self.path.unlink(missing_ok=True)
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def fileno(self) -> int:
        """Return the descriptor of the master; -1 while the port is unplugged."""
        return self._master

    @property
    def is_open(self) -> bool:
        """Return whether a program has opened the port."""
        if self._master < 0:
            return False
        return not self._poll.poll(0)  # POLLHUP while no slave is open

    @property
    def baud(self) -> int:
        """Return the baud rate of the program, bit/s."""
        return int(TERMIOS2.unpack(fcntl.ioctl(self._master, TCGETS2, bytes(TERMIOS2.size)))[6])

    def read(self) -> bytes:
        """Return the bytes that the program sent, at most 4096; empty if no byte arrived."""
        try:
            return os.read(self._master, READ_BYTES)
        except OSError:  # no bytes, or the program closed the port (EIO)
            return b""

    def write(self, data: bytes) -> int:
        """Send bytes. Return the number of accepted bytes."""
        try:
            return os.write(self._master, data)
        except OSError:  # the terminal is full or has no reader
            return 0


def set_baud(fd: int, baud: int) -> None:
    """Set any baud rate on a terminal, also a rate without a constant."""
    *flags, rest, _, _ = TERMIOS2.unpack(fcntl.ioctl(fd, TCGETS2, bytes(TERMIOS2.size)))
    flags[2] = flags[2] & ~CBAUD | BOTHER
    fcntl.ioctl(fd, TCSETS2, TERMIOS2.pack(*flags, rest, baud, baud))
    termios.tcflush(fd, termios.TCIOFLUSH)


class Adapter:
    """Delay between wire and terminal: zero, or until the latency timer of a USB adapter fires."""

    def __init__(self, profile: ArrivalProfile, begin_ns: int) -> None:
        self._begin_ns = begin_ns
        self._step_ns = round(profile.timer_ns / (1 + profile.timer_ppm * 1e-6))

    def handed_over_ns(self, due_ns: int) -> int:
        """Return the time at which a burst whose last byte arrived at `due_ns` is delivered."""
        step_ns = self._step_ns
        return due_ns + step_ns - (due_ns - self._begin_ns) % step_ns if step_ns else due_ns


class SimulatedPort:
    """Connection between a device and its terminal. It reads no clock: the owner passes the time and waits.

    Synchronization: one thread.
    """

    def __init__(
        self,
        module: StreamModule,
        node: PtyNode,
        adapter: Adapter,
        faults: Faults | None = None,
        truth: TextIO | None = None,
    ) -> None:
        """`truth` gets one line per completely sent frame: sample_ns, device_ms, written_ns."""
        self.module: StreamModule = module  # the device
        self.node: PtyNode = node  # the terminal
        self.counters: PtyCounters = PtyCounters()  # numbers of sent and lost bytes
        self._adapter, self._faults, self._truth = adapter, faults, truth
        self._held: deque[Burst] = deque()
        self._replug_ns: int | None = None
        node.plug(module.baud)
        if truth:
            truth.write(f"# epoch_ns={module.epoch_ns}\nsample_ns,device_ms,written_ns\n")

    def step(self, now_ns: int, readable: bool = True) -> None:
        """Process all due events. With `readable`, also read the bytes of the program."""
        if self._replug_ns is not None and now_ns >= self._replug_ns:
            self._plug(now_ns)
        self._receive_from_module(now_ns)
        if readable and self.node.fileno() >= 0:
            self._listen(now_ns)
        self._hand_over(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """Return the latest time of the next call of `step`."""
        times = [now_ns + NS_PER_S]
        if self._held:
            times.append(self._held[0].due_ns)
        if (module_ns := self.module.next_ns()) is not None:
            times.append(self._adapter.handed_over_ns(module_ns))
        if self._replug_ns is not None:
            times.append(self._replug_ns)
        elif not self.node.is_open:
            times.append(now_ns + LOOK_NS)
        return min(times)

    def unplug(self, now_ns: int, duration_ns: int) -> None:
        """Remove the cable: the node disappears and the device loses its power. Both return after `duration_ns`."""
        self.node.unplug()
        self.counters.unplugs += 1
        self.counters.bytes_unheard += sum(len(burst.data) for burst in self._held)
        self._held.clear()
        self._replug_ns = now_ns + duration_ns

    def close(self) -> None:
        """Remove the terminal. A second call does nothing."""
        self.node.unplug()

    def summary(self) -> dict[str, int]:
        """Return the counters by name, with the faults."""
        faults = self._faults.counts if self._faults else {}
        return (
            self.module.counters()
            | asdict(self.counters)
            | {f"fault_{kind}": count for kind, count in sorted(faults.items())}
        )

    def _plug(self, now_ns: int) -> None:
        self._replug_ns = None
        self.module.reboot(now_ns)
        self.node.plug(self.module.baud)

    def _receive_from_module(self, now_ns: int) -> None:
        """Pass the output of the device through faults and adapter."""
        faults = self._faults
        for burst in self.module.advance(now_ns):
            arriving: Burst | None = burst
            if faults and self._replug_ns is None:
                faults.baud, until_ns = self.module.baud, faults.unplugged_until_ns
                arriving = faults.pass_on(burst)
                if faults.unplugged_until_ns != until_ns:
                    self.unplug(now_ns, faults.rates.unplug_ns)
            if arriving:
                self._held.append(arriving._replace(due_ns=self._adapter.handed_over_ns(arriving.due_ns)))

    def _listen(self, now_ns: int) -> None:
        data = self.node.read()
        if data:
            self.module.receive(heard(data, self.node.baud, self.module.baud), now_ns)

    def _hand_over(self, now_ns: int) -> None:
        """Write all due bytes in one piece. Bytes that do not fit are lost."""
        held, due = self._held, []
        while held and held[0].due_ns <= now_ns:
            due.append(held.popleft())
        if not due:
            return
        data = b"".join(burst.data for burst in due)
        if not self.node.is_open:
            self.counters.bytes_unheard += len(data)
            return
        baud = self.node.baud
        if baud != self.module.baud:
            self.counters.bursts_wrong_baud += len(due)
            data = heard(data, self.module.baud, baud)
        written = self.node.write(data) if data else 0
        self.counters.bytes_written += written
        self.counters.bytes_lost_full += len(data) - written
        if self._truth and written == len(data):
            self._note(due, now_ns)

    def _note(self, due: list[Burst], now_ns: int) -> None:
        assert self._truth
        for burst in due:
            if burst.sample_ns is not None:
                self._truth.write(f"{burst.sample_ns},{burst.device_ms},{now_ns}\n")


def sharpen_timers() -> None:
    """Request wake-ups with an accuracy of 1 µs instead of 50 µs. Without the permission, the jitter stays."""
    with suppress(OSError):
        Path("/proc/self/timerslack_ns").write_text("1")
