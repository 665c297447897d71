"""One thread per bus: it makes the transfers of all devices there at absolute deadlines, and hands over what was read.

    loop ──commands──▶ thread: due poll? ─▶ transfer ─▶ readings ─┐
      ▲                        │ no: one transfer of a dialogue    │ before it sleeps: one wake-up for all of it
      └────────────────────────┴───────────────────────────────────┘

The thread owns the links while they are open. It blocks in transfers and between rounds, nowhere else. A device that
fails costs the others the time of that transfer. What is done in a round, and when, is here; the thread that goes from
one to the next is in `bus_thread`, and time is `now_ns`: a test puts its own in the place of both.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from time import monotonic_ns
from typing import Any, TypeVar

from imud.contracts.link import PolledLink
from imud.contracts.polling import Poll, Reading, Transfer, TransferScript
from imud.errors import ImudError, LinkError, TransferError
from imud.runtime.polled.round_robin import RoundRobin
from imud.runtime.polled.schedule import Deadlines, Schedule, Timetable
from imud.units import NS_PER_S
from imud.worker import BusThread, StartWorker

T = TypeVar("T")

IDLE_NS = 60 * NS_PER_S
POLLS_IN_ROW = 8
"""On a bus that is never idle, a dialogue has its turn after so many polls."""
READINGS_MAX = 10_000
"""Readings that wait for a loop that does not run; more are given up and count as missed deadlines."""

TakeReadings = Callable[[Sequence[Reading], LinkError | None], None]
"""Called in the loop's thread with what was read, oldest first, and the error that ended the bus, if any."""


class Member:
    """One device on a bus. Methods: the loop's thread; what begins with an underscore: the bus's."""

    def __init__(self, bus: "PolledBus", link: PolledLink, deadlines: Deadlines, take: TakeReadings) -> None:
        self.link = link
        self._deadlines = deadlines
        self._schedule: Timetable | None = None
        self._bus = bus
        self._now_ns = bus.now_ns
        self._take = take
        self._polls: Sequence[Poll] = ()
        self._due_ns: list[int] = []
        self._talks: deque[_ScriptRun] = deque()
        self._readings: list[Reading] = []
        self._problem: LinkError | None = None
        self._left = False

    async def talk(self, dialogue: TransferScript[T], target: int) -> T:
        """Run a dialogue with one target. Raises what it raises, TransferError and LinkError."""
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._bus.command(lambda: self._talks.append(_ScriptRun(dialogue, target, future)))
        return await future

    def claim(self, target: int) -> bool:
        """Take a target of a shared bus for this device; False if it is another's."""
        if not self.link.shared:
            return True
        return self._bus.taken.setdefault(target, self) is self

    def release(self) -> None:
        """Give its target free."""
        self._bus.release(self)

    def start(self, polls: Sequence[Poll], timetable: Timetable | None = None) -> None:
        """Read from now on by the timetable; without one at deadlines, or in turns where the link has no rate."""
        rate_hz, begin_ns, counts = self.link.rate_hz, self._now_ns(), self._deadlines
        schedule = timetable or (Schedule(rate_hz, begin_ns, counts) if rate_hz else RoundRobin(begin_ns, counts))

        def begin() -> None:
            self._polls, self._due_ns = polls, [0] * len(polls)
            self._schedule = schedule

        self.command(begin)

    def command(self, command: Callable[[], None]) -> None:
        """Have something done by the bus's thread between two transfers, at once where it sleeps."""
        self._bus.command(command)

    def rest(self) -> None:
        """Read no more until `start`; what was read before still comes."""
        self.command(self._rest)

    def leave(self) -> None:
        """Leave the bus; the link is closed by its thread. Nothing is delivered any more. May be called twice."""
        if not self._left:
            self._left = True
            self._bus.leave(self)

    def _rest(self) -> None:
        self._schedule = None

    def _poll(self, schedule: Timetable) -> None:
        """All that is due at the present deadline."""
        start_ns = self._now_ns()
        schedule.begun(start_ns)
        due_ns = self._due_ns
        for number, poll in enumerate(self._polls):
            if start_ns >= due_ns[number]:
                due_ns[number] = start_ns + poll.every_ns if poll.every_ns else 0
                self._read(number, poll.transfer)
        schedule.done(self._now_ns())

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
            self._rest()
            return
        if len(self._readings) < READINGS_MAX:
            self._readings.append(Reading(number, data, error, start_ns, self._now_ns()))
        else:
            self._deadlines.missed += 1


class _ScriptRun:
    """A dialogue on its way, one transfer at a time."""

    __slots__ = ("dialogue", "error", "future", "send", "target")

    def __init__(self, dialogue: TransferScript[Any], target: int, future: asyncio.Future[Any]) -> None:
        self.dialogue = dialogue
        self.target = target
        self.future = future
        self.send: bytes | None = None
        self.error: TransferError | None = None

    def step(self, link: PolledLink) -> Callable[[], None] | None:
        """Make one transfer. At the end returns what tells the loop of it."""
        try:
            wanted = self.dialogue.throw(self.error) if self.error else self.dialogue.send(self.send)  # type: ignore[arg-type]  # None begins a generator
            link.select(self.target)
            self.error, self.send = None, link.transfer(wanted)
        except StopIteration as end:
            return _settle(self.future, end.value, None)
        except TransferError as error:
            if self.error is error:  # it came back out of the dialogue
                return _settle(self.future, None, error)
            self.error = error
        except ImudError as error:
            return _settle(self.future, None, error)
        return None


