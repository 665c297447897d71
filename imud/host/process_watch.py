"""Watches of the process: code that blocks the event loop, and memory that grows.

Neither can be prevented: code of another package runs in the process of the daemon. imud names the cause.
"""

import logging
import sys
import threading
from asyncio import AbstractEventLoop
from collections import Counter
from collections.abc import Callable
from resource import getpagesize
from types import FrameType
from typing import Final, Protocol

from imud.host.event_loop import SampleLoop
from imud.host.scope import INNERMOST, Scope, scope_of_frame
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

INTERVAL_S: Final = 0.5  # interval of the samples of a blocked loop, s
BLOCKED_NS: Final = 2 * NS_PER_S
"""Time without a tick of the loop that counts as blocked, ns: four times the interval of the ticks in a quiet state. A
host with a slow disk delays the loop by less."""
GROWTH_BYTES: Final = 256 << 20
"""Growth of the memory that imud reports, bytes. A flight recorder, the queues of all outputs and 500 devices need less
after the start."""
MEMORY_NS: Final = 5 * NS_PER_S  # interval of the checks of the memory, ns


class WatchOwner(Protocol):
    """Receiver of the reports. `imud.daemon` implements it, and this part may not import `imud.daemon`."""

    def on_blocked(self, scope: Scope | None, duration_ns: int) -> None:
        """Process a block of the event loop that has ended. `scope` blocked it; None if imud does not know the code."""
        ...

    def on_growth(self, text: str) -> None:
        """Process a growth of the memory."""
        ...


class StallWatch:
    """Thread that finds out which scope blocks the event loop. It does not run any code of the loop.

    Synchronization: `beat`, `start` and `close` in the loop's thread.
    """

    def __init__(self, now_ns: Callable[[], int], owner: WatchOwner) -> None:
        self._now_ns = now_ns
        self._owner = owner
        self._beat_ns = now_ns()
        self._suspects: Counter[Scope | None] = Counter()  # number of samples of each scope in the present block
        self._loop: SampleLoop | None = None
        self._thread_id = 0
        self._is_over = threading.Event()

    def start(self, loop: SampleLoop) -> None:
        """Watch a loop in the present thread."""
        self._loop = loop
        self._thread_id = threading.get_ident()
        self._beat_ns = self._now_ns()
        threading.Thread(target=self._run, name="stall watch", daemon=True).start()

    def beat(self, now_ns: int) -> None:
        """Note a tick of the loop. Report a block that has ended."""
        duration_ns = now_ns - self._beat_ns
        self._beat_ns = now_ns
        if duration_ns < BLOCKED_NS:
            return
        suspects, self._suspects = self._suspects, Counter()
        scope = suspects.most_common(1)[0][0] if suspects else None
        self._owner.on_blocked(scope, duration_ns)

    def close(self) -> None:
        """Stop the thread. A second call does nothing."""
        self._is_over.set()

    def look(self) -> None:
        """Take a sample if the loop is blocked. Runs in the thread."""
        waited_ns = self._now_ns() - self._beat_ns
        if waited_ns < BLOCKED_NS:
            return
        scope = self._blocking_scope()
        if not self._suspects:
            name = "imud does not know the code" if scope is None else f"the code of {scope.owner}"
            log.error("the event loop is blocked since %.1f s: %s", waited_ns / NS_PER_S, name)
        self._suspects[scope] += 1

    def _run(self) -> None:
        while not self._is_over.wait(INTERVAL_S):
            self.look()

    def _blocking_scope(self) -> Scope | None:
        """Return the scope of the running code of the loop; None if it belongs to no scope."""
        assert self._loop is not None
        scope = INNERMOST.scope or self._loop.running_reader_scope()
        if scope is not None:
            return scope
        frame: FrameType | None = sys._current_frames().get(self._thread_id)
        return scope_of_frame(frame)


def resident_bytes() -> int:
    """Return the size of the process in memory; 0 if the kernel does not report it."""
    try:
        with open("/proc/self/statm", "rb", buffering=0) as file:
            return int(file.read(256).split()[1]) * getpagesize()
    except (OSError, ValueError, IndexError):
        return 0


class MemoryWatch:
    """Watch of the memory of the process. Synchronization: one thread."""

    def __init__(self, read_bytes: Callable[[], int] = resident_bytes) -> None:
        self._read_bytes = read_bytes
        self._start_bytes = 0  # size at the first check; 0 before it
        self._limit_bytes = 0
        self.due_ns = 0  # CLOCK_MONOTONIC of the next check

    def check(self, now_ns: int) -> str:
        """Return a text if the process has grown by another GROWTH_BYTES since the first check; otherwise empty."""
        if now_ns < self.due_ns:
            return ""
        self.due_ns = now_ns + MEMORY_NS
        size_bytes = self._read_bytes()
        if not self._start_bytes:
            self._start_bytes = size_bytes
            self._limit_bytes = size_bytes + GROWTH_BYTES
        if size_bytes < self._limit_bytes:
            return ""
        self._limit_bytes = size_bytes + GROWTH_BYTES
        return f"imud uses {size_bytes >> 20} MiB of memory, {self._start_bytes >> 20} MiB after its start"


class ProcessWatch:
    """Both watches of the process. Synchronization: the loop's thread."""

    def __init__(self, now_ns: Callable[[], int], owner: WatchOwner) -> None:
        self._stalls = StallWatch(now_ns, owner)
        self._memory = MemoryWatch()
        self._owner = owner

    def start(self, loop: AbstractEventLoop) -> None:
        """Watch a loop in the present thread. A loop without scopes is not watched."""
        if isinstance(loop, SampleLoop):
            self._stalls.start(loop)

    def tick(self, now_ns: int) -> None:
        """Report a block that has ended, and a growth of the memory. Called at each tick of the daemon."""
        self._stalls.beat(now_ns)
        if now_ns >= self._memory.due_ns and (text := self._memory.check(now_ns)):
            self._owner.on_growth(text)

    def close(self) -> None:
        """Stop the thread. A second call does nothing."""
        self._stalls.close()
