"""The links of I2C and SPI through buses inside the process: complete transactions, values, errors and closing."""

import errno

import pytest

from imud.contracts.script import Transfer
from imud.links.i2c import I2cLink, I2cOptions
from imud.links.spi import SpiLink, SpiOptions
from imud.model.errors import LinkError, TransferError
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import FD, InProcessI2c, InProcessSpi


@pytest.mark.parametrize("funcs", [1, 0x0C00_0000], ids=["I2C", "SMBus"])
def test_transactions_on_i2c(funcs: int) -> None:
    bus = InProcessI2c({0x19: Imu61xRegisters(lambda: 0, product="IMU612")}, funcs)
    link = I2cLink(I2cOptions(bus=1), open_bus=bus.open, ioctl=bus.ioctl)
    link.open()
    link.select(0x19)
    assert [link.transfer(Transfer(*one)) for one in (((b"\x6a",), 8), ((b"\x06\x4b",),), ((b"\x06",), 1))] == [
        b"\x00\x00IMU612", b"", b"\x4b",
    ]  # fmt: skip
    link.select(0x20)
    with pytest.raises(TransferError):
        link.transfer(Transfer((b"\x6a",), 8))
    assert bus.calls == [(0x19, (b"\x6a", 8)), (0x19, (b"\x06\x4b",)), (0x19, (b"\x06", 1)), (0x20, (b"\x6a", 8))]
    assert (bus.fd, bus.opened) == (FD, 1)
    link.close()
    bus.open_error = errno.EACCES
    with pytest.raises(LinkError):
        link.open()
    assert (bus.fd, bus.opened) == (None, 1)


@pytest.mark.parametrize("bits", [8, 16])
def test_selections_on_spi(bits: int) -> None:
    bus = InProcessSpi(lambda selections, mode: [bytes(byte ^ mode for byte in one) for one in selections])
    bus.word_bits = bits
    options = SpiOptions(port="/dev/spidev0.1", speed_hz=2_000_000)
    link = SpiLink(options, ioctl=bus.ioctl, open_node=bus.open, close_node=bus.close)
    link.open()
    link.select(3)
    assert link.transfer(Transfer((b"\x80\x00\x12\x34", b"\xfe\x01"))) == b"\x83\x03\x11\x37\xfd\x02"
    bus.device, bus.keep_messages = None, False
    assert link.transfer(Transfer((b"\x80\x00",))) == b"\0\0"
    assert (bus.messages, bus.opened) == ([((b"\x80\x00\x12\x34", b"\xfe\x01"), bits, 2_000_000)], [FD])
    link.close()
    assert bus.opened == []
