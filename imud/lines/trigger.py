"""SIN as a trigger: imud makes rising edges on a line at absolute deadlines, and time-stamps each edge.

    deadline ─▶ clock, line high, clock ─▶ time stamp ─┐ buffered; wakes the event loop every HAND_OVER_NS,
    pulse length ─▶ line low                           ┘ or `drain` fetches them before the path decodes a read

A device in ONMARK mode answers each rising edge with a frame, after 125 µs on average (HiPNUC manual, 1.2.1).
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from imud.contracts.lines import OnLineEnd, OutputLine, TriggerOptions, TriggerStamp
from imud.host.clock import HostClock
from imud.host.threads import BusThread, StartWorker, Worker
from imud.lines.watched_line import RETRY_NS
from imud.model.errors import LinkError
from imud.model.event import EventKind, RaiseEvent
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock

# Length of a pulse, ns, at most half a period. The manual gives no length. 1 ms passes each level shifter.
PULSE_NS: Final = NS_PER_MS
# Share of a period, 1/4, after which imud skips a late edge. The next edge would follow too soon.
LATE_SHARE: Final = 4
HAND_OVER_NS: Final = 50 * NS_PER_MS  # minimum time between two wake-ups of the event loop for time stamps, ns
STAMPS_MAX: Final = 10_000  # Capacity of the buffer of time stamps. If the event loop stalls, the oldest are dropped.
IDLE_NS: Final = 60 * NS_PER_S  # sleep of the thread without a due edge, ns

# called with time stamps in order, in the thread of the event loop
OnStamps = Callable[[Sequence[TriggerStamp]], None]


class TriggerCounts:
    """Counters of a trigger. The trigger's thread writes them, any thread can read them."""

    __slots__ = ("edges", "missed", "singles", "sum_late_ns", "worst_late_ns")

    def __init__(self) -> None:
        self.edges = 0  # number of rising edges
        self.singles = 0  # number of edges that `once` requested
        self.missed = 0  # number of deadlines without an edge
        self.sum_late_ns = 0  # sum of the times from deadline to edge, ns, without the edges of `once`
        self.worst_late_ns = 0

    @property
    def mean_late_ns(self) -> float:
        """Return the mean time from deadline to edge, ns; 0 without edges."""
        return self.sum_late_ns / max(self.edges - self.singles, 1)


