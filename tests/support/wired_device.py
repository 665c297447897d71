"""Simulated devices connected to a device of imud in simulated time: a HiPNUC device with pins, and an IMU61x.

The bytes and edges of the HiPNUC device arrive in step.
"""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.lines import DeviceLines, LineFactory, OutputOptions
from imud.device import utc as utc_keeper
from imud.formats.nmea0183 import build
from imud.links.memory import MemoryLink, MemoryOptions
from imud.model.event import Event, EventKind
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from imud.sim.imu61x.uart import Imu61xModule
from imud.sim.ports.faults import Faults
from imud.sim.ports.pins import MemoryInput, MemoryLines, MemoryOutput, OnEdge, PinFaults, Pins
from imud.sim.ports.uart_wire import heard
from imud.sim.sensor import Pin
from imud.utc.receivers import RmcOptions
from imud.utc.system_clock import KernelClock
from tests.support.device_rig import DeviceRigs
from tests.support.event_loops import LoopWorker, VirtualClock, run_virtually
from tests.support.old_spellings import act
from tests.support.rmc_sources import FakeSource
from tests.support.simulated_modules import HIPNUC_STILL

BEGIN_NS = 1000 * NS_PER_S + 123_456_789
BAUD = 115_200
STEP_S = 0.002
TICK_S = 0.1
WAKE_NS = 30_000  # time from the last byte to the program that reads it, ns
EDGE_LATE_NS = 45_000  # time from the measurement to the rising edge, ns: 125 µs to the frame minus 80 µs of the pulse


