"""Host clocks: exact under preemption, updated after a step, correct while slewed, cheap in between.
Conversion between CLOCK_MONOTONIC and steady time: exact at pairs, linear between them, with a correct error."""

import time
from itertools import pairwise
from random import Random

import pytest

from imud.host import clock as host_clock
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

AHEAD_NS = 1_795_000_000 * NS_PER_S
CALL_NS = 100


class Host:
    """Three clocks with a read time, and a thread that can be preempted between two reads."""

    def __init__(self) -> None:
        self.raw = 1000 * NS_PER_S
        self.steered_ns = 0
        self.rate = 0.0
        """Rate error of CLOCK_MONOTONIC."""
        self.ahead_ns = AHEAD_NS
        self.calls = 0
        self.preempted: dict[int, int] = {}
        """Duration of the preemption before each call, ns."""
        self.clock = host_clock.HostClock(self.monotonic_ns, self.realtime_ns, self.raw_ns)

    def sleep(self, ns: int) -> None:
        self.raw += ns
        self.steered_ns += int(self.rate * ns)

    def truth_ns(self) -> int:
        return self.raw + self.steered_ns

    def raw_ns(self) -> int:
        self.calls += 1
        self.sleep(CALL_NS + self.preempted.get(self.calls, 0))
        return self.raw

    def monotonic_ns(self) -> int:
        self.raw_ns()
        return self.truth_ns()

    def realtime_ns(self) -> int:
        return self.monotonic_ns() + self.ahead_ns

    def offset_ns(self) -> int:
        return self.clock.utc_offset_ns()


def test_the_first_reading_measures_and_later_readings_cost_two_calls() -> None:
    for away_ns, readings in ((700, 1), (701, 2)):
        host = Host()
        begun = host.calls
        host.preempted = {begun + 4: away_ns}  # with three calls of 100 ns: 1 µs is tight enough
        first, calls = host.offset_ns(), host.calls
        assert calls - begun == 2 + 4 * readings + 2, "two calls look for a suspend"
        assert abs(first - AHEAD_NS) <= host.clock.error_ns <= 501
        assert (host.clock.kept_utc_offset_ns(), host.clock.kept()) == (first, (first, 0))
        assert abs(host.clock.utc_ns() - host.realtime_ns()) <= 1500
    host, measured = Host(), list[tuple[int, ...]]()
    host.clock.on_measured = lambda *given: measured.append(given)
    first, calls = host.offset_ns(), host.calls
    assert measured == [(1000 * NS_PER_S + 650, 1000 * NS_PER_S + 700, 0)]
    for number in range(1, 100):
        host.sleep(NS_PER_MS)
        assert host.offset_ns() == first
        assert host.calls == calls + 2 * number


def test_preemption_shifts_no_difference_and_a_disturbed_host_gives_the_tightest_of_some_readings() -> None:
    for call in range(1, 20):
        for away_ns in (5 * NS_PER_US, NS_PER_MS, 3 * NS_PER_S):
            host = Host()
            host.preempted = {call: away_ns}
            for _ in range(3):
                assert abs(host.offset_ns() - AHEAD_NS) <= 2 * CALL_NS, (call, away_ns)
                assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS, (call, away_ns)
    host = Host()
    host.preempted = {call: 10 * NS_PER_US + call * NS_PER_US for call in range(1, 1000)}
    calls = host.calls
    offset_ns = host.offset_ns()
    assert host.calls <= calls + 2 + 20 + 2
    assert abs(offset_ns - AHEAD_NS) <= host.clock.error_ns
    host = Host()
    host.preempted = dict.fromkeys(range(1, 10_000), 10 * NS_PER_US)
    host.offset_ns()
    calls = host.calls
    for _ in range(50):  # not every read measures again
        host.sleep(NS_PER_MS)
        host.offset_ns()
    assert host.calls == calls + 2 * 50


