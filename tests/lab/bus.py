"""Simulated I2C and SPI devices. A thread connects them to the kernel's bus drivers.

A device is a function from the transfer to the bytes that the host reads. It may raise Refuse (wire.py). The transfers
are from any thread or process: i2c-tools, the code under test, or the test itself. In the same process, do not use
fcntl.ioctl with more than 1024 bytes (33 or more SPI transfers). It keeps the GIL, so the thread cannot reply, and the
transfer fails with ETIMEDOUT after `timeout_ms` of the kernel module.
"""

import errno
import os
import select
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Generic, Self, TypeVar, cast

from tests.lab import wire

STOP_LIMIT_S = 10.0  # limit for the end of the thread
OneTransfer = TypeVar("OneTransfer", wire.I2cTransfer, wire.SpiTransfer)


class Bus(Generic[OneTransfer]):
    """The devices of one bus, as a context manager. `close()` raises the unexpected exceptions of devices.

    Synchronization: devices run in the serving thread; any thread can call `attach`, `detach` and `transfers`.
    """

    def __init__(self, path: Path, select_of: Callable[[OneTransfer], int]) -> None:
        """`path` is the kernel module's node. `select_of` returns the address or chip select of a transfer."""
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._stop = os.eventfd(0, os.EFD_CLOEXEC)
        self._select_of: Callable[[OneTransfer], int] = select_of
        self._lock = threading.Lock()
        self._devices: dict[int, Callable[[OneTransfer], bytes]] = {}
        self._transfers: list[OneTransfer] = []
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name=path.name, daemon=True)
        self._thread.start()

    def attach(self, select: int, device: Callable[[OneTransfer], bytes]) -> None:
        with self._lock:
            self._devices[select] = device

    def detach(self, select: int) -> None:
        with self._lock:
            del self._devices[select]

    @property
    def transfers(self) -> list[OneTransfer]:
        with self._lock:
            return list(self._transfers)

    def close(self) -> None:
        if self._file < 0:
            return
        os.eventfd_write(self._stop, 1)
        self._thread.join(STOP_LIMIT_S)
        stuck = self._thread.is_alive()
        if not stuck:
            os.close(self._file)
            os.close(self._stop)
        self._file = -1
        assert not stuck, "expected the end of the serving thread; a simulated device did not return"
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _serve(self) -> None:
        poll = select.poll()
        poll.register(self._file, select.POLLIN)
        poll.register(self._stop, select.POLLIN)
        while self._stop not in dict(poll.poll()):
            try:
                request = os.read(self._file, wire.MAX_BYTES)
            except BlockingIOError:
                continue  # the host cancelled the transfer between poll and read
            transfer = cast(OneTransfer, wire.parse(request))
            self._write(self._answer(transfer))

    def _write(self, answer: bytes) -> None:
        try:
            os.write(self._file, answer)
        except OSError as error:
            if error.errno != errno.ESTALE:  # the transfer of the host has timed out
                self._failure = error

    def _answer(self, transfer: OneTransfer) -> bytes:
        with self._lock:
            self._transfers.append(transfer)
            device = self._devices.get(self._select_of(transfer))
        try:
            return _served(transfer, device)
        except wire.Refuse as refusal:
            return wire.refusal(transfer, refusal.number)
        except Exception as error:  # noqa: BLE001 - a mistake in a test's device must fail that test, not hang it
            self._failure = error
            return wire.refusal(transfer, errno.EIO)


def _served(transfer: OneTransfer, device: Callable[[OneTransfer], bytes] | None) -> bytes:
    if device is not None:
        return wire.answer(transfer, device(transfer))
    if isinstance(transfer, wire.I2cTransfer):
        raise wire.Refuse(errno.ENXIO)
    return wire.answer(transfer, bytes(transfer.whole))


def i2c_bus(number: int = 0) -> Bus[wire.I2cTransfer]:
    return Bus(Path(f"/dev/imud-lab-i2c{number}"), lambda transfer: transfer.segments[0].address)


def spi_bus(number: int) -> Bus[wire.SpiTransfer]:
    """The devices behind /dev/spidev<number>.*, by chip select. Bus 0 has only 8-bit words, bus 1 also 16-bit words."""
    return Bus(Path(f"/dev/imud-lab-spi{number}"), lambda transfer: transfer.chip_select)


class RegisterDevice:
    """A simulated I2C device that is similar to most sensors: byte registers and a register pointer."""

    def __init__(self, contents: dict[int, int] | None = None) -> None:
        self.registers = bytearray(256)
        self.pointer = 0
        for register, value in (contents or {}).items():
            self.registers[register] = value

    def __call__(self, transfer: wire.I2cTransfer) -> bytes:
        return b"".join(self._segment(segment) for segment in transfer.segments)

    def _segment(self, segment: wire.I2cSegment) -> bytes:
        if segment.reads:
            return bytes(self._next() for _ in range(segment.length))
        if segment.data:
            self.pointer = segment.data[0]
        for value in segment.data[1:]:
            self.registers[self.pointer] = value
            self.pointer = (self.pointer + 1) % 256
        return b""

    def _next(self) -> int:
        value = self.registers[self.pointer]
        self.pointer = (self.pointer + 1) % 256
        return value
