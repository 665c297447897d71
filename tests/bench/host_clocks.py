"""Accuracy of the clock on hosts with a slewed CLOCK_MONOTONIC: `python -m tests.bench.host_clocks` prints the table.

The arrival models use steady time, which is the truth. CLOCK_MONOTONIC follows from steady time and changing rates. A
real `HostClock` reads it at each read of the device. With `--unseen`, the clock does not know the steering of the host.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from imud.host.clock import UNSTEERED, HostClock
from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import BARE_UART, LOADED, USB_16MS, Arrival, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock import BAUD_OF_RATE, TICK_MODULUS, TICK_NS, Accuracy, Point, accuracy

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


STEERINGS: Final = (
    Steering("not steered"),
    Steering("20 ppm, constant", ((-1000, 20),)),
    Steering("500 ppm for 40 s, twice", ((30, 500), (70, -500), (110, 0))),
    Steering("83,333 ppm for 5 s after start", ((2, 83_333), (7, 0))),
    Steering("-83,333 ppm for 5 s", ((80, -83_333), (85, 0))),
    Steering("400 ppm, alternating each second", tuple((s, 400 * (-1) ** s) for s in range(1, 120))),
)


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


def figures(profile: ArrivalProfile, rate_hz: int, steering: Steering, seconds: int, *, unseen: bool) -> Accuracy:
    model = ArrivalModel(profile, rate_hz, 1, Crystal(50.0), BAUD_OF_RATE[rate_hz])
    dated = run(model, steering, rate_hz * seconds, unseen=unseen)
    assert rises(dated)
    return accuracy([d.point for d in dated])


def print_table(*, unseen: bool) -> None:
    print(
        "| host's clock | arrival | rate, Hz | σ, µs | rms, µs | p99.9, µs | mean t_err, µs | in 2 t_err | settling |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for steering in STEERINGS:
        for profile, rate_hz in ((BARE_UART, 100), (USB_16MS, 100), (LOADED, 100), (BARE_UART, 1000)):
            a = figures(profile, rate_hz, steering, 130 if rate_hz == 1000 else 150, unseen=unseen)
            micro = " | ".join(f"{ns / 1000:.0f}" for ns in (a.sigma_ns, a.rms_ns, a.p999_ns, a.mean_t_err_ns))
            print(
                f"| {steering.name} | {profile.name} | {rate_hz} | {micro} | {a.share:.3f} | {a.share_settling:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    print_table(unseen="--unseen" in sys.argv)
