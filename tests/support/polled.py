"""A polled device and its runner in one process, for tests on simulated and on real buses."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import msgspec

from imud.config import DeviceConfig
from imud.contracts.lines import LineFactory
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceState
from imud.devices import DRIVERS
from imud.event import Event, EventKind
from imud.links import LINKS
from imud.runtime.polled.bus import Buses
from imud.runtime.polled.runner import PolledRunner
from imud.sample import Sample
from imud.signals.gpio import GPIO_LINES
from tests.support.running import LIMIT_S


class Rig:
    """One runner with what came out of it."""

    def __init__(self, buses: Buses, config: DeviceConfig, device_id: int = 0, lines: LineFactory = GPIO_LINES) -> None:
        self.samples: list[Sample] = []
        self.events: list[Event] = []
        self.now_ns = buses.now_ns
        self.runner = PolledRunner(config, device_id, self._publish, self.events.append, buses, lines)

    def _publish(self, batch: Batch) -> None:
        self.samples += batch.samples

    @property
    def kinds(self) -> list[EventKind]:
        """Kinds of the events so far."""
        return [event.kind for event in self.events]

    @property
    def state(self) -> DeviceState:
        """State now."""
        return self.runner.state

    async def until(self, holds: Callable[[], object], what: str, limit_s: float = LIMIT_S) -> None:
        """Tick until a condition holds; the ledger closes all the while."""
        end_ns = self.now_ns() + int(limit_s * 1e9)
        while not holds():
            assert self.now_ns() < end_ns, f"not within {limit_s} s: {what}; {self.runner.status()}"
            await asyncio.sleep(0.002)
            self.runner.tick(self.now_ns())
            assert self.runner.ledger.closes(), self.runner.ledger.snapshot()

    async def until_samples(self, more: int, limit_s: float = LIMIT_S) -> None:
        """Wait for more samples, and until the state says so."""
        wanted = len(self.samples) + more
        await self.until(
            lambda: len(self.samples) >= wanted and self.state is DeviceState.RUNNING, f"{more} more samples", limit_s
        )


def device_config(name: str, driver: str, link: str, settings: dict[str, Any], **options: Any) -> DeviceConfig:
    """A device of the configuration."""
    row = DRIVERS.get(driver)
    made = msgspec.convert(options, row.settings) if row is not None and options else None
    return DeviceConfig(name, driver, made, True, link, msgspec.convert(settings, LINKS[link].settings))


@asynccontextmanager
async def running(
    *configs: DeviceConfig, buses: Buses | None = None, lines: LineFactory = GPIO_LINES
) -> AsyncIterator[list[Rig]]:
    """Runners at work on their buses, with real threads unless others are given; all closed at the end."""
    mistakes: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: mistakes.append(context))
    buses = buses or Buses()
    rigs = [Rig(buses, config, number, lines) for number, config in enumerate(configs)]
    tasks = [asyncio.create_task(rig.runner.run()) for rig in rigs]
    try:
        yield rigs
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
        for rig in rigs:
            rig.runner.close()
        buses.end()
        assert all(isinstance(one, asyncio.CancelledError) for one in ended), ended
        assert not mistakes, mistakes
        assert all(rig.runner.ledger.closes() for rig in rigs)
