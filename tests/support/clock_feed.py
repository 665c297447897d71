"""Measurements for a `SampleClock` and its samples, as rows of device ticks and host time."""

from collections.abc import Iterable
from itertools import pairwise

from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock

Point = tuple[int | None, int]  # device ticks, and host time since the start, ms

MODULUS = 1 << 32
BEGIN_NS = 1_000 * NS_PER_S


def make_clock(*, tick_modulus: int = MODULUS, byte_ns: int = 10_850, hold_ns: int = 0) -> SampleClock:
    """Return a clock with ticks of one millisecond, behind a UART at 921600 baud."""
    return SampleClock("imu", tick_ns=NS_PER_MS, tick_modulus=tick_modulus, byte_ns=byte_ns, hold_ns=hold_ns)


def message(ticks: int | None, trailing_bytes: int = 0) -> Measurement:
    return Measurement(82, trailing_bytes, ticks)


def feed(clock: SampleClock, points: Iterable[Point]) -> list[Sample]:
    """Return the samples of (ticks, host ms since the start). Each frame is read 1 ms after its measurement."""
    return [clock.sample(message(ticks), BEGIN_NS + int((ms + 1) * NS_PER_MS), 0) for ticks, ms in points]


def steady(first_tick: int, first_ms: int, count: int, step_ms: int = 10) -> list[Point]:
    return [(first_tick + i * step_ms, first_ms + i * step_ms) for i in range(count)]


def rises(samples: Iterable[Sample]) -> bool:
    """Return whether the time stamps rise strictly, and none is after the arrival."""
    taken = list(samples)
    return all(a.t_ns < b.t_ns for a, b in pairwise(taken)) and all(s.t_ns <= s.t_rx_ns for s in taken)