@pytest.mark.parametrize(
    "step_ns", [-NS_PER_S, -2 * NS_PER_US, 2 * NS_PER_US, NS_PER_MS, 37 * NS_PER_S, 3600 * NS_PER_S]
)
def test_a_step_a_leap_second_or_a_suspend_is_seen_by_the_next_reading(step_ns: int) -> None:
    """CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW stop together in a suspend; then CLOCK_REALTIME leads by the suspend."""
    host = Host()
    before = host.offset_ns()
    host.ahead_ns += step_ns
    for away_ns in (0, 3600 * NS_PER_S):  # a host with clocks that run during a suspend
        host.sleep(away_ns)
        assert abs(host.offset_ns() - before - step_ns) <= 2 * CALL_NS
        assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS  # the time stamps do not change


def test_the_kept_difference_follows_a_small_step_within_a_second_and_does_not_wander() -> None:
    host = Host()
    before = host.offset_ns()
    host.ahead_ns += 750
    assert host.offset_ns() == before
    host.sleep(NS_PER_S)
    assert abs(host.offset_ns() - before - 750) <= 2 * CALL_NS
    host = Host()
    host.rate = 500e-6
    seen = set()
    for number in range(200):
        host.preempted = {host.calls + number % 7: number % 5 * 100}
        host.sleep(10 * NS_PER_MS)
        seen.add(host.offset_ns())
    assert len(seen) <= 5
    assert all(abs(offset_ns - AHEAD_NS) <= 4 * CALL_NS for offset_ns in seen)


@pytest.mark.parametrize("rate", [20e-6, -500e-6, 500e-6, 83_333e-6, -83_333e-6])
def test_while_the_clocks_are_slewed_utc_stays_and_steering_is_followed(rate: float) -> None:
    host = Host()
    first = host.offset_ns()
    host.rate = rate
    for _ in range(300):
        host.sleep(10 * NS_PER_MS)
        assert abs(host.offset_ns() - first) <= 2 * CALL_NS
        assert abs(host.clock.steady.steady_ns(host.truth_ns()) - host.raw) <= NS_PER_US + 4 * CALL_NS
    assert host.clock.steady.rate == pytest.approx(rate, abs=1e-6)


def test_a_suspend_differs_from_a_step_and_from_a_preemption() -> None:
    host, asleep_ns = Host(), 0
    clock = host_clock.HostClock(
        host.monotonic_ns, host.realtime_ns, host.raw_ns, lambda: host.monotonic_ns() + asleep_ns
    )
    for number in range(1, 30):
        host.preempted = {host.calls + number: 3 * NS_PER_S}
        clock.utc_offset_ns()
        host.ahead_ns += 3600 * NS_PER_S
        clock.utc_offset_ns()
    assert clock.suspends == 0
    for count, slept_ns in ((0, 99 * NS_PER_MS), (1, 101 * NS_PER_MS), (2, 2 * NS_PER_S)):
        asleep_ns += slept_ns
        host.ahead_ns += slept_ns
        clock.utc_offset_ns()
        clock.utc_offset_ns()
        assert clock.suspends == count


def test_a_clock_that_is_read_faster_than_it_ticks() -> None:
    now = [1000 * NS_PER_S]
    clock = host_clock.HostClock(lambda: now[0], lambda: now[0] + AHEAD_NS, lambda: now[0])
    for _ in range(10):
        assert [clock.utc_offset_ns() for _ in range(3)] == [AHEAD_NS] * 3
        assert clock.steady.steady_ns(now[0]) == now[0]
        now[0] += 4 * NS_PER_MS
    steady = host_clock.SteadyTime()
    for i in range(10):
        steady.add_pair(BEGIN_NS, RAW_NS)
        steady.add_pair(BEGIN_NS + i, RAW_NS)
    assert abs(steady.steady_ns(BEGIN_NS) - BEGIN_NS) < 50
    assert abs(steady.offset_ns) < 50


