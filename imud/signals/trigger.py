"""SIN as a trigger: imud makes rising edges on a line at absolute deadlines, and says when each of them was.

    deadline ─▶ clock, line high, clock ─▶ stamp ─┐ gathered; the loop is woken for them now and then,
    pulse length ─▶ line low                      ┘ or takes them with `drain` before it feeds what it read

A device in ONMARK mode answers each rising edge with a frame, 125 µs later on average (HiPNUC manual, 1.2.1).
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from time import monotonic_ns
from typing import Final

from imud.contracts.lines import OnLineEnd, OutputLine
from imud.contracts.timing import TriggerStamp
from imud.errors import LinkError
from imud.units import NS_PER_MS, NS_PER_S
from imud.worker import BusThread, StartWorker, Worker

PULSE_NS: Final = NS_PER_MS
"""Length of a pulse, or half a period where that is shorter. The manual names none for triggers; 1 ms passes any level
shifter."""
LATE_SHARE: Final = 4
"""An edge that cannot be made within a quarter of a period is left out: the next would come too soon after it."""
HAND_OVER_NS: Final = 50 * NS_PER_MS
"""The loop is woken for stamps at most so often."""
STAMPS_MAX: Final = 10_000
"""Stamps that wait for a loop that does not run; the oldest go first."""
IDLE_NS: Final = 60 * NS_PER_S

OnStamps = Callable[[Sequence[TriggerStamp]], None]
"""Called in the loop's thread with stamps in their order."""


class TriggerCounts:
    """How a trigger kept its deadlines. Written by its thread, read by any."""

    __slots__ = ("edges", "missed", "singles", "sum_late_ns", "worst_late_ns")

    def __init__(self) -> None:
        self.edges = 0
        """Rising edges made."""
        self.singles = 0
        """Of these, those that were asked for one by one."""
        self.missed = 0
        """Deadlines that were not kept: no edge was made for them."""
        self.sum_late_ns = 0
        """Time from deadline to edge, summed over the edges that have a deadline."""
        self.worst_late_ns = 0

    @property
    def mean_late_ns(self) -> float:
        """Mean time from deadline to edge, 0 without an edge."""
        return self.sum_late_ns / max(self.edges - self.singles, 1)


