"""Fixtures of the lab. pytest collects these tests only in the guest of the lab: `make lab` runs it."""

import asyncio
import inspect
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.lab.bus import Bus, i2c_bus, spi_bus
from tests.lab.can_interface import CanInterface, controller_pair, virtual_can
from tests.lab.gpio_chip import GpioChip, simulated_chip
from tests.lab.serial_port import PseudoTerminal, pseudo_terminal, uart_pair
from tests.lab.wire import I2cTransfer, SpiTransfer
from tests.support.leaks import open_descriptors

SHARE = os.environ.get("IMUD_LAB")

GPIO_LINES = ("SOUT", "SIN", "PPS", "ALARM", "", "RESET")

collect_ignore_glob = [] if SHARE else ["*"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not SHARE:
        terminalreporter.write_line("tests/lab skipped: it needs the lab's kernel; try make lab")


def pytest_runtest_logstart() -> None:
    if SHARE:
        mark = Path(SHARE) / "first-test"
        if not mark.exists():
            mark.touch()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run an `async` test in a new event loop."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names}))
    return True


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Check that each test closes its descriptors and ends its threads."""
    before = open_descriptors()
    yield
    assert open_descriptors() == before, "open descriptors"
    assert threading.enumerate() == [threading.main_thread()], "running threads"


@pytest.fixture
def vcan() -> Iterator[CanInterface]:
    with virtual_can("vcan0") as interface:
        yield interface


@pytest.fixture
def can_pair() -> Iterator[tuple[CanInterface, CanInterface]]:
    with controller_pair() as pair:
        yield pair


@pytest.fixture
def gpio_chip() -> Iterator[GpioChip]:
    """Create a chip with the lines SOUT, SIN, PPS, ALARM, a line without a name, and RESET."""
    with simulated_chip(GPIO_LINES) as chip:
        yield chip


@pytest.fixture
def i2c() -> Iterator[Bus[I2cTransfer]]:
    with i2c_bus(0) as bus:
        yield bus


@pytest.fixture
def spi8() -> Iterator[Bus[SpiTransfer]]:
    """Create the far end of /dev/spidev0.*, a controller with only 8-bit words. Attach devices by chip select."""
    with spi_bus(0) as bus:
        yield bus


@pytest.fixture
def spi16() -> Iterator[Bus[SpiTransfer]]:
    with spi_bus(1) as bus:
        yield bus


@pytest.fixture
def pty() -> Iterator[PseudoTerminal]:
    with pseudo_terminal() as terminal:
        yield terminal


@pytest.fixture
def uarts() -> tuple[Path, Path]:
    return uart_pair()
