"""End of the process: a deadline, also if a thread or a function of another package never returns.

Python waits for all threads that are not daemon threads, and asyncio waits for its executor, both without a limit.
"""

import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

log = logging.getLogger(__name__)

THREADS_LIMIT_S: Final = 5.0
"""Maximum wait for other threads at the end of a command, s. The timeout of a bus transfer is 1 s."""
STOP_LIMIT_S: Final = 20.0
"""Maximum time from the request to stop the daemon until the end of its event loop, s. Some outputs need up to 5 s to
write their last data. systemd kills the daemon after 90 s (TimeoutStopSec)."""


class EndDeadline:
    """Deadline for the end of the process. Synchronization: `start` and `cancel` in one thread."""

    def __init__(self, limit_s: float) -> None:
        self.status = 0  # exit status of a process that the deadline ends
        self._limit_s = limit_s
        self._is_cancelled = threading.Event()

    def start(self) -> None:
        """End the process after the limit, unless it ends itself or `cancel` is called."""
        threading.Thread(target=self._watch, name="end deadline", daemon=True).start()

    def cancel(self) -> None:
        self._is_cancelled.set()

    def _watch(self) -> None:
        if self._is_cancelled.wait(self._limit_s):
            return
        names = ", ".join(thread.name for thread in blocking_threads()) or "no other thread"
        log.error("imud did not end within %g s and stops now; still running: %s", self._limit_s, names)
        exit_now(self.status)


def end_process(status: int) -> None:
    """Limit the wait for the other threads at the end of the process to THREADS_LIMIT_S."""
    if any(blocking_threads()):
        deadline = EndDeadline(THREADS_LIMIT_S)
        deadline.status = status
        deadline.start()


def blocking_threads() -> Iterator[threading.Thread]:
    """Yield the threads for which Python waits at its end, except the main thread."""
    for thread in threading.enumerate():
        if not thread.daemon and thread is not threading.main_thread():
            yield thread


def exit_now(status: int) -> None:
    """Flush all output and end the process, without `atexit` functions and without a wait for threads."""
    with suppress(Exception):
        logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a closed pipe or a full disk
            stream.flush()
    os._exit(status)
