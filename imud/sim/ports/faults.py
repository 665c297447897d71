"""Faults of bad wires on a stream of bursts, from a seed. The log contains each fault with its kind.

Each kind of fault affects a burst (a frame or a reply) with its own probability. A test can therefore compute the
numbers of damaged frames, lost samples and skipped bytes in the ledger of the receiver.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from inspect import signature
from random import Random
from typing import Final, NamedTuple, TypeVar

from imud.model.units import NS_PER_MS
from imud.sim.ports.uart_wire import heard
from imud.sim.sensor import Burst

R = TypeVar("R")

LOG_MAX: Final = 100_000  # Maximum number of faults in `Faults.log`. The counters have no limit.
INSERT_BYTES_MAX: Final = 16
WRONG_BAUDS: Final = (9600, 115_200, 230_400, 256_000, 460_800, 921_600)


class FaultKind(StrEnum):
    """Kinds of faults."""

    CUT = "cut"  # the end of the burst is missing, at least one byte
    FLIP = "flip"  # one bit is wrong
    DROP = "drop"  # one byte is missing
    INSERT = "insert"  # up to 16 random bytes precede one of its bytes
    DELAY = "delay"  # the burst and all later bursts are late
    UNPLUG = "unplug"  # The port disappears. This burst and the bursts of the next `unplug_ns` are lost.
    WRONG_BAUD = "wrong_baud"  # the burst has another baud rate
    LOSE = "lose"  # the complete burst is missing


_Order = (
    FaultKind.UNPLUG, FaultKind.WRONG_BAUD, FaultKind.CUT, FaultKind.FLIP, FaultKind.DROP, FaultKind.INSERT,
    FaultKind.DELAY, FaultKind.LOSE,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FaultRates:
    """Probability of each fault per burst, 0 to 1, and the duration of lasting faults.

    Raises ValueError for a probability out of range.
    """

    cut: float = 0.0  # probability of `FaultKind.CUT`
    flip: float = 0.0  # probability of `FaultKind.FLIP`
    drop: float = 0.0  # probability of `FaultKind.DROP`
    insert: float = 0.0  # probability of `FaultKind.INSERT`
    delay: float = 0.0  # probability of `FaultKind.DELAY`
    unplug: float = 0.0  # probability of `FaultKind.UNPLUG`
    wrong_baud: float = 0.0  # probability of `FaultKind.WRONG_BAUD`
    lose: float = 0.0  # probability of `FaultKind.LOSE`
    delay_ns: int = 5 * NS_PER_MS  # maximum delay, ns
    unplug_ns: int = 300 * NS_PER_MS  # time until the port appears again, ns

    def __post_init__(self) -> None:
        for kind in FaultKind:
            if not 0.0 <= getattr(self, kind.value) <= 1.0:
                raise ValueError(f"fault {kind.value}: expected a probability 0 … 1, got {getattr(self, kind.value)}")

    def any(self) -> bool:
        """Return whether a fault is possible."""
        return any(getattr(self, kind.value) for kind in FaultKind)


class Fault(NamedTuple):
    """A fault that happened."""

    kind: FaultKind  # kind of the fault
    due_ns: int  # time of the end of the undisturbed burst, ns
    burst: int  # number of the burst, from 0
    sample_ns: int | None  # time of the measurement in the disturbed frame, ns; None for text


class Faults:
    """Injector of faults into bursts. The same seed and the same bursts give the same faults."""

    def __init__(self, seed: int, rates: FaultRates, baud: int = 115_200) -> None:
        self.rates: FaultRates = rates  # probabilities
        self.baud: int = baud  # Baud rate of the device, bit/s. A wrong baud rate is any other rate.
        self.log: list[Fault] = []  # faults in order of time, at most 100,000
        self.counts: Counter[FaultKind] = Counter()  # number of faults of each kind
        self.bursts: int = 0  # number of bursts
        self.bursts_hit: int = 0  # number of changed or lost bursts, without late bursts
        self.unplugged_until_ns: int = 0  # CLOCK_MONOTONIC until which the port is absent
        self._random = Random(seed)
        self._held_until_ns = 0

    def pass_on(self, burst: Burst) -> Burst | None:
        """Return a burst as it arrives; None if it is lost. Bursts keep their order."""
        number, self.bursts = self.bursts, self.bursts + 1
        kinds = self._strike()
        if burst.due_ns < self.unplugged_until_ns:
            self.bursts_hit += 1
            return None
        data, due_ns = burst.data, max(burst.due_ns, self._held_until_ns)
        for kind in kinds:
            self._note(Fault(kind, burst.due_ns, number, burst.sample_ns))
            if kind is FaultKind.UNPLUG:
                self.unplugged_until_ns = burst.due_ns + self.rates.unplug_ns
                self.bursts_hit += 1
                return None
            if kind is FaultKind.DELAY:
                due_ns += self._random.randint(1, self.rates.delay_ns)
                self._held_until_ns = due_ns
            elif data:  # an earlier fault can remove all bytes
                data = self._damaged(kind, data)
        self.bursts_hit += data != burst.data
        return burst._replace(due_ns=due_ns, data=data) if data else None

    def _strike(self) -> list[FaultKind]:
        """Choose the faults of one burst, in the order of their effect. The number of random values is the same for
        each burst.

        The method draws values for losses only if losses are possible, so that seeds of older tests keep their meaning.
        """
        rates, random = self.rates, self._random
        kinds = _Order if rates.lose else _Order[:-1]
        return [kind for kind in kinds if random.random() < getattr(rates, kind.value)]

    def _note(self, fault: Fault) -> None:
        self.counts[fault.kind] += 1
        if len(self.log) < LOG_MAX:
            self.log.append(fault)

    def _damaged(self, kind: FaultKind, data: bytes) -> bytes:
        random = self._random
        at = random.randrange(len(data))
        match kind:
            case FaultKind.CUT:
                data = data[:at]
            case FaultKind.FLIP:
                data = data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :]
            case FaultKind.DROP:
                data = data[:at] + data[at + 1 :]
            case FaultKind.INSERT:
                data = data[:at] + random.randbytes(random.randint(1, INSERT_BYTES_MAX)) + data[at:]
            case FaultKind.LOSE:
                data = b""
            case FaultKind.WRONG_BAUD:
                data = heard(data, random.choice([baud for baud in WRONG_BAUDS if baud != self.baud]), self.baud)
        return data


def rates_from(text: str) -> FaultRates:
    """Return the rates in `flip=0.01,drop=0.002` with the names of `FaultRates`. Raises ValueError."""
    return parse_rates(FaultRates, text)


def parse_rates(kind: Callable[..., R], text: str, where: str = "") -> R:
    """Return a dataclass of rates from `name=number,…`. Raises ValueError with `where` after the name of a fault."""
    known = list(signature(kind).parameters)
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        if name not in known:
            raise ValueError(f"fault {name!r}{where}: expected one of {', '.join(known)}")
        try:
            values[name] = int(value) if name.endswith("_ns") else float(value)
        except ValueError:
            raise ValueError(f"fault {name}{where}: expected a number, got {value!r}") from None
    return kind(**values)
