"""An SPI bus through spidev: SPI_IOC_MESSAGE(n), one ioctl for a whole transaction (<linux/spi/spidev.h>).

Words of 16 bits where the controller has them; where it refuses (EINVAL, as the Raspberry Pi's do), words of 8 bits
with the high byte first, which puts the same bits on the same wires. spidev keeps words of more than 8 bits in the
host's byte order. Chip select is held through each item of a transfer and released between items.
"""

import array
import ctypes
import errno
import fcntl
import os
import struct
import sys
from collections.abc import Callable
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.link import Claim, LinkType
from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters
from imud.links.device_node import DeviceNode, bus_open_problem, transfer_problem
from imud.model.errors import LinkError
from imud.model.options import Options

WR_MODE: Final = 0x40016B01
"""_IOW('k', 1, __u8)"""
WR_BITS_PER_WORD: Final = 0x40016B03
WR_MAX_SPEED_HZ: Final = 0x40046B04
ROW: Final = struct.Struct("=QQIIHBBBBBB")
"""struct spi_ioc_transfer: tx_buf, rx_buf, len, speed_hz, delay_usecs, bits_per_word, cs_change, tx_nbits, rx_nbits,
word_delay_usecs, pad."""
ROWS_MAX: Final = 32
"""fcntl.ioctl lets other threads run for arguments of up to 1024 bytes only."""
SWITCHED_ON: Final = "is SPI switched on (`dtparam=spi=on` on a Raspberry Pi)?"
PREPARED_MAX: Final = 64
"""Transfers whose buffers are kept; a device has some ten different ones."""

Ioctl = Callable[[int, int, bytes], object]


class SpiOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an SPI bus."""

    port: Annotated[str, Meta(min_length=1)]
    """Path of the bus and chip select, for example `/dev/spidev0.0`."""
    speed_hz: Annotated[int, Meta(ge=200_000, le=2_000_000)] = 1_000_000
    """Clock of the bus in Hz."""
    mode: Literal[0, 3, "auto"] = "auto"
    """SPI mode; `auto` tries 0, then 3, and decides by the product id."""
    rate_hz: Annotated[float, Meta(ge=0.1, le=4000)] = 100.0
    """Rate of reads, per second."""


def bus_of(settings: SpiOptions) -> str:
    """Return the path of the bus, without the chip select."""
    return settings.port.partition(".")[0]


class SpiLink:
    """A `PolledLink` on spidev. `ioctl` and `open_node` are the kernel's, or a test's."""

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
        """Return why the port cannot be opened now; empty when it is there."""
        return self._node.absence()

    async def wait_present(self) -> None:
        """Return when the node is there."""
        await self._node.wait_present()

    def open(self) -> None:
        """Open the node and set the clock. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._open()

    def select(self, target: int) -> None:
        """Use an SPI mode, 0 to 3. Raises LinkError."""
        self._place = self.place(target)
        try:
            self._ioctl(self._fd, WR_MODE, bytes([target]))
        except OSError as error:
            raise LinkError(f"{self.title} cannot do mode {target}: {os.strerror(error.errno or 0)}") from error

    def place(self, target: int) -> str:
        """A mode in messages."""
        return f"mode {target}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Send words and return those read at the same time. Raises TransferError, LinkMissing, LinkError."""
        message = self._prepared.get(transfer) or self._prepare(transfer)
        try:
            self._ioctl(self._fd, message.request, message.rows)
        except OSError as error:
            if error.errno == errno.EINVAL and self._bits == 16:  # a driver that looks at the words only now
                self._set_bits(8)
                return self.transfer(transfer)
            raise transfer_problem(error, self.title, self._place) from error
        return message.read()

    def write(self, data: bytes) -> None:
        """Raises LinkError: bytes are sent in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Zeros: the kernel counts no errors of this bus."""
        return KernelCounters()

    def serial_line(self) -> None:
        """None: a bus with a clock carries nothing unasked."""

    def close(self) -> None:
        """Release the node; may be called twice."""
        fd, self._fd = self._fd, -1
        self._prepared.clear()
        if fd >= 0:
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
        """16 if the controller has such words, otherwise 8."""
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
    """The argument of one SPI_IOC_MESSAGE with its buffers, made once and used again."""

    __slots__ = ("_rx", "_swapped", "_tx", "request", "rows")

    def __init__(self, transfer: Transfer, bits: int, speed_hz: int) -> None:
        """Raises LinkError for more items than an ioctl may have."""
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
            release = number + 1 < len(sends)  # cs_change of the last would keep the chip selected
            rows.append(ROW.pack(tx, rx, len(item), speed_hz, transfer.gap_us, bits, release, 0, 0, 0, 0))
            at += len(item)
        self.rows = b"".join(rows)
        self.request = 0x40006B00 | len(self.rows) << 16  # _IOW('k', 0, char[n])

    def read(self) -> bytes:
        """The received bytes, in the order of the wire."""
        return _byteswapped(self._rx.raw) if self._swapped else self._rx.raw


def _byteswapped(data: bytes) -> bytes:
    words = array.array("H", data)
    words.byteswap()
    return words.tobytes()


def _claims(settings: SpiOptions) -> list[Claim]:
    return [Claim(place=settings.port, key="port")]


LINK = LinkType("spi", SpiOptions, make_polled=SpiLink, claims=_claims, bus_of=bus_of)
