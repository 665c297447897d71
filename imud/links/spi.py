"""An SPI bus through spidev: SPI_IOC_MESSAGE(n), one ioctl for a whole transaction (<linux/spi/spidev.h>).

The link uses 16-bit words. If the controller rejects them with EINVAL (Raspberry Pi), the link uses 8-bit words, high
byte first. The bits on the wires are the same. spidev stores words of more than 8 bits in the byte order of the host.
Chip select is active during each item of a transfer and inactive between two items.
"""

import array
import ctypes
import errno
import fcntl
import os
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.link import Claim, LinkType
from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters
from imud.links.device_node import DeviceNode, bus_open_problem, transfer_problem
from imud.model.errors import LinkError
from imud.model.host_object import SpiPort
from imud.model.options import Options

WR_MODE: Final = 0x40016B01  # ioctl _IOW('k', 1, __u8): set the SPI mode
WR_BITS_PER_WORD: Final = 0x40016B03
WR_MAX_SPEED_HZ: Final = 0x40046B04
# `struct spi_ioc_transfer`: tx_buf, rx_buf, len, speed_hz, delay_usecs, bits_per_word, cs_change, tx_nbits, rx_nbits,
# word_delay_usecs, pad.
ROW: Final = struct.Struct("=QQIIHBBBBBB")
# Maximum number of rows in one ioctl. A row has 32 bytes. fcntl.ioctl blocks all other threads if the argument is
# longer than 1024 bytes.
ROWS_MAX: Final = 32
SWITCHED_ON: Final = "is SPI enabled (Raspberry Pi: `dtparam=spi=on`)?"
# Maximum number of transfers with stored buffers. A device uses about ten different transfers.
PREPARED_MAX: Final = 64

Ioctl = Callable[[int, int, bytes], object]


class SpiOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an SPI bus."""

    port: SpiPort
    """Path of bus and chip select, for example `/dev/spidev0.0`."""
    speed_hz: Annotated[int, Meta(ge=200_000, le=2_000_000)] = 1_000_000
    """Clock of the bus, Hz."""
    mode: Literal[0, 3, "auto"] = "auto"
    """SPI mode. `auto` tries 0, then 3, and checks the product ID."""
    rate_hz: Annotated[float, Meta(ge=0.1, le=4000)] = 100.0
    """Rate of the reads, Hz."""


def bus_of(settings: SpiOptions) -> str:
    """Return the path of the bus without the chip select."""
    return settings.port.partition(".")[0]


class SpiLink:
    """A `PolledLink` on spidev. Tests replace `ioctl` and `open_node`."""

    def __init__(
        self,
        settings: SpiOptions,
        *,
        ioctl: Ioctl = fcntl.ioctl,
        open_node: Callable[[str, int], int] = os.open,
        close_node: Callable[[int], None] = os.close,
    ) -> None:
        self._settings = settings
        self._ioctl, self._open_node, self._close_node = ioctl, open_node, close_node
        self._node = DeviceNode(settings.port, SWITCHED_ON)
        self._fd = -1
        self._bits = 16
        self._prepared: dict[Transfer, _Message] = {}
        self._place = ""
        self.title = settings.port
        self.writable = True
        self.bus = bus_of(settings)
        self.target: int | None = None if settings.mode == "auto" else settings.mode
        self.shared = False
        self.rate_hz = settings.rate_hz
        self.bit_rate = 0

    def absence(self) -> str:
        return self._node.absence()

    async def wait_present(self) -> None:
        await self._node.wait_present()

    def open(self) -> None:
        """Open the node and set the clock. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        self._open()

    def select(self, target: int) -> None:
        """Set the SPI mode of the next transfers, 0 to 3. Raises LinkError if the controller rejects the mode."""
        self._place = self.place(target)
        try:
            self._ioctl(self._fd, WR_MODE, bytes([target]))
        except OSError as error:
            raise LinkError(f"{self.title} rejects SPI mode {target}: {os.strerror(error.errno or 0)}") from error

    def place(self, target: int) -> str:
        """Return a mode in the form of messages."""
        return f"mode {target}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Send words. Return the words received at the same time. Raises TransferError, LinkMissing or LinkError."""
        message = self._prepared.get(transfer) or self._prepare(transfer)
        try:
            self._ioctl(self._fd, message.request, message.rows)
        except OSError as error:
            if (
                error.errno == errno.EINVAL and self._bits == 16
            ):  # some drivers check the word size only during a transfer
                self._set_bits(8)
                return self.transfer(transfer)
            raise transfer_problem(error, self.title, self._place) from error
        return message.read()

    def write(self, data: bytes) -> None:
        """Raises LinkError: the link sends bytes in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Return zeros: the kernel does not count errors of this bus."""
        return KernelCounters()

    def serial_line(self) -> None:
        """Return None: this bus carries no data without a request."""

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        self._prepared.clear()
        if fd >= 0:
            with suppress(OSError):  # the kernel closes the descriptor also after an error
                self._close_node(fd)

    def _open(self) -> None:
        try:
            self._fd = self._open_node(self.title, os.O_RDWR | os.O_CLOEXEC)
            self._ioctl(self._fd, WR_MAX_SPEED_HZ, struct.pack("=I", self._settings.speed_hz))
            self._set_bits(self._accepted_bits())
        except OSError as error:
            self.close()
            raise bus_open_problem(error, self.title, SWITCHED_ON) from error

    def _accepted_bits(self) -> int:
        """Return 16 if the controller supports 16-bit words, otherwise 8."""
        try:
            self._ioctl(self._fd, WR_BITS_PER_WORD, b"\x10")
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            self._ioctl(self._fd, WR_BITS_PER_WORD, b"\x08")
            return 8
        return 16

    def _set_bits(self, bits: int) -> None:
        self._bits = bits
        self._prepared.clear()

    def _prepare(self, transfer: Transfer) -> "_Message":
        if len(self._prepared) >= PREPARED_MAX:
            self._prepared.clear()
        message = self._prepared[transfer] = _Message(transfer, self._bits, self._settings.speed_hz)
        return message