class SquareWave:
    """Raises and lowers a line. Synchronization: one thread calls `work`; `once` any."""

    def __init__(
        self, line: OutputLine, rate_hz: float, counts: TriggerCounts, now_ns: Callable[[], int], pulse_ns: int
    ) -> None:
        """The first deadline is now; without a rate there is none."""
        self._line, self._counts, self._now_ns = line, counts, now_ns
        self._period_ns = round(NS_PER_S / rate_hz) if rate_hz else 0
        self._pulse_ns = min(pulse_ns, self._period_ns // 2) if rate_hz else pulse_ns
        self._late_ns = self._period_ns // LATE_SHARE
        self._low_ns = min(self._pulse_ns, self._late_ns) if rate_hz else pulse_ns
        self._due_ns = self._rest_until_ns = now_ns()
        self._fall_ns: int | None = None
        self._wanted: deque[None] = deque()
        self.stamps: deque[TriggerStamp] = deque(maxlen=STAMPS_MAX)
        """What was made, oldest first; taken out by the other side."""

    @property
    def high(self) -> bool:
        """Whether the line is active."""
        return self._fall_ns is not None

    def once(self) -> None:
        """Make one edge besides those of the rate, as soon as the line is low."""
        self._wanted.append(None)

    def work(self) -> int:
        """Do what is due; returns how many ns may pass before it is called again. Raises LinkError."""
        now_ns = self._now_ns()
        if self._fall_ns is not None:
            if now_ns < self._fall_ns:
                return self._fall_ns - now_ns
            self._lower()
            return 0
        if self._wanted and now_ns >= self._rest_until_ns:
            self._wanted.popleft()
            self._counts.singles += 1
            return self._raise()
        if self._period_ns:
            self._pass_over(now_ns)
            if now_ns >= max(self._due_ns, self._rest_until_ns):
                self._keep()
                return self._pulse_ns
        return self._next_ns() - now_ns

    def _next_ns(self) -> int:
        """When the line is to be raised."""
        if self._wanted:
            return self._rest_until_ns
        if self._period_ns:
            return max(self._due_ns, self._rest_until_ns)
        return self._now_ns() + IDLE_NS

    def _pass_over(self, now_ns: int) -> None:
        """Count the deadlines that cannot be kept any more, and go to the next."""
        over_ns = now_ns - self._late_ns - self._due_ns
        if over_ns > 0:
            passed = -(-over_ns // self._period_ns)
            self._counts.missed += passed
            self._due_ns += passed * self._period_ns

    def _keep(self) -> None:
        counts, due_ns = self._counts, self._due_ns
        self._due_ns += self._period_ns
        self._raise()
        late_ns = self.stamps[-1].t_ns - due_ns
        counts.sum_late_ns += late_ns
        counts.worst_late_ns = max(counts.worst_late_ns, late_ns)

    def _raise(self) -> int:
        now_ns, drive = self._now_ns, self._line.set
        before_ns = now_ns()
        drive(True)
        after_ns = now_ns()
        self._counts.edges += 1
        self._fall_ns = after_ns + self._pulse_ns
        error_ns = (after_ns - before_ns + 1) // 2
        self.stamps.append(TriggerStamp((before_ns + after_ns) // 2, error_ns, self._counts.edges))
        return self._pulse_ns

    def _lower(self) -> None:
        self._line.set(False)
        self._fall_ns = None
        self._rest_until_ns = self._now_ns() + self._low_ns


class Trigger:
    """Drives an open line from a thread of its own. Synchronization: the loop's thread only."""

    def __init__(
        self,
        line: OutputLine,
        rate_hz: float,
        *,
        now_ns: Callable[[], int] = monotonic_ns,
        start_worker: StartWorker = BusThread,
        pulse_ns: int = PULSE_NS,
    ) -> None:
        """`rate_hz` 0 is for no edges but those of `once`. The line stays its owner's, who opens and closes it."""
        self._line, self._rate_hz, self._pulse_ns = line, rate_hz, pulse_ns
        self._now_ns, self._start_worker = now_ns, start_worker
        self.counts = TriggerCounts()
        self._worker: Worker | None = None
        self._wave: SquareWave | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_stamps: OnStamps | None = None
        self._on_end: OnLineEnd | None = None
        self._told_ns = 0
        self._problem: LinkError | None = None

    def start(self, on_stamps: OnStamps, on_end: OnLineEnd) -> None:
        """Make edges from now on. Needs a running loop and an open line."""
        self._loop = asyncio.get_running_loop()
        self._on_stamps, self._on_end = on_stamps, on_end
        self._problem = None
        self._wave = SquareWave(self._line, self._rate_hz, self.counts, self._now_ns, self._pulse_ns)
        self._worker = self._start_worker(f"trigger {self._line.title}", self._round, self._failed)

    def once(self) -> None:
        """Make one edge as soon as the line is low; its stamp comes as those of the others do. Raises LinkError."""
        if self._wave is None or self._worker is None or self._problem is not None:
            raise self._problem or LinkError(f"{self._line.title} is not driven: no edge can be made")
        self._wave.once()
        self._worker.ring()

    def drain(self) -> None:
        """Deliver now the stamps of all edges made so far. Does not wait."""
        wave, on_stamps = self._wave, self._on_stamps
        if wave is None or on_stamps is None or not wave.stamps:
            return
        found = []
        with suppress(IndexError):  # the thread only appends
            while True:
                found.append(wave.stamps.popleft())
        on_stamps(found)

    def stop(self) -> None:
        """End the thread, deliver what is left, and leave the line inactive and open; may be called twice."""
        if self._worker is None:
            return
        self._worker.end()
        self._worker = None
        with suppress(LinkError):  # it is gone, and its level with it
            self._line.set(False)
        self.drain()
        self._wave = self._on_stamps = self._on_end = None

    # --- the thread's side -------------------------------------------------------------------------------------------

    def _round(self) -> int:
        wave = self._wave
        assert wave is not None
        if self._problem is not None:
            return IDLE_NS
        try:
            rest_ns = wave.work()
        except LinkError as error:
            self._problem = error
            self._call_loop(self._end)
            return IDLE_NS
        if wave.stamps and not wave.high:
            self._tell()
        return rest_ns

    def _tell(self) -> None:
        now_ns = self._now_ns()
        if not self._rate_hz or now_ns - self._told_ns >= HAND_OVER_NS:
            self._told_ns = now_ns
            self._call_loop(self.drain)

    def _failed(self, error: BaseException) -> None:
        def fail() -> None:
            raise error

        self._call_loop(fail)

    def _call_loop(self, callback: Callable[[], None]) -> None:
        assert self._loop is not None
        with suppress(RuntimeError):  # the loop is closed: nobody is there to be told
            self._loop.call_soon_threadsafe(callback)

    def _end(self) -> None:
        problem, on_end = self._problem, self._on_end
        if problem is None:
            return  # it was of an earlier start
        self.stop()
        if on_end is not None:
            on_end(problem)
