"""Whose latency holds for which device."""

from imud.runtime.latency.budget import MOST_NS, NOBODY, LatencyBudget, Need
from imud.units import NS_PER_MS


class Told:
    """A device, and what it was told."""

    def __init__(self, budget: LatencyBudget, name: str) -> None:
        self.needs: list[Need] = []
        budget.add_device(name, self.needs.append)

    @property
    def now(self) -> tuple[float, str]:
        """Latency in ms, and who asks for it."""
        return self.needs[-1].latency_ns / NS_PER_MS, self.needs[-1].who


def test_the_strictest_of_those_that_concern_a_device_decides() -> None:
    budget = LatencyBudget()
    bow, stern = Told(budget, "bow"), Told(budget, "stern")
    assert bow.needs == [NOBODY]
    budget.ask("shared memory", 5 * NS_PER_MS)
    budget.ask("client 1", 2 * NS_PER_MS, ["stern"])
    budget.ask("client 2", 20 * NS_PER_MS, ["bow", "stern", "gone"])
    assert bow.now == (5, "shared memory")
    assert stern.now == (2, "client 1")
    budget.ask("client 2", 0)
    assert bow.now == stern.now == (0, "client 2")
    budget.release("client 2")
    budget.release("shared memory")
    assert bow.now == (50, "")
    assert stern.now == (2, "client 1")
    assert budget.need("stern") == Need(2 * NS_PER_MS, "client 1")


def test_a_device_is_told_changes_only() -> None:
    budget = LatencyBudget()
    bow = Told(budget, "bow")
    budget.ask("client 1", 5 * NS_PER_MS)
    budget.ask("client 2", 5 * NS_PER_MS)
    budget.ask("client 3", 7 * NS_PER_MS)
    budget.release("client 3")
    budget.release("nobody")
    budget.ask("client 4", 1, ["stern"])
    assert bow.needs == [NOBODY, Need(5 * NS_PER_MS, "client 1")]
    budget.release("client 1")
    assert bow.needs[2:] == [Need(5 * NS_PER_MS, "client 2")]


def test_a_device_that_appears_is_told_what_holds_already() -> None:
    budget = LatencyBudget()
    budget.ask("all", 9 * NS_PER_MS)
    budget.ask("named", 4 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (4, "named")
    assert Told(budget, "stern").now == (9, "all")
    budget.remove_device("bow")
    budget.remove_device("bow")
    budget.ask("named", 3 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (3, "named")


def test_nothing_waits_longer_than_the_most_and_no_latency_is_negative() -> None:
    budget = LatencyBudget()
    bow = Told(budget, "bow")
    budget.ask("patient", 10 * MOST_NS)
    assert bow.needs == [NOBODY]
    budget.ask("hasty", -1)
    assert bow.now == (0, "hasty")
