"""The account and the plan of `make chaos`: pure parts, tested without a kernel."""

from collections.abc import Sequence

import msgspec
import pytest

from imud.sample import Sample, Sync
from imud.sim import SIMULATORS
from imud.sim.simulator import Burst, SimulatorOptions
from tests.lab.chaos.account import KNOWN, Account, Hole, Interval, account, find_holes, sequence_faults
from tests.lab.chaos.faults import PAUSE_S, ROUND_S, Fault, Planned, all_faults, plan, play
from tests.lab.chaos.polls import Answer, Asked, LoggedRegisters, PollLog, block_replies
from tests.lab.chaos.truth import BASE, LoggedModule, TruthLog, by_device_time, decoded, encoded, time_key
from tests.lab.wire import Refuse

PERIOD_NS = 100_000_000
REMEMBERED = list(range(KNOWN))
"""Samples after which a counter is known."""


def sample(seq: int, number: int, *, t_dev_ns: int | None = None) -> Sample:
    """A sample that was taken at the moment of that number, and arrived right then."""
    t_ns = number * PERIOD_NS
    return Sample("imu", seq, t_ns, 1, Sync.ARRIVAL, t_ns + 1, t_ns, t_dev_ns, encoded(number % BASE**2))


def received(numbers: Sequence[int]) -> list[Sample]:
    return [sample(seq, number) for seq, number in enumerate(numbers, 1)]


def away(begin: float, end: float, *, restarts: bool = False) -> Interval:
    """An outage between two times in periods."""
    return Interval(round(begin * PERIOD_NS), round(end * PERIOD_NS), restarts)


def booked(numbers: list[int], lost: int, *outages: Interval, unknown: int = 0, learns: bool = False) -> Account:
    holes = find_holes(received(numbers), numbers, outages, learns=learns)
    return account(len(numbers), holes, lost, unknown, len(outages))


def test_losses_are_the_holes() -> None:
    assert booked([1, 2, 5, 6, 8], 3) == Account(5, 3, holes=3, least=3, most=3)
    assert booked([1, 2, 5, 6, 8], 3).balanced
    assert not booked([1, 2, 5, 6, 8], 2).balanced
    assert not booked([1, 2, 5, 6, 8], 4).balanced
    assert not booked([1, 2, 5, 6, 8], 1, unknown=1).balanced


def test_a_device_that_ran_on_while_its_link_was_away_has_lost_exactly_the_samples_of_that_time() -> None:
    numbers = [*REMEMBERED, KNOWN + 4, KNOWN + 5]
    outage = away(KNOWN + 0.2, KNOWN + 3.9)
    assert [booked(numbers, lost, outage).balanced for lost in (0, 3, 4, 5)] == [False, False, True, False]
    assert not booked(numbers, 0, outage, unknown=1).balanced  # its counter was known


def test_before_the_counter_is_known_the_samples_of_an_outage_are_counted_or_a_gap_of_unknown_size() -> None:
    numbers, outage = [0, 1, 6, 7], away(2, 5)
    assert [booked(numbers, lost, outage).balanced for lost in (0, 2, 3, 4, 5, 6)] == [
        False,
        False,
        True,
        True,
        True,
        False,
    ]
    assert [booked(numbers, lost, outage, unknown=1).balanced for lost in (0, 4, 6)] == [True, True, False]
    assert not booked(numbers, 0, outage, unknown=2).balanced


def test_a_restart_is_a_gap_of_unknown_size_and_changes_no_other_loss() -> None:
    numbers = [*REMEMBERED, KNOWN + 4, KNOWN + 5, KNOWN + 8]
    restart = away(KNOWN + 0.2, KNOWN + 3.9, restarts=True)
    assert booked(numbers, 2, restart, unknown=1) == Account(
        KNOWN + 3, 2, holes=6, least=2, most=7, unknown=1, unknown_most=1, outages=1
    )
    assert not booked(numbers, 2, restart).balanced  # neither counted nor unknown
    assert not booked(numbers, 1, restart, unknown=1).balanced
    assert not booked(numbers, 8, restart, unknown=1).balanced


def test_after_a_restart_the_counter_must_become_known_again() -> None:
    restart, outage = away(KNOWN + 0.1, KNOWN + 0.2, restarts=True), away(KNOWN + 2.1, KNOWN + 4.9)
    numbers = [*REMEMBERED, KNOWN, KNOWN + 1, KNOWN + 2, KNOWN + 5]
    assert booked(numbers, 0, restart, outage, unknown=1).balanced
    assert not booked(numbers, 0, outage, unknown=1).balanced


