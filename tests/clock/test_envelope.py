"""The line under the points."""

from random import Random

import pytest

from imud.clock.envelope import BINS, Envelope
from imud.units import NS_PER_MS, NS_PER_S


def laid(slope: float, delay_mean_ns: float, seconds: int, seed: int = 1) -> tuple[Envelope, int]:
    """An envelope under 100 points a second of a line through the origin, and its error at the newest point."""
    random = Random(seed)
    envelope = Envelope(0, 0)
    x = 0
    for i in range(1, 100 * seconds):
        x = i * 10 * NS_PER_MS
        y = int(slope * x + random.expovariate(1 / delay_mean_ns))
        envelope.add(x, y, 0, y - envelope.y_ref - envelope.at(x))
    return envelope, int(envelope.y_ref + envelope.at(x) - slope * x)


@pytest.mark.parametrize("slope", [1.0, 1 / 0.95, 1 / 1.05, 1.00005])
def test_it_lies_where_nothing_was_delayed(slope: float) -> None:
    envelope, off_ns = laid(slope, 1_000_000, 100)
    assert abs(off_ns) < 20_000  # the mean delay is 1 ms
    assert envelope.slope == pytest.approx(slope, abs=1e-6)
    assert envelope.error_ns < 20_000


def test_it_is_young_but_not_wild() -> None:
    envelope, off_ns = laid(1.0, 1_000_000, 1)
    assert abs(off_ns) < 1_000_000
    assert envelope.slope_error > 1e-5


def test_the_window_is_bounded() -> None:
    envelope, _ = laid(1.0, 1_000_000, 200)
    assert 30 * NS_PER_S < envelope.span_ns < (BINS + 2) * NS_PER_S
    assert len(envelope._bins) <= BINS


def test_an_old_minimum_goes() -> None:
    """One impossible early arrival bends the line for no more than a window."""
    envelope = Envelope(0, -5_000_000)
    x = 0
    for i in range(1, 100 * 100):
        x = i * 10 * NS_PER_MS
        envelope.add(x, x, 0, x - envelope.y_ref - envelope.at(x))
    assert abs(envelope.y_ref + envelope.at(x) - x) < 10
