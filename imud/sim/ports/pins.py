"""Brings the pins of a simulated device to lines: in memory, on a gpio-sim chip, or wherever a function reaches.

    module.pins() ──▶ faults ──▶ when it is due: on_edge[pin](due_ns, rising)
    SIN ──▶ module.mark()

The owner calls `step` right before it moves the bytes of the same device, so that the edge of a pulse is there before
the frame that follows it.
"""

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from random import Random
from time import sleep
from typing import Final, Protocol, TextIO

from imud.sim.ports.pin import Pin, PinEdge, PinModule
from imud.units import NS_PER_MS

OnEdge = Callable[[int, bool], None]
"""Called with the time at which an edge is due (CLOCK_MONOTONIC, ns) and whether it is a rising one."""
EXTRA_HIGH_NS: Final = 80_000
EXTRA_WITHIN_NS: Final = NS_PER_MS
LOST_MAX: Final = 100_000
"""Lost pulses kept in `PinFaults.lost`; the counts go on."""


class MarkedModule(Protocol):
    """A device with a sync input."""

    def mark(self, now_ns: int) -> None:
        """A rising edge on its sync input."""
        ...


@dataclass(frozen=True, slots=True)
class PinFaultRates:
    """Probabilities, 0 … 1."""

    lose_pulse: float = 0.0
    """Of a pulse: both its edges are missing."""
    lose_edge: float = 0.0
    """Of an edge: it alone is missing."""
    extra: float = 0.0
    """Of a pulse: another one follows it within a millisecond, as a disturbance would make."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0.0 <= getattr(self, field.name) <= 1.0:
                raise ValueError(f"{field.name}: expected a probability 0 … 1, got {getattr(self, field.name)}")


class PinFaults:
    """Passes edges on, or not. Same seed, same edges: same faults."""

    def __init__(self, seed: int, rates: PinFaultRates) -> None:
        self.rates = rates
        self.counts: Counter[str] = Counter()
        self.lost: list[tuple[Pin, int | None]] = []
        """Pin and instant of measurement of the pulses of which an edge is missing."""
        self._random = Random(seed)
        self._losing: set[Pin] = set()

    def pass_on(self, edge: PinEdge) -> list[PinEdge]:
        """The edge if it comes, and edges that come with it. Draws three times whatever happens."""
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
    """Hands the edges of a module's pins over when they are due. Synchronization: one thread."""

    def __init__(
        self,
        module: PinModule,
        on_edge: Mapping[Pin, OnEdge],
        faults: PinFaults | None = None,
        truth: TextIO | None = None,
    ) -> None:
        """`truth` gets one line per edge that is handed over: pin, level, due_ns, sample_ns (empty: of no sample), and
        step_ns, the time of the step that did it."""
        self._module, self._on_edge, self._faults, self._truth = module, on_edge, faults, truth
        self._held: list[PinEdge] = []
        self.edges = 0
        """Edges handed over."""
        if truth:
            truth.write("pin,level,due_ns,sample_ns,step_ns\n")

    def step(self, now_ns: int) -> None:
        """Do all that is due."""
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
        """When `step` may have something next, or None while nothing is to come."""
        times = [edge.due_ns for edge in self._held[:1]]
        if (next_ns := self._module.next_pin_ns()) is not None:
            times.append(next_ns)
        return min(times, default=None)

    def summary(self) -> dict[str, int]:
        """Counters by name."""
        faults = self._faults.counts if self._faults else {}
        return {"pin_edges": self.edges} | {f"pin_fault_{kind}": count for kind, count in sorted(faults.items())}


class PullFile:
    """A line of a gpio-sim chip, driven through its `pull` file in sysfs; the kernel stamps the edge as it is written.

    Interface: Documentation/admin-guide/gpio/gpio-sim.rst.
    """

    def __init__(self, path: Path, settle_s: float = 0.0) -> None:
        """For so long after a rising edge nothing else is done: an edge that comes before the kernel has told of the
        last one is not seen, and a frame must not come before its edge. Raises OSError."""
        self._file = path.open("wb", buffering=0)
        self._settle_s = settle_s

    def __call__(self, _due_ns: int, rising: bool) -> None:
        """Drive the line. Raises OSError."""
        self._file.write(b"pull-up" if rising else b"pull-down")
        if rising and self._settle_s:
            sleep(self._settle_s)

    def close(self) -> None:
        """Let go of the file; the level stays. May be called twice."""
        self._file.close()


class SinFile:
    """SIN of a device, read from the `value` file of a gpio-sim line that the program under test drives.

    sysfs tells of no change there, so the owner looks as often as it likes; the edge is as late as the look.
    """

    def __init__(self, path: Path, module: MarkedModule) -> None:
        self._path, self._module = path, module
        self._level = True  # a line that is high from the beginning has no edge

    def look(self, now_ns: int) -> None:
        """Tell the module of a rising edge since the last look. Raises OSError."""
        level = self._path.read_bytes().strip() == b"1"
        if level and not self._level:
            self._module.mark(now_ns)
        self._level = level


def pull_files(text: str, settle_s: float = 0.0) -> dict[Pin, PullFile]:
    """Files by pin from `sout=PATH,alarm=PATH`. Raises ValueError, OSError."""
    files: dict[Pin, PullFile] = {}
    for part in filter(None, text.split(",")):
        name, _, path = part.partition("=")
        if name not in set(Pin) or not path:
            raise ValueError(f"pin {part!r}: expected NAME=PATH with one of {', '.join(Pin)}")
        files[Pin(name)] = PullFile(Path(path), settle_s)
    return files


def pin_rates(text: str) -> PinFaultRates:
    """Rates from `lose_pulse=0.1,extra=0.01`; names are those of `PinFaultRates`. Raises ValueError."""
    known = [field.name for field in fields(PinFaultRates)]
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        if name not in known:
            raise ValueError(f"fault {name!r} of pins: expected one of {', '.join(known)}")
        try:
            values[name] = float(value)
        except ValueError:
            raise ValueError(f"fault {name} of pins: expected a number, got {value!r}") from None
    return PinFaultRates(**values)


def _due_ns(edge: PinEdge) -> int:
    return edge.due_ns
