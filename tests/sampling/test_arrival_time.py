"""Frames without device time: by arrival time, by pace, by number."""

from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.arrival_time import ArrivalSpread, ArrivalTime, EvenArrivals, LinkDelay, error_parts

FIRST_SPREAD_NS = 2 * NS_PER_MS

DELAY = LinkDelay(0, 0)
BEGIN_NS = 1000 * NS_PER_S
PERIOD_NS = 10 * NS_PER_MS


def fed(times: ArrivalTime, count: int, *, numbered: bool = False, alone: bool = True) -> int:
    """Return the time stamp of the last of `count` even arrivals, relative to its arrival."""
    t_ns = 0
    for i in range(count):
        at_ns = BEGIN_NS + i * PERIOD_NS
        t_ns = times.time_stamp(
            i % 256 if numbered else None, at_ns, 82, alone=alone, triggered=False, is_first=i == 0
        ) - at_ns  # fmt: skip
    return t_ns


def off_ns(times: ArrivalTime, late_ns: int, number: int | None = None, *, alone: bool = True) -> int:
    """Return the time from the time stamp of a frame to its arrival at `late_ns`, ns."""
    return late_ns - times.time_stamp(number, late_ns, 82, alone=alone, triggered=False, is_first=False)


def test_the_first_frame_has_its_arrival_and_later_frames_the_pace_or_the_number() -> None:
    for alone in (True, False):
        times = ArrivalTime(DELAY, 0, lambda: None)
        fed(times, 100, alone=alone)
        late_ns = BEGIN_NS + 100 * PERIOD_NS + 4 * NS_PER_MS
        assert (off_ns(times, late_ns, alone=alone) > 3 * NS_PER_MS) is alone
        times.restart()  # after a missing link, the pace is measured again
        assert off_ns(times, late_ns + 400 * PERIOD_NS, alone=alone) == DELAY.floor_ns // 2
    times = ArrivalTime(DELAY, 0, lambda: None)
    assert fed(times, 1) == -DELAY.floor_ns // 2
    assert times.error_ns > FIRST_SPREAD_NS
    times = ArrivalTime(DELAY, 256, lambda: None)
    fed(times, 100, numbered=True)
    late_ns = BEGIN_NS + 102 * PERIOD_NS + 5 * NS_PER_MS
    assert abs(off_ns(times, late_ns, 102) - 5 * NS_PER_MS) < NS_PER_MS
    assert times.missed == 2


def test_hold_of_a_timer_and_spread_of_even_and_uneven_arrivals() -> None:
    delay = LinkDelay(byte_ns=10_850, hold_ns=16 * NS_PER_MS)
    assert delay.held_ns(0.0, 82) == 16 * NS_PER_MS
    assert delay.held_ns(1e6, 82) == 1e6 - 82 * 10_850
    assert delay.held_ns(1e9, 82) == 16 * NS_PER_MS
    assert delay.held_ns(1e5, 82) == 0.0
    assert LinkDelay(86_805, 0).floor_ns - LinkDelay(0, 0).floor_ns == 4 * 86_805
    even, uneven = ArrivalSpread(), ArrivalSpread()
    assert even.sigma_ns == FIRST_SPREAD_NS
    for i in range(1, 500):
        even.add_arrival(i * 10 * NS_PER_MS)
        uneven.add_arrival(i * 10 * NS_PER_MS + (i % 2) * 4 * NS_PER_MS)
    assert even.sigma_ns < 10_000
    assert abs(even.period_ns - 10 * NS_PER_MS) < 1000
    assert 2 * NS_PER_MS < uneven.sigma_ns < 12 * NS_PER_MS


def settled(even: EvenArrivals, count: int = 300) -> int:
    """Arrivals at a constant rate, each up to 100 µs late. Return the due time of the next arrival."""
    random = Random(1)
    for i in range(count):
        even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS + int(random.random() * 100 * NS_PER_US), 0, triggered=False)
    return BEGIN_NS + count * PERIOD_NS


