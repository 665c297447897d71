"""Devices with all their outputs, on links in memory or real links, in real or simulated time.

`DeviceRigs` contains the common parts of the devices of one daemon. `running` runs the devices until the end of a
block.
"""

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.lines import LineFactory
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceState, PollingStatus
from imud.device.device import Device
from imud.device.factory import DeviceFactory
from imud.drivers import DRIVERS
from imud.formats.records import Kind, PathRecord, decode_object, records_of
from imud.host import event_loop
from imud.host.clock import HostClock
from imud.host.threads import BusThread, StartWatchingWorker
from imud.lines.gpio import GPIO_LINES
from imud.links import LINKS
from imud.links.memory import MemoryCanLink, MemoryLink
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Sample
from imud.recording.observer import ClockObserver
from imud.recording.player import PlayedDevice, Player
from tests.support.event_loops import VirtualClock, run_virtually

LIMIT_S = 60.0  # Deadline of a wait, s. A loaded host delays a real device; virtual time does not wait.
STEP_S = 0.002
TURN_S = 0.0005  # Pause between two polls of a condition, s. Timers run during the pause, also in simulated time.


class DeviceRig:
    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.samples: list[Sample] = []
        self.batches = 0
        self.published: list[tuple[int, list[Sample]]] = []  # each batch with the time of its publication
        self.events: list[Event] = []
        self.recorded: list[bytes] = []  # records of the device, if `DeviceRigs.recording` is True
        self.now_ns = now_ns
        self.device: Device

    @property
    def ledger(self) -> Ledger:
        return self.device.ledger

    @property
    def kinds(self) -> list[EventKind]:
        return [event.kind for event in self.events]

    @property
    def state(self) -> DeviceState:
        return self.device.state

    def is_in(self, state: DeviceState) -> bool:
        """Return whether the device is in this state. A call, so that the type checker does not assume a constant."""
        return self.device.state is state

    @property
    def problem(self) -> str:
        return self.device.status().problem

    @property
    def polling(self) -> PollingStatus:
        polling = self.device.status().polling
        assert polling is not None
        return polling

    @property
    def link(self) -> MemoryLink:
        assert isinstance(self.device.link, MemoryLink)
        return self.device.link

    @property
    def can_link(self) -> MemoryCanLink:
        assert isinstance(self.device.link, MemoryCanLink)
        return self.device.link

    def tick(self, ahead_ns: int = 0) -> None:
        """Call `tick` of the device with the present time plus `ahead_ns`."""
        self.device.tick(self.now_ns() + ahead_ns)

    async def until(
        self, holds: Callable[[], object], what: str = "the condition", limit_s: float = LIMIT_S, *,
        step: Callable[[], object] = lambda: None, step_s: float = STEP_S,
    ) -> None:  # fmt: skip
        """Call `tick` and `step` until a condition is true. Check that the ledger balances each time."""
        end_ns = self.now_ns() + int(limit_s * 1e9)
        while not holds():
            assert self.now_ns() < end_ns, f"not within {limit_s} s: {what}; {self.device.status()}"
            await asyncio.sleep(step_s)
            step()
            self.tick()
            assert self.ledger.closes(), self.ledger.snapshot()

    async def turn(self, holds: Callable[[], object]) -> None:
        """Run the event loop without ticks until a condition is true."""
        end = asyncio.get_running_loop().time() + LIMIT_S
        while not holds():
            assert asyncio.get_running_loop().time() < end, f"does not come true: {self.device.status()}"
            await asyncio.sleep(TURN_S)

    async def until_samples(self, more: int, limit_s: float = LIMIT_S) -> None:
        """Wait for `more` samples and for the state running."""
        wanted = len(self.samples) + more
        await self.until(
            lambda: len(self.samples) >= wanted and self.state is DeviceState.RUNNING, f"{more} more samples", limit_s
        )


class DeviceOutput:
    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.events: list[Event] = []

    def publish(self, batch: Batch) -> None:
        self.samples += batch.samples

    def send_event(self, event: Event) -> None:
        self.events.append(event)

    def configured_devices(self) -> Sequence[DeviceConfig]:
        return ()

    def tick_soon(self) -> None: ...


