"""A serial port in the event loop: UART, RS-232, USB adapter or USB virtual port.

At 1 kHz, wake-ups and system calls cause the CPU time (measured). A wake-up therefore makes one read of all waiting
bytes and takes one time stamp. A paused link does not watch its descriptor: bytes wait in the kernel until `take` or
`resume`.
"""

import asyncio
import os
import time
from pathlib import Path
from typing import Annotated, Final, Literal

import serial
from msgspec import Meta

from imud.contracts.link import Claim, LinkType, OnData, OnEnd
from imud.contracts.status import KernelCounters
from imud.links.device_node import CABLE, PROC, DeviceNode
from imud.links.serial_port import TtyCounters, change_baud, hold_ns, open_port, port_problem, request_low_latency
from imud.model.errors import LinkError, LinkMissing
from imud.model.host_object import SerialPort
from imud.model.options import Options

READ_BYTES: Final = 65536
# A read of this size can leave bytes behind (n_tty delivers at most 4095 bytes): the link reads again.
FULL_READ_BYTES: Final = 2048
# Maximum number of waiting bytes: half of the buffer of n_tty (4095 bytes). At three quarters, n_tty stops the driver
# of a USB adapter, and the adapter itself can hold only 256 bytes.
WAITING_BYTES: Final = 2048
# Maximum number of bytes to send. Requests have some dozens of bytes: more bytes mean that the port does not send.
WRITE_QUEUE_BYTES: Final = 4096
DEFAULT_BAUD: Final = 115200  # baud rate of a port that imud opens for detection, bit/s


class UartOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a serial port."""

    port: SerialPort
    """Path of the port. `/dev/serial/by-id/…` names the adapter and survives replugging; `/dev/ttyUSB0` does not."""
    baud: Annotated[int, Meta(ge=50, le=4_000_000)] | Literal["auto"] = "auto"
    """Baud rate, bit/s. `auto`: imud tries each rate of the device."""
    low_latency: bool = True
    """Request low latency from driver and USB adapter."""


class UartLink:
    """A serial port as a `StreamLink`. Synchronization: the loop's thread only."""

    def __init__(self, settings: UartOptions, *, sys: Path = Path("/sys"), proc: Path = PROC) -> None:
        self._settings = settings
        self._sys = sys
        self._proc = proc
        self._port: serial.Serial | None = None
        self._fd = -1
        self._counters: TtyCounters | None = None
        self._node = DeviceNode(settings.port, CABLE)
        self._on_data: OnData = _ignore_data
        self._on_end: OnEnd = _ignore_end
        self._loop: asyncio.AbstractEventLoop | None = None
        self._unsent = bytearray()
        self.waiting_bytes = WAITING_BYTES
        self.title = settings.port
        self.auto_baud = settings.baud == "auto"
        self.writable = True
        self.baud: int = DEFAULT_BAUD if settings.baud == "auto" else settings.baud
        self.hold_ns = 0

    def absence(self) -> str:
        return self._node.absence()

    async def wait_present(self) -> None:
        await self._node.wait_present()

    def open(self) -> None:
        """Open the port exclusively, raw 8N1. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        path = self._settings.port
        self._port = open_port(path, self.baud, self._proc)
        self._fd = self._port.fileno()
        self._counters = TtyCounters(self._fd)
        if self._settings.low_latency:
            request_low_latency(self._port, path, self._sys)
        self.hold_ns = hold_ns(path, self._sys)

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        self._on_data, self._on_end = on_data, on_end
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._read)

    def deliver_to(self, on_data: OnData) -> None:
        self._on_data = on_data

    def pause(self) -> None:
        """Stop the delivery until `resume`. Bytes wait in the kernel. imud does not detect a removed port."""
        if self._loop is not None:
            self._loop.remove_reader(self._fd)

    def take(self) -> bytes:
        """Return all waiting bytes. If the port was removed, return the last bytes and report the end."""
        data = b""
        while self._loop is not None:
            try:
                piece = os.read(self._fd, READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                self._end(error)
                break
            if not piece:
                self._end(None)
                break
            data = data + piece if data else piece
            if len(piece) < FULL_READ_BYTES:
                break
        return data

    def resume(self) -> None:
        """Continue the delivery. Do nothing if the port has ended or is closed."""
        if self._loop is not None:
            self._loop.add_reader(self._fd, self._read)

    def write(self, data: bytes) -> None:
        """Send bytes, or queue at most WRITE_QUEUE_BYTES that the port does not accept now. Raises LinkError."""
        if self._fd < 0:
            raise LinkError(f"{self.title} is not open and cannot send")
        if len(self._unsent) + len(data) > WRITE_QUEUE_BYTES:
            raise LinkError(f"{self.title} does not accept bytes: {len(self._unsent)} bytes wait; is the port stuck?")
        if self._unsent:
            self._unsent += data
            return
        rest = data[self._send(data) :]
        if rest:
            self._unsent += rest
            self._loop = self._loop or asyncio.get_running_loop()
            self._loop.add_writer(self._fd, self._write_more)

    def set_baud(self, baud: int) -> None:
        """Change the rate and discard the bytes of the old rate. Raises LinkError for an unsupported rate."""
        if self._port is None:
            raise LinkError(f"{self.title} is not open; cannot set its baud rate")
        change_baud(self._port, self._settings.port, baud, self._proc)
        self.baud = baud

    def kernel_counters(self) -> KernelCounters:
        """Return the errors that the kernel counted since `open`; zeros if the driver has no counters."""
        return self._counters.read() if self._counters else KernelCounters()

    def close(self) -> None:
        self._stop()
        self._fd = -1
        self._unsent.clear()
        self._counters = None
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _read(self) -> None:
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(error)
            return
        if not data:
            self._end(None)
            return
        on_data = self._on_data
        on_data(data, time.monotonic_ns())

    def _end(self, error: OSError | None) -> None:
        self._stop()
        reason = "hung up" if error is None else f"{os.strerror(error.errno or 0)}"
        self._on_end(LinkMissing(f"{self.title} is missing ({reason}): was the cable or the adapter unplugged?"))

    def _send(self, data: bytes | bytearray) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise port_problem(error, self.title, self._proc) from error

    def _write_more(self) -> None:
        try:
            sent = self._send(self._unsent)
        except LinkError:  # the reader receives the same error and reports it
            sent = len(self._unsent)
        del self._unsent[:sent]
        if not self._unsent and self._loop is not None:
            self._loop.remove_writer(self._fd)

    def _stop(self) -> None:
        if self._loop is not None and self._fd >= 0:
            self._loop.remove_reader(self._fd)
            self._loop.remove_writer(self._fd)
        self._loop = None


def _ignore_data(data: bytes, t_rx_ns: int) -> None: ...


def _ignore_end(error: LinkError | None) -> None: ...


def _claims(settings: UartOptions) -> list[Claim]:
    return [Claim(place=settings.port, key="port")]


LINK = LinkType("uart", UartOptions, UartLink, claims=_claims)
