"""A thread that sleeps from one deadline to the next: for a polled bus, or a trigger line.

A worker calls a function that returns how long it may sleep; tests call that function themselves, at times they choose
(`tests/support/virtual_time.py`).
"""

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

from imud.units import NS_PER_S

END_LIMIT_S = 5.0
"""A transfer on a bus that hangs ends with the controller's own time-out, of one second at most."""

SWITCH_INTERVAL_S: Final = 0.0005
"""After so long a thread lets another one run that waits (sys.setswitchinterval, for the whole process). A read of an
SPI bus waits for the interpreter twice, when its thread wakes and after the transfer. Measured at 1 kHz beside a loop
that computes 2 ms of every 20 ms, three times 8 s of each in turns: with the usual 5 ms reads begin 127 to 149 µs late
on average, with this 92 to 98 µs; missed deadlines, 0.06 % and less, are not fewer. 0.1 ms costs a quarter more CPU. A
scrape of the metrics (`scrape_server`) keeps samples waiting for 4.1 ms with the usual value and 300 silent clients,
for 0.65 ms with this."""

Round = Callable[[], int]
"""Does what is due, and returns after how many ns it is to be called again; 0 for at once."""


class Worker(Protocol):
    """Caller of a `Round` again and again, one call at a time."""

    def ring(self) -> None:
        """End the present sleep, or skip the next: there is work. From any thread."""
        ...

    def end(self) -> None:
        """Stop calling; return when the present call is over."""
        ...


StartWorker = Callable[[str, Round, Callable[[BaseException], None]], Worker]
"""Starts a worker: its name, what it calls, and what is called with an exception, which ends it."""


def share_interpreter() -> None:
    """Have threads give way to others after SWITCH_INTERVAL_S. A shorter interval that is set already stays."""
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL_S))


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


class BusThread:
    """A `Worker` that is a thread."""

    def __init__(self, name: str, work: Round, failed: Callable[[BaseException], None]) -> None:
        self._work, self._failed = work, failed
        self._wake = WakeEvent()
        self._ended = False
        share_interpreter()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ring(self) -> None:
        """End the present sleep, or skip the next. From any thread."""
        self._wake.ring()

    def end(self) -> None:
        """Stop after the present transfer; may be called twice."""
        self._ended = True
        self._wake.ring()
        self._thread.join(END_LIMIT_S)

    def _run(self) -> None:
        _sharpen_timer()
        work, wait = self._work, self._wake.wait
        try:
            while not self._ended:
                rest_ns = work()
                if rest_ns > 0 and not self._ended:
                    wait(rest_ns / NS_PER_S)
        except BaseException as error:  # noqa: BLE001 - a defect of imud must end the daemon, not just this thread
            self._failed(error)


def _sharpen_timer() -> None:
    """Ask the kernel to wake this thread within 1 µs instead of 50 µs; without the right to, jitter stays."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1", encoding="ascii")
