"""The faults with effect, resources and duration, and the plan of a run, which only depends on its seed."""

import ctypes
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from random import Random
from signal import SIGCONT, SIGHUP, SIGSTOP
from time import monotonic, sleep
from typing import Any, Final, NamedTuple, Protocol

from imud.sim.ports.faults import FaultRates
from imud.sim.ports.pins import PinFaultRates
from tests.lab.chaos.daemon import Life
from tests.lab.chaos.far_side import STUCK, FarSide

DAEMON: Final = "daemon"
EVERY_S: Final = 0.8
ROUND_S: Final = 15.0
PAUSE_S: Final = 0.3


class Scene(Protocol):
    @property
    def far(self) -> FarSide: ...

    @property
    def life(self) -> Life: ...

    @property
    def state(self) -> Path:
        """Folder on a small file system, with the state of the daemon."""
        ...

    def write_config(self, variant: int) -> None:
        """Write the configuration: a valid one by number, an invalid one for -1."""
        ...

    def next_life(self, end: Callable[[Life], None]) -> None: ...


@dataclass(frozen=True)
class Fault:
    name: str
    resources: frozenset[str]
    """Resources of the fault. Two faults with a common resource are never active at the same time."""
    begin: Callable[[Scene, float], None]
    """Function that starts the fault. Its second argument is the duration, s."""
    end: Callable[[Scene], None] = lambda scene: None
    shortest_s: float = 0.2
    longest_s: float = 2.5
    outage: tuple[str, ...] = ()
    """Devices whose link is away or that restart. Devices on I2C and SPI report the time themselves."""
    restarts: bool = False
    """True if these devices restart or lose their power; False if they keep running."""
    weight: float = 1.0


class Planned(NamedTuple):
    begin_s: float
    fault: Fault
    lasts_s: float


def plan(seed: int, seconds: float, faults: list[Fault]) -> Iterator[list[Planned]]:
    """Yield rounds of faults for about this time. The same arguments give the same rounds."""
    random = Random(seed)
    for _ in range(max(round(seconds / ROUND_S), 1)):
        yield _round(random, faults)


def _round(random: Random, faults: list[Fault]) -> list[Planned]:
    """Return faults in the order of their start. Two active faults never share a resource."""
    planned: list[Planned] = []
    free_s: dict[str, float] = {}
    at_s = random.expovariate(1 / EVERY_S)
    while at_s < ROUND_S:
        fault = random.choices(faults, [fault.weight for fault in faults])[0]
        lasts_s = random.uniform(fault.shortest_s, fault.longest_s)
        if all(free_s.get(resource, 0.0) <= at_s for resource in fault.resources):
            planned.append(Planned(at_s, fault, lasts_s))
            free_s |= dict.fromkeys(fault.resources, at_s + lasts_s + PAUSE_S)
        at_s += random.expovariate(1 / EVERY_S)
    return planned


def plan_short(seed: int, faults: list[Fault]) -> list[list[Planned]]:
    """Return two rounds. In the second round the daemon knows the counters of more devices, so its losses are exact."""
    random = Random(seed)
    return [_each_once(random, faults) for _ in range(2)]


def _each_once(random: Random, faults: list[Fault]) -> list[Planned]:
    """Return a round in which every kind of fault happens once, as early as its resources allow."""
    free_s, planned = dict[str, float](), list[Planned]()
    for fault in random.sample(faults, len(faults)):
        begin_s = max(free_s.get(resource, random.uniform(0.0, EVERY_S)) for resource in fault.resources)
        planned.append(Planned(begin_s, fault, random.uniform(fault.shortest_s, fault.longest_s)))
        free_s |= dict.fromkeys(fault.resources, begin_s + planned[-1].lasts_s + PAUSE_S)
    return sorted(planned, key=lambda item: item.begin_s)


