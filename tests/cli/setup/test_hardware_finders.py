"""Finders with a device on a pseudo-terminal, devices on an RS-485 bus, and a device on an I2C bus."""

import os
import threading
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest

from imud.cli.setup import hardware as finders
from imud.cli.setup.hardware import FINDERS
from imud.contracts.driver import StreamDriver
from imud.drivers import DRIVERS
from imud.links.i2c import I2cLink, I2cOptions
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import InProcessI2c
from tests.support.pty_port import BAUD, PtyPort, slave, wired


def test_a_port_is_listened_to() -> None:
    driver = DRIVERS["hipnuc-uart"]
    assert isinstance(driver, StreamDriver)
    port = PtyPort()
    frame = driver.example_frame(Random(1))
    stop = threading.Event()

    def feed() -> None:
        while not stop.wait(0.01):
            os.write(port.master, frame)

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        (report,) = FINDERS.listen([port.path], set())
    finally:
        stop.set()
        feeder.join()
    os.close(port.master)
    os.close(port.slave)
    assert (report.port, report.driver, report.problem) == (port.path, "hipnuc-uart", "")


def test_a_line_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finders, "SLAVES", range(2, 4))
    monkeypatch.setattr(finders, "FACTORY_ID", 2)
    monkeypatch.setattr(finders, "REPLY_MS", 400)
    with wired(tmp_path, slave(2)) as (path, _):
        (found,) = FINDERS.scan_rs485(str(path), BAUD)
    assert found.keys == {"driver": "hipnuc-modbus", "rs485": {"line": str(path), "baud": BAUD, "address": 2}}
    assert found.title == "HI14R2N-485-000"
    (absent,) = FINDERS.scan_rs485(str(tmp_path / "none"), 0)
    assert "does not exist" in absent.problem


def on_bus(monkeypatch: pytest.MonkeyPatch, bus: InProcessI2c) -> None:
    row = SimpleNamespace(
        settings=I2cOptions, make_polled=lambda settings: I2cLink(settings, open_bus=bus.open, ioctl=bus.ioctl)
    )
    monkeypatch.setattr(finders, "LINKS", {"i2c": row})


def test_a_bus_is_asked_at_every_address(monkeypatch: pytest.MonkeyPatch) -> None:
    on_bus(monkeypatch, InProcessI2c({0x19: Imu61xRegisters(lambda: 0, product="IMU612")}))
    (found,) = FINDERS.ask_bus("i2c", "1")
    assert found.keys == {"driver": "imu61x-i2c", "i2c": {"bus": 1, "address": 0x19}}
    assert (found.node, found.title, found.device) == ("/dev/i2c-1", "IMU612", "address 0x19")


def test_a_bus_without_a_sensor_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    on_bus(monkeypatch, InProcessI2c({}))
    (found,) = FINDERS.ask_bus("i2c", "1")
    assert (found.driver, "no acknowledgement at address 0x18" in found.problem) == ("", True)


def test_a_bus_that_is_not_there_and_a_number_that_no_bus_has() -> None:
    for kind, bus in [("i2c", "250"), ("i2c", "900"), ("spi", "/dev/spidev250.0")]:
        (found,) = FINDERS.ask_bus(kind, bus)
        assert found.problem
    (found,) = FINDERS.ask_bus("i2c", "256")
    assert found.problem == "bus: expected a whole number from 0 to 255, got 256"
