"""Transfers of all devices of a bus in one thread, at absolute deadlines.

    loop ──commands──▶ thread: due poll? ─▶ transfer ─▶ readings ─┐
      ▲                        │ no: one transfer of a script      │ before a sleep: one wake-up of the loop
      └────────────────────────┴───────────────────────────────────┘

The thread owns the open links. It blocks only in transfers and between rounds. A failing device delays the other
devices by the time of its transfer. This module contains the rounds; a `Worker` contains the thread.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, Protocol, TypeVar

from imud.contracts.codec import Poll, Reading
from imud.contracts.link import PolledLink
from imud.contracts.script import Transfer, TransferScript
from imud.host.clock import HostClock
from imud.host.threads import BusThread, StartWatchingWorker
from imud.model.errors import ImudError, LinkError, TransferError
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.path import QUIET_NS

LATE_SHARE: Final = 4  # a read counts as late if its delay exceeds the period divided by this number
QUIET_INTERVALS: Final = 3  # number of missing edges after which imud reads at deadlines
UNMATCHED_MOST: Final = 64  # maximum number of reads without a known edge. imud does not count older reads.


class Deadlines:
    """Counters of the deadlines of a device, over all of its schedules."""

    __slots__ = ("late", "missed", "polls", "sum_late_ns", "worst_ns")

    def __init__(self) -> None:
        self.polls = 0  # number of deadlines with a read
        self.late = 0  # number of late reads
        self.missed = 0  # number of deadlines without a read, because the previous read lasted too long
        self.sum_late_ns = 0  # sum of the delays of all reads, ns
        self.worst_ns = 0  # maximum delay of a read, ns

    def served(self, late_ns: int, limit_ns: int) -> None:
        """Count a read. It is late if its delay exceeds `limit_ns`."""
        self.polls += 1
        self.sum_late_ns += late_ns
        self.late += late_ns > limit_ns
        self.worst_ns = max(self.worst_ns, late_ns)


class Timetable(Protocol):
    """Times of the reads of a device."""

    due_ns: int  # CLOCK_MONOTONIC of the next read. The bus serves the device with the lowest value first.

    def begun(self, start_ns: int, /) -> None:
        """Count a read that starts."""
        ...

    def done(self, now_ns: int, /) -> None:
        """Set `due_ns` to the next read after the end of a read."""
        ...


class Schedule:
    """Deadlines at `begin_ns` + n · period. Synchronization: the bus's thread."""

    __slots__ = ("_late_ns", "counts", "due_ns", "period_ns")

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = round(NS_PER_S / rate_hz)
        self._late_ns = self.period_ns // LATE_SHARE
        self.counts = counts
        self.due_ns = begin_ns  # CLOCK_MONOTONIC of the next deadline

    def begun(self, start_ns: int) -> None:
        self.counts.served(start_ns - self.due_ns, self._late_ns)

    def done(self, now_ns: int) -> None:
        """Set the next deadline. Count the deadlines that have passed without a read."""
        due_ns, period_ns = self.due_ns + self.period_ns, self.period_ns
        if due_ns + period_ns <= now_ns:  # a read that is late by less than a period is still useful
            passed = (now_ns - due_ns) // period_ns
            self.counts.missed += passed
            due_ns += passed * period_ns
        self.due_ns = due_ns


