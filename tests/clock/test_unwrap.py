"""Device time that does not wrap, and is finer than its tick."""

from itertools import pairwise

from imud.clock.unwrap import DeviceTime
from imud.units import NS_PER_MS


def test_it_wraps_any_number_of_times() -> None:
    time = DeviceTime(NS_PER_MS, 1000)
    time.begin(990)
    for i in range(1, 1001):
        time.advance((990 + 10 * i) % 1000)
    assert time.raw_ns == (990 + 10_000) * NS_PER_MS
    assert time.even_ns == time.raw_ns
    assert time.error_ns == 0


def test_a_backward_step_is_a_long_way_forward() -> None:
    """The caller compares it with the host's time; nothing here is signed."""
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(5000)
    assert time.peek_ns(4990) == ((1 << 32) - 10) * NS_PER_MS


def test_an_uneven_rate_becomes_even() -> None:
    """400 Hz in milliseconds: the stamps step 2, 3, 2, 3; the samples 2.5."""
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    even = []
    for i in range(1, 2000):
        time.advance(i * 5 // 2)
        even.append(time.even_ns)
        assert 0 <= time.even_ns - time.raw_ns <= NS_PER_MS
    steps = [b - a for a, b in pairwise(even[1000:])]
    assert max(abs(step - 2_500_000) for step in steps) < 2_000
    assert 0 < time.error_ns < 50_000


def test_two_samples_in_one_tick_are_told_apart() -> None:
    """1 kHz in milliseconds, 100 ppm fast: after 5 s a stamp comes twice."""
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    even = []
    for i in range(1, 14_000):
        time.advance(int(i * 0.9999 + 0.5))
        even.append(time.even_ns)
    assert all(abs(b - a - NS_PER_MS) < 1000 for a, b in pairwise(even[100:]))


def test_a_loss_is_counted_with_the_step() -> None:
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    for i in range(1, 11):
        time.advance(10 * i)
    time.advance(130)
    assert time.missed == 2
    time.begin(0)
    assert time.missed == 0
