"""Check the rule of `make chaos` that compares the losses of a ledger with the truth, without a daemon or a bus."""

from collections.abc import Sequence

import pytest

from imud.model.sample import Sample, Sync
from tests.lab.chaos.account import KNOWN, Hole, Interval, account, find_holes, sequence_faults

PERIOD_NS = 100_000_000
REMEMBERED = list(range(KNOWN))


def received(numbers: Sequence[int], first_seq: int = 1) -> list[Sample]:
    times = ((seq, number * PERIOD_NS) for seq, number in enumerate(numbers, first_seq))
    return [Sample("imu", seq, t_ns, 1, Sync.ARRIVAL, t_ns + 1, t_ns) for seq, t_ns in times]


def away(begin: float, end: float) -> Interval:
    return Interval(round(begin * PERIOD_NS), round(end * PERIOD_NS))


def restart(begin: float, end: float) -> Interval:
    return away(begin, end)._replace(restarts=True)


COUNTER_KNOWN = ([*REMEMBERED, KNOWN + 4, KNOWN + 5], [away(KNOWN + 0.2, KNOWN + 3.9)])
COUNTER_NEW = ([0, 1, 6, 7], [away(2, 5)])
RESTARTED = ([*REMEMBERED, KNOWN + 4, KNOWN + 5, KNOWN + 8], [restart(KNOWN + 0.2, KNOWN + 3.9)])
TWO_RESTARTS = ([0, 1, 6, 7, 10, 11], [restart(2, 5), restart(8, 9)])


@pytest.mark.parametrize(
    ("case", "unknown", "accepted"),
    [
        (([1, 2, 5, 6, 8], []), 0, {3}), (([1, 2, 5, 6, 8], []), 1, set()), (COUNTER_KNOWN, 0, {4}),
        (COUNTER_KNOWN, 1, set()), (COUNTER_NEW, 0, {3, 4, 5}), (COUNTER_NEW, 1, {0, 1, 2, 3, 4, 5}),
        (COUNTER_NEW, 2, set()), (RESTARTED, 0, {5, 6, 7}), (RESTARTED, 1, {2, 3, 4, 5, 6, 7}),
        (TWO_RESTARTS, 1, set(range(1, 9))), (TWO_RESTARTS, 2, set(range(9))),
    ],
)  # fmt: skip
def test_losses_that_the_rule_accepts(case: tuple[list[int], list[Interval]], unknown: int, accepted: set[int]) -> None:
    numbers, outages = case
    holes = find_holes(received(numbers), numbers, outages)
    assert {lost for lost in range(12) if account(len(numbers), holes, lost, unknown, 0).balanced} == accepted


def test_a_rate_is_learned_from_four_equal_steps_without_a_restart() -> None:
    numbers = [1, 2, 5, 6, 7, 8, 9, 11]
    assert [hole.is_certain for hole in find_holes(received(numbers), numbers, [], learns=True)][1::5] == [False, True]
    numbers = [1, 2, 3, 4, 5, 7, 8]
    assert not find_holes(received(numbers), numbers, [restart(3.1, 3.2)], learns=True)[4].is_certain


def test_a_hole_with_a_sample_on_one_side_may_be_in_the_losses() -> None:
    holes = [Hole(2, True), Hole(3, False, 0, is_open=True)]
    assert [account(9, holes, lost, 0, 1).balanced for lost in (1, 2, 6, 7)] == [False, True, True, False]


def test_faults_of_the_sequence() -> None:
    good = received(range(4, 8), 4)
    assert sequence_faults(good, 4) == []
    assert sequence_faults(good, 3) == ["sample 4 follows 2"]
    assert sequence_faults([good[0], good[2]], 4) == ["sample 6 follows 4"]
    assert "a time stamp does not increase" in sequence_faults(received([9, 9]), 1)
