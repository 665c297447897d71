"""The event loop of the daemon: asyncio's, with readers that are called as soon as their descriptors are seen readable.

asyncio makes a handle of each event, queues it, and runs it in a context: for a read of 6 µs that is as much again,
a seventh of all instructions of a sample. Readers (`add_reader`) do without:

    epoll of readers: descriptors ──readable──▶ callback, at once
      └─ asyncio's own epoll: writers, signals, transports ──▶ handles, queued as always

The wait of a turn is that of the outer epoll. So readers come first in every turn, each once; then handles and timers
have theirs. Writers are asyncio's own, also of a descriptor that has a reader.
"""

import asyncio
import select
import selectors
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, Final, TypeVar, TypeVarTuple

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

EVENTS_MAX: Final = 256
"""Descriptors seen in one turn; those beyond come in the next."""

OnError = Callable[[dict[str, Any]], None]
"""`loop.call_exception_handler`."""


class ReaderSelector(selectors.EpollSelector):
    """Selector of asyncio's own descriptors, which calls readers itself. Synchronization: the event loop's thread."""

    def __init__(self) -> None:
        super().__init__()
        self.on_error: OnError | None = None
        self._readers: dict[int, Callable[[], object]] = {}
        self._removed: set[int] = set()
        """Descriptors whose events of the present turn are no longer theirs: the number may be in use again."""
        self._outer = select.epoll()
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
        """Wait, call the readers whose descriptors are readable, and return asyncio's own events."""
        found: list[tuple[selectors.SelectorKey, int]] = []
        readers, removed = self._readers, self._removed
        if removed:
            removed.clear()
        if timeout is not None and timeout < 0:
            timeout = 0
        for fd, _ in self._outer.poll(timeout, EVENTS_MAX):
            callback = readers.get(fd)
            if callback is None:
                if fd == self._inner:
                    found = super().select(0)
            elif not removed or fd not in removed:
                try:
                    callback()
                except Exception as error:  # noqa: BLE001 - as asyncio does with a handle's
                    self._failed(callback, error)
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
