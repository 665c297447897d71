"""The scheduler of serving: clients that can be served stand in line, and each turn of the event loop has a time limit.

    client's socket ──▶ epoll ──▶ line ──least CPU time first──▶ serve(), one piece ──▶ epoll, or the line

All clients' sockets are in one epoll object, which is one descriptor of the event loop: however many clients have
something to say, the loop sees one event, and between two turns of at most TURN_NS it reads samples.
An armed socket reports once (EPOLLONESHOT) and is armed again when its client has nothing more to do, so a client that
is out of its allowance costs nothing until `tick` puts it in line again.

The order is that of a fair queue: each user has a run time, the CPU time that serving took, and each client has its own
within its user. The user with the least is next, and of that user's clients the one with the least; clients that have
used little of their allowance go before all others. One that comes back from waiting starts at most CREDIT_NS behind
the one served last, so what was consumed long ago does not count.
"""

import asyncio
import logging
import select
from collections.abc import Callable
from enum import Enum, auto
from heapq import heappop, heappush
from typing import Final, Protocol

from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

TURN_NS: Final = 1_000_000
"""Serving in one turn of the event loop: a period of a 1 kHz device, whose samples are read between two turns."""
PIECES_MAX: Final = 64
"""A turn has so many pieces at most, whatever the clock says."""
COLLECT_NS: Final = 200_000
"""Within a turn, sockets are looked at again after so long, so that a client that asks little is next at once."""
EVENTS_MAX: Final = 512
SERVING_PER_S_NS: Final = 600_000_000
"""Time per second for serving, large sends to watchers included; the rest is the devices' and other programs'."""
SERVING_BURST_NS: Final = 20_000_000
PAUSE_S: Final = 0.002
"""When that is used up, only clients with most of their own allowance are served for so long, …"""
PAUSE_MAX_NS: Final = 10_000_000
"""… but one turn in so long is everybody's."""
PIECE_NS: Final = 2_000
"""What a piece costs in addition to the CPU time measured: the scheduler itself."""
CREDIT_NS: Final = 1_000_000
CPU_PER_S_NS: Final = 100_000_000
"""CPU time that one client may use of each second: 1,500 `poll` requests."""
CPU_BURST_NS: Final = 200_000_000
CPU_LIGHT_NS: Final = 150_000_000
"""A client with so much of it left is light: it is served even when the time for serving is used up."""
CPU_NEW_NS: Final = 100_000_000
"""What a new client has, so that connecting again does not make it a light one."""
BYTES_PER_S: Final = 262_144
"""Bytes that one client may send each second: 4,000 requests of usual length."""
BYTES_BURST: Final = 1 << 20
OVER_TICKS_MAX: Final = 100
"""A client that asks for more than its allowance for so many ticks (100 ms each) is evicted."""


class ServedClient(Protocol):
    """Who is served."""

    def on_ready(self, events: int) -> None:
        """The socket reported these events (EPOLLIN …)."""
        ...

    def serve(self) -> bool:
        """Do one bounded piece of work. Returns whether there is more to do without waiting for the socket."""
        ...

    def wanted_events(self) -> int:
        """The events of the socket to wait for; 0 for none."""
        ...

    def on_failure(self, error: Exception) -> None:
        """`serve` raised, which is an internal error: end the connection."""
        ...

    def on_overload(self) -> None:
        """It asked for more than its allowance for too long: end the connection."""
        ...


class TokenBucket:
    """An allowance: `rate` per second, of which `burst` may gather."""

    __slots__ = ("_at_ns", "_burst", "_rate", "level")

    def __init__(self, rate: int, burst: int, now_ns: int, level: int | None = None) -> None:
        self._rate = rate
        self._burst = burst
        self._at_ns = now_ns
        self.level: float = burst if level is None else level
        """What may be used now; negative after a piece that used more than there was."""

    def use(self, amount: int) -> None:
        """Subtract what was used; the debt is at most `burst`."""
        self.level = max(-self._burst, self.level - amount)

    def fill(self, now_ns: int) -> None:
        """Add what has gathered since the last call."""
        self.level = min(self._burst, self.level + self._rate * (now_ns - self._at_ns) / NS_PER_S)
        self._at_ns = now_ns


class _State(Enum):
    IDLE = auto()
    """Armed, or waiting for nothing."""
    IN_LINE = auto()
    SERVED = auto()
    """`serve` runs."""
    PARKED = auto()
    """Out of its allowance."""
    GONE = auto()


class _User:
    """The clients of one user that stand in line."""

    __slots__ = ("clients", "line", "run_ns", "served_ns", "uid")

    def __init__(self, uid: int, run_ns: int) -> None:
        self.uid = uid
        self.clients = 0
        self.run_ns = run_ns
        self.served_ns = 0
        """Run time of the client that was served last."""
        self.line: list[tuple[bool, int, int, Turn]] = []
        """A heap: whether the client is not a light one, its run time, its number."""

    def urgency(self) -> tuple[bool, int]:
        """The less, the sooner it is served."""
        return self.line[0][0], self.run_ns