def test_arrivals_need_a_known_pace() -> None:
    even = EvenArrivals()
    used = [even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS, 0, triggered=False) for i in range(60)]
    assert not any(used[:40])
    assert used[-1]
    random, even, t_ns, used_count = Random(2), EvenArrivals(), BEGIN_NS, 0
    for _ in range(3000):
        t_ns += int(random.expovariate(1 / PERIOD_NS))
        used_count += even.add_arrival(DELAY, t_ns, 0, triggered=False)
    assert used_count < 300
    for late_of_four, is_used in ((1, True), (3, False)):  # the mean lateness is 0.11 and 0.34 periods, the limit 0.25
        even = EvenArrivals()
        for i in range(800):
            late_ns = 45 * PERIOD_NS // 100 * (i % 4 < late_of_four)
            found = even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS + late_ns, 0, triggered=False)
        assert found is is_used
    for hold_ns, is_used in ((PERIOD_NS // 4, True), (PERIOD_NS // 4 + 100, False)):
        even, delay = EvenArrivals(), LinkDelay(0, hold_ns)
        used = [even.add_arrival(delay, BEGIN_NS + i * PERIOD_NS, 0, triggered=False) for i in range(200)]
        assert any(used) is is_used


def test_delayed_numbered_and_triggered_frames_are_time_stamped_by_the_fit() -> None:
    """Frames of two seconds arrive together."""
    even = EvenArrivals()
    due_ns = settled(even)
    read_ns = due_ns + 200 * PERIOD_NS
    for i in range(200):
        assert even.add_arrival(DELAY, read_ns, 0, triggered=False)
        off_ns = even.t_ns - (due_ns + i * PERIOD_NS)
        assert abs(off_ns) < 200 * NS_PER_US
        assert 2 * even.error_ns >= abs(off_ns)
    even = EvenArrivals()
    for i in range(300):
        even.add_arrival(DELAY, BEGIN_NS + i * PERIOD_NS, 1, triggered=False)
    late_ns = BEGIN_NS + 305 * PERIOD_NS
    assert even.add_arrival(DELAY, late_ns + 3 * PERIOD_NS, 6, triggered=False)
    assert abs(even.t_ns - late_ns) < 200 * NS_PER_US
    assert even.error_ns < 200 * NS_PER_US
    even = EvenArrivals()
    due_ns = settled(even)
    assert even.add_arrival(DELAY, due_ns + 4 * NS_PER_MS, 0, triggered=True)
    assert 2 * even.error_ns >= 4 * NS_PER_MS


@pytest.mark.parametrize("missing", [1, 2, 3, 4, 40])
def test_lost_samples_are_counted_after_four_frames(missing: int) -> None:
    even = EvenArrivals()
    due_ns = settled(even) + missing * PERIOD_NS
    for i in range(8):
        assert even.add_arrival(DELAY, due_ns + i * PERIOD_NS, 0, triggered=False)
        off_ns = even.t_ns - (due_ns + i * PERIOD_NS)
        assert 2 * even.error_ns >= abs(off_ns)
        if i == 0:
            assert (abs(off_ns) < 200 * NS_PER_US) is (missing <= 3)
        if i >= 3:
            assert abs(off_ns) < 200 * NS_PER_US
            assert even.error_ns < 200 * NS_PER_US


@pytest.mark.parametrize(("period_ns", "undecided"), [(5 * NS_PER_MS, 1), (20 * NS_PER_MS, 33)])
def test_another_rate_restarts_the_fit(period_ns: int, undecided: int) -> None:
    even = EvenArrivals()
    due_ns = settled(even)
    used = [even.add_arrival(DELAY, due_ns + i * period_ns, 0, triggered=False) for i in range(400)]
    assert used.index(False) == undecided
    assert used[-1]
    assert abs(even.t_ns - (due_ns + 399 * period_ns)) < 200 * NS_PER_US


def test_the_period_outlasts_a_stopped_clock() -> None:
    spread = ArrivalSpread()
    for number in (*range(1, 50), *[49] * 500):
        spread.add_arrival(number * 10 * NS_PER_MS)
    assert 5 * NS_PER_MS < spread.period_ns < 10 * NS_PER_MS


@pytest.mark.parametrize(
    ("sync", "t_err_ns", "fit", "tick_error_ns", "expected"),
    [
        (Sync.EDGE, 4000, None, 0.0, {"pulses": 4000}),
        (Sync.UTC, 9000, None, 0.0, {"utc": 9000}),
        (Sync.ARRIVAL, 700, None, None, {"poll": 700}),
        (Sync.ARRIVAL, 0, None, None, {}),
        # 225 us / sqrt(12) of the link, 2 ms of the spread, the rest of the timer
        (Sync.ARRIVAL, 7_000_000, None, 0.0, {"adapter": 4_935_048, "arrivals": 2_000_000, "link": 64_951}),
        # 1 ms of the timer x sqrt((2 / 12 + 1 / 4) / 3); other: 500 - hypot(30, 64.95 + 372.68) - 5 us
        (
            Sync.REGRESSION, 500_000, SimpleNamespace(error_ns=30_000.0, hidden_ns=1e6), 5_000.0,
            {"adapter": 372_677, "link": 64_951, "other": 56_343, "arrivals": 30_000, "device": 5_000},
        ),
    ],
)  # fmt: skip
def test_causes_of_the_time_stamp_error(
    sync: Sync, t_err_ns: int, fit: Any, tick_error_ns: float | None, expected: dict[str, int]
) -> None:
    parts = error_parts(sync, t_err_ns, LinkDelay(10_850, NS_PER_MS), fit, float(FIRST_SPREAD_NS), tick_error_ns)
    assert [(one.name, one.value_ns) for one in parts] == list(expected.items())
