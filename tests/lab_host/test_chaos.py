"""The account and the plan of `make chaos`: pure parts, tested without a kernel."""

from imud.sample import Sample, Sync
from tests.lab.chaos.account import Account, Interval, account, sequence_faults
from tests.lab.chaos.faults import PAUSE_S, ROUND_S, all_faults, plan
from tests.lab.chaos.truth import BASE, TruthLog, decoded, encoded, time_key

PERIOD_NS = 100_000_000


def sample(seq: int, number: int, *, t_dev_ns: int | None = None) -> Sample:
    """A sample that was taken at the moment of that number, and arrived right then."""
    t_ns = number * PERIOD_NS
    return Sample("imu", seq, t_ns, 1, Sync.ARRIVAL, t_ns + 1, t_ns, t_dev_ns, encoded(number % BASE**2))


def booked(numbers: list[int], lost: int, *outages: Interval, learns: bool = False) -> Account:
    samples = [sample(seq, number) for seq, number in enumerate(numbers, 1)]
    return account(samples, numbers, lost, outages, learns=learns)


def test_losses_are_the_holes() -> None:
    assert booked([1, 2, 5, 6, 8], 3) == Account(5, 3, 3, 0, 0)
    assert booked([1, 2, 5, 6, 8], 3).balanced
    assert not booked([1, 2, 5, 6, 8], 2).balanced
    assert not booked([1, 2, 5, 6, 8], 4).balanced


def test_a_hole_that_an_outage_touches_does_not_count() -> None:
    away = Interval(2 * PERIOD_NS + 5, 4 * PERIOD_NS)
    assert booked([1, 2, 5, 6, 8], 1, away) == Account(5, 1, 1, 1, 2)
    assert booked([1, 2, 5, 6, 8], 2, away).balanced
    assert not booked([1, 2, 5, 6, 8], 3, away).balanced


def test_a_rate_is_learned_from_four_equal_steps() -> None:
    assert booked([1, 2, 5, 6, 7, 8, 9, 11], 1, learns=True) == Account(8, 1, 1, 0, 2)
    assert booked([1, 2, 5], 0, learns=True).unheard == 2


def test_faults_of_the_sequence() -> None:
    good = [sample(seq, seq) for seq in range(4, 8)]
    assert sequence_faults(good, 4) == []
    assert sequence_faults(good, 3) == ["sample 4 follows 2"]
    assert sequence_faults([good[0], good[2]], 4) == ["sample 6 follows 4"]
    assert "a stamp does not rise" in sequence_faults([sample(4, 9), sample(5, 9)], 4)


def test_a_sample_is_found_by_its_device_time_after_a_restart_too() -> None:
    log = TruthLog(time_key, PERIOD_NS // 3)
    for number in range(10):
        log.add(number * PERIOD_NS, number % 5 * PERIOD_NS)  # restarted after five
    received = [sample(1, 1, t_dev_ns=PERIOD_NS), sample(2, 8, t_dev_ns=3 * PERIOD_NS)]
    strange = sample(3, 9, t_dev_ns=7 * PERIOD_NS)
    assert log.numbers_of([*received, strange]) == [1, 8, None]


def test_an_acceleration_carries_a_number() -> None:
    numbers = [0, 1, BASE - 1, BASE, BASE**2 - 1]
    assert [decoded(sample(1, number)) for number in numbers] == numbers


def test_a_plan_follows_from_its_seed_and_shares_no_resource() -> None:
    faults = all_faults(with_memory=True)
    rounds = list(plan(7, 600.0, faults))
    assert rounds == list(plan(7, 600.0, faults))
    assert rounds != list(plan(8, 600.0, faults))
    assert len(rounds) == 600 / ROUND_S
    assert {item.fault.name for planned in rounds for item in planned} == {fault.name for fault in faults}
    for planned in rounds:
        for number, item in enumerate(planned):
            for later in planned[number + 1 :]:
                if item.fault.resources & later.fault.resources:
                    assert later.begin_s >= item.begin_s + item.lasts_s + PAUSE_S - 1e-9