class _Message:
    """Argument of one SPI_IOC_MESSAGE with its buffers, made once for many transfers."""

    __slots__ = ("_rx", "_swapped", "_tx", "request", "rows")

    def __init__(self, transfer: Transfer, bits: int, speed_hz: int) -> None:
        """Raises LinkError for more items than an ioctl supports."""
        sends = transfer.sends
        if not 0 < len(sends) <= ROWS_MAX:
            raise LinkError(f"expected 1 to {ROWS_MAX} items in one SPI message, got {len(sends)}")
        self._swapped = bits > 8 and sys.byteorder == "little"
        sent = b"".join(sends)
        self._tx = ctypes.create_string_buffer(_byteswapped(sent) if self._swapped else sent, len(sent))
        self._rx = ctypes.create_string_buffer(len(sent))
        rows, at = [], 0
        for number, item in enumerate(sends):
            tx, rx = ctypes.addressof(self._tx) + at, ctypes.addressof(self._rx) + at
            release = number + 1 < len(sends)  # cs_change in the last row would keep chip select active
            rows.append(ROW.pack(tx, rx, len(item), speed_hz, transfer.gap_us, bits, release, 0, 0, 0, 0))
            at += len(item)
        self.rows = b"".join(rows)
        self.request = 0x40006B00 | len(self.rows) << 16  # _IOW('k', 0, char[n])

    def read(self) -> bytes:
        """Return the received bytes in the order of the wire."""
        return _byteswapped(self._rx.raw) if self._swapped else self._rx.raw


def _byteswapped(data: bytes) -> bytes:
    words = array.array("H", data)
    words.byteswap()
    return words.tobytes()


def _claims(settings: SpiOptions) -> list[Claim]:
    return [Claim(place=settings.port, key="port")]


LINK = LinkType("spi", SpiOptions, make_polled=SpiLink, claims=_claims, bus_of=bus_of)
