"""Thread for a polled bus or a trigger line. It sleeps until the next deadline or the next edge of a line.

A worker calls `do_round` of its job, which returns the time of the next sleep. Tests call this method themselves at
times of their choice (`tests/support/event_loops.py`).
"""

import asyncio
import gc
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Protocol, TypeVar

from imud.model.units import NS_PER_S

# Maximum wait for the end of a thread, s. A hanging bus transfer ends at the timeout of the controller, at most 1 s. A
# hanging write to a disk has no timeout: code that shares objects with such a thread must not use them again.
END_LIMIT_S = 5.0

# An SPI read waits for the interpreter twice: at wake-up and after the transfer. Measured at 1 kHz next to a loop that
# computes 2 ms of every 20 ms: with the default of 5 ms, reads start 127 to 149 µs late on average, with 0.3 ms 72 to
# 96 µs. Missed data-ready edges: 0.54 % with 0.5 ms, 0.19 % with 0.3 ms, 0.17 % with 0.2 ms. 0.1 ms costs a quarter
# more CPU time. With 300 silent metrics clients, a scrape delays samples by 4.1 ms (default) or 0.65 ms (0.5 ms).
# Maximum time, s, that a thread runs while another thread waits (sys.setswitchinterval, for the complete process)
SWITCH_INTERVAL_S: Final = 0.0003

SELECT_FDS: Final = 1024  # limit of descriptor numbers for `select` (FD_SETSIZE)

T = TypeVar("T")


def call_in_thread(name: str, function: Callable[[], T]) -> "asyncio.Future[T]":
    """Call a function in a new daemon thread, and return its result or its exception. Needs a running event loop.

    A function that hangs (a silent name server, a file on a dead network disk) delays neither the end of the process
    nor other calls. A thread of the event loop's executor would delay both, because a program cannot cancel the call.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def finish(result: T | None, error: BaseException | None) -> None:
        if future.done():  # the caller no longer waits
            return
        if error is None:
            future.set_result(result)  # type: ignore[arg-type] # without an error, the result has the type T
        else:
            future.set_exception(error)

    def run() -> None:
        result: T | None = None
        problem: BaseException | None = None
        try:
            result = function()
        except BaseException as error:  # noqa: BLE001 - the caller raises the error again
            problem = error
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(finish, result, problem)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future


class Job(Protocol):
    """Work of a thread."""

    def do_round(self) -> int:
        """Do the due work. Return the time until the next call, ns; 0: immediately."""
        ...

    def round_failed(self, error: BaseException) -> None:
        """Process an exception of `do_round`, in the thread. The worker makes no further call."""
        ...


class Worker(Protocol):
    """Caller of `Job.do_round` in a loop, one call at a time."""

    def ring(self) -> None:
        """End the present sleep, or skip the next sleep, because there is work. From any thread."""
        ...

    def end(self) -> bool:
        """Stop calling. Wait up to END_LIMIT_S for the present call and return whether it has ended."""
        ...


class WatchingWorker(Worker, Protocol):
    """Worker with descriptors that can end its sleep."""

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        """End the sleep when a descriptor becomes readable: the thread of the job calls `callback` first. One call
        for all data since the last call; the worker reads no data. Return whether this is possible. From any thread."""
        ...

    def unwatch(self, fd: int) -> None:
        """Remove a descriptor, open or closed. Do nothing if it is not watched."""
        ...


StartWorker = Callable[[str, Job], Worker]  # starts a worker with a name
StartWatchingWorker = Callable[[str, Job], WatchingWorker]


def share_interpreter() -> None:
    """Let a thread give way to other threads after SWITCH_INTERVAL_S. Keep a shorter interval."""
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL_S))


@contextmanager
def rare_garbage_collection(allocations: int) -> Iterator[None]:
    """Run the garbage collector after `allocations` new objects, without the objects that exist now."""
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(allocations)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


class WakeEvent:
    """Wait that another thread can end. The wait of a lock uses CLOCK_MONOTONIC and costs a third of an Event."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def wait(self, seconds: float) -> None:
        """Return after `seconds`, or after a `ring` since the last wait."""
        self._lock.acquire(timeout=seconds)

    def ring(self) -> None:
        """End the present wait, or the next wait. From any thread."""
        with suppress(RuntimeError):  # already ringing
            self._lock.release()