class RoundRobin:
    """Turns in place of deadlines: every device is always due, and the device with the longest wait is first.
    Synchronization: the bus's thread."""

    __slots__ = ("counts", "due_ns", "period_ns")

    def __init__(self, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = 0
        self.counts = counts
        self.due_ns = begin_ns  # CLOCK_MONOTONIC at the end of the device's last turn

    def begun(self, _start_ns: int) -> None:
        self.counts.polls += 1

    def done(self, now_ns: int) -> None:
        """Move the device behind all other devices after its turn."""
        self.due_ns = now_ns


class ReadySchedule:
    """Edges in place of deadlines. Synchronization: the bus's thread; any thread may read `by_edges`.

    The first read is immediate, because a line that stays active until a read makes no edge before the first read.
    The thread can notice an edge (`noticed`) before the loop has its time (`on_edges`). Either call causes the read.
    """

    __slots__ = (
        "_deadlines", "_edge_ns", "_interval_ns", "_pending", "_start_ns", "_starts", "_unstamped",
        "by_edges", "counts", "due_ns",
    )  # fmt: skip

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        """`rate_hz` is the rate of the deadlines if there are no edges."""
        self._deadlines = Schedule(rate_hz, begin_ns, counts)
        self._interval_ns = self._deadlines.period_ns
        self._edge_ns = begin_ns  # CLOCK_MONOTONIC of the newest edge, or of the start
        self._start_ns = 0  # CLOCK_MONOTONIC of the start of the newest read
        self._pending = True  # whether the newest edge still needs a read
        self._unstamped = False  # whether the time of the pending edge is unknown
        self._starts: deque[int] = deque(maxlen=UNMATCHED_MOST)  # starts of the reads of such edges, oldest first
        self.counts = counts
        self.by_edges = True  # whether edges cause the reads; False: deadlines
        self.due_ns = begin_ns  # CLOCK_MONOTONIC of the pending edge or of the deadline

    @property
    def period_ns(self) -> int:
        """Present time between two reads, ns."""
        return self._interval_ns if self.by_edges else self._deadlines.period_ns

    def noticed(self, now_ns: int) -> None:
        """Read immediately: an edge has arrived, and its time is unknown."""
        if self.by_edges:
            self._pending = self._unstamped = True
            self.due_ns = self._edge_ns = now_ns

    def has_read(self, t_ns: int) -> bool:
        """Return whether a read started after this edge. Any thread may call it."""
        return t_ns <= self._start_ns

    def on_edges(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Process edges, oldest first. `interval_ns` is the time between the two newest edges."""
        t_ns = times_ns[-1]
        self._count_reads(times_ns, interval_ns)
        if not self.by_edges and t_ns - self._edge_ns > QUIET_NS:  # a single edge can be a disturbance
            self._edge_ns = t_ns
            return
        self.by_edges = True
        self._edge_ns, self._interval_ns = t_ns, interval_ns
        if t_ns > self._start_ns:
            self._pending, self._unstamped, self.due_ns = True, False, t_ns
        elif not self._unstamped:
            self._wait()

    def begun(self, start_ns: int) -> None:
        """Count a read that starts. Without a pending edge, change to deadlines."""
        self._start_ns = start_ns
        if self.by_edges and not self._pending:
            self.by_edges = False
            self._deadlines.due_ns = start_ns
        if not self.by_edges:
            self._deadlines.begun(start_ns)
            return
        if self._unstamped:
            self._unstamped = False
            self._starts.append(start_ns)
        else:
            self.counts.served(start_ns - self.due_ns, self._interval_ns // LATE_SHARE)

    def done(self, now_ns: int) -> None:
        if self.by_edges:
            self._wait()
        else:
            self._deadlines.done(now_ns)
            self.due_ns = self._deadlines.due_ns

    def _count_reads(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Count the reads of noticed edges. Each read belongs to the newest edge before its start."""
        starts, at = self._starts, 0
        while starts and at < len(times_ns):
            start_ns, edge_ns = starts.popleft(), 0
            while at < len(times_ns) and times_ns[at] <= start_ns:
                edge_ns, at = times_ns[at], at + 1
            if edge_ns:  # a read without an edge is not counted
                self.counts.served(start_ns - edge_ns, interval_ns // LATE_SHARE)

    def _wait(self) -> None:
        self._pending = False
        self.due_ns = self._edge_ns + max(QUIET_NS, QUIET_INTERVALS * self._interval_ns)


T = TypeVar("T")

IDLE_NS = 60 * NS_PER_S  # maximum sleep of a thread without a due read, ns
FAR_NS = 1 << 63  # time of the next read if there is none: after all other times
# On a bus that is never idle, a script gets one transfer after this number of reads, or after this time
POLLS_IN_ROW = 8
ROW_NS = 100 * NS_PER_MS
READINGS_MAX = 10_000
"""Maximum number of readings that wait for a blocked loop. imud drops further readings and counts missed deadlines."""

OnReadings = Callable[[Sequence[Reading], LinkError | None], None]
"""Called in the loop's thread with the readings, oldest first, and the error that ended the bus, or None."""
Callback = Callable[[], None]


def ignore_target(_target: int) -> None:
    """Ignore the target of a script that does not change the address."""


class BusMember:
    """Membership of a device on a bus. Synchronization: the loop's thread only."""

    def __init__(self, bus: "PolledBus", link: PolledLink, deadlines: Deadlines, on_readings: OnReadings) -> None:
        """`PolledBus.join` creates a member. `deadlines` counts the reads."""
        self.link = link
        self.deadlines = deadlines
        self._bus = bus
        self._on_readings = on_readings
        self._left = False
        self._latency_ns = 0
        self._polling = _Polling(self, bus.host)
        bus.command(lambda: bus.add(self._polling))

    async def run(self, script: TransferScript[T], target: int, on_target: Callable[[int], None] = ignore_target) -> T:
        """Run a transfer script on one target. Raises the errors of the script, TransferError and LinkError.

        `on_target` receives the target at the end of the script, also after an error.
        """
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        running = _ScriptRun(script, target, future)
        self.command(lambda: self._polling.scripts.append(running))
        try:
            return await future
        finally:
            if future.done() and not future.cancelled():
                on_target(running.target)

    def claim(self, target: int) -> bool:
        return not self.link.shared or self._bus.claim(target, self)

    def release(self) -> None:
        self._bus.release(self)

    def start(self, polls: Sequence[Poll], timetable: Timetable | None = None) -> None:
        """Start reads at the times of `timetable`. Without it: at deadlines, or in turns if the link has no rate."""
        rate_hz, begin_ns, counts = self.link.rate_hz, self._bus.host.now_ns(), self.deadlines
        schedule = timetable or (Schedule(rate_hz, begin_ns, counts) if rate_hz else RoundRobin(begin_ns, counts))
        self.command(lambda: self._polling.start(polls, schedule))

    def set_latency(self, latency_ns: int) -> None:
        """Set the maximum hold of a reading, ns; 0: no hold."""
        if latency_ns != self._latency_ns:
            self._latency_ns = latency_ns
            self.command(lambda: self._polling.set_latency(latency_ns))

    def command(self, command: Callback) -> None:
        self._bus.command(command)

    def watch(self, fd: int, callback: Callback) -> bool:
        """Call a function in the bus's thread if a descriptor becomes readable. Return False for an invalid descriptor.

        The thread does not read the descriptor.
        """
        return fd >= 0 and self._bus.watch(fd, callback)

    def unwatch(self, fd: int) -> None:
        self._bus.unwatch(fd)

    def note(self, command: Callback) -> None:
        self._bus.note(command)

    def stop(self) -> None:
        """Stop reads. The bus still delivers previous readings."""
        self.command(self._polling.stop)

    def leave(self) -> None:
        """Leave the bus. Its thread closes the link and delivers no more readings. A second call does nothing."""
        if not self._left:
            self._left = True
            self.release()
            self.command(lambda: self._bus.remove(self._polling))

    def deliver(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """Pass readings to the owner, unless the member has left. Runs in the loop's thread."""
        if not self._left:
            self._on_readings(readings, problem)


class _Polling:
    """Reads and scripts of one device. Synchronization: the bus's thread only."""

    def __init__(self, member: BusMember, host: HostClock) -> None:
        self.link = member.link
        self.scripts: deque[_ScriptRun] = deque()  # waiting transfer scripts; the first script is running
        self.schedule: Timetable | None = None  # times of the reads; None while imud does not read the device
        self.held = False  # whether a script forbids reads until its next transfer
        self._member = member
        self._now_ns = host.now_ns
        self._polls: Sequence[Poll] = ()
        self._due_ns: list[int] = []
        self._readings: list[Reading] = []
        self._problem: LinkError | None = None
        self._latency_ns = 0
        # whether a reading failed: imud must deliver it immediately, because the device can be missing
        self._failed = False

    def set_latency(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns

    def start(self, polls: Sequence[Poll], schedule: Timetable) -> None:
        self._polls, self._due_ns = polls, [0] * len(polls)
        self.schedule = schedule

    def stop(self) -> None:
        self.schedule = None

    def poll(self, schedule: Timetable) -> None:
        """Execute the polls that are due at the present deadline."""
        start_ns = self._now_ns()
        schedule.begun(start_ns)
        due_ns = self._due_ns
        for number, poll in enumerate(self._polls):
            if start_ns >= due_ns[number]:
                due_ns[number] = start_ns + poll.every_ns if poll.every_ns else 0
                self._read(number, poll.transfer)
        schedule.done(self._now_ns())

    def step_script(self) -> Callback | None:
        """Execute one transfer of the running script. At its end return a function that completes it in the loop."""
        settle = self.scripts[0].step(self.link)
        self.held = settle is None and self.scripts[0].holds
        if settle is not None:
            self.scripts.popleft()
        return settle

    def delivery(self, next_ns: int) -> Callback | None:
        """Return a function that delivers all readings in the loop's thread. Return None without readings, or if they
        can wait until the next call at `next_ns`."""
        readings, problem, deliver = self._readings, self._problem, self._member.deliver
        waits = not readings or next_ns <= readings[0].end_ns + self._latency_ns
        if waits and problem is None and not self._failed:
            return None
        self._readings, self._problem, self._failed = [], None, False
        return lambda: deliver(readings, problem)

    def _read(self, number: int, transfer: Transfer) -> None:
        error: TransferError | None = None
        data = b""
        start_ns = self._now_ns()
        try:
            data = self.link.transfer(transfer)
        except TransferError as trouble:
            error = trouble
        except LinkError as problem:
            self._problem = problem
            self.stop()
            return
        self._failed = self._failed or error is not None
        if len(self._readings) < READINGS_MAX:
            self._readings.append(Reading(number, data, error, start_ns, self._now_ns()))
        else:
            self._member.deadlines.missed += 1


class _ScriptRun:
    """A running transfer script."""

    __slots__ = ("error", "future", "holds", "script", "send", "target")

    def __init__(self, script: TransferScript[Any], target: int, future: asyncio.Future[Any]) -> None:
        self.script = script
        self.target = target
        self.future = future
        self.send: bytes | None = None
        self.error: TransferError | None = None
        self.holds = False

    def step(self, link: PolledLink) -> Callback | None:
        """Execute one transfer. At the end of the script return a function that completes it in the loop's thread."""
        try:
            wanted = self.script.throw(self.error) if self.error else self.script.send(self.send)  # type: ignore[arg-type]  # None begins a generator
            self.error, self.send = None, self._transfer(link, wanted)
        except StopIteration as end:
            return _settle(self.future, end.value, None)
        except TransferError as error:
            if self.error is error:  # the script did not handle the error
                return _settle(self.future, None, error)
            self.error = error
        except ImudError as error:
            return _settle(self.future, None, error)
        return None

    def _transfer(self, link: PolledLink, wanted: Transfer) -> bytes:
        self.holds = wanted.holds
        link.select(self.target if wanted.at is None else wanted.at)
        try:
            return link.transfer(wanted)
        finally:
            if wanted.then_at is not None:
                self.target = wanted.then_at
            if wanted.at is not None or wanted.then_at is not None:
                link.select(self.target)  # the next transfer can be a read of the device


def _settle(future: asyncio.Future[Any], value: object, error: Exception | None) -> Callback:
    def settle() -> None:
        if future.done():
            return
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)

    return settle


class PolledBus:
    """A bus and its devices.

    The loop's thread calls `join` … `end`, the bus's thread calls `add`, `remove` and the rounds.
    """

    def __init__(
        self, name: str, loop: asyncio.AbstractEventLoop, host: HostClock, start_worker: StartWatchingWorker
    ) -> None:
        self.host = host
        self._loop = loop
        # Members of the bus. Only the bus's thread uses this list.
        self._polling: list[_Polling] = []
        self._commands: deque[Callback] = deque()
        self._callbacks: list[Callback] = []  # functions that the loop's thread runs at the next wake-up
        self._in_row = 0  # number of reads since the last transfer of a script
        self._row_ns = 0  # CLOCK_MONOTONIC of the first of these reads
        # Claimed targets of a shared bus. Only the loop's thread uses them.
        self._owners: dict[int, BusMember] = {}
        self._failure: BaseException | None = None
        self._worker = start_worker(name, self)

    # --- the loop's side ---------------------------------------------------------------------------------------------

    def join(self, link: PolledLink, deadlines: Deadlines, on_readings: OnReadings) -> BusMember:
        """Add a device with an open link. `deadlines` counts the reads."""
        return BusMember(self, link, deadlines, on_readings)

    def claim(self, target: int, member: BusMember) -> bool:
        """Claim a target for a member. Return False if another member has claimed it."""
        return self._owners.setdefault(target, member) is member

    def release(self, member: BusMember) -> None:
        """Release the claims of a member."""
        self._owners = {target: owner for target, owner in self._owners.items() if owner is not member}

    def command(self, command: Callback) -> None:
        """Run a function in the thread between two transfers. Wake the thread."""
        self.note(command)
        self._worker.ring()

    def note(self, command: Callback) -> None:
        """Run a function in the thread before its next work."""
        self._commands.append(command)

    def watch(self, fd: int, callback: Callback) -> bool:
        """Call a function in the thread if a descriptor becomes readable."""
        return self._worker.watch(fd, callback)

    def unwatch(self, fd: int) -> None:
        """Stop to watch a descriptor."""
        self._worker.unwatch(fd)

    def end(self) -> None:
        """Stop the thread after its transfer, and close all links. A second call does nothing."""
        self._worker.end()
        for polling in self._polling:
            polling.link.close()
        self._polling = []

    # --- the thread's side -------------------------------------------------------------------------------------------

    def add(self, polling: "_Polling") -> None:
        self._polling.append(polling)

    def remove(self, polling: "_Polling") -> None:
        self._polling.remove(polling)
        polling.link.close()

    def do_round(self) -> int:
        """Run the commands, then due reads or one transfer of a script. Return the time until the next work, ns."""
        commands = self._commands
        while commands:
            commands.popleft()()
        polling, schedule = self._next()
        now_ns = self.host.now_ns()
        if not self._in_row:
            self._row_ns = now_ns
        is_row_full = self._in_row >= POLLS_IN_ROW or now_ns - self._row_ns > ROW_NS
        if schedule is not None and schedule.due_ns <= now_ns and not is_row_full:
            assert polling is not None
            self._in_row += 1
            polling.poll(schedule)
            if not polling.link.rate_hz:  # a read is always due: the thread is never idle
                self._hand_over(FAR_NS)
            return 0
        stepped, self._in_row = self._step_script(), 0
        if stepped:
            return 0
        self._hand_over(schedule.due_ns if schedule is not None else FAR_NS)
        if commands:
            return 0
        return max(0, schedule.due_ns - self.host.now_ns()) if schedule is not None else IDLE_NS

    def _next(self) -> tuple[_Polling | None, Timetable | None]:
        """Return the device with the next read, and its timetable."""
        first, earliest = None, None
        for polling in self._polling:
            schedule = polling.schedule
            if schedule is not None and not polling.held and (earliest is None or schedule.due_ns < earliest.due_ns):
                first, earliest = polling, schedule
        return first, earliest

    def _step_script(self) -> bool:
        """Execute one transfer of a waiting script; return whether a script was waiting."""
        for polling in self._polling:
            if polling.scripts:
                settle = polling.step_script()
                if settle is not None:
                    self._callbacks.append(settle)
                return True
        return False

    def _hand_over(self, next_ns: int) -> None:
        """Deliver all results that cannot wait until `next_ns`, with one wake-up of the loop."""
        callbacks = self._callbacks
        for polling in self._polling:
            delivery = polling.delivery(next_ns)
            if delivery is not None:
                callbacks.append(delivery)
        if callbacks:
            self._callbacks = []
            self._call_loop(lambda: [callback() for callback in callbacks])

    def _call_loop(self, callback: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(callback)

    def round_failed(self, error: BaseException) -> None:
        """Raise an exception of a round again in the loop's thread."""
        self._failure = error
        self._call_loop(self._raise)

    def _raise(self) -> None:
        assert self._failure is not None
        raise self._failure


class PolledBuses:
    """Buses by name. Synchronization: the loop's thread."""

    def __init__(self, host: HostClock, start_worker: StartWatchingWorker = BusThread) -> None:
        """`start_worker` starts the thread of a bus."""
        self._host = host
        self._start_worker = start_worker
        self._buses: dict[str, PolledBus] = {}

    def get(self, name: str) -> PolledBus:
        """Return a bus. Start its thread at the first call."""
        bus = self._buses.get(name)
        if bus is None:
            bus = self._buses[name] = PolledBus(name, asyncio.get_running_loop(), self._host, self._start_worker)
        return bus

    def end(self) -> None:
        """Stop all threads. A second call does nothing."""
        for bus in self._buses.values():
            bus.end()
        self._buses.clear()
