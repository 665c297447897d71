"""Event loop of the daemon: asyncio with readers that run as soon as their descriptors are readable.

asyncio makes a handle of each event, queues it, and runs it in a context. For a read of 6 µs this doubles the time: a
seventh of all instructions of a sample. Readers (`add_reader`) avoid the handle:

    epoll of readers: descriptors ──readable──▶ callback, immediately
      └─ epoll of asyncio: writers, signals, transports ──▶ handles, queued

Each turn waits on the outer epoll. In every turn each reader runs once, then handles and timers run. asyncio handles
writers, also for a descriptor with a reader.

If a turn only called readers, the selector waits again. An asyncio turn would do nothing: no handle is ready and no
timer is due. The selector returns at its timeout, at an asyncio event, or if a reader gave the loop a callback, a timer
or `stop`. Other threads and signals wake the loop through a descriptor of asyncio.

The end of a hold and the tick of the daemon use an `Alarm`. The selector calls it like a reader. A timer of asyncio
costs a handle and a complete turn of asyncio, about 15,000 instructions.
"""

import asyncio
import select
import selectors
from collections.abc import Callable, Coroutine
from contextlib import suppress
from contextvars import Context
from functools import partial
from heapq import heappop, heappush
from itertools import count
from math import inf
from time import monotonic
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

EVENTS_MAX: Final = 256  # maximum number of descriptors in one turn; the next turn handles all others
_NUMBERS: Final = count()  # numbers of the calls of `Alarm.set`, which make equal due times comparable

OnError = Callable[[dict[str, Any]], None]  # `loop.call_exception_handler`


class Poller(Protocol):
    """The used methods of `select.epoll`."""

    def register(self, fd: int, eventmask: int, /) -> None: ...

    def unregister(self, fd: int, /) -> None: ...

    def poll(self, timeout: float | None, maxevents: int, /) -> list[tuple[int, int]]:
        """Wait for events; None waits without a timeout."""
        ...

    def close(self) -> None: ...


class AlarmOwner(Protocol):
    """Owner of an alarm."""

    def on_alarm(self) -> object:
        """Do the work that is due."""
        ...


class Alarm:
    """A timer that one owner sets again and again. Synchronization: the thread of the event loop."""

    __slots__ = ("_alarms", "_handle", "_loop", "due_s", "on_alarm")

    def __init__(self, owner: AlarmOwner) -> None:
        """Call `owner.on_alarm` in the running loop each time that the alarm is due. The alarm is not set."""
        self.due_s: float | None = None  # time of the loop's clock; None if the alarm is not set
        self.on_alarm = owner.on_alarm
        self._loop = loop = asyncio.get_running_loop()
        self._alarms = loop.alarms if isinstance(loop, SampleLoop) else None
        self._handle: asyncio.TimerHandle | None = None  # timer of a loop that has no alarms

    def set(self, delay_s: float) -> None:
        """Call the owner once after `delay_s`, in place of an earlier `set`."""
        if self._alarms is not None:
            self.due_s = due_s = monotonic() + delay_s
            heappush(self._alarms, (due_s, next(_NUMBERS), self))
            return
        if self._handle is not None:
            self._handle.cancel()
        self.due_s = due_s = self._loop.time() + delay_s
        self._handle = self._loop.call_at(due_s, self._ring)

    def cancel(self) -> None:
        """Do not call the owner. Do nothing if the alarm is not set."""
        self.due_s = None
        if self._handle is not None:
            self._handle.cancel()

    def _ring(self) -> None:
        """Call the owner: the timer of a loop without alarms is due."""
        self.due_s = None
        self.on_alarm()


