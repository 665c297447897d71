"""Transfers of all devices of a bus in one thread, at absolute deadlines.

    loop ──commands──▶ thread: due poll? ─▶ transfer ─▶ readings ─┐
      ▲                        │ no: one transfer of a script      │ before it sleeps: one wake-up for all of it
      └────────────────────────┴───────────────────────────────────┘

The thread owns the links while they are open. It blocks in transfers and between rounds, nowhere else. A device that
fails costs the others the time of that transfer. What is done in a round, and when, is here; the thread that goes from
one to the next is a `Worker`, and time is `now_ns`: a test puts its own in the place of both.
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
from imud.model.units import NS_PER_S
from imud.sampling.path import QUIET_NS

LATE_SHARE: Final = 4
"""A read that begins later than a quarter of its period counts as late."""
QUIET_INTERVALS: Final = 3
UNMATCHED_MOST: Final = 64
"""Reads whose edges are not known yet; the oldest are forgotten, and not counted."""


class Deadlines:
    """Counters of kept and missed deadlines, over all schedules of a device."""

    __slots__ = ("late", "missed", "polls", "sum_late_ns", "worst_ns")

    def __init__(self) -> None:
        self.polls = 0
        """Deadlines that were served, late or not."""
        self.late = 0
        """Of these, those served more than a quarter of a period late."""
        self.missed = 0
        """Deadlines that passed before the one before them was done: nothing was read for them."""
        self.sum_late_ns = 0
        """Time from deadline to read, summed over `polls`."""
        self.worst_ns = 0
        """Longest time from deadline to read."""

    def served(self, late_ns: int, limit_ns: int) -> None:
        """Count a read by its delay after its deadline; longer than `limit_ns` is late."""
        self.polls += 1
        self.sum_late_ns += late_ns
        self.late += late_ns > limit_ns
        self.worst_ns = max(self.worst_ns, late_ns)


class Timetable(Protocol):
    """Timetable of a device's reads."""

    due_ns: int
    """CLOCK_MONOTONIC; the lowest on a bus comes first."""

    def begun(self, start_ns: int, /) -> None:
        """Count the read that begins."""
        ...

    def done(self, now_ns: int, /) -> None:
        """Set `due_ns` to that of the next read: one is over."""
        ...


class Schedule:
    """Deadlines at `begin_ns` + n · period. Synchronization: the bus's thread."""

    __slots__ = ("_late_ns", "counts", "due_ns", "period_ns")

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = round(NS_PER_S / rate_hz)
        self._late_ns = self.period_ns // LATE_SHARE
        self.counts = counts
        self.due_ns = begin_ns
        """The next deadline (CLOCK_MONOTONIC)."""

    def begun(self, start_ns: int) -> None:
        """Count the read for the present deadline."""
        self.counts.served(start_ns - self.due_ns, self._late_ns)

    def done(self, now_ns: int) -> None:
        """Go to the next deadline that can still be kept, and count those passed over."""
        due_ns, period_ns = self.due_ns + self.period_ns, self.period_ns
        if due_ns + period_ns <= now_ns:  # less late than a period, the next is still worth reading
            passed = (now_ns - due_ns) // period_ns
            self.counts.missed += passed
            due_ns += passed * period_ns
        self.due_ns = due_ns


