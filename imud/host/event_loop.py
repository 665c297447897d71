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

EVENTS_MAX: Final = 256  # maximum number of descriptors in one turn; the next turn handles all others

OnError = Callable[[dict[str, Any]], None]  # `loop.call_exception_handler`


class Poller(Protocol):
    """The used methods of `select.epoll`."""

    def register(self, fd: int, eventmask: int, /) -> None: ...

    def unregister(self, fd: int, /) -> None: ...

    def poll(self, timeout: float | None, maxevents: int, /) -> list[tuple[int, int]]:
        """Wait for events; None waits without a timeout."""
        ...

    def close(self) -> None: ...


class ReaderSelector(selectors.EpollSelector):
    """Selector for asyncio's descriptors that calls readers itself. Synchronization: the thread of the event loop."""

    def __init__(self, poller: Poller | None = None) -> None:
        """`poller` watches the readers and the epoll of asyncio; None for an epoll of the kernel."""
        super().__init__()
        self.on_error: OnError | None = None
        # Whether the loop received a callback, a timer or `stop` since the wait started. Set by the loop.
        self.has_news = False
        self._readers: dict[int, Callable[[], object]] = {}
        # Descriptors that were removed in the present turn. The kernel may already use the number for another file.
        self._removed: set[int] = set()
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
        try:
            self._outer.unregister(fd)
        except OSError:  # the kernel removes a closed descriptor itself
            return True
        return True

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait, call the readers of all readable descriptors, and return the events of asyncio. Returns at an asyncio
        event, at the timeout, and if a reader gave the loop a callback, a timer or `stop`."""
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
                    except Exception as error:  # noqa: BLE001 - asyncio does the same with the callback of a handle
                        self._failed(callback, error)
            if found or self.has_news:
                return found
            if timeout is not None and (timeout := end_s - monotonic()) <= 0:
                return found

    def close(self) -> None:
        """Release both descriptors. A second call does nothing."""
        self._readers.clear()
        self._outer.close()
        super().close()

    def _failed(self, callback: Callable[[], object], error: Exception) -> None:
        if self.on_error is not None:
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

    def add_reader(self, fd: Any, callback: Callable[[*Arguments], Any], *args: *Arguments) -> None:
        """Call `callback` with `args` in each turn in which `fd`, a descriptor or a file, is readable or at its end."""
        self._reader_selector.add(_number_of(fd), partial(callback, *args))

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
