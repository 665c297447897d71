"""The learned period and what is missing by it."""

from random import Random

import pytest

from imud.clock.gaps import PeriodLearner


def missing(steps: list[int]) -> list[int]:
    """What a new learner makes of each step."""
    learner = PeriodLearner()
    return [learner.step(step) for step in steps]


def test_nothing_is_missing_before_a_period_is_known() -> None:
    assert missing([10, 30, 10, 50, 10]) == [0] * 5


@pytest.mark.parametrize(
    ("step", "lost", "expected"), [(10, 20, 1), (10, 30, 2), (1, 2, 1), (1, 5, 4), (1000, 3000, 2)]
)
def test_a_longer_step_is_a_loss(step: int, lost: int, expected: int) -> None:
    assert missing([step] * 10 + [lost] + [step] * 3)[10:] == [expected, 0, 0, 0]


def test_uneven_ticks_are_no_loss() -> None:
    """400 Hz in milliseconds."""
    learner = PeriodLearner()
    assert [learner.step(2 + i % 2) for i in range(1000)] == [0] * 1000
    assert learner.period_ticks == pytest.approx(2.5, abs=0.01)
    assert learner.step(8) == 2


def test_losses_do_not_blur_an_uneven_rate() -> None:
    """A mean of only what is left is off by a thousandth, and that drags device time through its tick."""
    random = Random(3)
    learner = PeriodLearner()
    ticks, i, found = 0, 0, []
    for _ in range(20_000):
        i += 1
        while random.random() < 0.1:
            i += 1
        ticks, before = i * 5 // 2, ticks
        learner.step(ticks - before)
        found.append(learner.period_ticks)
    assert all(abs(period - 2.5) < 5e-4 for period in found[5000:])


def test_at_a_tick_per_sample_two_may_share_one() -> None:
    """1 kHz in milliseconds, 100 ppm fast: a stamp comes twice after 10 s."""
    learner = PeriodLearner()
    for i in range(10_100):
        learner.step(int(i * 0.9999) - int((i - 1) * 0.9999))
    assert learner.period_ticks == pytest.approx(0.9999, abs=3e-5)


def test_a_slower_rate_is_adopted() -> None:
    learner = PeriodLearner()
    seen = [learner.step(step) for step in [10] * 20 + [20] * 20]
    assert sum(seen) <= 11
    assert learner.period_ticks == 20
    assert learner.step(40) == 1


def test_a_faster_rate_costs_nothing() -> None:
    learner = PeriodLearner()
    assert sum(learner.step(step) for step in [10] * 20 + [1] * 20) == 0
    assert learner.period_ticks == 1
    assert learner.step(10) == 9


def test_losses_among_good_steps_do_not_change_the_period() -> None:
    assert sum(missing([1] * 10 + [2, 1, 3, 1] * 500)) == 500 * 3


def test_repeats_are_ignored() -> None:
    learner = PeriodLearner()
    assert sum(learner.step(step) for step in [10, 0] * 50) == 0
    assert learner.period_ticks == 10


def test_losses_in_the_beginning_leave_no_fraction() -> None:
    learner = PeriodLearner()
    for step in [1, 2, 1, 1] + [1] * 100:
        learner.step(step)
    assert learner.period_ticks == 1
    assert learner.changes == 0


def test_one_of_ten_lost_at_random_is_no_slower_rate() -> None:
    random = Random(1)
    learner = PeriodLearner()
    for _ in range(200_000):
        step = 1
        while random.random() < 0.1:
            step += 1
        learner.step(step)
        assert learner.period_ticks < 2
    assert learner.period_ticks == 1


def test_a_rate_hardly_off_whole_ticks_is_learned_from_its_first_odd_step() -> None:
    learner = PeriodLearner()
    for i in range(4001):
        learner.step(11 if i % 2000 == 1999 else 10)
    assert learner.period_ticks == pytest.approx(10.0005, abs=1e-5)
    assert 0 < learner.changes < 5
