"""Messages without device time: by their arrival, by their pace, by their number."""

from imud.clock.arrival_time import ArrivalTime
from imud.clock.link_delay import FIRST_SPREAD_NS, LinkDelay
from imud.units import NS_PER_MS, NS_PER_S

DELAY = LinkDelay(0, 0)
BEGIN_NS = 1000 * NS_PER_S
PERIOD_NS = 10 * NS_PER_MS


def fed(times: ArrivalTime, count: int, *, numbered: bool = False, alone: bool = True) -> int:
    """The time of the last of so many even arrivals, relative to it."""
    t_ns = 0
    for i in range(count):
        at_ns = BEGIN_NS + i * PERIOD_NS
        t_ns = times.date(
            i % 256 if numbered else None, at_ns, 82, alone=alone, triggered=False, is_first=i == 0
        ) - at_ns  # fmt: skip
    return t_ns


def test_the_first_message_is_dated_by_its_arrival() -> None:
    times = ArrivalTime(DELAY, 0, lambda: None)
    assert fed(times, 1) == -DELAY.floor_ns // 2
    assert times.error_ns > FIRST_SPREAD_NS


def test_a_late_message_is_dated_by_the_pace_of_those_before_unless_others_carry_time() -> None:
    late_ns = BEGIN_NS + 100 * PERIOD_NS + 4 * NS_PER_MS
    for alone in (True, False):
        times = ArrivalTime(DELAY, 0, lambda: None)
        fed(times, 100, alone=alone)
        off_ns = late_ns - times.date(None, late_ns, 82, alone=alone, triggered=False, is_first=False)
        assert (off_ns > 3 * NS_PER_MS) is alone


def test_a_number_counts_what_is_missing() -> None:
    times = ArrivalTime(DELAY, 256, lambda: None)
    fed(times, 100, numbered=True)
    at_ns = BEGIN_NS + 102 * PERIOD_NS
    t_ns = times.date(102, at_ns + 5 * NS_PER_MS, 82, alone=True, triggered=False, is_first=False)
    assert times.missed == 2
    assert abs(t_ns - at_ns) < NS_PER_MS


def test_after_the_link_was_away_the_pace_is_learned_anew() -> None:
    times = ArrivalTime(DELAY, 0, lambda: None)
    fed(times, 100)
    times.restart()
    later_ns = BEGIN_NS + 500 * PERIOD_NS + 4 * NS_PER_MS
    assert times.date(None, later_ns, 82, alone=True, triggered=False, is_first=False) == later_ns - DELAY.floor_ns // 2
