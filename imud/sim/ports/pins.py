"""Pins of a simulated device and their connection to lines, with faults.

    module.pins() ──▶ faults ──▶ when it is due: on_edge[pin](due_ns, rising)

The owner calls `step` before it moves the bytes of the same device, so that the edge of a pulse precedes its frame.
"""

import asyncio
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from random import Random
from time import sleep
from typing import Final, Protocol, TextIO

from imud.contracts.lines import Edge, InputOptions, LineFactory, OnEdges, OnLineEnd, OutputOptions
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.ports.faults import parse_rates
from imud.sim.sensor import Pin, PinEdge, StreamModule

# Function for an edge: its due time (CLOCK_MONOTONIC, ns), and True for a rising edge.
OnEdge = Callable[[int, bool], None]
EXTRA_HIGH_NS: Final = 80_000
EXTRA_WITHIN_NS: Final = NS_PER_MS
LOST_MAX: Final = 100_000  # Maximum number of pulses in `PinFaults.lost`. The counters have no limit.


@dataclass(frozen=True, slots=True)
class PinFaultRates:
    """Probabilities of faults, 0 to 1."""

    lose_pulse: float = 0.0  # probability that both edges of a pulse are missing
    lose_edge: float = 0.0  # probability that an edge is missing
    extra: float = 0.0  # probability of an additional pulse within a millisecond, as from a disturbance

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0.0 <= getattr(self, field.name) <= 1.0:
                raise ValueError(f"{field.name}: expected a probability 0 … 1, got {getattr(self, field.name)}")


class PinFaults:
    """Injector of faults into edges. The same seed and the same edges give the same faults."""

    def __init__(self, seed: int, rates: PinFaultRates) -> None:
        self.rates = rates
        self.counts: Counter[str] = Counter()
        self.lost: list[tuple[Pin, int | None]] = []  # pin and measurement time of the pulses with a missing edge
        self._random = Random(seed)
        self._losing: set[Pin] = set()

    def pass_on(self, edge: PinEdge) -> list[PinEdge]:
        """Return an edge with additional edges, or no edge. Draws three random values for each edge."""
        rates, pin = self.rates, edge.pin
        pulse, alone, extra = (self._random.random() for _ in fields(rates))
        if edge.rising and pulse < rates.lose_pulse:
            self._losing.add(pin)
            self._note("lose_pulse", edge)
            return []
        if not edge.rising and pin in self._losing:
            self._losing.remove(pin)
            return []
        if alone < rates.lose_edge:
            self._note("lose_edge", edge)
            return []
        if edge.rising or extra >= rates.extra:
            return [edge]
        self.counts["extra"] += 1
        begin_ns = edge.due_ns + self._random.randint(1, EXTRA_WITHIN_NS)
        return [edge, PinEdge(begin_ns, pin, True), PinEdge(begin_ns + EXTRA_HIGH_NS, pin, False)]

    def _note(self, kind: str, edge: PinEdge) -> None:
        self.counts[kind] += 1
        if len(self.lost) < LOST_MAX:
            self.lost.append((edge.pin, edge.sample_ns))


class Pins:
    """Connection of the pins of a device to lines. It delivers edges at their due time. Synchronization: one thread."""

    def __init__(
        self,
        module: HipnucModule,
        on_edge: Mapping[Pin, OnEdge],
        faults: PinFaults | None = None,
        truth: TextIO | None = None,
    ) -> None:
        """`truth` gets one line per delivered edge: pin, level, due_ns, sample_ns (empty if no sample follows), and
        step_ns, the time of the step."""
        self._module, self._on_edge, self._faults, self._truth = module, on_edge, faults, truth
        self._held: list[PinEdge] = []
        self.edges = 0  # number of delivered edges
        if truth:
            truth.write("pin,level,due_ns,sample_ns,step_ns\n")

    def step(self, now_ns: int) -> None:
        """Deliver all due edges."""
        for edge in self._module.pins(now_ns):
            if edge.pin in self._on_edge:
                for passed in self._faults.pass_on(edge) if self._faults else [edge]:
                    insort(self._held, passed, key=_due_ns)
        due = bisect_right(self._held, now_ns, key=_due_ns)
        done, self._held = self._held[:due], self._held[due:]
        for edge in done:
            self._on_edge[edge.pin](edge.due_ns, edge.rising)
            if self._truth:
                sample = "" if edge.sample_ns is None else edge.sample_ns
                self._truth.write(f"{edge.pin},{edge.rising:d},{edge.due_ns},{sample},{now_ns}\n")
        self.edges += len(done)

    def next_ns(self) -> int | None:
        """Return the time of the next edge of `step`; None if no edge is due."""
        times = [edge.due_ns for edge in self._held[:1]]
        if (next_ns := self._module.next_pin_ns()) is not None:
            times.append(next_ns)
        return min(times, default=None)

    def summary(self) -> dict[str, int]:
        faults = self._faults.counts if self._faults else {}
        return {"pin_edges": self.edges} | {f"pin_fault_{kind}": count for kind, count in sorted(faults.items())}


