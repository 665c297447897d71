"""spidev's ioctls, straight from <linux/spi/spidev.h>: the host's side for tests of the lab itself."""

import ctypes
import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

WR_MODE = 0x40016B01  # _IOW('k', 1, __u8)
RD_MODE = 0x80016B01
WR_BITS_PER_WORD = 0x40016B03  # _IOW('k', 3, __u8)
TRANSFER = struct.Struct(
    "=QQIIHBBBBBB"
)  # tx, rx, len, speed, delay_us, bits, cs_change, tx_n, rx_n, word_delay_us, pad


def message_request(count: int) -> int:
    """SPI_IOC_MESSAGE(count) = _IOW('k', 0, char[count * 32])."""
    return 0x40006B00 | (count * TRANSFER.size) << 16


@dataclass
class HostTransfer:
    """One spi_ioc_transfer: `tx` is memory as the host has it, `rx` comes back the same way."""

    tx: bytes
    speed_hz: int = 0
    delay_us: int = 0
    bits_per_word: int = 0
    cs_change: bool = False
    word_delay_us: int = 0


@dataclass(frozen=True)
class HostDevice:
    """An open spidev."""

    fd: int

    def set_mode(self, mode: int) -> None:
        """SPI mode bits."""
        fcntl.ioctl(self.fd, WR_MODE, struct.pack("B", mode))

    def set_bits_per_word(self, bits: int) -> None:
        """Default word size. OSError EINVAL if the controller cannot."""
        fcntl.ioctl(self.fd, WR_BITS_PER_WORD, struct.pack("B", bits))

    def exchange(self, *transfers: HostTransfer) -> tuple[int, list[bytes]]:
        """One message. Returns the ioctl's result (bytes transferred) and what was read."""
        tx = [ctypes.create_string_buffer(transfer.tx, len(transfer.tx)) for transfer in transfers]
        rx = [ctypes.create_string_buffer(len(transfer.tx)) for transfer in transfers]
        rows = [
            TRANSFER.pack(
                *(ctypes.addressof(tx[i]), ctypes.addressof(rx[i]), len(one.tx), one.speed_hz, one.delay_us),
                *(one.bits_per_word, one.cs_change, 0, 0, one.word_delay_us, 0),
            )
            for i, one in enumerate(transfers)
        ]
        done = fcntl.ioctl(self.fd, message_request(len(rows)), bytearray(b"".join(rows)))
        return done, [bytes(buffer) for buffer in rx]


@contextmanager
def host_device(bus: int, chip_select: int = 0) -> Iterator[HostDevice]:
    """/dev/spidev<bus>.<chip_select>, in mode 0 with 8-bit words."""
    fd = os.open(Path(f"/dev/spidev{bus}.{chip_select}"), os.O_RDWR | os.O_CLOEXEC)
    try:
        device = HostDevice(fd)
        device.set_mode(0)
        device.set_bits_per_word(8)
        yield device
    finally:
        os.close(fd)