def _settle(future: asyncio.Future[Any], value: object, error: Exception | None) -> Callable[[], None]:
    def settle() -> None:
        if future.done():
            return
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)

    return settle


class PolledBus:
    """One bus and its devices."""

    def __init__(
        self, name: str, loop: asyncio.AbstractEventLoop, now_ns: Callable[[], int], start_worker: StartWorker
    ) -> None:
        self.now_ns = now_ns
        """CLOCK_MONOTONIC."""
        self._loop = loop
        self._members: list[Member] = []
        self._commands: deque[Callable[[], None]] = deque()
        self._news: list[Callable[[], None]] = []
        self._in_row = 0
        self.taken: dict[int, Member] = {}
        """Targets of a shared bus and whose they are. The loop's thread."""
        self.failure: BaseException | None = None
        self._worker = start_worker(name, self._round, self._failed)

    # --- the loop's side ---------------------------------------------------------------------------------------------

    def join(self, link: PolledLink, deadlines: Deadlines, take: TakeReadings) -> Member:
        """A device whose link is open comes to this bus; how its deadlines are kept is counted in `deadlines`."""
        member = Member(self, link, deadlines, take)
        self.command(lambda: self._members.append(member))
        return member

    def leave(self, member: Member) -> None:
        """It goes; the thread closes its link."""
        self.release(member)

        def close() -> None:
            self._members.remove(member)
            member.link.close()

        self.command(close)

    def release(self, member: Member) -> None:
        """Its target is free for others."""
        self.taken = {target: owner for target, owner in self.taken.items() if owner is not member}

    def command(self, command: Callable[[], None]) -> None:
        """Have something done by the thread between two transfers."""
        self._commands.append(command)
        self._worker.ring()

    def end(self) -> None:
        """Stop the thread after the present transfer and close what is open; may be called twice."""
        self._worker.end()
        for member in self._members:
            member.link.close()
        self._members = []

    # --- the thread's side -------------------------------------------------------------------------------------------

    def _round(self) -> int:
        """Commands, then what is due or one step of a dialogue; how long there is nothing else to do, in ns."""
        commands = self._commands
        while commands:
            commands.popleft()()
        member, due_ns = self._next()
        now_ns = self.now_ns()
        if member is not None and member._schedule is not None and due_ns <= now_ns and self._in_row < POLLS_IN_ROW:
            self._in_row += 1
            member._poll(member._schedule)
            if not member.link.rate_hz:  # something is always due here: no idle moment comes to hand over in
                self._hand_over()
            return 0
        stepped, self._in_row = self._step(), 0
        if stepped:
            return 0
        self._hand_over()
        if commands:
            return 0
        return max(0, due_ns - self.now_ns()) if member is not None else IDLE_NS

    def _failed(self, error: BaseException) -> None:
        """A round raised: the loop's thread must."""
        self.failure = error
        self._call_loop(self._raise)

    def _next(self) -> tuple[Member | None, int]:
        first, due_ns = None, 0
        for member in self._members:
            schedule = member._schedule
            if schedule is not None and (first is None or schedule.due_ns < due_ns):
                first, due_ns = member, schedule.due_ns
        return first, due_ns

    def _step(self) -> bool:
        """One transfer of one dialogue, if there is any."""
        for member in self._members:
            if member._talks:
                ended = member._talks[0].step(member.link)
                if ended is not None:
                    member._talks.popleft()
                    self._news.append(ended)
                return True
        return False

    def _hand_over(self) -> None:
        """Give the loop all that has gathered, with one wake-up."""
        news = self._news
        for member in self._members:
            if member._readings or member._problem is not None:
                news.append(_delivery(member, member._readings, member._problem))
                member._readings, member._problem = [], None
        if news:
            self._news = []
            self._call_loop(lambda: [tell() for tell in news])

    def _call_loop(self, callback: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody is there to be told
            self._loop.call_soon_threadsafe(callback)

    def _raise(self) -> None:
        assert self.failure is not None
        raise self.failure


def _delivery(member: Member, readings: Sequence[Reading], problem: LinkError | None) -> Callable[[], None]:
    return lambda: None if member._left else member._take(readings, problem)


class Buses:
    """The buses in use, by name. Synchronization: the loop's thread."""

    def __init__(self, now_ns: Callable[[], int] = monotonic_ns, start_worker: StartWorker = BusThread) -> None:
        """Time, and what runs the buses, are the real ones unless given."""
        self.now_ns = now_ns
        self._start_worker = start_worker
        self._buses: dict[str, PolledBus] = {}

    def get(self, name: str) -> PolledBus:
        """The bus of that name; its thread starts with its first device."""
        bus = self._buses.get(name)
        if bus is None:
            bus = self._buses[name] = PolledBus(name, asyncio.get_running_loop(), self.now_ns, self._start_worker)
        return bus

    def end(self) -> None:
        """Stop all threads; may be called twice."""
        for bus in self._buses.values():
            bus.end()
        self._buses.clear()
