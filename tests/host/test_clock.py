"""Host clocks: exact under preemption, updated after a step, correct while slewed, cheap in between."""

import time
from itertools import pairwise

import pytest

from imud.host.clock import KEPT_NS, READINGS, TOLERANCE_NS, HostClock
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
        self.clock = HostClock(self.monotonic_ns, self.realtime_ns, self.raw_ns)

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
    host = Host()
    begun = host.calls
    first, calls = host.offset_ns(), host.calls
    assert calls - begun == 2 + 4 + 2, "one reading is tight enough; two calls look for a suspend"
    assert abs(first - AHEAD_NS) <= host.clock.error_ns <= 2 * CALL_NS
    for number in range(1, 100):
        host.sleep(NS_PER_MS)
        assert host.offset_ns() == first
        assert host.calls == calls + 2 * number


def test_preemption_at_any_call_shifts_neither_difference() -> None:
    for call in range(1, 4 * READINGS):
        for away_ns in (5 * NS_PER_US, NS_PER_MS, 3 * NS_PER_S):
            host = Host()
            host.preempted = {call: away_ns}
            for _ in range(3):
                assert abs(host.offset_ns() - AHEAD_NS) <= 2 * CALL_NS, (call, away_ns)
                assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS, (call, away_ns)


def test_a_host_that_is_never_undisturbed_gives_the_tightest_of_some_readings() -> None:
    host = Host()
    host.preempted = {call: 10 * NS_PER_US + call * NS_PER_US for call in range(1, 1000)}
    calls = host.calls
    offset_ns = host.offset_ns()
    assert host.calls <= calls + 2 + 4 * READINGS + 2
    assert abs(offset_ns - AHEAD_NS) <= host.clock.error_ns
    host = Host()
    host.preempted = dict.fromkeys(range(1, 10_000), 10 * NS_PER_US)
    host.offset_ns()
    calls = host.calls
    for _ in range(50):  # not every read measures again
        host.sleep(NS_PER_MS)
        host.offset_ns()
    assert host.calls == calls + 2 * 50


@pytest.mark.parametrize("step_ns", [-NS_PER_S, -2 * NS_PER_US, 2 * NS_PER_US, NS_PER_MS, 37 * NS_PER_S])
def test_a_step_of_the_wall_clock_or_a_leap_second_is_seen_by_the_next_reading(step_ns: int) -> None:
    host = Host()
    before = host.offset_ns()
    host.ahead_ns += step_ns
    assert abs(host.offset_ns() - before - step_ns) <= 2 * CALL_NS
    assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS  # the time stamps do not change


def test_a_step_below_the_tolerance_is_seen_within_a_second() -> None:
    host = Host()
    before = host.offset_ns()
    host.ahead_ns += 3 * TOLERANCE_NS // 4
    assert host.offset_ns() == before
    host.sleep(KEPT_NS)
    assert abs(host.offset_ns() - before - 3 * TOLERANCE_NS // 4) <= 2 * CALL_NS


@pytest.mark.parametrize("rate", [20e-6, -500e-6, 500e-6, 83_333e-6, -83_333e-6])
def test_while_the_clocks_are_slewed_utc_stays_and_steering_is_followed(rate: float) -> None:
    host = Host()
    first = host.offset_ns()
    host.rate = rate
    for _ in range(300):
        host.sleep(10 * NS_PER_MS)
        assert abs(host.offset_ns() - first) <= 2 * CALL_NS
        now_ns = host.truth_ns()
        assert abs(host.clock.steady.steady_ns(now_ns) - host.raw) <= TOLERANCE_NS + 4 * CALL_NS
    assert host.clock.steady.rate == pytest.approx(rate, abs=1e-6)


def test_the_kept_difference_does_not_wander_while_it_is_measured_again_and_again() -> None:
    host = Host()
    host.rate = 500e-6
    seen = set()
    for number in range(200):
        host.preempted = {host.calls + number % 7: number % 5 * 100}
        host.sleep(10 * NS_PER_MS)
        seen.add(host.offset_ns())
    assert len(seen) <= 5
    assert all(abs(offset_ns - AHEAD_NS) <= 4 * CALL_NS for offset_ns in seen)


def test_after_a_suspend_and_a_stopped_machine_nothing_moves() -> None:
    host = Host()  # CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW stop together; CLOCK_REALTIME leads by the suspend
    before = host.offset_ns()
    host.ahead_ns += 3600 * NS_PER_S
    assert abs(host.offset_ns() - before - 3600 * NS_PER_S) <= 2 * CALL_NS
    assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS
    host.sleep(3600 * NS_PER_S)  # a host with clocks that run during a suspend
    assert abs(host.offset_ns() - before - 3600 * NS_PER_S) <= 2 * CALL_NS
    assert abs(host.clock.steady.offset_ns) <= 2 * CALL_NS


def test_a_suspend_differs_from_a_step_and_from_a_preemption() -> None:
    host, asleep_ns = Host(), 0
    clock = HostClock(host.monotonic_ns, host.realtime_ns, host.raw_ns, lambda: host.monotonic_ns() + asleep_ns)
    for number in range(1, 30):
        host.preempted = {host.calls + number: 3 * NS_PER_S}
        clock.utc_offset_ns()
        host.ahead_ns += 3600 * NS_PER_S
        clock.utc_offset_ns()
    assert clock.suspends == 0
    for count in (1, 2):
        asleep_ns += 2 * NS_PER_S
        host.ahead_ns += 2 * NS_PER_S
        clock.utc_offset_ns()
        clock.utc_offset_ns()
        assert clock.suspends == count


def test_a_coarse_clock_is_supported() -> None:
    now = [1000 * NS_PER_S]
    clock = HostClock(lambda: now[0], lambda: now[0] + AHEAD_NS, lambda: now[0])
    for _ in range(10):
        assert [clock.utc_offset_ns() for _ in range(3)] == [AHEAD_NS] * 3
        assert clock.steady.steady_ns(now[0]) == now[0]
        now[0] += 4 * NS_PER_MS


def test_without_the_raw_clock_the_monotonic_clock_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_clock: int) -> int:
        raise OSError(22, "Invalid argument")

    assert HostClock().is_steering_seen
    monkeypatch.setattr(time, "clock_gettime_ns", refuse)
    clock = HostClock()
    assert not clock.is_steering_seen
    assert abs(clock.utc_offset_ns() - (time.time_ns() - time.monotonic_ns())) < 60 * NS_PER_S
    assert abs(clock.steady.steady_ns(time.monotonic_ns()) - time.monotonic_ns()) < 60 * NS_PER_S


def test_the_real_clocks() -> None:
    clock = HostClock()
    before_ns = time.time_ns()
    utc_ns = clock.now_ns() + clock.utc_offset_ns()
    assert before_ns - NS_PER_MS < utc_ns < time.time_ns() + 60 * NS_PER_S
    steady = []
    for _ in range(10):
        clock.utc_offset_ns()
        steady.append(clock.steady.steady_ns(clock.now_ns()))
    assert all(a < b for a, b in pairwise(steady))
