"""Latency of each device from all requests."""

from random import Random

from imud.device.latency import NOBODY, LatencyBudget, Need
from imud.model.units import NS_PER_MS

MOST_NS = 50 * 10**6


class Told:
    def __init__(self, budget: LatencyBudget, name: str) -> None:
        self.needs: list[Need] = []
        budget.add_device(name, self.needs.append)

    @property
    def now(self) -> tuple[float, str]:
        """Return the latency in ms, and its client."""
        return self.needs[-1].latency_ns / NS_PER_MS, self.needs[-1].who


def test_the_smallest_latency_counts_for_a_device() -> None:
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
    budget = LatencyBudget()
    budget.ask("all", 9 * NS_PER_MS)
    budget.ask("named", 4 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (4, "named")
    assert Told(budget, "stern").now == (9, "all")
    budget.remove_device("bow")
    budget.remove_device("bow")
    budget.ask("named", 3 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (3, "named")


def test_a_device_is_notified_of_changes_within_the_limits() -> None:
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
    budget = LatencyBudget()
    bow = Told(budget, "bow")
    budget.ask("patient", 10 * MOST_NS)
    assert bow.needs == [NOBODY]
    budget.ask("hasty", -1)
    assert bow.now == (0, "hasty")


def test_the_order_of_requests_does_not_matter() -> None:
    random, budget = Random(1), LatencyBudget()
    names = ["bow", "stern", "mast", "gone"]
    devices = {name: Told(budget, name) for name in names[:3]}
    stand: dict[str, tuple[int, list[str] | None]] = {}
    for _ in range(3000):
        who = f"client {random.randrange(12)}"
        if random.random() < 0.4:
            stand.pop(who, None)
            budget.release(who)
        else:
            latency_ns = random.choice([0, 5, 5, 20, 50, 80]) * NS_PER_MS
            wanted = random.choice([None, random.sample(names, random.randrange(1, 4))])
            stand[who] = latency_ns, wanted
            budget.ask(who, latency_ns, wanted)
        for name, device in devices.items():
            needs = [Need(ns, who) for who, (ns, wanted) in stand.items() if wanted is None or name in wanted]
            assert device.needs[-1] == budget.need(name) == min([*needs, NOBODY])


def test_a_withdrawn_request_does_not_visit_other_requests() -> None:
    budget, compared = LatencyBudget(), 0

    class Counted(str):
        __slots__ = ()

        def __lt__(self, other: str) -> bool:
            nonlocal compared
            compared += 1
            return str.__lt__(self, other)

    bow = Told(budget, "bow")
    names = [Counted(f"client {number:04}") for number in range(1000)]
    for name in names:
        budget.ask(name, 0, ["bow"])
    for name in names:
        budget.release(name)
    assert bow.now == (50, "")
    assert compared < 1000 * 2 * 40, "a search of the list for each, and no more"
