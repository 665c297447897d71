"""The messages of the kernel module (kmod/protocol.h): requests as records, replies as bytes. No I/O.

SPI data is in wire order here, most significant byte of each word first. The kernel module uses the byte order of the
host for words of more than 8 bits. `SpiTransfer.answer` and the parser convert.
"""

import struct
import sys
from dataclasses import dataclass

KIND_I2C = 1
KIND_SPI = 2
I2C_M_RD = 0x0001
"""Flag of a segment that the host reads (<linux/i2c.h>)."""

REQUEST = struct.Struct("=IIHHII")  # id, size, kind, segments, mode, chip_select
I2C_SEGMENT = struct.Struct("=HHI")  # address, flags, length
SPI_SEGMENT = struct.Struct("=IIIIIBBBB")  # length, speed, delay, word delay, cs delay, bits, cs_change, tx, rx
ANSWER = struct.Struct("=IiII")  # id, status, done, size
MAX_BYTES = 64 * 1024  # maximum size of a message of the kernel module


class Refuse(Exception):
    """Exception of a simulated device. The call of the host then fails with this errno."""

    def __init__(self, number: int) -> None:
        """`number` is an errno: ENXIO for a NAK, ETIMEDOUT for a stuck bus, EAGAIN for a lost arbitration."""
        super().__init__(number)
        self.number = number


@dataclass(frozen=True, slots=True)
class I2cSegment:
    """One I2C message. A repeated start separates two messages of a transfer."""

    address: int
    flags: int
    length: int
    data: bytes

    @property
    def reads(self) -> bool:
        return bool(self.flags & I2C_M_RD)


@dataclass(frozen=True, slots=True)
class I2cTransfer:
    id: int
    segments: tuple[I2cSegment, ...]

    @property
    def read_length(self) -> int:
        return sum(segment.length for segment in self.segments if segment.reads)

    @property
    def whole(self) -> int:
        """Return `done` of a complete transfer."""
        return len(self.segments)

    def payload(self, data: bytes) -> bytes:
        return data


@dataclass(frozen=True, slots=True)
class SpiSegment:
    mosi: bytes
    speed_hz: int
    bits_per_word: int
    cs_change: bool
    reads: bool


@dataclass(frozen=True, slots=True)
class SpiTransfer:
    id: int
    mode: int
    chip_select: int
    segments: tuple[SpiSegment, ...]

    @property
    def selections(self) -> tuple[tuple[SpiSegment, ...], ...]:
        groups: list[list[SpiSegment]] = [[]]
        for number, segment in enumerate(self.segments):
            groups[-1].append(segment)
            if segment.cs_change and number + 1 < len(self.segments):
                groups.append([])
        return tuple(tuple(group) for group in groups)

    @property
    def stays_selected(self) -> bool:
        """Return whether the chip stays selected after the message: cs_change of the last segment."""
        return bool(self.segments) and self.segments[-1].cs_change

    @property
    def read_length(self) -> int:
        """Return the number of bytes in a complete reply to the kernel module."""
        return sum(len(segment.mosi) for segment in self.segments if segment.reads)

    @property
    def whole(self) -> int:
        """Return `done` of a complete transfer."""
        return sum(len(segment.mosi) for segment in self.segments)

    def payload(self, miso: bytes) -> bytes:
        kept, start = [], 0
        for segment in self.segments:
            part = miso[start : start + len(segment.mosi)]
            start += len(segment.mosi)
            if segment.reads:
                kept.append(swapped(part, segment.bits_per_word))
        return b"".join(kept)


Transfer = I2cTransfer | SpiTransfer


def swapped(data: bytes, bits_per_word: int) -> bytes:
    """Convert words of 9 to 16 bits between host byte order and wire order. Return 8-bit words unchanged."""
    if bits_per_word <= 8 or sys.byteorder == "big":
        return data
    return b"".join(data[i : i + 2][::-1] for i in range(0, len(data), 2))


def parse(request: bytes) -> Transfer:
    identifier, size, kind, count, mode, chip_select = REQUEST.unpack_from(request)
    assert size == len(request), f"request says {size} bytes, has {len(request)}"
    assert kind in (KIND_I2C, KIND_SPI), f"unknown kind {kind}"
    if kind == KIND_I2C:
        return I2cTransfer(identifier, _i2c_segments(request, count))
    return SpiTransfer(identifier, mode, chip_select, _spi_segments(request, count))


def _i2c_segments(request: bytes, count: int) -> tuple[I2cSegment, ...]:
    segments, at = [], REQUEST.size
    for _ in range(count):
        address, flags, length = I2C_SEGMENT.unpack_from(request, at)
        at += I2C_SEGMENT.size
        data = b"" if flags & I2C_M_RD else request[at : at + length]
        at += len(data)
        segments.append(I2cSegment(address, flags, length, data))
    return tuple(segments)


def _spi_segments(request: bytes, count: int) -> tuple[SpiSegment, ...]:
    segments, at = [], REQUEST.size
    for _ in range(count):
        length, speed_hz, _, _, _, bits, change, sends, reads = SPI_SEGMENT.unpack_from(request, at)
        at += SPI_SEGMENT.size
        mosi = swapped(request[at : at + length], bits) if sends else bytes(length)
        at += length if sends else 0
        segments.append(SpiSegment(mosi, speed_hz, bits, bool(change), bool(reads)))
    return tuple(segments)


def answer(transfer: Transfer, data: bytes) -> bytes:
    """Return the reply to a successful transfer. `data` contains the read bytes, for SPI the bytes of all segments."""
    payload = transfer.payload(data)
    assert len(payload) == transfer.read_length, f"device gave {len(payload)} bytes, host reads {transfer.read_length}"
    return ANSWER.pack(transfer.id, 0, transfer.whole, len(payload)) + payload


def refusal(transfer: Transfer, number: int) -> bytes:
    """Return the reply that makes the call of the host fail with an errno."""
    return ANSWER.pack(transfer.id, -number, 0, 0)