class DescriptorWait:
    """Wait that descriptors can end."""

    def __init__(self) -> None:
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll = select.epoll()
        # EPOLLET: one wake-up per arrival of data, because another thread reads the data
        self._epoll.register(self._bell, select.EPOLLIN | select.EPOLLET)
        self._callbacks: dict[int, Callable[[], None]] = {}

    @property
    def is_usable(self) -> bool:
        """Whether `select` accepts the descriptor; False if about a thousand descriptors are open."""
        return self._epoll.fileno() < SELECT_FDS

    def add(self, fd: int, callback: Callable[[], None]) -> None:
        """Call `callback` in `wait` when data arrives on a descriptor."""
        self._callbacks[fd] = callback
        self._epoll.register(fd, select.EPOLLIN | select.EPOLLET)

    def discard(self, fd: int) -> None:
        """Remove the callback of a descriptor."""
        if self._callbacks.pop(fd, None) is not None:
            with suppress(OSError):  # the kernel removes a closed descriptor itself
                self._epoll.unregister(fd)

    def wait(self, seconds: float) -> None:
        """Return after `seconds`, after data arrived, or after a `ring` since the last wait."""
        # the timeout of select has a resolution of 1 µs, the timeout of epoll 1 ms
        select.select((self._epoll,), (), (), seconds)
        for fd, _ in self._epoll.poll(0):
            callback = self._callbacks.get(fd)
            if callback is not None:
                callback()

    def ring(self) -> None:
        """End the present wait, or the next wait. From any thread."""
        os.eventfd_write(self._bell, 1)

    def close(self) -> None:
        """Release both descriptors."""
        self._callbacks.clear()
        self._epoll.close()
        os.close(self._bell)


class BusThread:
    """Thread that is a `WatchingWorker`."""

    def __init__(self, name: str, job: Job) -> None:
        self._job = job
        self._wake = WakeEvent()
        # Used after the first `watch`. It costs twice as much as a WakeEvent.
        self._descriptors: DescriptorWait | None = None
        self._ended = False
        share_interpreter()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ring(self) -> None:
        """End the present sleep, or skip the next sleep. From any thread."""
        self._wake.ring()
        if self._descriptors is not None:
            self._descriptors.ring()

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        """End the sleep when a descriptor becomes readable."""
        descriptors = self._descriptors or DescriptorWait()
        if not descriptors.is_usable:
            descriptors.close()
            return False
        descriptors.add(fd, callback)
        self._descriptors = descriptors
        self._wake.ring()  # the thread may sleep in the other wait
        return True

    def unwatch(self, fd: int) -> None:
        """Remove a descriptor."""
        if self._descriptors is not None:
            self._descriptors.discard(fd)

    def end(self) -> bool:
        """Stop after the present transfer. A second call does nothing."""
        self._ended = True
        self.ring()
        self._thread.join(END_LIMIT_S)
        descriptors, self._descriptors = self._descriptors, None
        is_over = not self._thread.is_alive()
        if descriptors is not None and is_over:
            descriptors.close()
        return is_over

    def _run(self) -> None:
        _sharpen_timer()
        do_round = self._job.do_round
        try:
            while not self._ended:
                rest_ns = do_round()
                if rest_ns > 0 and not self._ended:
                    (self._descriptors or self._wake).wait(rest_ns / NS_PER_S)
        except BaseException as error:  # noqa: BLE001 - the owner of the job raises the error again
            self._job.round_failed(error)


def _sharpen_timer() -> None:
    """Ask the kernel to wake this thread within 1 µs, not 50 µs. Without the permission, jitter remains."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1", encoding="ascii")
