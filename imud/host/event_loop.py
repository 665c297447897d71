"""The event loop of the daemon: asyncio's, with readers that are called as soon as their descriptors are seen readable.

asyncio makes a handle of each event, queues it, and runs it in a context: for a read of 6 µs that is as much again,
a seventh of all instructions of a sample. Readers (`add_reader`) do without:

    epoll of readers: descriptors ──readable──▶ callback, at once
      └─ asyncio's own epoll: writers, signals, transports ──▶ handles, queued as always

The wait of a turn is that of the outer epoll. So readers come first in every turn, each once; then handles and timers
have theirs. Writers are asyncio's own, also of a descriptor that has a reader.

A turn of asyncio around a wait in which only readers were called is for nothing: no handle is ready and no timer is
due. So the selector waits again itself, until its time is over, until asyncio has an event, or until something was
given to the loop meanwhile: a callback, a timer, `stop`. What another thread or a signal gives is an event: asyncio
writes to a descriptor of its own for it.
"""

import asyncio
import select
import selectors
from collections.abc import Callable, Coroutine
from contextvars import Context
from functools import partial
from math import inf
from time import monotonic
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

EVENTS_MAX: Final = 256
"""Descriptors seen in one turn; those beyond come in the next."""

OnError = Callable[[dict[str, Any]], None]
"""`loop.call_exception_handler`."""


class Poller(Protocol):
    """What is used of `select.epoll`."""

    def register(self, fd: int, eventmask: int, /) -> None:
        """Watch a descriptor. Raises OSError."""
        ...

    def unregister(self, fd: int, /) -> None:
        """Watch it no more. Raises OSError."""
        ...

    def poll(self, timeout: float | None, maxevents: int, /) -> list[tuple[int, int]]:
        """Wait for events, without end for None."""
        ...

    def close(self) -> None:
        """Release the descriptor."""
        ...


class ReaderSelector(selectors.EpollSelector):
    """Selector of asyncio's own descriptors, which calls readers itself. Synchronization: the event loop's thread."""

    def __init__(self, poller: Poller | None = None) -> None:
        """`poller` watches readers and the epoll of asyncio's own; None for one of the kernel."""
        super().__init__()
        self.on_error: OnError | None = None
        self.has_news = False
        """Whether the loop was given something since the wait began: it must have its turn. Set by the loop."""
        self._readers: dict[int, Callable[[], object]] = {}
        self._removed: set[int] = set()
        """Descriptors whose events of the present turn are no longer theirs: the number may be in use again."""
        self._outer: Poller = poller or select.epoll()
        self._poll = self._outer.poll
        self._inner = self.fileno()
        self._outer.register(self._inner, select.EPOLLIN)

    def add(self, fd: int, callback: Callable[[], object]) -> None:
        """Call `callback` in each turn in which the descriptor is readable, in place of the one before."""
        self._readers[fd] = callback
        try:
            self._outer.register(fd, select.EPOLLIN)
        except FileExistsError:
            return

    def remove(self, fd: int) -> bool:
        """Call nothing any more. Returns whether there was a reader; it may be closed already."""
        if self._readers.pop(fd, None) is None:
            return False
        self._removed.add(fd)
        try:
            self._outer.unregister(fd)
        except OSError:  # closed, with which the kernel removed it
            return True
        return True

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait, call the readers whose descriptors are readable, and return asyncio's own events.

        Returns when there are some, when the time is over, and when the loop was given something by a reader.
        """
        found: list[tuple[selectors.SelectorKey, int]] = []
        readers, removed, poll = self._readers, self._removed, self._poll
        if timeout is not None and timeout < 0:
            timeout = 0
        end_s = inf if timeout is None else monotonic() + timeout
        self.has_news = False
        while True:
            if removed:
                removed.clear()
            for fd, _ in poll(timeout, EVENTS_MAX):
                callback = readers.get(fd)
                if callback is None:
                    if fd == self._inner:
                        found = super().select(0)
                elif not removed or fd not in removed:
                    try:
                        callback()
                    except Exception as error:  # noqa: BLE001 - as asyncio does with a handle's
                        self._failed(callback, error)
            if found or self.has_news:
                return found
            if timeout is not None and (timeout := end_s - monotonic()) <= 0:
                return found

    def close(self) -> None:
        """Release both descriptors; may be called twice."""
        self._readers.clear()
        self._outer.close()
        super().close()

    def _failed(self, callback: Callable[[], object], error: Exception) -> None:
        if self.on_error is not None:
            self.on_error({"message": f"Exception in reader {callback!r}", "exception": error})


class SampleLoop(asyncio.SelectorEventLoop):
    """An event loop whose readers cost little. A reader runs in no context (contextvars) and in no task."""

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
        """Call `callback` with `args` at a time of the loop's clock; `call_later` does this too."""
        self._reader_selector.has_news = True
        return super().call_at(when, callback, *args, context=context)

    def stop(self) -> None:
        """End `run_forever` after this turn."""
        self._reader_selector.has_news = True
        super().stop()

    def add_reader(self, fd: Any, callback: Callable[[*Arguments], Any], *args: *Arguments) -> None:
        """Call `callback` with `args` in each turn in which `fd`, a descriptor or a file, is readable or at its end."""
        self._reader_selector.add(_number_of(fd), partial(callback, *args))

    def remove_reader(self, fd: Any) -> bool:
        """Call nothing any more. Returns whether there was a reader, also one of asyncio's own (`sock_recv`, …)."""
        number = _number_of(fd)
        return number >= 0 and (self._reader_selector.remove(number) or super().remove_reader(number))


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end in a `SampleLoop`, as `asyncio.run`."""
    with asyncio.Runner(loop_factory=SampleLoop) as runner:
        return runner.run(main)


def _number_of(fd: Any) -> int:
    """The number of a descriptor, or of a file; -1 for a closed one."""
    return fd if isinstance(fd, int) else int(fd.fileno())
