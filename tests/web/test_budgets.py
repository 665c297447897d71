"""Turns of the pages, requests of an address, and the CPU time of a coroutine."""

import asyncio

import pytest

from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkLimits
from imud.web.budgets import OPEN_PAGES, MeasuredCall, PageTurns, RequestQueue, WebBudget, WebClock

STOPPED = WebClock(lambda: 0, lambda: 0)
PAGES = 8


async def test_page_has_one_message_per_turn() -> None:
    """A page with one message waits for at most one message of each other page."""
    turns = PageTurns(WebBudget(WorkLimits(turn_replies=1000, second_replies=1000), STOPPED))
    order: list[str] = []

    async def flood(page: str) -> None:
        for _ in range(100):
            await turns.process(page, lambda: order.append(page))

    floods = [asyncio.ensure_future(flood(f"flood {number}")) for number in range(PAGES)]
    await asyncio.sleep(0)
    await turns.process("quiet", lambda: order.append("quiet"))
    assert order.index("quiet") <= 2 * PAGES, order
    for task in floods:
        task.cancel()
    await asyncio.gather(*floods, return_exceptions=True)


async def test_error_of_message_goes_to_its_page() -> None:
    turns = PageTurns(WebBudget(OPEN_PAGES, STOPPED))

    def fail() -> None:
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        await turns.process("a", fail)
    assert await turns.process("a", lambda: None) is False


async def test_coroutine_is_charged_without_its_waits() -> None:
    cpu_ns = 0
    budget = WebBudget(WorkLimits(second_cpu_ns=1000), WebClock(lambda: 0, lambda: cpu_ns))

    async def work() -> str:
        nonlocal cpu_ns
        cpu_ns += 400
        await asyncio.sleep(0)
        cpu_ns += 600
        with pytest.raises(ZeroDivisionError):
            await fail()
        return "done"

    async def fail() -> None:
        await asyncio.sleep(0)
        raise ZeroDivisionError

    async def other() -> None:
        nonlocal cpu_ns
        cpu_ns += 1_000_000  # while the first coroutine waits

    results = await asyncio.gather(MeasuredCall(budget, "a", work()), other())
    assert results[0] == "done"
    assert not budget.has_time("a")
    assert budget.has_time("b")


async def test_measured_coroutine_can_be_cancelled() -> None:
    events: list[str] = []

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            events.append("cancelled")
            raise

    async def run() -> None:
        await MeasuredCall(WebBudget(OPEN_PAGES, STOPPED), "a", work())

    task = asyncio.ensure_future(run())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert events == ["cancelled"]


async def test_requests_wait_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.web.budgets.PAUSE_S", 0.0)
    now_ns = 0

    def advance() -> int:
        nonlocal now_ns
        now_ns += NS_PER_S // 100
        return now_ns

    queue = RequestQueue(WebBudget(WorkLimits(second_replies=2), WebClock(advance, lambda: 0)))
    order: list[int] = []

    async def request(number: int) -> bool:
        has_waited = await queue.wait("a")
        order.append(number)
        return has_waited

    waits = await asyncio.gather(*(request(number) for number in range(6)))
    assert order == [0, 1, 2, 3, 4, 5]
    assert waits[:2] == [False, False]
    assert all(waits[2:])
