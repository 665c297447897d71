"""An I2C bus through i2c-dev: one transaction writes and reads a register with a repeated start (I2C_RDWR).

If a controller supports SMBus only (no I2C_FUNC_I2C), the link uses block reads of at most 32 bytes. The bits on the
bus are the same. The link shortens the timeout of the bus, so that a blocked bus delays its devices only for a short
time.
"""

import fcntl
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Final, Literal, Protocol

from msgspec import Meta
from smbus2 import I2cFunc, SMBus, i2c_msg

from imud.contracts.link import Claim, LinkType
from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters
from imud.host.library_call import LibraryCall
from imud.links.device_node import DeviceNode, bus_open_problem, transfer_problem
from imud.model.errors import LinkError
from imud.model.host_object import HostObject, names
from imud.model.options import Options

I2C_TIMEOUT: Final = 0x0702  # ioctl: timeout of the adapter in units of 10 ms (<linux/i2c-dev.h>)
TIMEOUT_10MS: Final = 5  # timeout of the bus, 10 ms: 40 times the 1.2 ms of 48 bytes at 400 kHz
SWITCHED_ON: Final = "is I2C enabled (Raspberry Pi: `dtparam=i2c_arm=on`), and is the kernel module i2c-dev loaded?"
BLOCK_BYTES_MAX: Final = 32  # maximum length of an I2C block read of an SMBus controller, bytes


class I2cOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an I2C bus."""

    bus: Annotated[int, Meta(ge=0, le=255, extra=names(HostObject.I2C_BUS))] = 1
    """Number of the bus: 1 for `/dev/i2c-1`."""
    address: Annotated[int, Meta(ge=0x08, le=0x77)] | Literal["auto"] = "auto"
    """7-bit address, for example 0x18. `auto`: imud tries each address that the device supports."""
    rate_hz: Annotated[float, Meta(ge=0.1, le=4000)] = 100.0
    """Rate of the reads, Hz."""


def bus_of(settings: I2cOptions) -> str:
    return f"/dev/i2c-{settings.bus}"


class I2cBus(Protocol):
    """Part of smbus2.SMBus that the link uses."""

    @property
    def fd(self) -> int | None: ...

    @property
    def funcs(self) -> int: ...

    def i2c_rdwr(self, *messages: i2c_msg) -> None: ...

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int) -> list[int]:
        """Write a register number, send a repeated start, read."""
        ...

    def write_i2c_block_data(self, i2c_addr: int, register: int, data: list[int]) -> None:
        """Write a register number and data."""
        ...

    def close(self) -> None: ...


class I2cLink:
    """A `PolledLink` on i2c-dev. Tests replace `open_bus` and `ioctl`."""

    def __init__(
        self,
        settings: I2cOptions,
        *,
        open_bus: Callable[[str], I2cBus] = SMBus,
        ioctl: Callable[[int, int, int], object] = fcntl.ioctl,
    ) -> None:
        self._open_bus, self._ioctl = open_bus, ioctl
        self._node = DeviceNode(bus_of(settings), SWITCHED_ON)
        self._bus: I2cBus | None = None
        self._address = 0
        self._place = ""
        self.title = bus_of(settings)
        self._library = LibraryCall(f"use {self.title}", OSError)
        self.writable = True
        self.bus = self.title
        self.target: int | None = None if settings.address == "auto" else settings.address
        self.shared = True
        self.rate_hz = settings.rate_hz
        self.bit_rate = 0

    def absence(self) -> str:
        return self._node.absence()

    async def wait_present(self) -> None:
        await self._node.wait_present()

    def open(self) -> None:
        """Open the node. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        self._open()

    def select(self, target: int) -> None:
        """Set the 7-bit address of the next transfers."""
        self._address = target
        self._place = self.place(target)

    def place(self, target: int) -> str:
        """Return an address in the form of messages."""
        return f"address {target:#04x}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Write, then read after a repeated start. Raises TransferError, LinkMissing or LinkError."""
        bus, (sent,) = self._bus, transfer.sends
        if bus is None:
            raise LinkError(f"{self.title} is not open")
        try:
            with self._library:
                if bus.funcs & I2cFunc.I2C:
                    return self._combined(bus, sent, transfer.read_bytes)
                return self._block(bus, sent, transfer.read_bytes)
        except OSError as error:
            raise transfer_problem(error, self.title, self._place) from error

    def write(self, data: bytes) -> None:
        """Raises LinkError: the link sends bytes in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Return zeros: the kernel does not count errors of this bus."""
        return KernelCounters()

    def serial_line(self) -> None:
        """Return None: this bus carries no data without a request."""

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(OSError, LinkError), self._library:  # the adapter was removed
                bus.close()

    def _open(self) -> None:
        try:
            with self._library:
                self._bus = self._open_bus(self.title)
                self._ioctl(self._bus.fd or 0, I2C_TIMEOUT, TIMEOUT_10MS)
        except LinkError:
            self.close()
            raise
        except OSError as error:
            self.close()
            raise bus_open_problem(error, self.title, SWITCHED_ON) from error

    def _combined(self, bus: I2cBus, sent: bytes, read_bytes: int) -> bytes:
        write = i2c_msg.write(self._address, sent)
        if not read_bytes:
            bus.i2c_rdwr(write)
            return b""
        read = i2c_msg.read(self._address, read_bytes)
        bus.i2c_rdwr(write, read)
        return bytes(read)

    def _block(self, bus: I2cBus, sent: bytes, read_bytes: int) -> bytes:
        """Make the transfer with SMBus calls: one register number, at most 32 bytes."""
        if not sent or len(sent) - 1 > BLOCK_BYTES_MAX or read_bytes > BLOCK_BYTES_MAX or (read_bytes and sent[1:]):
            raise LinkError(f"{self.title} is an SMBus controller and cannot make this transfer")
        if read_bytes:
            return bytes(bus.read_i2c_block_data(self._address, sent[0], read_bytes))
        bus.write_i2c_block_data(self._address, sent[0], list(sent[1:]))
        return b""


def _claims(settings: I2cOptions) -> list[Claim]:
    address = None if settings.address == "auto" else settings.address
    return [Claim(place=f"/dev/i2c-{settings.bus}", key="bus", shared=True, part=address, part_key="address")]


LINK = LinkType("i2c", I2cOptions, make_polled=I2cLink, claims=_claims, bus_of=bus_of)
