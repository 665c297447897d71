"""Pins of a simulated device, single wires next to its data, and their connection to lines, with faults.

    module.pins() ──▶ faults ──▶ when it is due: on_edge[pin](due_ns, rising)

The owner calls `step` right before it moves the bytes of the same device, so that the edge of a pulse is there before
the frame that follows it.
"""

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from random import Random
from typing import Final, NamedTuple, Protocol, TextIO, runtime_checkable

from imud.sim.ports.faults import parse_rates
from imud.units import NS_PER_MS

OnEdge = Callable[[int, bool], None]
"""Called with the time at which an edge is due (CLOCK_MONOTONIC, ns) and whether it is a rising one."""
EXTRA_HIGH_NS: Final = 80_000
EXTRA_WITHIN_NS: Final = NS_PER_MS
LOST_MAX: Final = 100_000
"""Lost pulses kept in `PinFaults.lost`; the counts go on."""


class Pin(StrEnum):
    """Outputs, by the names that lines have in the configuration."""

    SOUT = "sout"
    """High before each frame; the frame follows the falling edge."""
    SOUT_DIV = "sout_div"
    """Every n-th pulse of SOUT."""
    ALARM = "alarm"
    """High while an angle is out of range."""


class PinEdge(NamedTuple):
    """A change of a pin's level."""

    due_ns: int
    """CLOCK_MONOTONIC of the change."""
    pin: Pin
    rising: bool
    sample_ns: int | None = None
    """CLOCK_MONOTONIC of the measurement whose frame follows; None where none does."""


@runtime_checkable
class PinModule(Protocol):
    """A simulated device with pins. Its inputs are methods (`mark`), times as in `StreamModule`."""

    def pins(self, now_ns: int) -> list[PinEdge]:
        """Return the edges since the last call, in order. All pins are low in the beginning."""
        ...

    def next_pin_ns(self) -> int | None:
        """Time of the next output of `pins`; None for none."""
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
    """Injector of faults into edges. Same seed, same edges: same faults."""

    def __init__(self, seed: int, rates: PinFaultRates) -> None:
        self.rates = rates
        self.counts: Counter[str] = Counter()
        self.lost: list[tuple[Pin, int | None]] = []
        """Pin and instant of measurement of the pulses of which an edge is missing."""
        self._random = Random(seed)
        self._losing: set[Pin] = set()

    def pass_on(self, edge: PinEdge) -> list[PinEdge]:
        """Pass an edge on, with extra edges, or drop it. Draws three times for every edge."""
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
    """Connection of a module's pins to lines: delivers edges when they are due. Synchronization: one thread."""

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
        """Time of the next output of `step`; None for none."""
        times = [edge.due_ns for edge in self._held[:1]]
        if (next_ns := self._module.next_pin_ns()) is not None:
            times.append(next_ns)
        return min(times, default=None)

    def summary(self) -> dict[str, int]:
        """Counters by name."""
        faults = self._faults.counts if self._faults else {}
        return {"pin_edges": self.edges} | {f"pin_fault_{kind}": count for kind, count in sorted(faults.items())}


def pin_rates(text: str) -> PinFaultRates:
    """Rates from `lose_pulse=0.1,extra=0.01`; names are those of `PinFaultRates`. Raises ValueError."""
    return parse_rates(PinFaultRates, text, " of pins")


def _due_ns(edge: PinEdge) -> int:
    return edge.due_ns