class RoundRobin:
    """Turns instead of deadlines: every device is due at once, the one that waited longest comes first. Nothing is late
    or missed. Synchronization: the bus's thread."""

    __slots__ = ("counts", "due_ns", "period_ns")

    def __init__(self, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = 0
        """No-op: there are no deadlines."""
        self.counts = counts
        self.due_ns = begin_ns
        """End of the device's last turn (CLOCK_MONOTONIC): the lowest of all members is next."""

    def begun(self, _start_ns: int) -> None:
        """Count the turn that begins."""
        self.counts.polls += 1

    def done(self, now_ns: int) -> None:
        """Queue behind all other devices: the turn is over."""
        self.due_ns = now_ns


class ReadySchedule:
    """Edges instead of deadlines. The first read is at once: a line that stays active until it is read makes no edge
    before that. Synchronization: the bus's thread; `by_edges` is read by any thread.

    An edge may be noticed (`noticed`) before its stamp is known (`on_edges`): one of both causes the read.
    """

    __slots__ = (
        "_deadlines", "_edge_ns", "_interval_ns", "_pending", "_start_ns", "_starts", "_unstamped",
        "by_edges", "counts", "due_ns",
    )  # fmt: skip

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        """`rate_hz` is that of the deadlines."""
        self._deadlines = Schedule(rate_hz, begin_ns, counts)
        self._interval_ns = self._deadlines.period_ns
        self._edge_ns = begin_ns
        """The newest edge, or the beginning."""
        self._start_ns = 0
        """Begin of the newest read."""
        self._pending = True
        """Whether the newest edge was not read yet."""
        self._unstamped = False
        """Whether the stamp of the edge that is to be read is not known yet."""
        self._starts: deque[int] = deque(maxlen=UNMATCHED_MOST)
        """Begins of reads of such edges, oldest first."""
        self.counts = counts
        self.by_edges = True
        """False while deadlines take the place of edges."""
        self.due_ns = begin_ns
        """The edge that is to be read, or the deadline (CLOCK_MONOTONIC)."""

    @property
    def period_ns(self) -> int:
        """Time between two reads, as it is now."""
        return self._interval_ns if self.by_edges else self._deadlines.period_ns

    def noticed(self, now_ns: int) -> None:
        """Read at once: an edge came, whose stamp is not known yet."""
        if self.by_edges:
            self._pending = self._unstamped = True
            self.due_ns = self._edge_ns = now_ns

    def has_read(self, t_ns: int) -> bool:
        """Whether a read began after this edge. From any thread."""
        return t_ns <= self._start_ns

    def on_edges(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Note edges, oldest first, and the time between the two newest."""
        t_ns = times_ns[-1]
        self._count_reads(times_ns, interval_ns)
        if not self.by_edges and t_ns - self._edge_ns > QUIET_NS:  # one alone may be a disturbance
            self._edge_ns = t_ns
            return
        self.by_edges = True
        self._edge_ns, self._interval_ns = t_ns, interval_ns
        if t_ns > self._start_ns:
            self._pending, self._unstamped, self.due_ns = True, False, t_ns
        elif not self._unstamped:
            self._wait()

    def begun(self, start_ns: int) -> None:
        """Count a read that begins: of the newest edge, or since there is none."""
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
        """Wait for the next edge or deadline."""
        if self.by_edges:
            self._wait()
        else:
            self._deadlines.done(now_ns)
            self.due_ns = self._deadlines.due_ns

    def _count_reads(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Count reads of edges that were noticed, by their stamps: each is of the newest edge before it."""
        starts, at = self._starts, 0
        while starts and at < len(times_ns):
            start_ns, edge_ns = starts.popleft(), 0
            while at < len(times_ns) and times_ns[at] <= start_ns:
                edge_ns, at = times_ns[at], at + 1
            if edge_ns:  # else it is of none
                self.counts.served(start_ns - edge_ns, interval_ns // LATE_SHARE)

    def _wait(self) -> None:
        self._pending = False
        self.due_ns = self._edge_ns + max(QUIET_NS, QUIET_INTERVALS * self._interval_ns)


T = TypeVar("T")

IDLE_NS = 60 * NS_PER_S
FAR_NS = 1 << 63
"""Nothing is to be done before anything that may wait for it."""
POLLS_IN_ROW = 8
"""Number of polls after which a script has its turn on a bus that is never idle."""
READINGS_MAX = 10_000
"""Readings that wait for a loop that does not run; more are dropped and count as missed deadlines."""

OnReadings = Callable[[Sequence[Reading], LinkError | None], None]
"""Called in the loop's thread with what was read, oldest first, and the error that ended the bus, if any."""
Callback = Callable[[], None]


def ignore_target(_target: int) -> None:
    """Ignore the target of a script: the version for scripts that move no device."""


class BusMember:
    """A device on a bus, for its owner. Synchronization: the loop's thread only."""

    def __init__(self, bus: "PolledBus", link: PolledLink, deadlines: Deadlines, on_readings: OnReadings) -> None:
        """`PolledBus.join` creates a member. `deadlines` counts the reads."""
        self.link = link
        self.deadlines = deadlines
        self._bus = bus
        self._on_readings = on_readings
        self._left = False
        self._latency_ns = 0
        self._polling = _Polling(self, bus.now_ns)
        bus.command(lambda: bus.add(self._polling))

    async def run(self, script: TransferScript[T], target: int, on_target: Callable[[int], None] = ignore_target) -> T:
        """Run a transfer script with one target. Raises what it raises, TransferError and LinkError.

        `on_target` gets the target with which the script has ended, by an error as well.
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
        """Claim a target of a shared bus for this device; return False if it is another's."""
        return not self.link.shared or self._bus.claim(target, self)

    def release(self) -> None:
        """Release the claimed target; no-op without one."""
        self._bus.release(self)

    def start(self, polls: Sequence[Poll], timetable: Timetable | None = None) -> None:
        """Read from now on by the timetable; without one at deadlines, or in turns where the link has no rate."""
        rate_hz, begin_ns, counts = self.link.rate_hz, self._bus.now_ns(), self.deadlines
        schedule = timetable or (Schedule(rate_hz, begin_ns, counts) if rate_hz else RoundRobin(begin_ns, counts))
        self.command(lambda: self._polling.start(polls, schedule))

    def set_latency(self, latency_ns: int) -> None:
        """Let readings wait so long before they are delivered together, ns; 0: not at all."""
        if latency_ns != self._latency_ns:
            self._latency_ns = latency_ns
            self.command(lambda: self._polling.set_latency(latency_ns))

    def command(self, command: Callback) -> None:
        """Have the bus's thread run a function between two transfers, at once if it sleeps."""
        self._bus.command(command)

    def watch(self, fd: int, callback: Callback) -> bool:
        """Have the bus's thread call a function when something comes on a descriptor; return whether that is possible.

        It reads nothing of it, and goes on with what is due then.
        """
        return fd >= 0 and self._bus.watch(fd, callback)

    def unwatch(self, fd: int) -> None:
        """Call nothing for a descriptor any more; it may be closed already."""
        self._bus.unwatch(fd)

    def note(self, command: Callback) -> None:
        """Have the bus's thread run a function before what it does next, whenever that is."""
        self._bus.note(command)

    def stop(self) -> None:
        """Read no more until `start`; what was read before is still delivered."""
        self.command(self._polling.stop)

    def leave(self) -> None:
        """Leave the bus; the link is closed by its thread. Nothing is delivered any more. May be called twice."""
        if not self._left:
            self._left = True
            self.release()
            self.command(lambda: self._bus.remove(self._polling))

    def deliver(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """Pass readings to the owner, unless the member has left. Runs in the loop's thread."""
        if not self._left:
            self._on_readings(readings, problem)


class _Polling:
    """Polls of one device. Synchronization: the bus's thread only."""

    def __init__(self, member: BusMember, now_ns: Callable[[], int]) -> None:
        self.link = member.link
        self.scripts: deque[_ScriptRun] = deque()
        """Transfer scripts that wait for their transfers, the running one first."""
        self.schedule: Timetable | None = None
        """Timetable of its reads; None while it is not read."""
        self.held = False
        """Whether a script keeps it from being read until its next transfer."""
        self._member = member
        self._now_ns = now_ns
        self._polls: Sequence[Poll] = ()
        self._due_ns: list[int] = []
        self._readings: list[Reading] = []
        self._problem: LinkError | None = None
        self._latency_ns = 0
        self._failed = False
        """Whether one of the readings failed: the device may be gone, and is to be looked for at once."""

    def set_latency(self, latency_ns: int) -> None:
        """Let readings wait so long."""
        self._latency_ns = latency_ns

    def start(self, polls: Sequence[Poll], schedule: Timetable) -> None:
        """Read from now on."""
        self._polls, self._due_ns = polls, [0] * len(polls)
        self.schedule = schedule

    def stop(self) -> None:
        """Read no more."""
        self.schedule = None

    def poll(self, schedule: Timetable) -> None:
        """Read all that is due at the present deadline."""
        start_ns = self._now_ns()
        schedule.begun(start_ns)
        due_ns = self._due_ns
        for number, poll in enumerate(self._polls):
            if start_ns >= due_ns[number]:
                due_ns[number] = start_ns + poll.every_ns if poll.every_ns else 0
                self._read(number, poll.transfer)
        schedule.done(self._now_ns())

    def step_script(self) -> Callback | None:
        """Make one transfer of the running script; at its end return what settles it in the loop's thread."""
        settle = self.scripts[0].step(self.link)
        self.held = settle is None and self.scripts[0].holds
        if settle is not None:
            self.scripts.popleft()
        return settle

    def delivery(self, next_ns: int) -> Callback | None:
        """Return what delivers all that has gathered, to be called in the loop's thread; None for nothing, or where it
        may wait until `next_ns`, when it is asked for again."""
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
    """A transfer script that is running, one transfer at a time."""

    __slots__ = ("error", "future", "holds", "script", "send", "target")

    def __init__(self, script: TransferScript[Any], target: int, future: asyncio.Future[Any]) -> None:
        self.script = script
        self.target = target
        self.future = future
        self.send: bytes | None = None
        self.error: TransferError | None = None
        self.holds = False

    def step(self, link: PolledLink) -> Callback | None:
        """Make one transfer. At the end of the script return what settles it in the loop's thread."""
        try:
            wanted = self.script.throw(self.error) if self.error else self.script.send(self.send)  # type: ignore[arg-type]  # None begins a generator
            self.error, self.send = None, self._transfer(link, wanted)
        except StopIteration as end:
            return _settle(self.future, end.value, None)
        except TransferError as error:
            if self.error is error:  # the script let it out
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
                link.select(self.target)  # reads have their turn between two transfers of a script


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
    """A bus and its devices."""

    def __init__(
        self, name: str, loop: asyncio.AbstractEventLoop, host: HostClock, start_worker: StartWatchingWorker
    ) -> None:
        self.now_ns = host.now_ns
        """CLOCK_MONOTONIC."""
        self._loop = loop
        self._polling: list[_Polling] = []
        """Polls of the members. The bus's thread."""
        self._commands: deque[Callback] = deque()
        self._callbacks: list[Callback] = []
        """For the loop's thread, at the next wake-up."""
        self._in_row = 0
        self._owners: dict[int, BusMember] = {}
        """Claimed targets of a shared bus. The loop's thread."""
        self._failure: BaseException | None = None
        self._worker = start_worker(name, self._round, self._failed)

    # --- the loop's side ---------------------------------------------------------------------------------------------

    def join(self, link: PolledLink, deadlines: Deadlines, on_readings: OnReadings) -> BusMember:
        """Add a device whose link is open; how its deadlines are kept is counted in `deadlines`."""
        return BusMember(self, link, deadlines, on_readings)

    def claim(self, target: int, member: BusMember) -> bool:
        """Claim a target for a member; return False if it is another's."""
        return self._owners.setdefault(target, member) is member

    def release(self, member: BusMember) -> None:
        """Release what a member has claimed; no-op without."""
        self._owners = {target: owner for target, owner in self._owners.items() if owner is not member}

    def command(self, command: Callback) -> None:
        """Have something done by the thread between two transfers."""
        self.note(command)
        self._worker.ring()

    def note(self, command: Callback) -> None:
        """Have something done by the thread before what it does next."""
        self._commands.append(command)

    def watch(self, fd: int, callback: Callback) -> bool:
        """Have the thread call a function when something comes on a descriptor."""
        return self._worker.watch(fd, callback)

    def unwatch(self, fd: int) -> None:
        """Call nothing for a descriptor any more."""
        self._worker.unwatch(fd)

    def end(self) -> None:
        """Stop the thread after the present transfer and close what is open; may be called twice."""
        self._worker.end()
        for polling in self._polling:
            polling.link.close()
        self._polling = []

    # --- the thread's side -------------------------------------------------------------------------------------------

    def add(self, polling: "_Polling") -> None:
        """Serve one more device."""
        self._polling.append(polling)

    def remove(self, polling: "_Polling") -> None:
        """Serve a device no more, and close its link."""
        self._polling.remove(polling)
        polling.link.close()

    def _round(self) -> int:
        """Run commands, then due polls or one step of a script; return the time until the next work, ns."""
        commands = self._commands
        while commands:
            commands.popleft()()
        polling, schedule = self._next()
        if schedule is not None and schedule.due_ns <= self.now_ns() and self._in_row < POLLS_IN_ROW:
            assert polling is not None
            self._in_row += 1
            polling.poll(schedule)
            if not polling.link.rate_hz:  # something is always due here: no idle moment comes to hand over in
                self._hand_over(FAR_NS)
            return 0
        stepped, self._in_row = self._step_script(), 0
        if stepped:
            return 0
        self._hand_over(schedule.due_ns if schedule is not None else FAR_NS)
        if commands:
            return 0
        return max(0, schedule.due_ns - self.now_ns()) if schedule is not None else IDLE_NS

    def _next(self) -> tuple[_Polling | None, Timetable | None]:
        """Return who is to be read next, and its timetable."""
        first, earliest = None, None
        for polling in self._polling:
            schedule = polling.schedule
            if schedule is not None and not polling.held and (earliest is None or schedule.due_ns < earliest.due_ns):
                first, earliest = polling, schedule
        return first, earliest

    def _step_script(self) -> bool:
        """Make one transfer of one script, if there is any."""
        for polling in self._polling:
            if polling.scripts:
                settle = polling.step_script()
                if settle is not None:
                    self._callbacks.append(settle)
                return True
        return False

    def _hand_over(self, next_ns: int) -> None:
        """Deliver all gathered results that may not wait until `next_ns` to the loop, with one wake-up."""
        callbacks = self._callbacks
        for polling in self._polling:
            delivery = polling.delivery(next_ns)
            if delivery is not None:
                callbacks.append(delivery)
        if callbacks:
            self._callbacks = []
            self._call_loop(lambda: [callback() for callback in callbacks])

    def _call_loop(self, callback: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(callback)

    def _failed(self, error: BaseException) -> None:
        """Raise the exception of a round in the loop's thread."""
        self._failure = error
        self._call_loop(self._raise)

    def _raise(self) -> None:
        assert self._failure is not None
        raise self._failure


class PolledBuses:
    """The buses in use, by name. Synchronization: the loop's thread."""

    def __init__(self, host: HostClock, start_worker: StartWatchingWorker = BusThread) -> None:
        """`start_worker` starts the thread of a bus."""
        self._host = host
        self._start_worker = start_worker
        self._buses: dict[str, PolledBus] = {}

    def get(self, name: str) -> PolledBus:
        """Return the bus of that name; its thread starts with its first device."""
        bus = self._buses.get(name)
        if bus is None:
            bus = self._buses[name] = PolledBus(name, asyncio.get_running_loop(), self._host, self._start_worker)
        return bus

    def end(self) -> None:
        """Stop all threads; may be called twice."""
        for bus in self._buses.values():
            bus.end()
        self._buses.clear()
