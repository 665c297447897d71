"""A thread that sleeps from one deadline, or edge of a line, to the next: for a polled bus, or a trigger line.

A worker calls a function that returns how long it may sleep; tests call that function themselves, at times they choose
(`tests/support/virtual_time.py`).
"""

import gc
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Protocol

from imud.model.units import NS_PER_S

END_LIMIT_S = 5.0
"""A transfer on a bus that hangs ends with the controller's own time-out, of one second at most. A write to a disk that
hangs has none: whoever shares something with such a call leaves it alone."""

SWITCH_INTERVAL_S: Final = 0.0003
"""After so long a thread lets another one run that waits (sys.setswitchinterval, for the whole process). A read of an
SPI bus waits for the interpreter twice, when its thread wakes and after the transfer. Measured at 1 kHz beside a loop
that computes 2 ms of every 20 ms, three times 8 s of each in turns: with the usual 5 ms reads begin 127 to 149 µs late
on average, with 0.5 or 0.3 ms 72 to 96 µs. Of data-ready edges 0.54 % were missed with 0.5 ms, because two waits and
the transfer are longer than a period, 0.19 % with 0.3 ms, 0.17 % with 0.2 ms; 0.1 ms costs a quarter more CPU. A scrape
of the metrics (`scrape_server`) keeps samples waiting for 4.1 ms with the usual value and 300 silent clients, for
0.65 ms with 0.5 ms."""

SELECT_FDS: Final = 1024
"""Descriptors that `select` takes are below this (FD_SETSIZE)."""

Round = Callable[[], int]
"""Does what is due, and returns after how many ns it is to be called again; 0 for at once."""


class Worker(Protocol):
    """Caller of a `Round` again and again, one call at a time."""

    def ring(self) -> None:
        """End the present sleep, or skip the next: there is work. From any thread."""
        ...

    def end(self) -> bool:
        """Stop calling; return whether the present call is over, for which it waits END_LIMIT_S at most."""
        ...


class WatchingWorker(Worker, Protocol):
    """A worker whose sleep descriptors can end as well."""

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        """Have a descriptor that becomes readable end the sleep: `callback` is called where the `Round` is, before it.

        Once for what came since the last call; nothing is read. Returns whether that is possible. From any thread.
        """
        ...

    def unwatch(self, fd: int) -> None:
        """Call nothing for a descriptor, which may be closed already; no-op for one that is not watched."""
        ...


StartWorker = Callable[[str, Round, Callable[[BaseException], None]], Worker]
"""Starts a worker: its name, what it calls, and what is called with an exception, which ends it."""
StartWatchingWorker = Callable[[str, Round, Callable[[BaseException], None]], WatchingWorker]


def share_interpreter() -> None:
    """Have threads give way to others after SWITCH_INTERVAL_S. A shorter interval that is set already stays."""
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL_S))


@contextmanager
def rare_garbage_collection(allocations: int) -> Iterator[None]:
    """Have the garbage collector run after so many new objects, and leave out what is there now.

    For a process that makes next to no cycles and holds many objects: each run goes through all of them.
    """
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(allocations)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


class WakeEvent:
    """A wait that another thread can end. A lock's own wait is on CLOCK_MONOTONIC and costs a third of an Event's."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def wait(self, seconds: float) -> None:
        """Return after so much time, or when `ring` was called since the last wait."""
        self._lock.acquire(timeout=seconds)

    def ring(self) -> None:
        """End the present wait, or the next. From any thread."""
        with suppress(RuntimeError):  # it rings already
            self._lock.release()


class DescriptorWait:
    """A wait that descriptors can end: each time that something comes, not for as long as it is there (EPOLLET), since
    another thread reads it. `select` is what has a time-out in µs; that of epoll is in ms.
    """

    def __init__(self) -> None:
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll = select.epoll()
        self._epoll.register(self._bell, select.EPOLLIN | select.EPOLLET)
        self._callbacks: dict[int, Callable[[], None]] = {}

    @property
    def is_usable(self) -> bool:
        """Whether `select` takes its descriptor: it does not where a thousand others are open."""
        return self._epoll.fileno() < SELECT_FDS

    def add(self, fd: int, callback: Callable[[], None]) -> None:
        """Call `callback` in `wait` when something comes on a descriptor."""
        self._callbacks[fd] = callback
        self._epoll.register(fd, select.EPOLLIN | select.EPOLLET)

    def discard(self, fd: int) -> None:
        """Call nothing for it any more."""
        if self._callbacks.pop(fd, None) is not None:
            with suppress(OSError):  # closed, with which the kernel removed it
                self._epoll.unregister(fd)

    def wait(self, seconds: float) -> None:
        """Return after so much time, when something came, or when `ring` was called since the last wait."""
        select.select((self._epoll,), (), (), seconds)
        for fd, _ in self._epoll.poll(0):
            callback = self._callbacks.get(fd)
            if callback is not None:
                callback()

    def ring(self) -> None:
        """End the present wait, or the next. From any thread."""
        os.eventfd_write(self._bell, 1)

    def close(self) -> None:
        """Release both descriptors."""
        self._callbacks.clear()
        self._epoll.close()
        os.close(self._bell)


class BusThread:
    """A `WatchingWorker` that is a thread."""

    def __init__(self, name: str, work: Round, failed: Callable[[BaseException], None]) -> None:
        self._work, self._failed = work, failed
        self._wake = WakeEvent()
        self._descriptors: DescriptorWait | None = None
        """The wait once a descriptor was watched: it costs twice as much."""
        self._ended = False
        share_interpreter()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ring(self) -> None:
        """End the present sleep, or skip the next. From any thread."""
        self._wake.ring()
        if self._descriptors is not None:
            self._descriptors.ring()

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        """Have a descriptor end the sleep."""
        descriptors = self._descriptors or DescriptorWait()
        if not descriptors.is_usable:
            descriptors.close()
            return False
        descriptors.add(fd, callback)
        self._descriptors = descriptors
        self._wake.ring()  # the thread may sleep in the other wait
        return True

    def unwatch(self, fd: int) -> None:
        """Call nothing for a descriptor."""
        if self._descriptors is not None:
            self._descriptors.discard(fd)

    def end(self) -> bool:
        """Stop after the present transfer; may be called twice."""
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
        work = self._work
        try:
            while not self._ended:
                rest_ns = work()
                if rest_ns > 0 and not self._ended:
                    (self._descriptors or self._wake).wait(rest_ns / NS_PER_S)
        except BaseException as error:  # noqa: BLE001 - an internal error must end the daemon, not just this thread
            self._failed(error)


def _sharpen_timer() -> None:
    """Ask the kernel to wake this thread within 1 µs instead of 50 µs; without the right to, jitter stays."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1", encoding="ascii")
