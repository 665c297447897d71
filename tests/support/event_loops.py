"""Event loops of tests: one loop per test in real time, and one in simulated time, where hours take milliseconds.

    the loop would sleep until t ──▶ the clock jumps to t ──▶ due callbacks run

The turns of a polled bus also run in the loop (`LoopWorker`), not in a thread as in the daemon. The result is therefore
independent of the load of the host.
"""

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from imud.device.polled_bus import PolledBuses
from imud.host import event_loop
from imud.host.clock import HostClock
from imud.host.threads import Job
from imud.model.units import NS_PER_S

P = ParamSpec("P")
T = TypeVar("T")


def in_loop(test: Callable[P, Coroutine[None, None, None]]) -> Callable[P, None]:

    @wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        event_loop.run(without_readers_left(test(*args, **kwargs)))

    return run


async def without_readers_left(body: Coroutine[Any, Any, T]) -> T:
    result = await body
    loop = asyncio.get_running_loop()
    assert isinstance(loop, event_loop.SampleLoop)
    assert not loop._reader_selector._readers, "a descriptor is still watched"
    assert not timers_left(loop)
    return result


def timers_left(loop: Any) -> list[str]:
    """Return the timers of imud that are neither cancelled nor due. A closed object must not be called again."""
    pending = (timer for timer in loop._scheduled if not timer.cancelled())
    found = [repr(timer) for timer in pending if str(getattr(timer._callback, "__module__", "")).startswith("imud.")]
    return found + [repr(alarm) for due_s, _, alarm in getattr(loop, "alarms", ()) if due_s == alarm.due_s]


DESCRIPTOR_LIMIT_S = 60.0  # maximum real time of a loop that waits only for descriptors, s


UTC_AHEAD_NS = 1_795_000_000 * NS_PER_S  # CLOCK_REALTIME minus CLOCK_MONOTONIC


class VirtualClock:
    def __init__(self, begin_ns: int = 1000 * NS_PER_S) -> None:
        self._now_ns = begin_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance(self, duration_ns: int) -> None:
        assert duration_ns >= 0
        self._now_ns += duration_ns

    def realtime_ns(self) -> int:
        return self._now_ns + UTC_AHEAD_NS

    @property
    def host(self) -> HostClock:
        return HostClock(self.now_ns, self.realtime_ns, self.now_ns)


class _JumpingSelector(selectors.DefaultSelector):
    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            ready = super().select(DESCRIPTOR_LIMIT_S)
            assert ready, "nothing will ever happen any more"
            return ready
        self._clock.advance(round(timeout * NS_PER_S) + 1)
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(_JumpingSelector(clock))
        self._clock = clock

    def time(self) -> float:
        return self._clock.now_ns() / NS_PER_S

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ASYNC109
        await super().shutdown_default_executor()


class LoopWorker:
    """A `Worker` of a bus without a thread. Callbacks of the loop make its turns."""

    def __init__(self, _name: str, job: Job) -> None:
        self._job = job
        self._loop = asyncio.get_running_loop()
        self._next: asyncio.Handle | None = self._loop.call_soon(self._run)

    def ring(self) -> None:
        if self._next is not None:
            self._next.cancel()
            self._next = self._loop.call_soon(self._run)

    def watch(self, _fd: int, _callback: Callable[[], None]) -> bool:
        return False

    def unwatch(self, _fd: int) -> None: ...

    def end(self) -> bool:
        if self._next is not None:
            self._next.cancel()
            self._next = None
        return True

    def _run(self) -> None:
        try:
            rest_ns = self._job.do_round()
        except Exception as error:  # noqa: BLE001 - as in the thread
            self._next = None
            self._job.round_failed(error)
            return
        self._next = self._loop.call_later(rest_ns / NS_PER_S, self._run)


def virtual_buses(clock: VirtualClock) -> PolledBuses:
    return PolledBuses(HostClock(clock.now_ns), LoopWorker)


def run_virtually(clock: VirtualClock, body: Coroutine[Any, Any, None]) -> None:
    """Run `body` to its end. Check that no task or descriptor remains."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(clock)) as runner:
        runner.run(body)
        loop: Any = runner.get_loop()
        watched = {key.fd for key in loop._selector.get_map().values()} - {loop._ssock.fileno()}
        assert not watched, "a descriptor is still watched"
        assert not timers_left(loop)