def test_the_real_clocks_with_and_without_the_raw_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_clock: int) -> int:
        raise OSError(22, "Invalid argument")

    assert host_clock.HostClock().is_steering_seen
    monkeypatch.setattr(time, "clock_gettime_ns", refuse)
    clock = host_clock.HostClock()
    assert not clock.is_steering_seen
    assert abs(clock.utc_offset_ns() - (time.time_ns() - time.monotonic_ns())) < 60 * NS_PER_S
    assert abs(clock.steady.steady_ns(time.monotonic_ns()) - time.monotonic_ns()) < 60 * NS_PER_S
    clock = host_clock.HostClock()
    before_ns = time.time_ns()
    utc_ns = clock.now_ns() + clock.utc_offset_ns()
    assert before_ns - NS_PER_MS < utc_ns < time.time_ns() + 60 * NS_PER_S
    steady = []
    for _ in range(10):
        clock.utc_offset_ns()
        steady.append(clock.steady.steady_ns(clock.now_ns()))
    assert all(a < b for a, b in pairwise(steady))


BEGIN_NS = 700 * NS_PER_S
RAW_NS = 699 * NS_PER_S
"""CLOCK_MONOTONIC_RAW at the start: 1 s behind because of an earlier slew."""
FAST = 83_333e-6


def slewed(rate: float, pairs: int, step_ns: int = 10 * NS_PER_MS) -> host_clock.SteadyTime:
    """Return a clock that runs `rate` fast from the start, with a pair per step."""
    steady = host_clock.SteadyTime()
    for i in range(pairs):
        steady.add_pair(BEGIN_NS + int(i * step_ns * (1 + rate)), RAW_NS + i * step_ns)
    return steady


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
    # The slew started between 0.9 and 1 s, not at 0: it does not change times before 0.9 s.
    steady = host_clock.SteadyTime()
    steady.add_pair(BEGIN_NS, RAW_NS)
    steady.add_pair(BEGIN_NS + 1_008_333_300, RAW_NS + NS_PER_S, RAW_NS + 900 * NS_PER_MS)
    assert steady.monotonic_ns(BEGIN_NS + 900 * NS_PER_MS) == BEGIN_NS + 900 * NS_PER_MS
    assert steady.monotonic_ns(BEGIN_NS + 950 * NS_PER_MS) == BEGIN_NS + 950 * NS_PER_MS + 4_166_650
    assert steady.rate == pytest.approx(8_333_300 / NS_PER_S)


def test_both_conversions_are_each_other_s_reverse_and_rise_with_or_without_pairs() -> None:
    random, steady = Random(1), host_clock.SteadyTime()
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
    unsteered = host_clock.UNSTEERED
    assert (unsteered.offset_ns, unsteered.rate, unsteered.error_ns(BEGIN_NS)) == (0, 0.0, 0.0)
    assert unsteered.even_from_ns < 0
    steady = host_clock.SteadyTime()
    steady.add_pair(BEGIN_NS, RAW_NS)
    for at_ns in (BEGIN_NS - NS_PER_S, BEGIN_NS, BEGIN_NS + NS_PER_S):
        for one in (host_clock.UNSTEERED, steady):
            assert one.steady_ns(at_ns) == one.monotonic_ns(at_ns) == at_ns