def test_only_the_largest_uncertain_hole_is_covered_by_one_unknown_gap() -> None:
    numbers = [0, 1, 6, 7, 10, 11]
    outages = away(2, 5, restarts=True), away(8, 9, restarts=True)
    assert booked(numbers, 2, *outages, unknown=1).balanced
    assert booked(numbers, 1, *outages, unknown=1).balanced  # within one
    assert not booked(numbers, 0, *outages, unknown=1).balanced
    assert booked(numbers, 0, *outages, unknown=2).balanced


def test_a_rate_is_learned_from_four_equal_steps() -> None:
    numbers = [1, 2, 5, 6, 7, 8, 9, 11]
    assert booked(numbers, 1, unknown=2, learns=True).balanced
    assert booked(numbers, 3, learns=True).balanced
    assert not booked(numbers, 0, unknown=2, learns=True).balanced
    assert not booked(numbers, 1, unknown=3, learns=True).balanced
    assert not booked(numbers, 1, learns=True).balanced


def test_the_step_over_a_restart_is_none_of_the_four() -> None:
    numbers, restart = [1, 2, 3, 4, 5, 7, 8], away(3.1, 3.2, restarts=True)
    assert booked(numbers, 0, restart, unknown=3, learns=True).balanced  # two steps before, and one after, are no rate
    assert booked(numbers, 1, restart, unknown=2, learns=True).balanced


@pytest.mark.parametrize(("unknown_most", "known"), [(0, [True, False, False]), (1, [True, True, False])])
def test_a_hole_with_a_sample_on_one_side_may_be_in_the_losses(unknown_most: int, known: list[bool]) -> None:
    """It is a gap of unknown size only where a sample has ended it."""
    holes = [Hole(2, True), Hole(3, False, unknown_most, is_open=True)]
    assert [account(9, holes, lost, 0, 1).balanced for lost in (1, 2, 6, 7)] == [False, True, True, False]
    assert [account(9, holes, 2, unknown, 1).balanced for unknown in (0, 1, 2)] == known


def polled(*asked: tuple[float, Answer] | tuple[float, Answer, float]) -> PollLog:
    """Transfers at times in periods, and when what they read was renewed; without that it is new."""
    log = PollLog(PERIOD_NS)
    for at, answer, *renewed in asked:
        t_ns = round(at * PERIOD_NS)
        log.add(Asked(t_ns + 1, answer, True, round(renewed[0] * PERIOD_NS) if renewed else t_ns))
    return log


GOOD, DAMAGED = Answer.GOOD, Answer.DAMAGED


def read_at(*times: float) -> list[Sample]:
    """Samples read at times in periods."""
    begun = [round(at * PERIOD_NS) for at in times]
    return [msgspec.structs.replace(sample(seq, 0), t_ns=t_ns, t_rx_ns=t_ns + 2) for seq, t_ns in enumerate(begun, 1)]


def test_deadlines_without_a_sample_are_holes_of_a_polled_device() -> None:
    """A read that waited serves its deadline late, and the next one the newest that passed: one of seven is missing."""
    times = [0, 1, 4.3, 4.4, 5, 6]
    log, samples = polled(*((at, GOOD) for at in times)), read_at(*times)
    numbers = log.numbers_of(samples, [])
    assert numbers == [0, 1, 4, 4, 5, 6]
    assert log.strange(samples) == []
    assert sum(hole.missing for hole in find_holes(samples, numbers, [])) == 1


def test_values_that_were_read_twice_are_no_sample() -> None:
    log = polled((0, GOOD), (1, GOOD, 1), (2, GOOD, 1), (3, GOOD, 1), (4, GOOD))
    assert log.numbers_of(read_at(0, 1, 4), []) == [0, 1, 2]


def test_after_a_trouble_the_deadlines_begin_anew() -> None:
    log = polled((0, GOOD), (1, GOOD), (2, DAMAGED), (3.6, GOOD), (4.6, GOOD))
    samples = read_at(0, 1, 3.6, 4.6)
    troubles = log.troubles(0, 5 * PERIOD_NS)
    assert [round(trouble.begin_ns / PERIOD_NS) for trouble in troubles] == [2]
    numbers = log.numbers_of(samples, troubles)
    assert numbers == [0, 1, 4, 5]
    assert [hole.is_certain for hole in find_holes(samples, numbers, troubles)] == [True, False, True]


