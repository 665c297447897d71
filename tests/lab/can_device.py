"""A device of the daemon on a CAN interface of the kernel, with simulated modules on the same bus."""

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import closing
from time import monotonic, monotonic_ns
from typing import Any

from imud.config import DeviceConfig
from imud.contracts.settings import Settings
from imud.contracts.status import DeviceState
from imud.event import Event
from imud.host_clock import HostClock
from imud.links.can.link import SocketCanSettings
from imud.runtime.device import Device
from imud.runtime.device_factory import DeviceFactory
from imud.sample import Sample
from imud.sim.can_module import CanModule, CanModules
from imud.sim.ports.can_port import CanPort

LIMIT_S = 60.0


class BusRig:
    """Modules on an interface, and a device of the daemon that is the first of them."""

    def __init__(self, interface: str, driver: str, options: Settings, *modules: CanModule) -> None:
        self.port = CanPort(CanModules(modules), interface)
        self.samples: list[Sample] = []
        self.events: list[Event] = []
        config = DeviceConfig("bow", driver, options, True, "socketcan", SocketCanSettings(interface=interface))
        self.factory = DeviceFactory(lambda batch: self.samples.extend(batch.samples), self.events.append, HostClock())
        self.device: Device = self.factory.make(config, 1)

    async def until(self, condition: Callable[[], object], what: str) -> None:
        end = monotonic() + LIMIT_S
        while not condition():
            assert monotonic() < end, f"not within {LIMIT_S} s: {what}; {self.device.status()}"
            self.device.tick(monotonic_ns())
            self.port.step(monotonic_ns(), True)
            await asyncio.sleep(0.002)

    async def done(self, work: Coroutine[Any, Any, Any]) -> Any:
        task = asyncio.create_task(work)
        await self.until(task.done, "its end")
        return task.result()

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def both() -> None:
            task = asyncio.create_task(self.device.run())
            try:
                await self.until(lambda: self.device.state is DeviceState.RUNNING, "samples")
                await story()
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
                self.device.close()
                self.factory.close()

        with closing(self.port):
            asyncio.run(both())
        assert self.device.ledger.closes(), self.device.ledger.snapshot()