def test_the_newest_offset_holds_while_it_was_constant() -> None:
    steady = slewed(20e-6, 101)  # 200 ns per step
    assert abs(steady.monotonic_ns(steady.even_from_ns) - steady.even_from_ns - steady.offset_ns) <= NS_PER_US
    last_ns = BEGIN_NS + NS_PER_S
    assert steady.even_from_ns == last_ns - 5 * 10 * NS_PER_MS
    steady = slewed(FAST, 101)
    assert steady.even_from_ns == last_ns
    steady.add_pair(BEGIN_NS + 2 * NS_PER_S + 83_333_000, RAW_NS + 2 * NS_PER_S)
    assert steady.even_from_ns == last_ns  # the slew has ended
    steady = host_clock.SteadyTime()
    for i in range(100):
        steady.add_pair(BEGIN_NS + i * NS_PER_S + (i % 2) * 3 * NS_PER_US, RAW_NS + i * NS_PER_S, 0, NS_PER_US)
    assert steady.even_from_ns == BEGIN_NS
    steady.add_pair(BEGIN_NS + 100 * NS_PER_S + 4 * NS_PER_US, RAW_NS + 100 * NS_PER_S, 0, NS_PER_US)
    assert steady.even_from_ns == BEGIN_NS + NS_PER_S  # 4 µs after the first pair, 1 µs after the second pair


def test_memory_is_bounded_and_the_rest_stays_correct() -> None:
    steady = slewed(FAST, 2 * 4096 + 10, NS_PER_MS)
    last_ns = BEGIN_NS + (2 * 4096 + 9) * NS_PER_MS
    for back_ns in (0, 3 * NS_PER_MS // 2, NS_PER_S, 2 * NS_PER_S):
        steady_ns = last_ns - back_ns
        assert steady.monotonic_ns(steady_ns) == pytest.approx(BEGIN_NS + (steady_ns - BEGIN_NS) * (1 + FAST), abs=2)
    assert slewed(FAST, 4096, NS_PER_MS).monotonic_ns(BEGIN_NS) == BEGIN_NS
    steady = slewed(FAST, 4097, NS_PER_MS)  # half of the pairs were removed
    assert steady.monotonic_ns(BEGIN_NS) > BEGIN_NS  # the pair is no longer known
    oldest_ns = BEGIN_NS + 2048 * NS_PER_MS
    assert steady.monotonic_ns(oldest_ns) == pytest.approx(BEGIN_NS + (oldest_ns - BEGIN_NS) * (1 + FAST), abs=2)


def test_the_rate_is_that_of_the_last_two_seconds_and_its_change_is_in_the_error() -> None:
    assert slewed(FAST, 2).rate == pytest.approx(FAST, rel=1e-6)
    steady = slewed(0.0, 3001, NS_PER_MS)
    for ms in range(1, 2001):
        begin_ns, raw_ns = BEGIN_NS + 3 * NS_PER_S, RAW_NS + 3 * NS_PER_S
        steady.add_pair(begin_ns + int(ms * NS_PER_MS * (1 + FAST)), raw_ns + ms * NS_PER_MS)
    assert steady.rate == pytest.approx(FAST, rel=1e-6)
    later_ns = 5 * NS_PER_S + 400 * NS_PER_MS
    steady.add_pair(BEGIN_NS + later_ns + int(2 * NS_PER_S * FAST), RAW_NS + later_ns)
    assert steady.rate == pytest.approx(FAST * 0.8, rel=1e-3)
    # The true time is in a triangle above the chord: at most a quarter of the step times the change.
    steady = slewed(0.0, 5)
    now_ns, raw = BEGIN_NS + 40 * NS_PER_MS, RAW_NS + 40 * NS_PER_MS
    for _ in range(4):
        now_ns, raw = now_ns + int(10 * NS_PER_MS * (1 + FAST)), raw + 10 * NS_PER_MS
        steady.add_pair(now_ns, raw)
    onset_ns = BEGIN_NS + 45 * NS_PER_MS
    assert steady.error_ns(onset_ns) == pytest.approx(10e6 * FAST / 12**0.5, rel=1e-3), "uniform in the triangle"
    assert steady.error_ns(BEGIN_NS + 15 * NS_PER_MS) == 0.0
    assert steady.error_ns(BEGIN_NS + 75 * NS_PER_MS) < 10
    assert steady.error_ns(BEGIN_NS - NS_PER_S) == steady.error_ns(BEGIN_NS + NS_PER_S) == 0.0