def test_a_value_that_is_read_again_where_the_deadlines_begin_is_no_deadline() -> None:
    log = polled((0, GOOD), (1, DAMAGED), (2, DAMAGED), (3, DAMAGED), (3.02, GOOD, 3.01), (3.03, GOOD, 3.01))
    samples = read_at(0, 3.03)
    assert log.numbers_of(samples, log.troubles(0, 5 * PERIOD_NS)) == [0, 3]


def test_a_sample_without_a_good_answer_is_strange() -> None:
    log = polled((0, GOOD), (1, DAMAGED))
    assert log.strange(read_at(0, 1, 2)) == [2, 3]


def test_transfers_are_logged_by_what_the_host_got() -> None:
    registers = LoggedRegisters(PERIOD_NS)
    faults = registers.device.faults

    def answer(transfer: str) -> bytes:
        try:
            return registers.device.i2c([bytes([0x12]), 32])
        except OSError as error:
            raise Refuse(error.errno or 0) from error

    ask = registers.logged(answer, lambda transfer: bool(transfer == "burst"))
    ask("burst")
    ask("identity")
    faults.flips = 1
    ask("burst")
    faults.line = 0xFF
    ask("burst")
    faults.error = 5
    with pytest.raises(Refuse):
        ask("burst")
    asked = registers.log.between(0, 1 << 62)
    assert [(a.answer, a.is_sample) for a in asked] == [
        (GOOD, True), (GOOD, False), (DAMAGED, True), (Answer.ABSENT, True), (Answer.REFUSED, True)
    ]  # fmt: skip
    assert [trouble.begin_ns for trouble in registers.log.troubles(0, 1 << 62)] == [a.t_ns for a in asked[2:]]


def test_replies_with_a_sample_are_logged() -> None:
    log = PollLog(PERIOD_NS)
    add = block_replies(log)
    add(Burst(9, bytes(57), 5), 0)  # address, function, length, 26 registers, CRC
    add(Burst(19, bytes(13), 15), 0)  # a serial number
    add(Burst(29, bytes(57), None), 0)
    assert [asked.measured_ns for asked in log.between(0, 1 << 62)] == [5]


def test_a_module_without_power_takes_no_sample() -> None:
    options = SimulatorOptions(rate_hz=10.0, baud=115200, boot_ms=0, noise="none", skew_ppm=0.0)
    log = TruthLog(time_key, 1)
    module = LoggedModule(SIMULATORS["hipnuc-uart"].make(options, 0), by_device_time(log, PERIOD_NS), 0)
    assert module.advance(PERIOD_NS * 21 // 2)
    taken = len(log)
    module.power_off(PERIOD_NS * 21 // 2)
    assert module.advance(20 * PERIOD_NS) == []
    module.reboot(30 * PERIOD_NS)
    assert len(log) == taken
    module.advance(PERIOD_NS * 81 // 2)
    assert len(log) == 2 * taken


def test_samples_that_a_module_had_no_room_for_are_taken_too() -> None:
    log = TruthLog(time_key, 1)
    add = by_device_time(log, PERIOD_NS)
    for number, power_ns in ((1, 0), (2, 0), (5, 0), (9, 7 * PERIOD_NS)):  # restarted at 7
        add(Burst(0, b"", number * PERIOD_NS, (number * PERIOD_NS - power_ns) // 1_000_000), power_ns)
    add(Burst(0, b"text"), 0)
    taken = [(1, 1), (5, 5), (9, 2)]
    received = [sample(seq, at, t_dev_ns=key * PERIOD_NS) for seq, (at, key) in enumerate(taken, 1)]
    assert log.numbers_of(received) == [0, 4, 5]


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


@pytest.mark.parametrize("late_s", [0.0, 0.5, 4.0])
def test_faults_of_one_resource_follow_each_other_also_where_the_host_is_late(late_s: float) -> None:
    now_s, going, most = 100.0, list[Fault](), 0

    def wait(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    def begin(item: Planned) -> None:
        nonlocal now_s, most
        assert not any(item.fault.resources & fault.resources for fault in going)
        going.append(item.fault)
        most = max(most, len(going))
        now_s += late_s

    for planned in plan(7, 120.0, all_faults(with_memory=True)):
        play(planned, begin, going.remove, lambda: now_s, wait)
        assert not going
    assert most > 1, "faults of several resources go on together"
