"""Transfers of all devices of a bus in one thread, at absolute deadlines.

    loop ──commands──▶ thread: due poll? ─▶ transfer ─▶ readings ─┐
      ▲                        │ no: one transfer of a script      │ before a sleep: one wake-up of the loop
      └────────────────────────┴───────────────────────────────────┘

The thread owns the open links. It blocks only in transfers and between rounds. A failing device delays the other
devices by the time of its transfer. This module contains the rounds; a `Worker` contains the thread.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from imud.contracts.codec import Poll, Reading
from imud.contracts.link import PolledLink
from imud.contracts.script import Transfer, TransferScript
from imud.device.timetable import Deadlines, RoundRobin, Schedule, Timetable
from imud.host.clock import HostClock
from imud.host.scope import INHERITED, Scope, words_of
from imud.host.threads import BusThread, StartWatchingWorker
from imud.model.errors import CommandError, ImudError, LinkError, TransferError
from imud.model.units import NS_PER_MS, NS_PER_S

log = logging.getLogger(__name__)


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


def raise_again(error: BaseException) -> None:
    """Raise an internal error in the loop's thread."""
    raise error


def ignore_target(_target: int) -> None:
    """Ignore the target of a script that does not change the address."""


class BusMember:
    """Membership of a device on a bus. Synchronization: the loop's thread only."""

    def __init__(self, bus: "PolledBus", link: PolledLink, deadlines: Deadlines, on_readings: OnReadings) -> None:
        """`PolledBus.join` creates a member in the scope of the device. `deadlines` counts the reads."""
        self.link = link
        self.deadlines = deadlines
        self._bus = bus
        self._on_readings = on_readings
        self._scope = INHERITED.get() or Scope(link.title, raise_again)
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
        """Run a function in the thread. Its error is an error of this member."""
        self._bus.command(lambda: self._polling.guard(command))

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
            self._bus.command(lambda: self._bus.remove(self._polling))

    def deliver(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """Pass readings to the owner, unless the member has left. Runs in the loop's thread."""
        if not self._left:
            self._scope.call(self._on_readings, readings, problem)

    def fail(self, error: BaseException) -> None:
        """Report an internal error of this member, unless it has left. Runs in the loop's thread."""
        if not self._left:
            self._scope.fail(error)


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
        self._error: BaseException | None = None  # internal error that ended the reads

    def guard(self, step: Callback) -> None:
        """Run a step of this member. An error ends only its reads and scripts."""
        try:
            step()
        except BaseException as error:  # noqa: BLE001 - the other members of the bus continue
            self.end_by(error)

    def end_by(self, error: BaseException) -> None:
        """Stop because of an internal error, which `delivery` reports."""
        self._error = self._error or error
        self.held = False
        self.stop()

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
        if self._error is not None:
            error, self._error = self._error, None
            return lambda: self._member.fail(error)
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
        except BaseException as error:  # noqa: BLE001 - an internal error of one device; the bus continues
            return _settle(self.future, None, CommandError(f"the script failed: {words_of(error)}"))
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
        """Remove a device and close its link. An error of the link must not end the bus."""
        self._polling.remove(polling)
        try:
            polling.link.close()
        except BaseException as error:  # noqa: BLE001 - the other members of the bus continue
            log.error("%s: cannot close its link: %s", polling.link.title, words_of(error))

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
            try:
                polling.poll(schedule)
            except BaseException as error:  # noqa: BLE001 - the other members of the bus continue
                polling.end_by(error)
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