class DeviceRigs:
    """Creates devices with common time, buses and lines, and keeps their outputs separate."""

    recording = bool(os.environ.get("IMUD_RECORD_RIGS"))
    """True: the rig records each device from start to end, and compares the replay with the live run.

    `IMUD_RECORD_RIGS=1 pytest tests/device tests/lines` does it in every test with rigs, except for fake drivers, which
    a replay does not know.
    """

    def __init__(
        self, host: HostClock | None = None, *, state_dir: Path | None = None, lines: LineFactory = GPIO_LINES,
        start_worker: StartWatchingWorker = BusThread, configured: Sequence[DeviceConfig] = (),
    ) -> None:  # fmt: skip
        """Without arguments, use the real time, lines and workers. `configured` contains all devices of the file."""
        self.host = host or HostClock()
        self._host_tap = ClockObserver(self.host)
        self._configured = configured
        self.rigs: dict[str, DeviceRig] = {}
        self.factory = DeviceFactory(self, self.host, state_dir=state_dir, lines=lines, start_worker=start_worker)

    def add(self, config: DeviceConfig, link: MemoryLink | MemoryCanLink | None = None) -> DeviceRig:
        rig = self.rigs[config.name] = DeviceRig(self.host.now_ns)
        number = len(self.rigs) - 1
        if link is None:
            rig.device = self.factory.make(config, number)
        else:
            factory = self.factory
            transport = factory.on_stream(link) if isinstance(link, MemoryLink) else factory.on_can(link)
            rig.device = factory.make_on(config, number, transport)
        if self.recording:
            self.record(rig)
        return rig

    def record(self, rig: DeviceRig) -> None:
        self._host_tap.begin(rig.recorded.append)
        rig.device.record(rig.recorded.append)

    @asynccontextmanager
    async def at_work(self) -> AsyncIterator[list[DeviceRig]]:
        """Run all devices. Close them at the end and check that their ledgers balance."""
        mistakes: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda _loop, context: mistakes.append(context))
        rigs = list(self.rigs.values())
        tasks = [asyncio.create_task(rig.device.run()) for rig in rigs]
        try:
            yield rigs
        finally:
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
            for rig in rigs:
                rig.device.close()
            self.factory.close()
        assert all(one is None or isinstance(one, asyncio.CancelledError) for one in ended), ended
        assert not mistakes, mistakes
        assert all(rig.ledger.closes() for rig in rigs), [rig.ledger.snapshot() for rig in rigs]
        if self.recording:
            for rig in filter(is_replayed, rigs):
                check_replay(rig)

    def configured_devices(self) -> Sequence[DeviceConfig]:
        return self._configured

    def tick_soon(self) -> None: ...

    def publish(self, batch: Batch) -> None:
        rig = self.rigs[batch.device]
        assert batch.device_id == rig.device.device_id
        rig.batches += 1
        rig.published.append((self.host.now_ns(), list(batch.samples)))
        rig.samples += batch.samples

    def send_event(self, event: Event) -> None:
        assert isinstance(event.kind, EventKind)
        assert isinstance(event.t_ns, int)
        self.rigs[event.device].events.append(event)


def is_replayed(rig: DeviceRig) -> bool:
    """Return whether a replay supports all drivers of the device."""
    found = (record for one in rig.recorded for record in records_of(one) if record.kind == Kind.PATH)
    return {decode_object(record, PathRecord).driver for record in found} <= set(DRIVERS)


def check_replay(rig: DeviceRig) -> PlayedDevice:
    """Replay the records of a device, and compare samples and ledger with the live run."""
    rig.device.observer.check(rig.recorded.append)
    samples: list[Sample] = []
    player = Player(lambda batch: samples.extend(batch.samples))
    player.play(record for one in rig.recorded for record in records_of(one))
    (played,) = player.devices.values()
    assert not played.fresh_starts
    assert samples == rig.samples
    assert played.ledger.snapshot() == rig.ledger.snapshot()
    assert not played.differences
    return played


def device_config(name: str, driver: str, link: str, settings: dict[str, Any], **options: Any) -> DeviceConfig:
    row = DRIVERS.get(driver)
    made = msgspec.convert(options, row.settings) if row is not None and options else None
    return DeviceConfig(name, driver, made, True, link, msgspec.convert(settings, LINKS[link].settings))


@asynccontextmanager
async def running(
    *configs: DeviceConfig, lines: LineFactory = GPIO_LINES, rigs: DeviceRigs | None = None
) -> AsyncIterator[list[DeviceRig]]:
    """Run the configured devices, in real time if `rigs` is None. Close all devices at the end."""
    rigs = rigs or DeviceRigs(lines=lines)
    for config in configs:
        rigs.add(config)
    async with rigs.at_work() as made:
        yield made


def play(
    rigs: DeviceRigs, story: Callable[[list[DeviceRig]], Coroutine[Any, Any, None]], clock: VirtualClock | None = None
) -> None:
    """Run the devices of `rigs` during a story, in the time of `clock` if given. No memory link may stay open."""

    async def whole() -> None:
        async with rigs.at_work() as made:
            await story(made)
        assert not any(link.is_open for link in _memory_links(made))

    if clock is None:
        event_loop.run(whole())
    else:
        run_virtually(clock, whole())


def _memory_links(rigs: Iterable[DeviceRig]) -> list[MemoryLink | MemoryCanLink]:
    return [rig.device.link for rig in rigs if isinstance(rig.device.link, MemoryLink | MemoryCanLink)]