class WiredDevice:
    def __init__(
        self, lines: DeviceLines, settings: ModuleSettings | None = None, hardware: HipnucHardware | None = None, *,
        frame_faults: Faults | None = None, pin_faults: PinFaults | None = None, identify: bool = False,
        rmc: RmcOptions | None = None,
    ) -> None:  # fmt: skip
        self.clock = VirtualClock(BEGIN_NS)
        self.source = FakeSource()
        self.memory = MemoryLines(self.clock.now_ns)
        self.cut: set[Pin] = set()
        self.instants: dict[int, int] = {}  # time of the measurement by device time (ms) of the received frames
        self.frames: list[int] = []
        self._config = DeviceConfig(
            "bow", "hipnuc-uart", None, identify, "memory", MemoryOptions(baud=BAUD), lines=lines, rmc=rmc
        )
        self._rigs = DeviceRigs(self.clock.host, lines=LineFactory(self.memory.input, self._output, LoopWorker))
        self._settings, self._hardware = settings, hardware
        self._frame_faults, self._pin_faults = frame_faults, pin_faults
        self._pulses: dict[Pin, dict[int, int]] = {pin: {} for pin in Pin}
        self._timer: asyncio.Handle | None = None
        self._heard = 0

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(utc_keeper, "RMC_SOURCES", {"gpsd": lambda _settings, _context: self.source})
            patch.setattr(utc_keeper, "kernel_clock", lambda: KernelClock(False, 0, 0))
            run_virtually(self.clock, self._play(story))

    async def _play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self.rig = self._rigs.add(self._config)
        self.device, self.link = self.rig.device, self.rig.link
        self.power_on()
        ticking = asyncio.create_task(self._tick())
        try:
            async with self._rigs.at_work():
                await asyncio.sleep(0.3)
                self.run_module()
                await story()
        finally:
            if self._timer is not None:
                self._timer.cancel()
            ticking.cancel()
        lines: Sequence[MemoryInput | MemoryOutput] = [*self.memory.inputs.values(), *self.memory.outputs.values()]
        assert not any(line.is_open for line in lines)
        assert not any(line.active for line in self.memory.outputs.values())
        assert self.source.closed is (self._config.rmc is not None)

    @property
    def samples(self) -> list[Sample]:
        return self.rig.samples

    @property
    def events(self) -> list[Event]:
        return self.rig.events

    # --- actions of a story -------------------------------------------------------------------------------------------

    async def wait(self, seconds: float) -> list[Sample]:
        before = len(self.samples)
        await asyncio.sleep(seconds)
        return self.samples[before:]

    def power_on(self) -> None:
        self.module = HipnucModule(self.clock.now_ns(), self._settings, self._hardware)
        on_edge: Mapping[Pin, OnEdge] = {pin: partial(self._on_edge, pin) for pin in Pin}
        self.pins = Pins(self.module, on_edge, self._pin_faults)

    def tell(self, command: str) -> None:
        self.module.receive(command.encode() + b"\r\n", self.clock.now_ns())

    def line(self, key: str) -> MemoryInput:
        return self.memory.inputs[f"bow {key}"]

    def pulse_per_second(self, t_ns: int) -> None:
        self.module.mark(t_ns)
        self.line("pps").pulse(t_ns, 5 * NS_PER_MS)

    def sentence(self, unix_s: int) -> None:
        self.source.sentences += 1
        self.source.give(build(unix_s * NS_PER_S), self.clock.now_ns())

    # --- true values --------------------------------------------------------------------------------------------------

    def instant(self, sample: Sample) -> int:
        """Return the time of the measurement, while the device time counts from power-on."""
        assert sample.t_dev_ns is not None
        return self.instants[sample.t_dev_ns // NS_PER_MS]

    def pulses(self, pin: Pin) -> dict[int, int]:
        """Return the measurement times by pulse number, for the pulses that the host received."""
        return self._pulses[pin]

    def of_kind(self, kind: EventKind) -> list[Event]:
        return [event for event in self.events if event.kind is kind]

    # --- implementation -----------------------------------------------------------------------------------------------

    def run_module(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        now_ns, module = self.clock.now_ns(), self.module
        for data in self.link.written[self._heard :]:
            module.receive(data, now_ns)
        self._heard = len(self.link.written)
        self.pins.step(now_ns)
        for burst in module.advance(now_ns - WAKE_NS):
            passed = self._frame_faults.pass_on(burst) if self._frame_faults else burst
            if passed is None:
                continue
            if burst.sample_ns is not None and burst.device_ms is not None:
                self.instants[burst.device_ms] = burst.sample_ns
                self.frames.append(burst.sample_ns)
            self.link.feed(passed.data, now_ns)
        times = [now_ns + NS_PER_MS * 20]
        if (next_ns := module.next_ns()) is not None:
            times.append(next_ns + WAKE_NS)
        if (next_ns := self.pins.next_ns()) is not None:
            times.append(next_ns)
        rest_s = max(min(times) - now_ns, 0) / NS_PER_S
        self._timer = asyncio.get_running_loop().call_later(rest_s, self.run_module)

    def _on_edge(self, pin: Pin, t_ns: int, rising: bool) -> None:
        line = self.memory.inputs.get(f"bow {pin}")
        if line is None or pin in self.cut or not line.is_open:
            return
        line.edge(t_ns, rising)
        if rising:
            pulses = self._pulses[pin]
            pulses[len(pulses) + 1] = t_ns - EDGE_LATE_NS

    def _output(self, _settings: OutputOptions, purpose: str) -> MemoryOutput:
        return self.memory.outputs.setdefault(
            purpose, MemoryOutput(purpose, now_ns=self.clock.now_ns, on_change=self._on_sin)
        )

    def _on_sin(self, now_ns: int, active: bool) -> None:
        if active:
            self.module.mark(now_ns)
            self.run_module()

    async def _tick(self) -> None:
        while True:
            self.device.tick(self.clock.now_ns())
            await asyncio.sleep(TICK_S)


# --- a device on a link with a baud rate at both ends -----------------------------------------------------------------


SimulatedModule = TypeVar("SimulatedModule", HipnucModule, Imu61xModule)


class LinkedModule(MemoryLink, Generic[SimulatedModule]):
    """A link in simulated time with a device at its far end. `carry` must run."""

    step_s = STEP_S

    def __init__(self, settings: MemoryOptions, module: SimulatedModule, clock: VirtualClock) -> None:
        super().__init__(settings)
        self.module: SimulatedModule = module
        self.clock = clock
        self.sent_at: list[tuple[int, bytes]] = []
        self.module_is_on = True

    def write(self, data: bytes) -> None:
        super().write(data)
        self.sent_at.append((self.baud, data))
        if self.module_is_on:
            self.module.receive(heard(data, self.baud, self.module.baud), self.clock.now_ns())

    async def carry(self) -> None:
        while True:
            baud = self.module.baud
            for burst in self.module.advance(self.clock.now_ns()):
                if self.module_is_on:
                    self.feed(heard(burst.data, baud, self.baud), self.clock.now_ns())
            await asyncio.sleep(self.step_s)


class Imu61xLine(LinkedModule[Imu61xModule]):
    step_s = 0.005


class LinkedDevice:
    def __init__(
        self, settings: ModuleSettings | None = None, hardware: HipnucHardware = HIPNUC_STILL, **config: Any
    ) -> None:
        clock = self.clock = VirtualClock()
        driver, identify = config.pop("driver", "hipnuc-uart"), config.pop("identify", True)
        lines: DeviceLines | None = config.pop("lines", None)
        declared = config.pop("declared", None)
        state_dir: Path | None = config.pop("state_dir", None)
        memory = MemoryOptions(**{"baud": 115200, **config})
        self.module = HipnucModule(clock.now_ns(), settings, hardware)
        self.link = LinkedModule(memory, self.module, clock)
        self.rigs = DeviceRigs(clock.host, state_dir=state_dir)
        self.rig = self.rigs.add(
            DeviceConfig("bow", driver, None, identify, "memory", memory, lines=lines, declared=declared), self.link
        )
        self.device = self.rig.device
        self.samples, self.events = self.rig.samples, self.rig.events

    @property
    def problem(self) -> str:
        return self.rig.problem

    @property
    def messages(self) -> list[str]:
        return [event.message for event in self.events]

    async def until(self, condition: Callable[[], object], what: str = "", limit_s: float = 30.0) -> None:
        await self.rig.until(condition, what or str(self.link.sent_at[-5:]), limit_s, step_s=0.01)

    async def wait(self, seconds: float) -> None:
        end_ns = self.clock.now_ns() + int(seconds * 1e9)
        await self.until(lambda: self.clock.now_ns() >= end_ns, limit_s=seconds + 1)

    async def act(self, name: str, **arguments: Any) -> object:
        acting = asyncio.ensure_future(act(self.device, name, arguments))
        await self.until(acting.done, f"the end of {name}", 60)
        return acting.result()

    def play(self, story: Callable[[], Awaitable[None]]) -> None:
        play_on_line(self.link, self.rigs, story)


def play_on_line(line: LinkedModule[Any], rigs: DeviceRigs, story: Callable[[], Awaitable[None]]) -> None:
    """Run the devices during a story while the link transfers data. Check at the end that their ledgers balance."""

    async def both() -> None:
        carrying = asyncio.create_task(line.carry())
        try:
            async with rigs.at_work():
                await story()
        finally:
            carrying.cancel()
            await asyncio.gather(carrying, return_exceptions=True)

    run_virtually(line.clock, both())
