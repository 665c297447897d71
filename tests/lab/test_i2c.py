"""The simulated I2C bus, seen by i2c-tools and smbus2 through the kernel's i2c-dev."""

import errno
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from smbus2 import SMBus, i2c_msg

from tests.lab.bus import Bus
from tests.lab.register_device import RegisterDevice
from tests.lab.tool import ToolError, tool
from tests.lab.wire import I2cTransfer, NoAnswer, Refuse, Short

ADDRESS = 0x4A
TIMEOUT = Path("/sys/module/imud_lab/parameters/timeout_ms")


@pytest.fixture
def sensor(i2c: Bus[I2cTransfer]) -> RegisterDevice:
    """Registers 0x10.. hold 0x11, 0x22, 0x33, 0x44."""
    device = RegisterDevice({0x10: 0x11, 0x11: 0x22, 0x12: 0x33, 0x13: 0x44})
    i2c.attach(ADDRESS, device)
    return device


@pytest.fixture
def short_timeout() -> Iterator[None]:
    """The module waits 100 ms for the simulator."""
    before = TIMEOUT.read_text(encoding="ascii")
    TIMEOUT.write_text("100", encoding="ascii")
    yield
    TIMEOUT.write_text(before, encoding="ascii")


def read_registers(register: int, count: int) -> bytes:
    """Pointer write, repeated start, read."""
    with closing(SMBus(0)) as host:
        pointer, data = i2c_msg.write(ADDRESS, [register]), i2c_msg.read(ADDRESS, count)
        host.i2c_rdwr(pointer, data)
        return bytes(data)


@pytest.mark.usefixtures("sensor")
def test_i2ctransfer_reads_with_a_repeated_start(i2c: Bus[I2cTransfer]) -> None:
    assert tool("i2ctransfer", "-y", "0", f"w1@{ADDRESS}", "0x10", "r4").split() == ["0x11", "0x22", "0x33", "0x44"]
    (transfer,) = i2c.transfers
    assert [(one.address, one.reads, one.length, one.data) for one in transfer.segments] == [
        (ADDRESS, False, 1, b"\x10"),
        (ADDRESS, True, 4, b""),
    ]


@pytest.mark.usefixtures("sensor")
def test_i2cget_reads_bytes_and_words() -> None:
    assert tool("i2cget", "-y", "0", hex(ADDRESS), "0x12").strip() == "0x33"
    assert tool("i2cget", "-y", "0", hex(ADDRESS), "0x10", "w").strip() == "0x2211"  # SMBus: low byte first


def test_i2cset_writes(sensor: RegisterDevice) -> None:
    tool("i2cset", "-y", "0", hex(ADDRESS), "0x20", "0xA5")
    assert sensor.registers[0x20] == 0xA5


@pytest.mark.usefixtures("sensor")
def test_i2cdetect_finds_the_device_only() -> None:
    rows = tool("i2cdetect", "-y", "-r", "0").splitlines()[1:]
    found = [cell for row in rows for cell in row.split(":")[1].split() if cell != "--"]
    assert found == ["4a"]


def test_absent_address_is_a_nak(i2c: Bus[I2cTransfer]) -> None:
    with pytest.raises(ToolError, match="Error: Sending messages failed: No such device or address"):
        tool("i2ctransfer", "-y", "0", "w1@0x21", "0", "r1")
    assert len(i2c.transfers) == 1


def test_no_simulator_is_a_nak() -> None:
    with pytest.raises(OSError, match=r"\[Errno 6\]"):
        read_registers(0x10, 1)


@pytest.mark.parametrize("number", [errno.ENXIO, errno.EREMOTEIO, errno.ETIMEDOUT, errno.EAGAIN])
def test_refusal_reaches_the_host(i2c: Bus[I2cTransfer], number: int) -> None:
    def refuse(_transfer: I2cTransfer) -> bytes:
        raise Refuse(number)

    i2c.attach(ADDRESS, refuse)
    with pytest.raises(OSError, match=rf"\[Errno {number}\]"):
        read_registers(0x10, 2)