class ReaderSelector(selectors.EpollSelector):
    """Selector for asyncio's descriptors that calls readers itself. Synchronization: the thread of the event loop."""

    on_error: OnError  # receives the errors of readers and alarms; set by the loop

    def __init__(self, poller: Poller | None = None) -> None:
        """`poller` watches the readers and the epoll of asyncio; None for an epoll of the kernel."""
        super().__init__()
        # Whether the loop received a callback, a timer or `stop` since the wait started. Set by the loop.
        self.has_news = False
        self._readers: dict[int, Callable[[], object]] = {}
        # Descriptors that were removed in the present turn. The kernel may already use the number for another file.
        self._removed: set[int] = set()
        # Heap of due times (`Alarm.set`). An entry is void if the alarm has another due time now.
        self.alarms: list[tuple[float, int, Alarm]] = []
        self._outer: Poller = poller or select.epoll()
        self._poll = self._outer.poll
        self._inner = self.fileno()
        self._outer.register(self._inner, select.EPOLLIN)

    def add(self, fd: int, callback: Callable[[], object]) -> None:
        """Call `callback` in each turn in which the descriptor is readable, in place of its previous callback."""
        self._readers[fd] = callback
        try:
            self._outer.register(fd, select.EPOLLIN)
        except FileExistsError:
            return

    def remove(self, fd: int) -> bool:
        """Remove the reader of a descriptor, open or closed. Return whether a reader existed."""
        if self._readers.pop(fd, None) is None:
            return False
        self._removed.add(fd)
        with suppress(OSError):  # the kernel removes a closed descriptor itself
            self._outer.unregister(fd)
        return True

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait, call the readers of all readable descriptors and the due alarms, and return the events of asyncio.
        Returns at an asyncio event, at the timeout, and if a callback gave the loop a callback, a timer or `stop`."""
        found: list[tuple[selectors.SelectorKey, int]] = []
        readers, removed, poll, alarms = self._readers, self._removed, self._poll, self.alarms
        now_s = monotonic()
        end_s = inf if timeout is None else now_s + timeout
        self.has_news = False
        while True:
            if removed:
                removed.clear()
            due_s = alarms[0][0] if alarms else inf
            wait_s = (due_s if due_s < end_s else end_s) - now_s
            for fd, _ in poll(None if wait_s == inf else wait_s if wait_s > 0 else 0, EVENTS_MAX):
                callback = readers.get(fd)
                if callback is None:
                    if fd == self._inner:
                        found = super().select(0)
                elif not removed or fd not in removed:
                    try:
                        callback()
                    except Exception as error:  # noqa: BLE001 - asyncio does the same with the callback of a handle
                        self._failed(callback, error)
            now_s = monotonic()
            if due_s <= now_s:  # an alarm that a reader has set rings after the next poll
                self._ring(now_s)
            if found or self.has_news or end_s <= now_s:
                return found

    def close(self) -> None:
        """Release both descriptors. A second call does nothing."""
        self._readers.clear()
        self.alarms.clear()
        self._outer.close()
        super().close()

    def _ring(self, now_s: float) -> None:
        """Ring the due alarms. An alarm that is set again rings in a later turn, so that readers are called between."""
        alarms, newest = self.alarms, next(_NUMBERS)
        while alarms and alarms[0][0] <= now_s and alarms[0][1] < newest:
            due_s, _, alarm = heappop(alarms)
            if due_s == alarm.due_s:
                alarm.due_s = None
                try:
                    alarm.on_alarm()
                except Exception as error:  # noqa: BLE001 - as for a reader
                    self._failed(alarm.on_alarm, error)

    def _failed(self, callback: Callable[[], object], error: Exception) -> None:
        self.on_error({"message": f"Exception in reader {callback!r}", "exception": error})


class SampleLoop(asyncio.SelectorEventLoop):
    """Event loop with cheap readers. A reader runs without a context (contextvars) and without a task."""

    def __init__(self, selector: ReaderSelector | None = None) -> None:
        self._reader_selector = selector or ReaderSelector()
        super().__init__(self._reader_selector)
        self._reader_selector.on_error = self.call_exception_handler

    def call_soon(
        self, callback: Callable[[*Arguments], object], *args: *Arguments, context: Context | None = None
    ) -> asyncio.Handle:
        """Call `callback` with `args` in the next turn."""
        self._reader_selector.has_news = True
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[[*Arguments], object], *args: *Arguments, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Call `callback` with `args` at a time of the loop's clock; also used by `call_later`."""
        self._reader_selector.has_news = True
        return super().call_at(when, callback, *args, context=context)

    def stop(self) -> None:
        """End `run_forever` after this turn."""
        self._reader_selector.has_news = True
        super().stop()

    @property
    def alarms(self) -> list[tuple[float, int, Alarm]]:
        """Heap of the alarms."""
        return self._reader_selector.alarms

    def add_reader(self, fd: Any, callback: Callable[[*Arguments], Any], *args: *Arguments) -> None:
        """Call `callback` with `args` in each turn in which `fd`, a descriptor or a file, is readable or at its end."""
        self._reader_selector.add(_number_of(fd), partial(callback, *args) if args else callback)

    def remove_reader(self, fd: Any) -> bool:
        """Remove the reader of a descriptor, also of asyncio itself (`sock_recv`, …). Return whether it existed."""
        number = _number_of(fd)
        return number >= 0 and (self._reader_selector.remove(number) or super().remove_reader(number))


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end in a `SampleLoop`, like `asyncio.run`."""
    with asyncio.Runner(loop_factory=SampleLoop) as runner:
        return runner.run(main)


def _number_of(fd: Any) -> int:
    """Return the number of a descriptor or file; -1 for a closed file."""
    return fd if isinstance(fd, int) else int(fd.fileno())
