"""Accuracy of the clock on hosts with a slewed CLOCK_MONOTONIC.

The arrival models use steady time, which is the truth. CLOCK_MONOTONIC follows from steady time and changing rates. A
real `HostClock` reads it at each read of the device. With `unseen`, the clock does not know the steering of the host.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from imud.host.clock import UNSTEERED, HostClock
from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import Arrival, ArrivalModel
from tests.bench.clock import TICK_MODULUS, TICK_NS, Point

UTC_AHEAD_NS: Final = 1_795_000_000 * NS_PER_S  # CLOCK_REALTIME minus CLOCK_MONOTONIC
DECODE_NS: Final = 20 * NS_PER_US  # time from the arrival to the clock read
BEGIN_NS: Final = 1000 * NS_PER_S  # steady time at the start


@dataclass(frozen=True, slots=True)
class Steering:
    name: str
    changes: tuple[tuple[float, float], ...] = ()

    def monotonic_ns(self, steady_ns: int) -> int:
        """Return CLOCK_MONOTONIC at a steady time, ns. Both are equal before the first change."""
        moved_ns = 0
        ends = [BEGIN_NS + int(s * NS_PER_S) for s, _ in self.changes[1:]] + [1 << 62]
        for (begin_s, ppm), end_ns in zip(self.changes, ends, strict=False):
            slewed_ns = min(steady_ns, end_ns) - BEGIN_NS - int(begin_s * NS_PER_S)
            if slewed_ns <= 0:
                break
            moved_ns += slewed_ns * round(ppm) // 1_000_000
        return steady_ns + moved_ns


class SteeredHost:
    """Simulated host with a real `HostClock`. `at` sets the present time."""

    def __init__(self, steering: Steering) -> None:
        self.steering = steering
        self.now_ns = BEGIN_NS
        self.ahead_ns = UTC_AHEAD_NS
        self.clock = HostClock(self.monotonic_ns, lambda: self.monotonic_ns() + self.ahead_ns, lambda: self.now_ns)

    def monotonic_ns(self) -> int:
        return self.steering.monotonic_ns(self.now_ns)

    def at(self, steady_ns: int) -> int:
        """Set the present time. Return CLOCK_REALTIME minus CLOCK_MONOTONIC, ns, as the daemon reads it then."""
        self.now_ns = steady_ns
        return self.clock.utc_offset_ns()


class DatedArrival(NamedTuple):
    sample: Sample
    truth_ns: int

    @property
    def point(self) -> Point:
        return Point(self.sample.t_ns - self.truth_ns, self.sample.t_err_ns, True, self.truth_ns)


def clock_on(host: SteeredHost, model: ArrivalModel, *, unseen: bool = False) -> SampleClock:
    return SampleClock(
        "bench", tick_ns=TICK_NS, tick_modulus=TICK_MODULUS, byte_ns=model.byte_ns, hold_ns=model.profile.hold_ns,
        host=UNSTEERED if unseen else host.clock.steady,
    )  # fmt: skip


def date(clock: SampleClock, host: SteeredHost, a: Arrival) -> DatedArrival:
    # the daemon reads the clocks 20 us after the arrival, when it decodes the frame
    offset_ns = host.at(a.t_rx_ns + DECODE_NS)
    monotonic_ns = host.steering.monotonic_ns
    m = Measurement(a.size_bytes, a.trailing_bytes, a.dev_ns // TICK_NS % TICK_MODULUS)
    return DatedArrival(clock.sample(m, monotonic_ns(a.t_rx_ns), offset_ns), monotonic_ns(a.t_ns))


def run(model: ArrivalModel, steering: Steering, count: int, *, unseen: bool = False) -> list[DatedArrival]:
    host = SteeredHost(steering)
    host.at(model.begin_ns)
    clock = clock_on(host, model, unseen=unseen)
    return [date(clock, host, a) for a in model.run(count)]


def rises(dated: Sequence[DatedArrival]) -> bool:
    # time stamps increase, and no time stamp is later than its arrival
    return all(a.sample.t_ns < b.sample.t_ns for a, b in pairwise(dated)) and all(
        d.sample.t_ns <= d.sample.t_rx_ns for d in dated
    )