class Turn:
    """A client's place in the schedule, for that client's own use."""

    __slots__ = ("_cpu", "_data", "_scheduler", "client", "fd", "number", "over_ticks", "run_ns", "state", "user")

    def __init__(
        self, scheduler: "Scheduler", client: ServedClient, fd: int, number: int, user: _User, now_ns: int
    ) -> None:
        self.client = client
        self.fd = fd
        self.number = number
        self.user = user
        self.run_ns = user.served_ns
        self.state = _State.IDLE
        self.over_ticks = 0
        self._cpu = TokenBucket(CPU_PER_S_NS, CPU_BURST_NS, now_ns, CPU_NEW_NS)
        self._data = TokenBucket(BYTES_PER_S, BYTES_BURST, now_ns)
        self._scheduler = scheduler

    def line_up(self) -> None:
        """Have the client served when its turn comes; no-op if it is in line."""
        if self.state is _State.IDLE:
            self._scheduler.line_up(self)

    def arm(self) -> None:
        """Wait for the events that the client wants; no-op while it is in line, after which that is done anyhow."""
        if self.state is _State.IDLE:
            self._scheduler.arm(self)

    def count_bytes(self, count: int) -> None:
        """Count bytes that the client sent."""
        self._data.use(count)

    def charge(self, cpu_ns: int) -> None:
        """Count CPU time that serving the client took."""
        self.run_ns += cpu_ns
        self.user.run_ns += cpu_ns
        self._cpu.use(cpu_ns)

    @property
    def is_over(self) -> bool:
        """Whether the client has used up its allowance."""
        return self._cpu.level < 0 or self._data.level < 0

    @property
    def is_light(self) -> bool:
        """Whether the client has used little of its allowance of late."""
        return self._cpu.level >= CPU_LIGHT_NS and self._data.level >= 0

    def fill(self, now_ns: int) -> None:
        """Add what the client may use by now."""
        self._cpu.fill(now_ns)
        self._data.fill(now_ns)

    def leave(self) -> None:
        """Be served no more; may be called twice."""
        if self.state is not _State.GONE:
            self._scheduler.remove(self)


