"""I2C and SPI inside the process: simulated devices behind substitutes for smbus2 and the ioctl of spidev.

For tests and measurements without a bus of the kernel: `SpiLink(settings, ioctl=bus.ioctl, open_node=bus.open, …)` and
`I2cLink(settings, open_bus=bus.open, ioctl=bus.ioctl)`.
"""

import ctypes
import errno
from collections.abc import Callable, Sequence

from smbus2 import I2cFunc, i2c_msg

from imud.links import spi
from imud.sim.imu61x.registers import Imu61xRegisters

I2C_M_RD = 0x0001  # flag of a read message (<linux/i2c.h>)
FD = 1_000_000  # First number of the simulated descriptors. No process has such descriptors.


class InProcessI2c:
    """An I2C bus with devices by address. It replaces `SMBus` and its opener."""

    def __init__(self, devices: dict[int, Imu61xRegisters], funcs: int = I2cFunc.I2C) -> None:
        self.devices = devices
        self.funcs = funcs
        self.fd: int | None = None
        self.opened = 0
        self.open_error = 0  # error number of `open`; 0 for no error
        self.calls: list[tuple[int, tuple[bytes | int, ...]]] = []  # address and parts of each transaction

    def open(self, _path: str) -> "InProcessI2c":
        if self.open_error:
            raise OSError(self.open_error, "by the test")
        self.fd, self.opened = FD, self.opened + 1
        return self

    def ioctl(self, _fd: int, _request: int, _argument: int) -> int:
        return 0

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        reads = [message for message in messages if message.flags & I2C_M_RD]
        parts = [message.len if message in reads else bytes(message) for message in messages]
        data = self._transact(messages[0].addr, parts)
        for message in reads:
            ctypes.memmove(message.buf, data, message.len)

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int) -> list[int]:
        return list(self._transact(i2c_addr, [bytes([register]), length]))

    def write_i2c_block_data(self, i2c_addr: int, register: int, data: list[int]) -> None:
        self._transact(i2c_addr, [bytes([register, *data])])

    def close(self) -> None:
        self.fd = None

    def _transact(self, address: int, parts: Sequence[bytes | int]) -> bytes:
        self.calls.append((address, tuple(parts)))
        device = self.devices.get(address)
        if device is None:
            raise OSError(errno.ENXIO, "no device acknowledges")
        return device.i2c(parts)


class InProcessSpi:
    """A chip select of an SPI bus behind the ioctl of spidev."""

    def __init__(
        self, device: Callable[[Sequence[bytes], int], Sequence[bytes]] | None = None, *, word_bits: int = 8
    ) -> None:
        """`device`: `Imu61xRegisters.spi`, None reads zeros. `word_bits`: maximum word size of the controller."""
        self.device = device
        self.mode = 0
        self.opened: list[int] = []
        self.open_error = 0  # error number of `open`; 0 for no error
        # MOSI of each selection, word size and speed of each message.
        self.messages: list[tuple[tuple[bytes, ...], int, int]] = []
        self.keep_messages = True
        self.word_bits = word_bits

    def open(self, _path: str, _flags: int) -> int:
        """Replace `os.open`."""
        if self.open_error:
            raise OSError(self.open_error, "by the test")
        self.opened.append(FD + len(self.opened))
        return self.opened[-1]

    def close(self, fd: int) -> None:
        """Replace `os.close`."""
        self.opened.remove(fd)

    def ioctl(self, _fd: int, request: int, argument: bytes) -> int:
        """Replace `fcntl.ioctl` on spidev."""
        if request == spi.WR_MODE:
            self.mode = argument[0]
        elif request == spi.WR_BITS_PER_WORD and argument[0] > self.word_bits:
            raise OSError(errno.EINVAL, "words of that size are not supported")
        elif request not in (spi.WR_BITS_PER_WORD, spi.WR_MAX_SPEED_HZ):
            self._message(argument)
        return 0

    def _message(self, argument: bytes) -> None:
        rows = list(spi.ROW.iter_unpack(argument))
        if any(row[5] > self.word_bits for row in rows):
            raise OSError(errno.EINVAL, "words of that size are not supported")
        mosi = [_swapped(ctypes.string_at(tx, size), bits) for tx, _, size, _, _, bits, *_ in rows]
        selections: list[bytes] = [b""]
        for part, row in zip(mosi, rows, strict=True):
            selections[-1] += part
            if row[6]:
                selections.append(b"")
        if self.keep_messages:
            self.messages.append((tuple(selections), rows[0][5], rows[0][3]))
        answer = self.device(selections, self.mode) if self.device else [bytes(len(part)) for part in selections]
        miso, at = b"".join(answer), 0
        for _, rx, size, _, _, bits, *_ in rows:
            ctypes.memmove(rx, _swapped(miso[at : at + size], bits), size)
            at += size


def _swapped(data: bytes, bits: int) -> bytes:
    """Convert 16-bit words between a little-endian memory and the wire."""
    if bits <= 8:
        return data
    return b"".join(data[at : at + 2][::-1] for at in range(0, len(data), 2))