def pin_rates(text: str) -> PinFaultRates:
    """Return the rates in `lose_pulse=0.1,extra=0.01` with the names of `PinFaultRates`. Raises ValueError."""
    return parse_rates(PinFaultRates, text, " of pins")


def _due_ns(edge: PinEdge) -> int:
    return edge.due_ns


class MemoryInput:
    """An `InputLine` that the simulated device drives with `edge`. Synchronization: the loop's thread only."""

    def __init__(self, title: str = "memory line", rising_only: bool = False) -> None:
        self.title = title
        self.open_error: LinkError | None = None  # error of `open`; None for no error
        self.is_open = False
        self._rising_only = rising_only
        self._watch = True
        self._level = False
        self._lost = 0
        self._number = 0
        self._waiting: list[Edge] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_edges: OnEdges | None = None
        self._on_end: OnLineEnd | None = None

    @property
    def edges_lost(self) -> int:
        """Return the number of edges of `lose`."""
        return self._lost

    # --- the device's side -------------------------------------------------------------------------------------------

    def edge(self, t_ns: int, rising: bool) -> None:
        """Change the level at this time. The next turn of the loop or `drain` delivers the edge."""
        self._level = rising
        if self.is_open and (rising or not self._rising_only):
            self._number += 1
            self._waiting.append(Edge(t_ns, rising, self._number))
            if self._loop is not None and self._watch and len(self._waiting) == 1:
                self._loop.call_soon(self.drain)

    def pulse(self, t_ns: int, width_ns: int) -> None:
        """Make a pulse: a rising edge at `t_ns`, a falling edge after `width_ns`."""
        self.edge(t_ns, True)
        self.edge(t_ns + width_ns, False)

    def lose(self, count: int) -> None:
        """Simulate edges that the kernel drops."""
        self._number += count
        self._lost += count

    def vanish(self, error: LinkError) -> None:
        """End the line with an error, as if the chip was removed."""
        on_end = self._on_end
        self.close()
        if on_end is not None:
            on_end(error)

    # --- imud's side -------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the line. Edges count after this call. Raises `open_error`."""
        if self.open_error is not None:
            raise self.open_error
        self.is_open = True

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Start the delivery of edges, with the edges since `open`. Without `watch`, only `drain` delivers edges."""
        self._on_edges, self._on_end = on_edges, on_end
        self._loop = asyncio.get_running_loop()
        self._watch = watch
        if watch:
            self._loop.call_soon(self.drain)

    def fileno(self) -> int:
        """Return -1: edges do not come from the kernel."""
        return -1

    def drain(self) -> None:
        if self._on_edges is not None and self._waiting:
            found, self._waiting = self._waiting, []
            self._on_edges(found)

    def level(self) -> bool:
        """Return the level of the last edge. Raises LinkError."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open")
        return self._level

    def close(self) -> None:
        self.is_open = False
        self._waiting = []
        self._loop = self._on_edges = self._on_end = None


class MemoryOutput:
    def __init__(
        self,
        title: str = "memory line",
        *,
        now_ns: Callable[[], int] = lambda: 0,
        on_change: Callable[[int, bool], None] | None = None,
    ) -> None:
        """`now_ns` gives the time of changes; without it, all times are 0.

        `on_change` is the device. It receives the time and the new level in the thread that drives the line.
        """
        self.title = title
        self.open_error: LinkError | None = None  # error of `open`; None for no error
        self.set_error: LinkError | None = None  # error of `set`; None for no error
        self.is_open = False
        self.active = False
        self.history: list[tuple[int, bool]] = []  # time (ns) and level of each change
        self._now_ns = now_ns
        self._on_change = on_change

    def open(self) -> None:
        """Open the line with the inactive level. Raises `open_error`."""
        if self.open_error is not None:
            raise self.open_error
        self.is_open = True
        self._become(False)

    def set(self, active: bool) -> None:
        """Set the level. Raises `set_error`, and LinkError if the line is not open."""
        if self.set_error is not None or not self.is_open:
            raise self.set_error or LinkError(f"{self.title} is not open")
        self._become(active)

    def close(self) -> None:
        """Release the line with the inactive level. A second call does nothing."""
        if self.is_open:
            self._become(False)
        self.is_open = False

    def _become(self, active: bool) -> None:
        if active != self.active:
            self.active = active
            now_ns = self._now_ns()
            self.history.append((now_ns, active))
            if self._on_change is not None:
                self._on_change(now_ns, active)