class Scheduler:
    """Serves clients in turns. Synchronization: the event loop's thread.

    `now_ns` is the clock that limits a turn, `cpu_ns` that of the CPU time of this thread, `time` what is left of the
    time for serving, in ns.
    """

    def __init__(self, now_ns: Callable[[], int], cpu_ns: Callable[[], int], time: TokenBucket) -> None:
        self._now_ns = now_ns
        self._cpu_ns = cpu_ns
        self.serving_time = time
        """What is left of the time for serving."""
        self._served_all_ns = 0
        self._loop = asyncio.get_running_loop()
        self._epoll = select.epoll()
        self._loop.add_reader(self._epoll.fileno(), self._on_events)
        self._next_turn: asyncio.Handle | None = None
        self._pausing = False
        """Whether the next turn comes after a pause."""
        self._places: dict[int, Turn] = {}
        self._users: dict[int, _User] = {}
        self._in_line: dict[_User, None] = {}
        """Users with clients in line."""
        self._served_ns = 0
        """Run time of the user that was served last."""
        self._parked: dict[Turn, None] = {}

    def add(self, client: ServedClient, fd: int, number: int, uid: int) -> Turn:
        """Wait for requests of a client from now on; clients of one user have the same `uid`."""
        self._epoll.register(fd, select.EPOLLIN | select.EPOLLONESHOT)
        user = self._users.get(uid)
        if user is None:
            user = self._users[uid] = _User(uid, self._served_ns)
        user.clients += 1
        place = self._places[fd] = Turn(self, client, fd, number, user, self._now_ns())
        return place

    def remove(self, place: Turn) -> None:
        """Serve a client no more."""
        place.state = _State.GONE
        self._places.pop(place.fd, None)
        self._parked.pop(place, None)
        if not self._epoll.closed:
            self._epoll.unregister(place.fd)
        place.user.clients -= 1
        if not place.user.clients:
            del self._users[place.user.uid]
            self._in_line.pop(place.user, None)

    def line_up(self, place: Turn) -> None:
        """Put a client that waits for nothing in line."""
        user = place.user
        place.state = _State.IN_LINE
        place.run_ns = max(place.run_ns, user.served_ns - CREDIT_NS)
        if not user.line:
            user.run_ns = max(user.run_ns, self._served_ns - CREDIT_NS)
            self._in_line[user] = None
        heappush(user.line, (not place.is_light, place.run_ns, place.number, place))
        if self._next_turn is None:
            self._schedule(True)

    def arm(self, place: Turn) -> None:
        """Wait for the events that a client wants."""
        events = place.client.wanted_events()
        if events:
            self._epoll.modify(place.fd, events | select.EPOLLONESHOT)

    def tick(self) -> None:
        """Put clients in line again that may use some time now, and evict those that never get along with theirs."""
        now_ns = self._now_ns()
        for place in list(self._places.values()):
            place.fill(now_ns)
            place.over_ticks = place.over_ticks + 1 if place.state is _State.PARKED else max(0, place.over_ticks - 1)
        for place in list(self._parked):
            if place.over_ticks > OVER_TICKS_MAX:
                self._overload(place)
            elif not place.is_over:
                del self._parked[place]
                place.state = _State.IDLE
                self.line_up(place)

    def _overload(self, place: Turn) -> None:
        try:
            place.client.on_overload()
        except Exception as error:  # noqa: BLE001 - whatever one client meets ends that client, not the daemon
            self._fail(place, error)

    def close(self) -> None:
        """Serve nobody any more; may be called twice."""
        if self._epoll.closed:
            return
        if self._next_turn is not None:
            self._next_turn.cancel()
        self._loop.remove_reader(self._epoll.fileno())
        self._epoll.close()

    # --- a turn -----------------------------------------------------------------------------------------------------

    def _on_events(self) -> None:
        """Sockets have events: serve once in this turn of the event loop, so that samples are read before and after."""
        if self._next_turn is None or self._pausing:
            self._schedule(True)

    def _turn(self) -> None:
        """Serve pieces until the time is used up or nobody is in line."""
        if self._next_turn is not None:
            self._next_turn.cancel()
            self._next_turn = None
        begun_ns = now_ns = self._now_ns()
        self.serving_time.fill(begun_ns)
        all_of_them = self.serving_time.level > 0 or begun_ns - self._served_all_ns >= PAUSE_MAX_NS
        if all_of_them:
            self._served_all_ns = begun_ns
        end_ns, collect_ns = begun_ns + TURN_NS, begun_ns + COLLECT_NS
        self._collect()
        for _ in range(PIECES_MAX):
            place = self._next(all_of_them)
            if place is None:
                break
            self._serve(place)
            now_ns = self._now_ns()
            if now_ns >= end_ns:
                break
            if now_ns >= collect_ns:
                collect_ns = now_ns + COLLECT_NS
                self._collect()
        self.serving_time.use(now_ns - begun_ns)
        if self._in_line and not self._epoll.closed:
            self._schedule(all_of_them)

    def _schedule(self, at_once: bool) -> None:
        """Have the next turn in the next turn of the event loop, or after a pause."""
        if self._next_turn is not None:
            self._next_turn.cancel()
        self._next_turn = self._loop.call_soon(self._turn) if at_once else self._loop.call_later(PAUSE_S, self._turn)
        self._pausing = not at_once

    def _collect(self) -> None:
        """Put those in line whose sockets have events."""
        if self._epoll.closed:
            return
        for fd, events in self._epoll.poll(0, EVENTS_MAX):
            place = self._places.get(fd)
            if place is not None:
                self._on_ready(place, events)

    def _on_ready(self, place: Turn, events: int) -> None:
        try:
            place.client.on_ready(events)
            place.line_up()
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(place, error)

    def _next(self, all_of_them: bool) -> Turn | None:
        """Take the next client out of the line; None if there is none, or none of those that may be served now."""
        while self._in_line:
            user = min(self._in_line, key=_User.urgency) if len(self._in_line) > 1 else next(iter(self._in_line))
            heavy, _, _, place = user.line[0]
            here = place.state is _State.IN_LINE
            if here and heavy and not all_of_them:
                return None
            heappop(user.line)
            if not user.line:
                del self._in_line[user]
            if here:
                user.run_ns = max(user.run_ns, self._served_ns - CREDIT_NS)
                user.served_ns = max(user.served_ns, place.run_ns)
                self._served_ns = max(self._served_ns, user.run_ns)
                return place
        return None

    def _serve(self, place: Turn) -> None:
        place.state = _State.SERVED
        client, begun_ns = place.client, self._cpu_ns()
        try:
            more = client.serve()
        except Exception as error:  # noqa: BLE001 - whatever one client's request meets ends that client, not the daemon
            self._fail(place, error)
            more = True
        place.charge(self._cpu_ns() - begun_ns + PIECE_NS)
        if place.state is not _State.SERVED:
            return
        place.state = _State.IDLE
        if not more:
            try:
                self.arm(place)
            except Exception as error:  # noqa: BLE001 - as above
                self._fail(place, error)
        elif place.is_over:
            place.state = _State.PARKED
            self._parked[place] = None
        else:
            self.line_up(place)

    def _fail(self, place: Turn, error: Exception) -> None:
        """End a client after an internal error; one that cannot even be ended is served no more."""
        try:
            place.client.on_failure(error)
        except Exception:
            log.exception("client %d cannot be ended, and is served no more", place.number)
            place.leave()