class SquareWave:
    """Generator of pulses on a line. Synchronization: one thread calls `work`; any thread may call `once`."""

    def __init__(
        self, line: OutputLine, rate_hz: float, counts: TriggerCounts, now_ns: Callable[[], int], pulse_ns: int
    ) -> None:
        """The first deadline is now. Without `rate_hz` (0), there are no deadlines."""
        self._line, self._counts, self._now_ns = line, counts, now_ns
        self._period_ns = round(NS_PER_S / rate_hz) if rate_hz else 0
        self._pulse_ns = min(pulse_ns, self._period_ns // 2) if rate_hz else pulse_ns
        self._late_ns = self._period_ns // LATE_SHARE
        self._low_ns = min(self._pulse_ns, self._late_ns) if rate_hz else pulse_ns
        self._due_ns = self._rest_until_ns = now_ns()
        self._fall_ns: int | None = None
        self._wanted: deque[None] = deque()  # one entry for each requested edge; deque operations are thread-safe
        # Time stamps of the edges, oldest first. The consumer removes them.
        self.stamps: deque[TriggerStamp] = deque(maxlen=STAMPS_MAX)

    @property
    def high(self) -> bool:
        return self._fall_ns is not None

    def once(self) -> None:
        """Request one edge in addition to the deadlines, as soon as the line is low."""
        self._wanted.append(None)

    def work(self) -> int:
        """Make the due edges. Return the time until the next call, ns. Raises LinkError."""
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
                self._raise_on_deadline()
                return self._pulse_ns
        return self._next_ns() - now_ns

    def _next_ns(self) -> int:
        if self._wanted:
            return self._rest_until_ns
        if self._period_ns:
            return max(self._due_ns, self._rest_until_ns)
        return self._now_ns() + IDLE_NS

    def _pass_over(self, now_ns: int) -> None:
        """Count the missed deadlines, and advance to the next deadline."""
        over_ns = now_ns - self._late_ns - self._due_ns
        if over_ns > 0:
            passed = -(-over_ns // self._period_ns)
            self._counts.missed += passed
            self._due_ns += passed * self._period_ns

    def _raise_on_deadline(self) -> None:
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
        error_ns = (after_ns - before_ns + 1) // 2  # the edge is between both clock readings
        self.stamps.append(TriggerStamp((before_ns + after_ns) // 2, error_ns, self._counts.edges))
        return self._pulse_ns

    def _lower(self) -> None:
        self._line.set(False)
        self._fall_ns = None
        self._rest_until_ns = self._now_ns() + self._low_ns


class Trigger:
    """Driver of an open line with its own thread. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        line: OutputLine,
        rate_hz: float,
        now_ns: Callable[[], int],
        *,
        start_worker: StartWorker = BusThread,
        pulse_ns: int = PULSE_NS,
    ) -> None:
        """Only `once` makes edges if `rate_hz` is 0. The caller opens and closes the line."""
        self._line, self._rate_hz, self._pulse_ns = line, rate_hz, pulse_ns
        self._now_ns, self._start_worker = now_ns, start_worker
        self.counts = TriggerCounts()
        self._worker: Worker | None = None
        self._wave: SquareWave | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_stamps: OnStamps | None = None
        self._on_end: OnLineEnd | None = None
        self._handed_over_ns = 0
        self._problem: LinkError | None = None

    def start(self, on_stamps: OnStamps, on_end: OnLineEnd) -> None:
        """Start the thread. A running event loop and an open line are required."""
        self._loop = asyncio.get_running_loop()
        self._on_stamps, self._on_end = on_stamps, on_end
        self._problem = None
        self._wave = SquareWave(self._line, self._rate_hz, self.counts, self._now_ns, self._pulse_ns)
        self._worker = self._start_worker(f"trigger {self._line.title}", self)

    def once(self) -> None:
        """Request one edge as soon as the line is low. Its time stamp is delivered as usual. Raises LinkError."""
        if self._wave is None or self._worker is None or self._problem is not None:
            raise self._problem or LinkError(f"{self._line.title} is not driven: no edge can be made")
        self._wave.once()
        self._worker.ring()

    def drain(self) -> None:
        """Deliver the time stamps of all edges so far. Do not block."""
        wave, on_stamps = self._wave, self._on_stamps
        if wave is None or on_stamps is None or not wave.stamps:
            return
        found = []
        with suppress(IndexError):  # the thread only appends
            while True:
                found.append(wave.stamps.popleft())
        on_stamps(found)

    def stop(self) -> None:
        """Stop the thread, deliver the remaining time stamps, and leave the line inactive and open."""
        if self._worker is None:
            return
        self._worker.end()
        self._worker = None
        with suppress(LinkError):  # the line is missing
            self._line.set(False)
        self.drain()
        self._wave = self._on_stamps = self._on_end = None

    # --- the trigger's thread
    # --------------------------------------------------------------------------------------------

    def do_round(self) -> int:
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
            self._hand_over()
        return rest_ns

    def _hand_over(self) -> None:
        now_ns = self._now_ns()
        if not self._rate_hz or now_ns - self._handed_over_ns >= HAND_OVER_NS:
            self._handed_over_ns = now_ns
            self._call_loop(self.drain)

    def round_failed(self, error: BaseException) -> None:
        def fail() -> None:
            raise error

        self._call_loop(fail)

    def _call_loop(self, callback: Callable[[], None]) -> None:
        assert self._loop is not None
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(callback)

    def _end(self) -> None:
        problem, on_end = self._problem, self._on_end
        if problem is None:
            return  # the failure belongs to an earlier start
        self.stop()
        if on_end is not None:
            on_end(problem)


class SinTrigger:
    """SIN as a driven line: it opens the line, runs its `Trigger`, and restarts both after a failure.

    Synchronization: the event loop's thread only.
    """

    def __init__(
        self,
        line: OutputLine,
        settings: TriggerOptions,
        raise_event: RaiseEvent,
        host: HostClock,
        start_worker: StartWorker,
    ) -> None:
        self.problem = ""  # reason why imud cannot drive SIN, one sentence; empty if it can
        self._line, self._raise_event, self._host = line, raise_event, host
        self._clock: SampleClock | None = None
        pulse_ns = round(settings.pulse_ms * NS_PER_MS)
        self._trigger = Trigger(line, settings.rate_hz, host.now_ns, start_worker=start_worker, pulse_ns=pulse_ns)
        # Delivers the time stamps of all edges so far. Does not block.
        self.drain: Callable[[], None] = self._trigger.drain
        self._running = False
        self._due_ns = 0

    @property
    def counts(self) -> TriggerCounts:
        return self._trigger.counts

    def start(self, clock: SampleClock) -> None:
        """Deliver time stamps to the clock of the detected device. `tick` drives the line."""
        self._clock = clock

    def tick(self, now_ns: int) -> None:
        """Start to drive the line if due. Call this method at 10 Hz."""
        if self._running or now_ns < self._due_ns:
            return
        try:
            self._line.open()
        except LinkError as error:
            self._end(error)
            return
        self.problem = ""
        self._running = True
        self._trigger.start(self._on_stamps, self._end)

    def once(self) -> None:
        """Make one edge in addition to the deadlines. Raises LinkError."""
        self._trigger.once()

    def stop(self) -> None:
        """Leave the line inactive and release it. The next `tick` opens it again. A second call does nothing."""
        self._clock = None
        self._trigger.stop()
        self._line.close()
        self._running = False
        self._due_ns = 0

    def _on_stamps(self, stamps: Sequence[TriggerStamp]) -> None:
        if self._clock is not None:
            self._host.utc_offset_ns()  # updates the steady time, by which the clock converts the time stamps
            self._clock.add_triggers(stamps)

    def _end(self, error: LinkError) -> None:
        self._line.close()
        self._running = False
        now_ns = self._host.now_ns()
        self._due_ns = now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._raise_event(now_ns, EventKind.LINK, f"line sin: {self.problem}", line="sin")
