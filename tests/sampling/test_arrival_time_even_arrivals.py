"""Frames without device time at a constant rate: delayed frames, lost samples, another rate, triggers."""

from random import Random

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_time import EvenArrivals, LinkDelay

PERIOD_NS = 10 * NS_PER_MS
BEGIN_NS = 1000 * NS_PER_S
DELAY = LinkDelay(0, 0)


def settled(even: EvenArrivals, count: int = 300) -> int:
    """Arrivals at a constant rate, each up to 100 µs late. Return the due time of the next arrival."""
    random = Random(1)
    for i in range(count):
        even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS + int(random.random() * 100 * NS_PER_US), 0, triggered=False)
    return BEGIN_NS + count * PERIOD_NS


def test_it_is_not_used_before_its_pace_is_known() -> None:
    even = EvenArrivals()
    used = [even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS, 0, triggered=False) for i in range(60)]
    assert not any(used[:40])
    assert used[-1]


def test_delayed_frames_are_time_stamped_by_the_fit() -> None:
    """Frames of two seconds arrive together."""
    even = EvenArrivals()
    due_ns = settled(even)
    read_ns = due_ns + 200 * PERIOD_NS
    for i in range(200):
        assert even.add_arrival(DELAY, read_ns, 0, triggered=False)
        off_ns = even.t_ns - (due_ns + i * PERIOD_NS)
        assert abs(off_ns) < 200 * NS_PER_US
        assert 2 * even.error_ns >= abs(off_ns)


@pytest.mark.parametrize("missing", [1, 2, 40])
def test_lost_samples_are_counted_after_four_frames(missing: int) -> None:
    even = EvenArrivals()
    due_ns = settled(even) + missing * PERIOD_NS
    for i in range(8):
        assert even.add_arrival(DELAY, due_ns + i * PERIOD_NS, 0, triggered=False)
        off_ns = even.t_ns - (due_ns + i * PERIOD_NS)
        assert 2 * even.error_ns >= abs(off_ns)
        if i >= 3:
            assert abs(off_ns) < 200 * NS_PER_US
            assert even.error_ns < 200 * NS_PER_US


def test_a_number_shows_the_loss_at_once() -> None:
    even = EvenArrivals()
    for i in range(300):
        even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS, 1, triggered=False)
    late_ns = BEGIN_NS + 305 * PERIOD_NS
    assert even.add_arrival(DELAY, late_ns + 3 * PERIOD_NS, 6, triggered=False)
    assert abs(even.t_ns - late_ns) < 200 * NS_PER_US
    assert even.error_ns < 200 * NS_PER_US


def test_a_triggered_sample_may_be_as_late_as_it_arrives() -> None:
    even = EvenArrivals()
    due_ns = settled(even)
    assert even.add_arrival(DELAY, due_ns + 4 * NS_PER_MS, 0, triggered=True)
    assert 2 * even.error_ns >= 4 * NS_PER_MS


@pytest.mark.parametrize("period_ns", [5 * NS_PER_MS, 20 * NS_PER_MS])
def test_another_rate_restarts_the_fit(period_ns: int) -> None:
    even = EvenArrivals()
    due_ns = settled(even)
    used = [even.add_arrival(DELAY, due_ns + i * period_ns, 0, triggered=False) for i in range(400)]
    assert not all(used)
    assert used[-1]
    assert abs(even.t_ns - (due_ns + 399 * period_ns)) < 200 * NS_PER_US


def test_arrivals_without_a_pace_keep_the_arrival_time() -> None:
    random, even, t_ns, used = Random(2), EvenArrivals(), BEGIN_NS, 0
    for _ in range(3000):
        t_ns += int(random.expovariate(1 / PERIOD_NS))
        used += even.add_arrival(DELAY, t_ns, 0, triggered=False)
    assert used < 300


def test_an_adapter_that_holds_frames_hides_losses() -> None:
    even = EvenArrivals()
    delay = LinkDelay(0, 16 * NS_PER_MS)
    assert not any(even.add_arrival(delay, BEGIN_NS + i * PERIOD_NS, 0, triggered=False) for i in range(200))
