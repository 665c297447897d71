"""Polled devices on buses inside the process, in virtual time. The deadlines alone decide the order of the reads."""

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.link import LinkType
from imud.host.clock import HostClock
from imud.links.i2c import I2cLink, I2cOptions
from imud.links.spi import SpiLink, SpiOptions
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import InProcessI2c, InProcessSpi
from imud.sim.ports.pins import MemoryLines
from tests.support.device_rig import DeviceRig, DeviceRigs, device_config, running
from tests.support.event_loops import LoopWorker, VirtualClock, run_virtually

RATE_HZ = 250.0
TRANSFER_NS = 160_000  # duration of each transfer, ns: 32 bytes at 1.6 Mbit/s


class PolledBusBench:
    """An SPI bus and an I2C bus for the links of the configuration, and the time."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, clock: VirtualClock | None = None) -> None:
        self.clock = clock or VirtualClock()
        self.is_virtual = clock is not None
        self.node = folder / "spidev0.0"
        self.node.touch()
        self.spi = InProcessSpi()  # SPI bus. `spi.device = …` connects a device.
        self.i2c = InProcessI2c({})
        self.lines = MemoryLines(self.clock.now_ns)
        self.before_next_time: Callable[[], None] | None = None
        """Function that runs directly before a device or its bus reads the time again."""
        monkeypatch.setattr("imud.links.spi.LINK", LinkType("spi", SpiOptions, make_polled=self._make_spi))
        monkeypatch.setattr("imud.links.i2c.LINK", LinkType("i2c", I2cOptions, make_polled=self._make_i2c))

    def registers(self, **more: Any) -> Imu61xRegisters:
        return Imu61xRegisters(self.clock.now_ns, **more)

    def running(self, *configs: DeviceConfig) -> AbstractAsyncContextManager[list[DeviceRig]]:
        host = HostClock(self._time, self.clock.realtime_ns, self._time)
        self.rigs = DeviceRigs(host, lines=self.lines.maker, start_worker=LoopWorker)
        return running(*configs, rigs=self.rigs)

    def run(self, body: Coroutine[Any, Any, None]) -> None:
        run_virtually(self.clock, body)

    def on_spi(self, rate_hz: float = RATE_HZ, **options: Any) -> DeviceConfig:
        return device_config("imu", "imu61x-spi", "spi", {"port": str(self.node), "rate_hz": rate_hz}, **options)

    def _time(self) -> int:
        before, self.before_next_time = self.before_next_time, None
        if before is not None:
            before()
        return self.clock.now_ns()

    def _make_spi(self, settings: SpiOptions) -> SpiLink:
        bus = self.spi
        return SpiLink(settings, ioctl=self._taking_time(bus.ioctl), open_node=bus.open, close_node=bus.close)

    def _make_i2c(self, settings: I2cOptions) -> I2cLink:
        self.i2c.i2c_rdwr = self._taking_time(InProcessI2c.i2c_rdwr.__get__(self.i2c))  # type: ignore[method-assign]  # the wire takes time
        return _ReadyI2c(settings, open_bus=self.i2c.open, ioctl=self.i2c.ioctl)

    def _taking_time(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            result = call(*args)
            if self.is_virtual:
                self.clock.advance(TRANSFER_NS)
            return result

        return timed


class _ReadyI2c(I2cLink):
    def absence(self) -> str:
        return ""

    async def wait_present(self) -> None:
        await asyncio.sleep(0)


def on_i2c(name: str = "imu", driver: str = "imu61x-i2c", **more: Any) -> DeviceConfig:
    return device_config(name, driver, "i2c", {"bus": 1, "rate_hz": RATE_HZ, **more})
