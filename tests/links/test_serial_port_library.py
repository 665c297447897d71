"""Exceptions of any class of pyserial and smbus2: only LinkErrors leave the links, and close always succeeds."""

import asyncio
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import serial
from smbus2 import I2cFunc

from imud.contracts.script import Transfer
from imud.links import serial_port
from imud.links.i2c import I2cLink, I2cOptions
from imud.links.rs485 import Rs485Link, Rs485Options, SharedPorts
from imud.links.serial_port import open_port
from imud.links.uart import UartLink, UartOptions
from imud.model.errors import LinkError
from tests.support.pty_port import PtyPort

ERRORS = (RuntimeError("x"), struct.error("bad"), SystemExit(0), GeneratorExit(), asyncio.CancelledError())


def raiser(error: BaseException) -> Callable[..., Any]:
    return Mock(side_effect=error)


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("place", ["__init__", "fileno", "baudrate"])
def test_pyserial_errors(monkeypatch: pytest.MonkeyPatch, place: str, error: BaseException) -> None:
    pty = PtyPort()
    if place == "baudrate":
        port = open_port(pty.path, 115200, Path("/proc"))
        monkeypatch.setattr(serial_port.DescriptorPort, "baudrate", property(None, raiser(error)))
        with pytest.raises(LinkError, match="cannot set 9600 baud"):
            serial_port.change_baud(port, pty.path, 9600, Path("/proc"))
        port.close()
    else:
        monkeypatch.setattr(serial_port.DescriptorPort, place, raiser(error))
        uart = UartLink(UartOptions(port=pty.path))
        rs485 = Rs485Link(Rs485Options(line=pty.path), ports=SharedPorts())
        for link in (uart, rs485):
            with pytest.raises(LinkError, match=f"cannot open {pty.path}"):
                link.open()
            link.close()
    pty.unplug()


@pytest.mark.parametrize("error", [*ERRORS, ValueError("no TIOCSSERIAL")], ids=lambda error: type(error).__name__)
def test_low_latency_is_optional(error: BaseException, tmp_path: Path) -> None:
    port = Mock(spec=serial.Serial)
    port.set_low_latency_mode.side_effect = error
    serial_port.request_low_latency(port, "/dev/ttyUSB0", tmp_path)
    assert port.set_low_latency_mode.call_count == 1


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("place", ["open", "ioctl", "i2c_rdwr", "read_i2c_block_data", "close"])
def test_smbus2_errors(place: str, error: BaseException) -> None:
    bus = Mock(fd=3, funcs=I2cFunc.I2C if place != "read_i2c_block_data" else 0)
    open_bus = raiser(error) if place == "open" else Mock(return_value=bus)
    ioctl = raiser(error) if place == "ioctl" else Mock()
    getattr(bus, place).side_effect = error
    link = I2cLink(I2cOptions(bus=1), open_bus=open_bus, ioctl=ioctl)
    if place in ("open", "ioctl"):
        with pytest.raises(LinkError, match="cannot use /dev/i2c-1"):
            link.open()
    else:
        link.open()
        link.select(0x19)
    if place in ("i2c_rdwr", "read_i2c_block_data"):
        with pytest.raises(LinkError, match="cannot use /dev/i2c-1"):
            link.transfer(Transfer((b"\x12",), 8))
    link.close()
    link.close()
