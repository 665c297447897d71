"""The simulated SPI buses, seen by spi-tools and by spidev's ioctls."""

import errno
import os
import struct
from collections.abc import Callable

import pytest

from tests.lab.bus import Bus
from tests.lab.spidev import HostTransfer, host_device
from tests.lab.tool import tool
from tests.lab.wire import Refuse, Short, SpiTransfer

MODE_3 = 0x03


def inverted(transfer: SpiTransfer) -> bytes:
    """A device that answers each byte with its complement."""
    return bytes(value ^ 0xFF for segment in transfer.segments for value in segment.mosi)


def constant(value: int) -> Callable[[SpiTransfer], bytes]:
    """A device that answers every byte with `value`."""
    return lambda transfer: bytes([value]) * transfer.whole


def test_spi_pipe_exchanges_bytes(spi8: Bus[SpiTransfer]) -> None:
    spi8.attach(0, inverted)
    assert (
        tool("spi-pipe", "-d", "/dev/spidev0.0", "-b", "4", "-n", "1", data=b"\x01\x02\x80\xff") == "\xfe\xfd\x7f\x00"
    )
    (transfer,) = spi8.transfers
    assert [segment.mosi for segment in transfer.segments] == [b"\x01\x02\x80\xff"]


def test_spi_config_sets_mode_and_speed(spi8: Bus[SpiTransfer]) -> None:
    spi8.attach(1, inverted)
    tool("spi-config", "-d", "/dev/spidev0.1", "-m", "3", "-s", "5000000")
    assert "mode=3" in tool("spi-config", "-d", "/dev/spidev0.1", "-q")
    with host_device(0, 1) as host:
        host.set_mode(MODE_3)
        host.exchange(HostTransfer(b"\0", speed_hz=5_000_000))
    (transfer,) = spi8.transfers
    assert (transfer.mode & 3, transfer.chip_select, transfer.segments[0].speed_hz) == (MODE_3, 1, 5_000_000)


@pytest.mark.usefixtures("spi8")
def test_limited_controller_refuses_16_bit_words() -> None:
    """As on a Raspberry Pi: both as the device's setting and in one transfer."""
    with host_device(0) as host:
        with pytest.raises(OSError, match=rf"\[Errno {errno.EINVAL}\]"):
            host.set_bits_per_word(16)
        with pytest.raises(OSError, match=rf"\[Errno {errno.EINVAL}\]"):
            host.exchange(HostTransfer(b"\x12\x34", bits_per_word=16))


def test_16_bit_words_go_out_high_byte_first(spi16: Bus[SpiTransfer]) -> None:
    """The host has words in its own byte order; the wire has the most significant byte first."""
    spi16.attach(0, lambda transfer: b"\xca\xfe\xba\xbe")
    with host_device(1) as host:
        done, (read,) = host.exchange(HostTransfer(struct.pack("=HH", 0x1234, 0xABCD), bits_per_word=16))
    assert done == 4
    assert struct.unpack("=HH", read) == (0xCAFE, 0xBABE)
    assert spi16.transfers[0].segments[0].mosi == b"\x12\x34\xab\xcd"


def test_8_bit_words_keep_memory_order(spi16: Bus[SpiTransfer]) -> None:
    spi16.attach(0, inverted)
    with host_device(1) as host:
        _, (read,) = host.exchange(HostTransfer(b"\x12\x34\xab\xcd", bits_per_word=8))
    assert spi16.transfers[0].segments[0].mosi == b"\x12\x34\xab\xcd"
    assert read == b"\xed\xcb\x54\x32"


def test_cs_pattern_and_delays_arrive_as_sent(spi8: Bus[SpiTransfer]) -> None:
    spi8.attach(0, inverted)
    sent = [
        HostTransfer(b"\x01\x02", speed_hz=1_000_000, delay_us=20, cs_change=True),
        HostTransfer(b"\x03", speed_hz=2_000_000, word_delay_us=3),
        HostTransfer(b"\x04\x05\x06", speed_hz=4_000_000, delay_us=7, cs_change=True),
        HostTransfer(b"\x07", speed_hz=8_000_000),
    ]
    with host_device(0) as host:
        done, read = host.exchange(*sent)
    (transfer,) = spi8.transfers
    assert done == 7
    assert read == [b"\xfe\xfd", b"\xfc", b"\xfb\xfa\xf9", b"\xf8"]
    assert [
        (one.mosi, one.speed_hz, one.delay_ns, one.word_delay_ns, one.cs_change, one.bits_per_word)
        for one in transfer.segments
    ] == [
        (b"\x01\x02", 1_000_000, 20_000, 0, True, 8),
        (b"\x03", 2_000_000, 0, 3_000, False, 8),
        (b"\x04\x05\x06", 4_000_000, 7_000, 0, True, 8),
        (b"\x07", 8_000_000, 0, 0, False, 8),
    ]
    assert [b"".join(one.mosi for one in group) for group in transfer.selections] == [
        b"\x01\x02",
        b"\x03\x04\x05\x06",
        b"\x07",
    ]
    assert not transfer.stays_selected


def test_last_cs_change_keeps_the_chip_selected(spi8: Bus[SpiTransfer]) -> None:
    with host_device(0) as host:
        host.exchange(HostTransfer(b"\1", cs_change=True))
    (transfer,) = spi8.transfers
    assert transfer.stays_selected
    assert len(transfer.selections) == 1


def test_absent_device_reads_zeros(spi8: Bus[SpiTransfer]) -> None:
    with host_device(0) as host:
        assert host.exchange(HostTransfer(b"\1\2")) == (2, [b"\0\0"])
    assert len(spi8.transfers) == 1


def test_no_simulator_is_an_error() -> None:
    with host_device(0) as host, pytest.raises(OSError, match=rf"\[Errno {errno.ENXIO}\]"):
        host.exchange(HostTransfer(b"\1"))


@pytest.mark.parametrize("number", [errno.EIO, errno.ETIMEDOUT])
def test_refusal_reaches_the_host(spi8: Bus[SpiTransfer], number: int) -> None:
    def refuse(_transfer: SpiTransfer) -> bytes:
        raise Refuse(number)

    spi8.attach(0, refuse)
    with host_device(0) as host, pytest.raises(OSError, match=rf"\[Errno {number}\]"):
        host.exchange(HostTransfer(b"\1"))


def test_short_transfer(spi8: Bus[SpiTransfer]) -> None:
    """write() returns what was transferred; SPI_IOC_MESSAGE returns what was asked for, short or not."""

    def short(transfer: SpiTransfer) -> bytes:
        raise Short(2, b"\x55\x66" if transfer.read_length else b"")

    spi8.attach(0, short)
    with host_device(0) as host:
        assert os.write(host.fd, b"\1\2\3\4") == 2
        done, (read,) = host.exchange(HostTransfer(b"\1\2\3\4"))
    assert (done, read[:2]) == (4, b"\x55\x66")


def test_buses_and_chip_selects_are_separate(spi8: Bus[SpiTransfer], spi16: Bus[SpiTransfer]) -> None:
    for bus, base in ((spi8, 0x10), (spi16, 0x20)):
        for chip_select in (0, 1):
            bus.attach(chip_select, constant(base + chip_select))
    read = []
    for number in (0, 1):
        for chip_select in (0, 1):
            with host_device(number, chip_select) as host:
                read.append(host.exchange(HostTransfer(b"\0"))[1][0])
    assert read == [b"\x10", b"\x11", b"\x20", b"\x21"]
