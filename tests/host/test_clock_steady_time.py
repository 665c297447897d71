"""Conversion between CLOCK_MONOTONIC and steady time: exact at pairs, linear between them, with a correct error."""

from random import Random

import pytest

from imud.host.clock import EVEN_NS, PAIRS_MOST, RATE_NS, UNSTEERED, SteadyTime
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

BEGIN_NS = 700 * NS_PER_S
RAW_NS = 699 * NS_PER_S
"""CLOCK_MONOTONIC_RAW at the start: 1 s behind because of an earlier slew."""
FAST = 83_333e-6


def slewed(rate: float, pairs: int, step_ns: int = 10 * NS_PER_MS) -> SteadyTime:
    """Return a clock that runs `rate` fast from the start, with a pair per step."""
    steady = SteadyTime()
    for i in range(pairs):
        steady.add_pair(BEGIN_NS + int(i * step_ns * (1 + rate)), RAW_NS + i * step_ns)
    return steady


def test_without_pairs_and_with_one_the_two_are_the_same() -> None:
    assert (UNSTEERED.offset_ns, UNSTEERED.rate, UNSTEERED.error_ns(BEGIN_NS)) == (0, 0.0, 0.0)
    assert UNSTEERED.even_from_ns < 0
    steady = SteadyTime()
    steady.add_pair(BEGIN_NS, RAW_NS)
    for at_ns in (BEGIN_NS - NS_PER_S, BEGIN_NS, BEGIN_NS + NS_PER_S):
        for one in (UNSTEERED, steady):
            assert one.steady_ns(at_ns) == one.monotonic_ns(at_ns) == at_ns


def test_offsets_between_before_and_after_pairs() -> None:
    """By hand: 83,333 ppm for a second, pairs every 10 ms; half a step is 5 ms, or 5.416665 ms."""
    steady = slewed(FAST, 101)
    assert steady.monotonic_ns(BEGIN_NS + 5 * NS_PER_MS) == BEGIN_NS + 5_416_665
    assert steady.steady_ns(BEGIN_NS + 5_416_665) == BEGIN_NS + 5 * NS_PER_MS
    assert steady.monotonic_ns(BEGIN_NS + NS_PER_S) == BEGIN_NS + 1_083_333_000
    assert steady.rate == pytest.approx(FAST, rel=1e-6)
    steady = slewed(FAST, 11)
    assert steady.monotonic_ns(BEGIN_NS - 7) == BEGIN_NS - 7
    last_ns = BEGIN_NS + 100 * NS_PER_MS
    assert steady.monotonic_ns(last_ns + 7) == last_ns + 8_333_300 + 7
    assert steady.steady_ns(last_ns + 8_333_300 + 7) == last_ns + 7


def test_both_conversions_are_each_other_s_reverse_and_rise() -> None:
    random, steady = Random(1), SteadyTime()
    monotonic, raw, rate = float(BEGIN_NS), RAW_NS, 0.0
    for _ in range(500):
        rate = random.choice((rate, rate, 0.0, FAST, -FAST, 500e-6))
        step_ns = random.randrange(1000, 20 * NS_PER_MS)
        monotonic, raw = monotonic + step_ns * (1 + rate), raw + step_ns
        steady.add_pair(int(monotonic), raw)
    before = 0
    for at_ns in range(BEGIN_NS, int(monotonic), 777_777):
        there_ns = steady.steady_ns(at_ns)
        assert abs(steady.monotonic_ns(there_ns) - at_ns) <= 2
        assert there_ns > before
        before = there_ns


def test_a_time_at_which_the_offset_was_still_the_old_one_is_a_pair() -> None:
    """The slew started between 0.9 and 1 s, not at 0: it does not change times before 0.9 s."""
    steady = SteadyTime()
    steady.add_pair(BEGIN_NS, RAW_NS)
    steady.add_pair(BEGIN_NS + 1_008_333_300, RAW_NS + NS_PER_S, RAW_NS + 900 * NS_PER_MS)
    assert steady.monotonic_ns(BEGIN_NS + 900 * NS_PER_MS) == BEGIN_NS + 900 * NS_PER_MS
    assert steady.monotonic_ns(BEGIN_NS + 950 * NS_PER_MS) == BEGIN_NS + 950 * NS_PER_MS + 4_166_650
    assert steady.rate == pytest.approx(8_333_300 / NS_PER_S)


