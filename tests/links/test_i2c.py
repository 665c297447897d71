"""The I2C link on a simulated bus: repeated start, SMBus transfers, failures."""

import asyncio
import errno
from unittest.mock import AsyncMock

import pytest
from smbus2 import I2cFunc

from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters
from imud.links import LINKS
from imud.links.device_node import DeviceNode
from imud.links.i2c import I2C_TIMEOUT, I2cLink, I2cOptions
from imud.model.errors import LinkDenied, LinkError, LinkMissing, TransferError, Trouble
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import InProcessI2c

READ_ID = Transfer((b"\x6a",), 8)


def device() -> Imu61xRegisters:
    return Imu61xRegisters(lambda: 0, product="IMU612")


def opened(bus: InProcessI2c, address: int = 0x19) -> I2cLink:
    link = I2cLink(I2cOptions(bus=1), open_bus=bus.open, ioctl=bus.ioctl)
    link.open()
    link.select(address)
    return link


@pytest.mark.parametrize("funcs", [I2cFunc.I2C, I2cFunc.SMBUS_READ_I2C_BLOCK])
@pytest.mark.manual("A 3.3.1 reading")
def test_register_is_written_and_read_in_one_transaction(funcs: int) -> None:
    bus = InProcessI2c({0x19: device()}, funcs)
    link = opened(bus)
    assert link.transfer(READ_ID) == b"\x00\x00IMU612"
    assert link.transfer(Transfer((b"\x06\x4b",))) == b""
    assert link.transfer(Transfer((b"\x06",), 1)) == b"\x4b"
    assert bus.calls == [(0x19, (b"\x6a", 8)), (0x19, (b"\x06\x4b",)), (0x19, (b"\x06", 1))]


@pytest.mark.parametrize("transfer", [Transfer((b"\x12",), 33), Transfer((b"\x12\x13",), 1), Transfer((bytes(34),))])
def test_smbus_controller_refuses_what_it_cannot(transfer: Transfer) -> None:
    link = opened(InProcessI2c({0x19: device()}, I2cFunc.SMBUS_READ_I2C_BLOCK))
    with pytest.raises(LinkError, match="SMBus"):
        link.transfer(transfer)


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ENXIO, Trouble.ABSENT), (errno.EREMOTEIO, Trouble.ABSENT), (errno.ETIMEDOUT, Trouble.STUCK),
        (errno.EAGAIN, Trouble.DISTURBED), (errno.EIO, Trouble.DISTURBED), (errno.ENODEV, LinkMissing),
    ],
)  # fmt: skip
def test_transfer_that_fails_says_how(number: int, expected: object) -> None:
    far = device()
    link = opened(InProcessI2c({0x19: far}))
    far.faults.error = number
    with pytest.raises((TransferError, LinkError), match=r"/dev/i2c-1") as error:
        link.transfer(READ_ID)
    assert (error.value.trouble if isinstance(error.value, TransferError) else type(error.value)) is expected


@pytest.mark.parametrize(("number", "kind"), [(errno.ENOENT, LinkMissing), (errno.EACCES, LinkDenied)])
def test_open_that_fails_says_why_and_leaves_nothing_open(number: int, kind: type[LinkError]) -> None:
    def refuse(_fd: int, _request: int, _argument: int) -> None:
        raise OSError(number, "by the test")

    bus = InProcessI2c({})
    with pytest.raises(kind, match=r"/dev/i2c-1"):
        I2cLink(I2cOptions(bus=1), open_bus=bus.open, ioctl=refuse).open()
    assert (bus.opened, bus.fd) == (1, None), "the bus was opened, and closed after the failed ioctl"
    bus.open_error = number
    with pytest.raises(kind, match=r"/dev/i2c-1"):
        opened(bus)


def test_names_time_out_and_close(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, requests = InProcessI2c({}), list[tuple[int, int]]()
    link = I2cLink(I2cOptions(), open_bus=bus.open, ioctl=lambda _fd, *request: requests.append(request))
    link.open()
    assert (requests, link.title, link.rate_hz) == ([(I2C_TIMEOUT, 5)], "/dev/i2c-1", 100.0)
    link.close()
    link.close()
    assert bus.fd is None
    with pytest.raises(LinkError, match="not open"):
        link.transfer(READ_ID)
    row_link = LINKS["i2c"].make_polled(I2cOptions(bus=3, address=0x1B))
    assert (row_link.title, row_link.bus, row_link.target, row_link.shared) == ("/dev/i2c-3", "/dev/i2c-3", 0x1B, True)
    assert row_link.place(0x1B) == "address 0x1b"
    with pytest.raises(LinkError):
        row_link.write(b"x")
    assert row_link.kernel_counters() == KernelCounters()
    monkeypatch.setattr(DeviceNode, "wait_present", waits := AsyncMock())
    asyncio.run(link.wait_present())
    waits.assert_awaited_once_with()
