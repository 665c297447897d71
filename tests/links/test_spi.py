"""The SPI link on a simulated spidev: arguments of the ioctl, both word sizes, failures."""

import asyncio
import errno
import gc
from pathlib import Path

import pytest
from smbus2 import I2cFunc, i2c_msg

from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters
from imud.links import LINKS
from imud.links.spi import WR_MAX_SPEED_HZ, SpiLink, SpiOptions
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing, TransferError, Trouble
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import InProcessI2c, InProcessSpi


def test_a_simulated_i2c_bus_has_the_calls_of_smbus2() -> None:
    bus = InProcessI2c({0x19: Imu61xRegisters(lambda: 0, product="IMU612")})
    assert (bus.open(""), bus.fd, bus.funcs, bus.ioctl(0, 0, 0), bus.opened) == (bus, 1_000_000, I2cFunc.I2C, 0, 1)
    bus.i2c_rdwr(i2c_msg.write(0x19, b"\x6a"), read := i2c_msg.read(0x19, 8))
    bus.write_i2c_block_data(0x19, 6, [0x4B])
    assert (bytes(read), bus.read_i2c_block_data(0x19, 6, 1)) == (b"\0\0IMU612", [0x4B])
    assert bus.calls == [(0x19, (b"\x6a", 8)), (0x19, (b"\x06\x4b",)), (0x19, (b"\x06", 1))]
    with pytest.raises(OSError, match="no device acknowledges"):
        bus.write_i2c_block_data(0x1A, 6, [0])
    bus.open_error = errno.EACCES
    with pytest.raises(OSError, match="by the test"):
        bus.open("")


def echo(selections: object, _mode: int) -> list[bytes]:
    assert isinstance(selections, list)
    return [bytes(byte ^ 0xFF for byte in selection) for selection in selections]


def link_to(bus: InProcessSpi, **settings: object) -> SpiLink:
    made = SpiOptions(port="/dev/spidev0.1", **settings)  # type: ignore[arg-type]  # passed on as given
    return SpiLink(made, ioctl=bus.ioctl, open_node=bus.open, close_node=bus.close)


@pytest.mark.parametrize("word_bits", [8, 16])
@pytest.mark.manual("A 2.1 role", "A 2.1 words")
def test_same_bits_on_the_wires_whatever_the_words(word_bits: int) -> None:
    bus = InProcessSpi(echo, word_bits=word_bits)
    link = link_to(bus, speed_hz=2_000_000)
    link.open()
    link.select(3)
    assert bus.mode == 3
    for _ in range(2):  # the second transfer uses the stored buffers
        assert link.transfer(Transfer((b"\x80\x00\x12\x34", b"\xfe\x01"))) == b"\x7f\xff\xed\xcb\x01\xfe"
    bus.device, bus.keep_messages = None, False
    assert link.transfer(Transfer((b"\x80\x00",))) == b"\0\0", "a bus without a device reads zeros"
    assert bus.messages == [((b"\x80\x00\x12\x34", b"\xfe\x01"), word_bits, 2_000_000)] * 2
    link.close()
    link.close()
    assert not bus.opened


def test_buffers_outlive_the_garbage_collector() -> None:
    bus = InProcessSpi(echo)
    link = link_to(bus)
    link.open()
    link.select(0)
    transfers = [Transfer((bytes([n, n]),)) for n in range(100)]  # more than PREPARED_MAX
    for _ in range(2):
        for n, transfer in enumerate(transfers):
            assert link.transfer(transfer) == bytes([n ^ 0xFF] * 2)
        gc.collect()


def test_controller_that_refuses_16_bits_in_a_message_only() -> None:
    bus = InProcessSpi(echo, word_bits=16)
    link = link_to(bus)
    link.open()
    link.select(0)
    bus.word_bits = 8
    assert link.transfer(Transfer((b"\x12\x34",))) == b"\xed\xcb"
    assert bus.messages[-1][1] == 8


@pytest.mark.manual("A 2.1 clock")
def test_speed_is_set_at_open() -> None:
    calls: list[tuple[int, bytes]] = []
    settings = SpiOptions(port="/dev/spidev0.1", speed_hz=250_000)
    ioctl = lambda _fd, *request: calls.append(request)  # noqa: E731
    SpiLink(settings, ioctl=ioctl, open_node=lambda *_: 3, close_node=lambda _: None).open()
    assert calls[0] == (WR_MAX_SPEED_HZ, (250_000).to_bytes(4, "little"))


def test_open_that_fails_says_why() -> None:
    for number, kind in (
        (errno.ENOENT, LinkMissing), (errno.ENXIO, LinkMissing), (errno.EACCES, LinkDenied), (errno.EBUSY, LinkBusy),
        (errno.EMFILE, LinkError),
    ):  # fmt: skip
        bus = InProcessSpi(echo)
        bus.open_error = number
        with pytest.raises(LinkError, match=r"/dev/spidev0\.1") as error:
            link_to(bus).open()
        assert type(error.value) is kind


@pytest.mark.parametrize("step", range(2))
def test_a_step_after_open_that_fails_closes_the_node(step: int) -> None:
    bus, refused = InProcessSpi(echo), iter([*[0] * step, errno.EIO])

    def ioctl(fd: int, request: int, argument: bytes) -> int:
        if number := next(refused):
            raise OSError(number, "by the test")
        return bus.ioctl(fd, request, argument)

    link = SpiLink(SpiOptions(port="/dev/spidev0.1"), ioctl=ioctl, open_node=bus.open, close_node=bus.close)
    with pytest.raises(LinkError, match="cannot use"):
        link.open()
    assert not bus.opened


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ETIMEDOUT, Trouble.STUCK), (errno.EIO, Trouble.DISTURBED), (errno.ESHUTDOWN, LinkMissing),
        (errno.ENODEV, LinkMissing),
    ],
)  # fmt: skip
def test_transfer_that_fails_says_whether_the_bus_is_gone(number: int, expected: object) -> None:
    def fail(_selections: object, _mode: int) -> list[bytes]:
        raise OSError(number, "by the test")

    link = link_to(InProcessSpi(fail, word_bits=16))
    link.open()
    link.select(0)
    with pytest.raises((TransferError, LinkError)) as error:
        link.transfer(Transfer((b"\x00\x00",)))
    assert (error.value.trouble if isinstance(error.value, TransferError) else type(error.value)) is expected


def test_row_and_names(tmp_path: Path) -> None:
    row, node = LINKS["spi"], tmp_path / "spidev3.1"
    link = row.make_polled(SpiOptions(port=str(node), mode=3))
    assert (link.bus, link.target, link.shared) == (str(tmp_path / "spidev3"), 3, False)
    assert (link.place(3), link.kernel_counters()) == ("mode 3", KernelCounters())
    assert row.make_polled(SpiOptions(port="/dev/spidev0.0")).target is None
    with pytest.raises(LinkError):
        link.write(b"x")
    node.touch()
    asyncio.run(link.wait_present())
    link = link_to(InProcessSpi(echo))
    link.open()
    with pytest.raises(LinkError, match="1 to 32 items"):
        link.transfer(Transfer((b"\x00\x00",) * 33))