def test_the_newest_offset_holds_while_it_was_constant() -> None:
    steady = slewed(20e-6, 101)  # 200 ns per step
    assert abs(steady.monotonic_ns(steady.even_from_ns) - steady.even_from_ns - steady.offset_ns) <= EVEN_NS
    last_ns = BEGIN_NS + NS_PER_S
    assert steady.even_from_ns == last_ns - 5 * 10 * NS_PER_MS
    steady = slewed(FAST, 101)
    assert steady.even_from_ns == last_ns
    steady.add_pair(BEGIN_NS + 2 * NS_PER_S + 83_333_000, RAW_NS + 2 * NS_PER_S)
    assert steady.even_from_ns == last_ns  # the slew has ended


def test_less_exact_pairs_do_not_shorten_the_constant_time() -> None:
    steady = SteadyTime()
    for i in range(100):
        steady.add_pair(BEGIN_NS + i * NS_PER_S + (i % 2) * 3 * NS_PER_US, RAW_NS + i * NS_PER_S, 0, NS_PER_US)
    assert steady.even_from_ns == BEGIN_NS
    steady.add_pair(BEGIN_NS + 100 * NS_PER_S + 4 * NS_PER_US, RAW_NS + 100 * NS_PER_S, 0, NS_PER_US)
    assert steady.even_from_ns == BEGIN_NS + NS_PER_S  # 4 µs after the first pair, 1 µs after the second pair


def test_a_change_of_the_rate_between_two_pairs_is_in_the_error() -> None:
    """The true time is in a triangle above the chord: at most a quarter of the step times the change."""
    steady = slewed(0.0, 5)
    now_ns, raw = BEGIN_NS + 40 * NS_PER_MS, RAW_NS + 40 * NS_PER_MS
    for _ in range(4):
        now_ns, raw = now_ns + int(10 * NS_PER_MS * (1 + FAST)), raw + 10 * NS_PER_MS
        steady.add_pair(now_ns, raw)
    onset_ns = BEGIN_NS + 45 * NS_PER_MS
    assert 100_000 < steady.error_ns(onset_ns) < 300_000
    assert steady.error_ns(BEGIN_NS + 15 * NS_PER_MS) == 0.0
    assert steady.error_ns(BEGIN_NS + 75 * NS_PER_MS) < 10
    assert steady.error_ns(BEGIN_NS - NS_PER_S) == steady.error_ns(BEGIN_NS + NS_PER_S) == 0.0


def test_memory_is_bounded_and_the_rest_stays_correct() -> None:
    steady = slewed(FAST, 2 * PAIRS_MOST + 10, NS_PER_MS)
    last_ns = BEGIN_NS + (2 * PAIRS_MOST + 9) * NS_PER_MS
    for back_ns in (0, 3 * NS_PER_MS // 2, NS_PER_S, RATE_NS):
        steady_ns = last_ns - back_ns
        assert steady.monotonic_ns(steady_ns) == pytest.approx(BEGIN_NS + (steady_ns - BEGIN_NS) * (1 + FAST), abs=2)
    assert steady.monotonic_ns(BEGIN_NS) > BEGIN_NS  # the pair is no longer known
    steady = slewed(FAST, PAIRS_MOST + 1, NS_PER_MS)  # half of the pairs were removed
    oldest_ns = BEGIN_NS + (PAIRS_MOST // 2) * NS_PER_MS
    assert steady.monotonic_ns(oldest_ns) == pytest.approx(BEGIN_NS + (oldest_ns - BEGIN_NS) * (1 + FAST), abs=2)


def test_the_rate_is_that_of_the_last_two_seconds() -> None:
    assert slewed(FAST, 2).rate == pytest.approx(FAST, rel=1e-6)
    steady = slewed(0.0, 3001, NS_PER_MS)
    for ms in range(1, 2001):
        steady.add_pair(
            BEGIN_NS + 3 * NS_PER_S + int(ms * NS_PER_MS * (1 + FAST)), RAW_NS + 3 * NS_PER_S + ms * NS_PER_MS
        )
    assert steady.rate == pytest.approx(FAST, rel=1e-6)
    steady.add_pair(
        BEGIN_NS + 5 * NS_PER_S + int(2 * NS_PER_S * FAST) + 400 * NS_PER_MS, RAW_NS + 5 * NS_PER_S + 400 * NS_PER_MS
    )
    assert steady.rate == pytest.approx(FAST * 0.8, rel=1e-3)


def test_a_clock_that_is_read_faster_than_it_ticks() -> None:
    steady = SteadyTime()
    for i in range(10):
        steady.add_pair(BEGIN_NS, RAW_NS)
        steady.add_pair(BEGIN_NS + i, RAW_NS)
    assert abs(steady.steady_ns(BEGIN_NS) - BEGIN_NS) < 50
    assert abs(steady.offset_ns) < 50