def test_short_transfer(i2c: Bus[I2cTransfer]) -> None:
    """i2c-dev returns the number of messages done; i2cget's SMBus emulation makes an error of it."""

    def short(_transfer: I2cTransfer) -> bytes:
        raise Short(1)

    i2c.attach(ADDRESS, short)
    assert read_registers(0x10, 2) == b"\0\0"
    with pytest.raises(ToolError):
        tool("i2cget", "-y", "0", hex(ADDRESS), "0x12")


@pytest.mark.usefixtures("short_timeout")
def test_silent_device_times_out_and_the_bus_lives_on(i2c: Bus[I2cTransfer]) -> None:
    def silent(_transfer: I2cTransfer) -> bytes:
        raise NoAnswer

    i2c.attach(ADDRESS, silent)
    with pytest.raises(OSError, match=rf"\[Errno {errno.ETIMEDOUT}\]"):
        read_registers(0x10, 1)
    i2c.attach(ADDRESS, RegisterDevice({0x10: 7}))
    assert read_registers(0x10, 1) == b"\7"


@pytest.mark.usefixtures("short_timeout")
def test_late_answer_is_refused(i2c: Bus[I2cTransfer]) -> None:
    host_gave_up = threading.Event()

    def late(_transfer: I2cTransfer) -> bytes:
        assert host_gave_up.wait(10)
        return b"\0"

    i2c.attach(ADDRESS, late)
    with pytest.raises(OSError, match=rf"\[Errno {errno.ETIMEDOUT}\]"):
        read_registers(0x10, 1)
    host_gave_up.set()
    i2c.attach(ADDRESS, RegisterDevice())
    assert read_registers(0x10, 1) == b"\0"
    assert i2c.late == 1


def test_simulator_that_leaves_ends_the_transfer(i2c: Bus[I2cTransfer]) -> None:
    """A bus closed during a transfer: ENXIO at once, not after the time-out."""
    asked, close_now = threading.Event(), threading.Event()

    def hold(_transfer: I2cTransfer) -> bytes:
        asked.set()
        assert close_now.wait(10)
        raise NoAnswer

    i2c.attach(ADDRESS, hold)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(read_registers, 0x10, 1)
        assert asked.wait(10)
        close_now.set()
        i2c.close()
        with pytest.raises(OSError, match=r"\[Errno 6\]"):
            read.result(10)


def test_mistake_in_a_device_fails_the_test(i2c: Bus[I2cTransfer]) -> None:
    def wrong(_transfer: I2cTransfer) -> bytes:
        raise KeyError("mistake")

    i2c.attach(ADDRESS, wrong)
    with pytest.raises(OSError, match=rf"\[Errno {errno.EIO}\]"):
        read_registers(0x10, 1)
    with pytest.raises(KeyError, match="mistake"):
        i2c.close()


@pytest.mark.usefixtures("i2c")
def test_second_simulator_is_refused() -> None:
    with pytest.raises(OSError, match=rf"\[Errno {errno.EBUSY}\]"):
        os.open("/dev/imud-lab-i2c0", os.O_RDWR)


@pytest.mark.usefixtures("sensor")
def test_hosts_at_once_get_their_own_answers() -> None:
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(read_registers, [0x10, 0x11, 0x12, 0x13] * 8, [1] * 32))
    assert answers == [b"\x11", b"\x22", b"\x33", b"\x44"] * 8


def test_largest_i2c_messages(i2c: Bus[I2cTransfer]) -> None:
    """i2c-dev allows 8192 bytes a message; the GIL is free during this ioctl, whose own argument is small."""
    i2c.attach(ADDRESS, lambda transfer: bytes(value % 251 for value in range(transfer.read_length)))
    assert read_registers(0, 8192) == bytes(value % 251 for value in range(8192))
