"""Table: Measurements in and samples out of a `SampleClock`, as rows of device ticks and host time."""

from collections.abc import Iterable
from itertools import pairwise

from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock

Point = tuple[int | None, int]
"""(device ticks, ms of the host since the beginning)."""

MODULUS = 1 << 32
BEGIN_NS = 1_000 * NS_PER_S


def make_clock(*, tick_modulus: int = MODULUS, byte_ns: int = 10_850, hold_ns: int = 0) -> SampleClock:
    """A clock of millisecond ticks behind a UART at 921600 baud."""
    return SampleClock("imu", tick_ns=NS_PER_MS, tick_modulus=tick_modulus, byte_ns=byte_ns, hold_ns=hold_ns)


def message(ticks: int | None, trailing_bytes: int = 0) -> Measurement:
    return Measurement(82, trailing_bytes, ticks)


def feed(clock: SampleClock, points: Iterable[Point]) -> list[Sample]:
    """Samples for (ticks, host ms since the beginning); each message is read 1 ms after it was measured."""
    return [clock.sample(message(ticks), BEGIN_NS + int((ms + 1) * NS_PER_MS), 0) for ticks, ms in points]


def steady(first_tick: int, first_ms: int, count: int, step_ms: int = 10) -> list[Point]:
    return [(first_tick + i * step_ms, first_ms + i * step_ms) for i in range(count)]


def rises(samples: Iterable[Sample]) -> bool:
    """Whether time rises strictly and no sample is dated after its arrival."""
    taken = list(samples)
    return all(a.t_ns < b.t_ns for a, b in pairwise(taken)) and all(s.t_ns <= s.t_rx_ns for s in taken)