def play(
    planned: list[Planned], begin: Callable[[Planned], None], end: Callable[[Fault], None],
    now_s: Callable[[], float] = monotonic, wait: Callable[[float], None] = sleep,
) -> None:  # fmt: skip
    """Play one round: each fault starts and ends at its time.

    A fault that starts late, because host or guest was busy, ends late. Faults with the same resources wait for it.
    """
    begin_s = now_s()
    going: list[tuple[float, Fault]] = []
    todo = list(planned)
    free_s: dict[str, float] = {}
    while todo or going:
        ends = [(end_s, True) for end_s, _ in going]
        begins = [
            (max(item.begin_s, *(free_s.get(resource, 0.0) for resource in item.fault.resources)), False)
            for item in todo[:1]
        ]
        due_s, is_end = min(ends + begins)
        wait(max(begin_s + due_s - now_s(), 0))
        if is_end:
            fault = next(fault for end_s, fault in going if end_s == due_s)
            going.remove((due_s, fault))
            end(fault)
            free_s |= dict.fromkeys(fault.resources, now_s() - begin_s + PAUSE_S)
        else:
            item = todo.pop(0)
            free_s |= dict.fromkeys(item.fault.resources, inf)
            begin(item)
            going.append((now_s() - begin_s + item.lasts_s, item.fault))


# --- what they do ----------------------------------------------------------------------------------------------------

STEP_MOST_S: Final = 3600.0
ADJ_FREQUENCY: Final = 0x2
TIMEX_BYTES: Final = 208  # size of struct timex on 64-bit Linux
FREQUENCY_AT: Final = 16
"""Offset of `freq` in struct timex (64 bits). The unit is 2^-16 ppm."""
SLEW_PPM: Final = 400  # less than the limit of the kernel, 500 ppm


def slew(ppm: float) -> None:
    """Let the system clock run faster by `ppm`. CLOCK_MONOTONIC also runs faster. Raises OSError."""
    timex = ctypes.create_string_buffer(TIMEX_BYTES)
    struct.pack_into("=I", timex, 0, ADJ_FREQUENCY)
    struct.pack_into("=q", timex, FREQUENCY_AT, round(ppm * 65536))
    if ctypes.CDLL(None, use_errno=True).adjtimex(timex) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex")


@dataclass
class _Clock:
    by_s: float = STEP_MOST_S
    moved_s: float = field(default=0.0)

    def step(self, scene: Scene, lasts_s: float) -> None:
        self.by_s = -self.by_s
        self._move(self.by_s * lasts_s / 3)

    def back(self, scene: Scene) -> None:
        self._move(-self.moved_s)

    def _move(self, by_s: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + by_s)
        self.moved_s += by_s


def _noise(name: str, rates: FaultRates) -> dict[str, Any]:
    return {
        "begin": lambda scene, lasts_s: scene.far.set_noise(name, rates),
        "end": lambda scene: scene.far.set_noise(name, FaultRates()),
    }


def _registers(name: str, **values: object) -> dict[str, Any]:
    quiet: dict[str, object] = {"error": 0, "line": None, "flips": 0, "frozen": False}
    return {
        "begin": lambda scene, lasts_s: scene.far.set_registers(name, **values),
        "end": lambda scene: scene.far.set_registers(name, **quiet),
    }


def _restart(name: str) -> dict[str, Any]:
    return {"outage": (name,), "restarts": True}


def _reboot(name: str) -> dict[str, Any]:
    return {**_restart(name), "shortest_s": 0.0, "longest_s": 0.0}


def _bus_off(scene: Scene, lasts_s: float) -> None:
    scene.far.can.enter("bus-off")


def _fill(scene: Scene, lasts_s: float) -> None:
    with suppress(OSError), (scene.state / "full").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


def _reload(variant: int) -> Callable[[Scene, float], None]:
    def reload(scene: Scene, lasts_s: float) -> None:
        scene.write_config(variant)
        scene.life.signal(SIGHUP)

    return reload


def _good_again(scene: Scene) -> None:
    scene.write_config(0)
    scene.life.signal(SIGHUP)


