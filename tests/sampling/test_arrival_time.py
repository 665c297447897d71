"""Frames without device time: by arrival time, by pace, by number."""

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.arrival_time import FIRST_SPREAD_NS, ArrivalTime, LinkDelay

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


def test_the_first_frame_has_the_arrival_time() -> None:
    times = ArrivalTime(DELAY, 0, lambda: None)
    assert fed(times, 1) == -DELAY.floor_ns // 2
    assert times.error_ns > FIRST_SPREAD_NS


def off_ns(times: ArrivalTime, late_ns: int, number: int | None = None, *, alone: bool = True) -> int:
    """Return the time from the time stamp of a frame to its arrival at `late_ns`, ns."""
    return late_ns - times.time_stamp(number, late_ns, 82, alone=alone, triggered=False, is_first=False)


def test_a_late_frame_is_time_stamped_by_the_pace() -> None:
    for alone in (True, False):
        times = ArrivalTime(DELAY, 0, lambda: None)
        fed(times, 100, alone=alone)
        late_ns = BEGIN_NS + 100 * PERIOD_NS + 4 * NS_PER_MS
        assert (off_ns(times, late_ns, alone=alone) > 3 * NS_PER_MS) is alone
        times.restart()  # after a missing link, the pace is measured again
        assert off_ns(times, late_ns + 400 * PERIOD_NS, alone=alone) == DELAY.floor_ns // 2


def test_a_number_counts_what_is_missing() -> None:
    times = ArrivalTime(DELAY, 256, lambda: None)
    fed(times, 100, numbered=True)
    late_ns = BEGIN_NS + 102 * PERIOD_NS + 5 * NS_PER_MS
    assert abs(off_ns(times, late_ns, 102) - 5 * NS_PER_MS) < NS_PER_MS
    assert times.missed == 2