class MemoryLines:
    """Factory of lines inside the process. It stores them by their purpose, for example `bow sout`."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.inputs: dict[str, MemoryInput] = {}
        self.outputs: dict[str, MemoryOutput] = {}
        self._now_ns = now_ns
        self.maker = LineFactory(self.input, self.output)

    def input(self, _settings: InputOptions, purpose: str, rising_only: bool = False) -> MemoryInput:
        """Return the input of this purpose, always the same object."""
        return self.inputs.setdefault(purpose, MemoryInput(purpose, rising_only))

    def output(self, _settings: OutputOptions, purpose: str) -> MemoryOutput:
        """Return the output of this purpose, always the same object."""
        return self.outputs.setdefault(purpose, MemoryOutput(purpose, now_ns=self._now_ns))


SIN_LOOK_NS: Final = 4 * NS_PER_MS  # Interval between two reads of SIN, ns. A pulse must be longer.


class MarkedModule(Protocol):
    """A device with a sync input."""

    def mark(self, now_ns: int) -> None:
        """Send a rising edge to the sync input."""
        ...


class PullFile:
    """A line of a gpio-sim chip, driven with its file `pull` in sysfs. The kernel time-stamps the edge at the write."""

    def __init__(self, path: Path, settle_s: float = 0.0) -> None:
        """Wait `settle_s` after each rising edge. The kernel ignores an edge before it has reported the previous edge,
        and a frame must not precede its edge. Raises OSError."""
        self._file = path.open("wb", buffering=0)
        self._settle_s = settle_s

    def __call__(self, _due_ns: int, rising: bool) -> None:
        self._file.write(b"pull-up" if rising else b"pull-down")
        if rising and self._settle_s:
            sleep(self._settle_s)

    def close(self) -> None:
        """Close the file. The level stays. A second call does nothing."""
        self._file.close()


class SinFile:
    """SIN of a device, read from the file `value` of a gpio-sim line that the tested program drives.

    sysfs does not report changes of this file. The owner therefore reads it at an interval, and an edge is late by up
    to this interval.
    """

    def __init__(self, path: Path, module: MarkedModule) -> None:
        self._path, self._module = path, module
        self._level = True  # a line that is high at the start has no edge

    def look(self, now_ns: int) -> None:
        """Pass a rising edge since the last call to the device. Raises OSError."""
        level = self._path.read_bytes().strip() == b"1"
        if level and not self._level:
            self._module.mark(now_ns)
        self._level = level


class SimulatedLines:
    """Lines next to the data of a device: its output pins and SIN. Synchronization: one thread."""

    def __init__(
        self, module: StreamModule, files: Mapping[Pin, PullFile], faults: PinFaults | None = None,
        truth: TextIO | None = None, sin: Path | None = None,
    ) -> None:  # fmt: skip
        """`close` closes `files` and `truth`. Raises ValueError for pins that the device does not have."""
        self._files, self._truth = files, truth
        self._pins: Pins | None = None
        if files:
            if not isinstance(module, HipnucModule):
                raise ValueError("pins: expected a device with simulated pins, got a device without pins")
            self._pins = Pins(module, files, faults, truth)
        self._sin = SinFile(sin, module) if sin else None

    def step(self, now_ns: int) -> None:
        """Deliver all due edges before the port sends its bytes. Raises OSError."""
        if self._sin is not None:
            self._sin.look(now_ns)
        if self._pins is not None:
            self._pins.step(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """Return the latest time of the next call of `step`."""
        next_ns = self._pins.next_ns() if self._pins is not None else None
        latest_ns = now_ns + (SIN_LOOK_NS if self._sin is not None else NS_PER_S)
        return latest_ns if next_ns is None else min(next_ns, latest_ns)

    def summary(self) -> dict[str, int]:
        return self._pins.summary() if self._pins is not None else {}

    def close(self) -> None:
        for file in self._files.values():
            file.close()
        if self._truth is not None:
            self._truth.close()


def pull_files(text: str, settle_s: float = 0.0) -> dict[Pin, PullFile]:
    """Return files by pin from `sout=PATH,alarm=PATH`. Raises ValueError, OSError."""
    files: dict[Pin, PullFile] = {}
    for part in filter(None, text.split(",")):
        name, _, path = part.partition("=")
        if name not in set(Pin) or not path:
            raise ValueError(f"pin {part!r}: expected NAME=PATH with one of {', '.join(Pin)}")
        files[Pin(name)] = PullFile(Path(path), settle_s)
    return files
