"""A device of the daemon on a CAN interface of the kernel, with simulated modules on the same bus."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, closing, nullcontext
from time import monotonic, monotonic_ns
from typing import Any

from imud.config.model import DeviceConfig
from imud.contracts.status import DeviceState
from imud.device.device import Device
from imud.device.factory import DeviceFactory
from imud.host.clock import HostClock
from imud.links.socketcan import SocketCanOptions
from imud.model.options import Options
from imud.sim.can_module import CanModule, CanModules
from imud.sim.ports.can_port import CanPort
from tests.support.device_rig import DeviceOutput

LIMIT_S = 60.0


class BusRig:
    """A device of the daemon on an interface, with the simulated modules of the bus; the first module is the device."""

    def __init__(self, interface: str, driver: str, options: Options | None, *modules: CanModule, **link: Any) -> None:
        self.port = CanPort(CanModules(modules), interface) if modules else None
        self.output = DeviceOutput()
        self.samples, self.events = self.output.samples, self.output.events
        settings = SocketCanOptions(interface=interface, **link)
        config = DeviceConfig("bow", driver, options, True, "socketcan", settings)
        self.factory = DeviceFactory(self.output, HostClock())
        self.device: Device = self.factory.make(config, 1)

    async def until(self, condition: Callable[[], object], what: str) -> None:
        end = monotonic() + LIMIT_S
        while not condition():
            assert monotonic() < end, f"not within {LIMIT_S} s: {what}; {self.device.status()}"
            self.device.tick(monotonic_ns())
            if self.port is not None:
                self.port.step(monotonic_ns(), True)
            await asyncio.sleep(0.002)

    async def done(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Wait for work of the device while the simulated devices run. Return its result."""
        task = asyncio.create_task(work)
        await self.until(task.done, "its end")
        return task.result()

    @asynccontextmanager
    async def played(self, *, waits: bool = True) -> AsyncIterator[None]:
        """Run the device during the block, from its first samples or, without modules, from an open bus."""

        def is_ready() -> bool:
            state = self.device.state
            return state is not DeviceState.MISSING if self.port is None else state is DeviceState.RUNNING

        with closing(self.port) if self.port is not None else nullcontext():
            task = asyncio.create_task(self.device.run())
            try:
                if waits:
                    await self.until(is_ready, "samples or an open bus")
                yield
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
                self.device.close()
                self.factory.close()
        assert self.device.ledger.closes(), self.device.ledger.snapshot()