def all_faults(*, with_memory: bool) -> list[Fault]:
    """Return every kind of fault. Without memory control, omit the fault that needs it."""
    clock = _Clock()
    one = frozenset
    bad_wire = FaultRates(flip=0.15, drop=0.1, insert=0.1, cut=0.1)
    faults = [
        Fault("pty unplugged", one({"serial"}), lambda s, t: s.far.unplug("serial", t), **_restart("serial")),
        Fault("pty unplugged, device has power", one({"serial"}), lambda s, t: s.far.pull_data("serial"),
              lambda s: s.far.plug_data("serial"), outage=("serial",)),
        Fault("RS-485 pty unplugged", one({"modbus"}), lambda s, t: s.far.unplug("modbus", t), **_restart("modbus")),
        Fault("device restarts (pty)", one({"serial"}), lambda s, t: s.far.reboot("serial"), **_reboot("serial")),
        Fault("device restarts (UART)", one({"uart"}), lambda s, t: s.far.reboot("uart"), **_reboot("uart")),
        Fault("device restarts (vcan)", one({"vcan"}), lambda s, t: s.far.reboot("vcan"), **_reboot("vcan")),
        Fault("noise on the pty", one({"serial"}), **_noise("serial", bad_wire)),
        Fault("noise on the UART", one({"uart"}), **_noise("uart", bad_wire)),
        Fault("pty silent", one({"serial"}), **_noise("serial", FaultRates(lose=1.0))),
        Fault("UART silent", one({"uart"}), **_noise("uart", FaultRates(lose=1.0))),
        Fault("edges of SOUT lost", one({"pins"}),
              lambda s, t: s.far.set_pin_noise(PinFaultRates(lose_pulse=0.4, lose_edge=0.1)),
              lambda s: s.far.set_pin_noise(PinFaultRates())),
        Fault("vcan0 down", one({"vcan"}), lambda s, t: s.far.vcan.down(), lambda s: s.far.vcan.up(), outage=("vcan",)),
        Fault("can0 down", one({"can"}), lambda s, t: s.far.can.down(), lambda s: s.far.can.up(), outage=("can",)),
        Fault("can0 bus-off", one({"can"}), _bus_off, lambda s: s.far.can.restart()),
        Fault("can0 error-passive", one({"can"}), lambda s, t: s.far.can.enter("error-passive"),
              lambda s: s.far.can.enter("error-active")),
        Fault("I2C: SDA stuck", one({"i2c"}), **_registers("i2c", **STUCK)),
        Fault("I2C: not acknowledged", one({"i2c"}), **_registers("i2c", error=6)),
        Fault("I2C: noise", one({"i2c"}), **_registers("i2c", flips=3)),
        Fault("I2C: registers frozen", one({"i2c"}), **_registers("i2c", frozen=True)),
        Fault("SPI: noise", one({"spi"}), **_registers("spi", flips=3)),
        Fault("SPI: line high", one({"spi"}), **_registers("spi", line=0xFF)),
        Fault("SPI: transfer fails", one({"spi"}), **_registers("spi", error=5)),
        Fault("clock steps", one({"clock"}), clock.step, clock.back),
        Fault("clock slews", one({"clock"}), lambda s, t: slew(SLEW_PPM), lambda s: slew(0.0)),
        Fault("SIGHUP, another configuration", one({DAEMON}), _reload(1), _good_again),
        Fault("SIGHUP, bad configuration", one({DAEMON}), _reload(-1), _good_again),
        Fault("SIGSTOP", one({DAEMON}), lambda s, t: s.life.signal(SIGSTOP), lambda s: s.life.signal(SIGCONT)),
        Fault("disk full", one({"disk"}), _fill, lambda s: (s.state / "full").unlink(missing_ok=True)),
        Fault("kill -9", one({DAEMON}), lambda s, t: s.next_life(Life.kill), weight=0.5),
    ]  # fmt: skip
    if with_memory:
        faults.append(
            Fault("out of memory", one({DAEMON}), lambda s, t: s.next_life(Life.run_out_of_memory), weight=0.3)
        )
    return faults
