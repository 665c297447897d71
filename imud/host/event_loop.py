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

Each callback belongs to a `Scope`: the scope of the code that scheduled it. The selector notes the running descriptor
or alarm, so that code of a reader passes on the scope of this reader.

The end of a hold and the tick of the daemon use an `Alarm`. The selector calls it like a reader. A timer of asyncio
costs a handle and a complete turn of asyncio, about 15,000 instructions.
"""

import asyncio
import logging
import select
import selectors
from collections.abc import Callable, Coroutine, Generator
from contextlib import suppress
from contextvars import Context
from functools import partial
from heapq import heappop, heappush
from itertools import count
from math import inf
from time import monotonic
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

from imud.host.scope import (
    INHERITED,
    INNERMOST,
    OwnedFuture,
    OwnedTask,
    Scope,
    scope_of_error,
    scope_of_report,
)

log = logging.getLogger(__name__)

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

EVENTS_MAX: Final = 256  # maximum number of descriptors in one turn; the next turn handles all others
NO_FD: Final = -1  # in place of the descriptor of a reader: none is running
ALARM_FD: Final = -2  # an alarm is running
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

    __slots__ = ("_alarms", "_handle", "_loop", "due_s", "on_alarm", "scope")

    def __init__(self, owner: AlarmOwner) -> None:
        """Call `owner.on_alarm` in the running loop each time that the alarm is due. The alarm is not set."""
        self.due_s: float | None = None  # time of the loop's clock; None if the alarm is not set
        self.on_alarm = owner.on_alarm
        self._loop = loop = asyncio.get_running_loop()
        self._alarms = loop.alarms if isinstance(loop, SampleLoop) else None
        self.scope = loop.present_scope() if isinstance(loop, SampleLoop) else None
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
        self._scopes: dict[int, Scope] = {}  # scope of each descriptor, also after `remove`: the reader may still run
        self.running_fd = NO_FD  # descriptor of the running reader
        self.running_alarm: Alarm | None = None
        # Descriptors that were removed in the present turn. The kernel may already use the number for another file.
        self._removed: set[int] = set()
        # Heap of due times (`Alarm.set`). An entry is void if the alarm has another due time now.
        self.alarms: list[tuple[float, int, Alarm]] = []
        self._outer: Poller = poller or select.epoll()
        self._poll = self._outer.poll
        self._inner = self.fileno()
        self._outer.register(self._inner, select.EPOLLIN)

    def add(self, fd: int, callback: Callable[[], object], scope: Scope | None = None) -> None:
        """Call `callback` in each turn in which the descriptor is readable, in place of its previous callback."""
        self._readers[fd] = callback
        if scope is not None:
            self._scopes[fd] = scope
        else:
            self._scopes.pop(fd, None)
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
                    self.running_fd = fd
                    try:
                        callback()
                    except BaseException as error:  # noqa: BLE001 - it belongs to the scope of the reader
                        self._failed(callback, error, self._scopes.get(fd))
            now_s = monotonic()
            if due_s <= now_s:  # an alarm that a reader has set rings after the next poll
                self._ring(now_s)
            if found or self.has_news or end_s <= now_s:
                self.running_fd = NO_FD
                return found

    def running_scope(self) -> Scope | None:
        """Return the scope of the running reader or alarm; None if none is running."""
        if self.running_fd == ALARM_FD:
            return self.running_alarm.scope if self.running_alarm is not None else None
        return self._scopes.get(self.running_fd)

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
                self.running_fd, self.running_alarm = ALARM_FD, alarm
                try:
                    alarm.on_alarm()
                except BaseException as error:  # noqa: BLE001 - as for a reader
                    self._failed(alarm.on_alarm, error, alarm.scope)

    def _failed(self, callback: Callable[[], object], error: BaseException, scope: Scope | None) -> None:
        """Report an error of a reader. Without a scope, SystemExit and KeyboardInterrupt end the loop as in asyncio."""
        if scope is None and isinstance(error, SystemExit | KeyboardInterrupt):
            raise error
        self.on_error({"message": f"Exception in reader {callback!r}", "exception": error, "scope": scope})


class SampleLoop(asyncio.SelectorEventLoop):
    """Event loop with cheap readers. A reader runs without a context (contextvars) and without a task.

    Each callback, task and future has the scope of the code that made it."""

    def __init__(self, selector: ReaderSelector | None = None) -> None:
        self._reader_selector = selector or ReaderSelector()
        super().__init__(self._reader_selector)
        self._reader_selector.on_error = self.call_exception_handler

    def call_soon(
        self, callback: Callable[[*Arguments], object], *args: *Arguments, context: Context | None = None
    ) -> asyncio.Handle:
        """Call `callback` with `args` in the next turn."""
        selector = self._reader_selector
        selector.has_news = True
        if context is None:  # `_context`, without its calls
            scope = INNERMOST.scope
            if scope is not None:
                context = scope.context
            elif selector.running_fd != NO_FD:
                context = self._context()
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[[*Arguments], object], *args: *Arguments, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Call `callback` with `args` at a time of the loop's clock; also used by `call_later`."""
        self._reader_selector.has_news = True
        return super().call_at(when, callback, *args, context=context if context is not None else self._context())

    def create_task(
        self,
        coro: Generator[Any, None, T] | Coroutine[Any, Any, T],
        *,
        name: object = None,
        context: Context | None = None,
    ) -> asyncio.Task[T]:
        """Start a task in `context`, or in the scope of the calling code."""
        if context is None:
            outer = self._context()
            context = None if outer is None else outer.copy()
        scope = INHERITED.get() if context is None else context.get(INHERITED)
        if scope is None:
            return super().create_task(coro, name=name, context=context)
        task = OwnedTask(coro, loop=self, name=None if name is None else str(name), context=context)
        task.scope = scope
        return task

    def create_future(self) -> asyncio.Future[Any]:
        """Return a future of the present scope."""
        scope = self.present_scope()
        if scope is None:
            return super().create_future()
        future = OwnedFuture(loop=self)
        future.scope = scope
        return future

    def present_scope(self) -> Scope | None:
        """Return the scope of the running code; None if it belongs to no scope."""
        return INNERMOST.scope or self._reader_selector.running_scope() or INHERITED.get()

    def running_reader_scope(self) -> Scope | None:
        """Return the scope of the running reader or alarm; None if none is running. Any thread may call it."""
        return self._reader_selector.running_scope()

    def _context(self) -> Context | None:
        """Return the context of the innermost scope; None if the present context already has this scope."""
        scope = INNERMOST.scope or self._reader_selector.running_scope()
        return None if scope is None else scope.context

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Report an error to its scope. The handler of the loop receives all other errors."""
        scope = scope_of_report(context)
        error = context.get("exception")
        if scope is None:
            super().call_exception_handler(context)
        elif isinstance(error, BaseException):
            scope.fail(error)
        else:
            log.warning("%s: %s", scope.owner, context.get("message"))

    def run_forever(self) -> None:
        """Run until `stop`. A SystemExit or KeyboardInterrupt in a scope is a failure of its owner, and the loop
        continues. asyncio stops at such an exception, and keeps all other callbacks."""
        while True:
            try:
                super().run_forever()
            except (SystemExit, KeyboardInterrupt) as error:
                scope = scope_of_error(error)
                if scope is None:
                    raise
                scope.fail(error)
            else:
                return

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
        number = _number_of(fd)
        self._reader_selector.add(number, partial(callback, *args) if args else callback, self.present_scope())

    def add_writer(self, fd: Any, callback: Callable[[*Arguments], Any], *args: *Arguments) -> None:
        """Call `callback` with `args` in each turn in which `fd` accepts data."""
        context = self._context()
        if context is None:
            super().add_writer(fd, callback, *args)
        else:
            add: Callable[..., None] = super().add_writer
            context.copy().run(add, fd, callback, *args)

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
