"""The budget limits CPU time and replies, and names the peer that exceeds it."""

import pytest

from imud.model.units import NS_PER_S
from imud.model.work_budget import EDGE_FACTOR, WorkBudget, WorkLimits

LIMITS = WorkLimits(turn_cpu_ns=1000, second_cpu_ns=2000, turn_replies=3, second_replies=5, peers=4)


class Cpu:
    """CPU clock that a test advances."""

    def __init__(self) -> None:
        self.time_ns = 0

    def __call__(self) -> int:
        return self.time_ns


@pytest.fixture
def cpu() -> Cpu:
    return Cpu()


@pytest.fixture
def budget(cpu: Cpu) -> WorkBudget:
    return WorkBudget(LIMITS, cpu)


def work(budget: WorkBudget, cpu: Cpu, peer: str, step_ns: int, count: int) -> int:
    """Offer `count` inputs that cost `step_ns` each. Return the number of admitted inputs."""
    admitted = 0
    for _ in range(count):
        if budget.admit(peer):
            admitted += 1
            cpu.time_ns += step_ns
    budget.end_turn()
    return admitted


def test_turn_ends_at_its_cpu_time(budget: WorkBudget, cpu: Cpu) -> None:
    budget.start_turn(0)
    assert work(budget, cpu, "a", 300, 100) == 4  # the fourth input starts at 900 ns, before the end of the turn
    assert budget.refused == 96


def test_turn_is_shared_by_all_peers(budget: WorkBudget, cpu: Cpu) -> None:
    budget.start_turn(0)
    admitted = sum(work(budget, cpu, f"peer {number}", 300, 1) for number in range(100))
    assert admitted == 4


def test_second_limits_a_peer_and_refills(budget: WorkBudget, cpu: Cpu) -> None:
    admitted = 0
    for _ in range(10):
        budget.start_turn(0)
        admitted += work(budget, cpu, "a", 1000, 1)
    assert admitted == 2
    budget.start_turn(NS_PER_S // 2)
    assert work(budget, cpu, "a", 1000, 1) == 1
    budget.start_turn(NS_PER_S // 2)
    assert work(budget, cpu, "a", 1000, 1) == 0


def test_other_peer_continues_while_one_is_refused(budget: WorkBudget, cpu: Cpu) -> None:
    for _ in range(5):
        budget.start_turn(0)
        work(budget, cpu, "a", 1000, 1)
    budget.start_turn(0)
    assert work(budget, cpu, "b", 10, 1) == 1


def test_edge_limits_peers_with_new_names(budget: WorkBudget, cpu: Cpu) -> None:
    admitted = 0
    for number in range(100):
        budget.start_turn(0)
        admitted += work(budget, cpu, f"peer {number}", 1000, 1)
    assert admitted == EDGE_FACTOR * 2


def test_replies_of_a_turn_and_of_a_second(budget: WorkBudget) -> None:
    budget.start_turn(0)
    assert [budget.take_reply("a") for _ in range(4)] == [True, True, True, False]
    budget.start_turn(0)
    assert [budget.take_reply("a") for _ in range(3)] == [True, True, False]
    budget.start_turn(NS_PER_S)
    assert budget.take_reply("a")


def test_problem_names_the_peer_for_ten_seconds(budget: WorkBudget, cpu: Cpu) -> None:
    assert budget.problem(0) == ""
    budget.start_turn(0)
    work(budget, cpu, "10.0.0.5", 5000, 2)
    assert budget.problem(10 * NS_PER_S).startswith("10.0.0.5 sends more than imud processes: 1 inputs")
    assert budget.problem(11 * NS_PER_S) == ""


def test_stored_peers_are_limited_and_idle_peers_leave_first(budget: WorkBudget, cpu: Cpu) -> None:
    budget.start_turn(0)
    work(budget, cpu, "busy", 1000, 1)
    for number in range(20):
        budget.start_turn(0)
        work(budget, cpu, f"peer {number}", 0, 1)
    assert len(budget._uses) <= LIMITS.peers
    assert "busy" in budget._uses


def test_clock_that_steps_back_adds_nothing(budget: WorkBudget, cpu: Cpu) -> None:
    budget.start_turn(NS_PER_S)
    work(budget, cpu, "a", 2000, 1)
    budget.start_turn(0)
    assert not budget.admit("a")


def test_turn_is_over_after_its_cpu_time(budget: WorkBudget, cpu: Cpu) -> None:
    budget.start_turn(0)
    assert not budget.is_turn_over
    work(budget, cpu, "a", 600, 3)
    assert budget.is_turn_over
    budget.start_turn(0)
    assert not budget.is_turn_over


def test_debt_of_a_peer_is_one_second(budget: WorkBudget, cpu: Cpu) -> None:
    """A flood costs CPU time although the budget refuses it. The peer can work again one second after the flood."""
    for _ in range(100):
        budget.start_turn(0)
        work(budget, cpu, "a", 1000, 1)
        budget.admit("a")
        cpu.time_ns += 1000  # cost of reading refused input
        budget.end_turn()
    assert budget.is_spent
    budget.start_turn(NS_PER_S * 11 // 10)
    assert not budget.is_spent
    assert budget.admit("a")


def test_charge_of_measured_work(budget: WorkBudget) -> None:
    budget.start_turn(0)
    budget.charge("a", LIMITS.second_cpu_ns)
    assert not budget.admit("a")
    assert budget.admit("b")
    budget.charge("b", EDGE_FACTOR * LIMITS.second_cpu_ns)
    assert not budget.admit("c"), "the peers of the edge together"
