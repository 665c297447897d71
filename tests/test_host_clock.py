"""The difference of the host's clocks: exact under preemption, new after a step, cheap in between."""

import time

from imud.host_clock import CHECK_NS, KEPT_NS, READINGS, HostClock
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

AHEAD_NS = 1_795_000_000 * NS_PER_S
CALL_NS = 100


class Host:
    """Two clocks that take their time to be read, and a thread that is preempted between two readings at will."""

    def __init__(self) -> None:
        self.t_ns = 1000 * NS_PER_S
        self.ahead_ns = AHEAD_NS
        self.calls = 0
        self.preempted: dict[int, int] = {}
        """For how long before which call."""
        self.clock = HostClock(self.monotonic_ns, self.realtime_ns)

    def monotonic_ns(self) -> int:
        self.calls += 1
        self.t_ns += CALL_NS + self.preempted.get(self.calls, 0)
        return self.t_ns

    def realtime_ns(self) -> int:
        return self.monotonic_ns() + self.ahead_ns

    def offset_ns(self) -> int:
        """As one who has read the time just now."""
        return self.clock.utc_offset_ns(self.t_ns)


def test_the_first_reading_measures_and_its_error_is_known() -> None:
    host = Host()
    assert abs(host.offset_ns() - AHEAD_NS) <= host.clock.error_ns == CALL_NS


def test_a_kept_difference_costs_one_call_and_does_not_move() -> None:
    host = Host()
    first = host.offset_ns()
    calls = host.calls
    for number in range(1, 100):
        host.t_ns += NS_PER_MS
        assert host.offset_ns() == first
        assert host.calls == calls + number


def test_preemption_at_any_call_does_not_shift_the_difference() -> None:
    for call in range(1, 4 * READINGS):
        for away_ns in (5 * NS_PER_US, NS_PER_MS, 3 * NS_PER_S):
            host = Host()
            host.preempted = {call: away_ns}
            for _ in range(3):
                assert abs(host.offset_ns() - AHEAD_NS) <= CALL_NS, (call, away_ns)


def test_a_host_that_is_never_undisturbed_gives_the_tightest_of_some_readings() -> None:
    host = Host()
    host.preempted = {call: 10 * NS_PER_US + call * NS_PER_US for call in range(1, 1000)}
    offset_ns = host.offset_ns()
    assert host.calls <= 1 + 3 * READINGS
    assert abs(offset_ns - AHEAD_NS) <= host.clock.error_ns


def test_a_step_of_the_wall_clock_is_seen_by_the_next_reading() -> None:
    for step_ns in (-NS_PER_S, -2 * NS_PER_US, CHECK_NS + 1, 37 * NS_PER_S):
        host = Host()
        before = host.offset_ns()
        host.ahead_ns += step_ns
        assert host.offset_ns() == before + step_ns


def test_a_small_step_is_seen_within_a_second() -> None:
    host = Host()
    before = host.offset_ns()
    host.ahead_ns += CHECK_NS // 2
    assert host.offset_ns() == before
    host.t_ns += KEPT_NS
    assert host.offset_ns() == before + CHECK_NS // 2


def test_a_time_read_long_ago_is_no_harm() -> None:
    host = Host()
    host.offset_ns()
    read_ns = host.t_ns
    host.t_ns += 20 * NS_PER_MS
    assert abs(host.clock.utc_offset_ns(read_ns) - AHEAD_NS) <= CALL_NS


def test_the_real_clocks() -> None:
    clock = HostClock()
    before_ns = time.time_ns()
    utc_ns = clock.now_ns() + clock.utc_offset_ns(clock.now_ns())
    assert before_ns - NS_PER_MS < utc_ns < time.time_ns() + NS_PER_MS
