"""Budgets of the web server: the work that pages and HTTP requests cause in the event loop.

Requests and pages without the token have budgets of their own. They cannot use the CPU time of users with the token.
Over the budget, imud does not read the connection, so that the kernel stops the sender. imud discards nothing.
"""

import asyncio
import logging
from collections import defaultdict
from collections.abc import Awaitable, Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget, WorkLimits

log = logging.getLogger(__name__)

T = TypeVar("T")

# A page acknowledges four times per second, and changes its view when the user clicks. One message needs up to 0.1 ms.
OPEN_PAGES: Final = WorkLimits(second_cpu_ns=10_000_000, second_replies=100)
TOKEN_PAGES: Final = WorkLimits(second_cpu_ns=50_000_000, second_replies=200)
# A page with all its files and first requests needs about 30 ms. One address can have several users.
OPEN_REQUESTS: Final = WorkLimits(second_cpu_ns=50_000_000, second_replies=100)
TOKEN_REQUESTS: Final = WorkLimits(second_cpu_ns=200_000_000, second_replies=250)
PAUSE_S: Final = 0.02
"""Time between two checks of a budget that is used up, s."""
LOG_NS: Final = 60 * NS_PER_S
"""Minimum time between two lines of the log about peers above their budget, ns."""


@dataclass
class WebClock:
    """Clocks of the event loop's thread."""

    now_ns: Callable[[], int]  # CLOCK_MONOTONIC
    cpu_ns: Callable[[], int]  # CPU time of the thread


class WebBudget:
    """Budget of one kind of peers. Synchronization: one event loop."""

    def __init__(self, limits: WorkLimits, clock: WebClock) -> None:
        self.work: Final = WorkBudget(limits, clock.cpu_ns)
        self.clock: Final = clock
        self._log_ns: int | None = None  # time of the last line of the log

    def has_time(self, peer: str) -> bool:
        """Return whether a peer has CPU time left."""
        self.work.start_turn(self.clock.now_ns())
        has_time = self.work.admit(peer)
        self.work.end_turn()
        return has_time

    def take(self, peer: str) -> bool:
        """Return whether a peer has CPU time left and may send one more request."""
        return self.has_time(peer) and self.work.take_reply(peer)

    def measure(self, peer: str, work: Callable[[], T]) -> T:
        """Call a function and charge its CPU time."""
        start_ns = self.clock.cpu_ns()
        try:
            return work()
        finally:
            self.work.charge(peer, self.clock.cpu_ns() - start_ns)

    def report(self, peer: str) -> None:
        """Log a peer that is above its budget, at most one peer per LOG_NS."""
        now_ns = self.clock.now_ns()
        if self._log_ns is None or now_ns - self._log_ns >= LOG_NS:
            self._log_ns = now_ns
            log.warning("%s sends more than imud web processes; %d inputs delayed until now", peer, self.work.refused)


class MeasuredCall(Awaitable[T]):
    """Coroutine whose CPU time is charged to a peer, without the time in which it waits."""

    def __init__(self, budget: WebBudget, peer: str, work: Coroutine[Any, Any, T]) -> None:
        self._budget, self._peer, self._work = budget, peer, work

    def __await__(self) -> Generator[Any, Any, T]:
        error: BaseException | None = None
        while True:
            try:
                waiting = self._budget.measure(self._peer, partial(self._step, error))
            except StopIteration as end:
                result: T = end.value
                return result
            error = None
            try:
                yield waiting
            except BaseException as raised:  # noqa: BLE001  # a cancellation too: the coroutine decides
                error = raised

    def _step(self, error: BaseException | None) -> Any:
        return self._work.send(None) if error is None else self._work.throw(error)


class RequestQueue:
    """Requests wait here until the budget of their address permits them, in their order."""

    def __init__(self, budget: WebBudget) -> None:
        self._budget = budget
        self._queues: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)  # by address
        self._waiting: defaultdict[str, int] = defaultdict(int)

    async def wait(self, peer: str) -> bool:
        """Wait for the budget. Return whether the request had to wait."""
        start_ns = self._budget.clock.now_ns()
        has_waited = False
        self._waiting[peer] += 1
        try:
            async with self._queues[peer]:
                while not self._budget.take(peer):
                    has_waited = True
                    await asyncio.sleep(PAUSE_S)
        finally:
            self._waiting[peer] -= 1
            if not self._waiting[peer]:
                del self._waiting[peer], self._queues[peer]
        if self._budget.clock.now_ns() - start_ns >= NS_PER_S:
            self._budget.report(peer)
        return has_waited


class PageTurns:
    """Messages of the pages: one message of each page per turn, in the order of their arrival."""

    def __init__(self, budget: WebBudget) -> None:
        self.budget: Final = budget
        self._queue: dict[str, tuple[Callable[[], None], asyncio.Future[bool]]] = {}  # by page
        self._delayed_pages: set[str] = set()  # pages whose message the last turn did not process
        self._next_turn: asyncio.Handle | None = None

    async def process(self, page: str, work: Callable[[], None]) -> bool:
        """Call `work` in a turn with budget. Return whether the page had to wait for its budget."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[bool] = loop.create_future()
        self._queue[page] = (work, done)
        if self._next_turn is None:
            self._next_turn = loop.call_soon(self._run_turn)
        try:
            return await done
        finally:
            self._queue.pop(page, None)
            if not self._queue and self._next_turn is not None:
                self._next_turn.cancel()
                self._next_turn = None

    def _run_turn(self) -> None:
        self._next_turn = None
        work = self.budget.work
        delayed_pages: set[str] = set()
        work.start_turn(self.budget.clock.now_ns())
        for page, (process, done) in list(self._queue.items()):
            if not (work.admit(page) and work.take_reply(page)):
                delayed_pages.add(page)
                continue
            del self._queue[page]
            if done.cancelled():  # the page has closed
                continue
            try:
                process()
            except Exception as error:  # noqa: BLE001  # the task of the page raises it
                done.set_exception(error)
            else:
                done.set_result(page in self._delayed_pages)
        work.end_turn()
        self._delayed_pages = delayed_pages
        if self._queue:
            self._next_turn = asyncio.get_running_loop().call_later(PAUSE_S, self._run_turn)
