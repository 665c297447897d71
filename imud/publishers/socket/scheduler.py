"""Scheduler of the clients: serves them in each turn of the event loop, for a limited time.

    socket of a client ──▶ epoll ──▶ queue, least CPU time first ──▶ serve(), one piece ──▶ epoll, or the queue

One epoll object contains the sockets of all clients. The event loop sees one descriptor, and reads samples between two
turns of at most TURN_NS. A socket reports one event (EPOLLONESHOT). The scheduler arms the socket again when its client
has no more work. Thus a client without allowance costs nothing until `tick` puts it in the queue again.

The queue is fair between users and between the clients of a user. A *run time* is the CPU time that serving took. The
user with the least run time is next, and of this user the client with the least run time. Clients that used little of
their allowance go before all others. A user or a client that had no work gets a run time at most CREDIT_NS below the
run time of the one served last, so unused time of the past gives no advantage.
"""

import asyncio
import logging
import select
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto
from heapq import heappop, heappush
from typing import Final

from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

TURN_NS: Final = 1_000_000
"""Maximum time of serving in one turn of the event loop, ns: the sample period of a 1 kHz device."""
PIECES_MAX: Final = 64
"""Maximum number of pieces in one turn."""
COLLECT_NS: Final = 200_000
"""Interval between two polls of the sockets within a turn, ns. imud then serves clients with few requests first."""
EVENTS_MAX: Final = 512
SERVING_PER_S_NS: Final = 600_000_000
"""Time for serving per second, ns, with batches to many clients. The rest is for devices and other programs."""
SERVING_BURST_NS: Final = 20_000_000
PAUSE_S: Final = 0.002
"""Time between two turns while the time for serving is used up. These turns serve only light clients."""
PAUSE_MAX_NS: Final = 10_000_000
"""Interval of the turns that serve every client, ns."""
PIECE_NS: Final = 2_000
"""CPU time of the scheduler for one piece, ns."""
CREDIT_NS: Final = 1_000_000
"""Maximum lead of a client or user that had no work, ns of run time."""
CPU_PER_S_NS: Final = 100_000_000
"""CPU time of a client per second, ns: 1,500 `poll` requests."""
CPU_BURST_NS: Final = 200_000_000
CPU_LIGHT_NS: Final = 150_000_000
"""Minimum unused CPU time of a light client, ns. imud serves light clients also if the time for serving is used up."""
CPU_NEW_NS: Final = 100_000_000
"""CPU time of a new client, ns: less than CPU_LIGHT_NS, because a new connection must not make a light client."""
BYTES_PER_S: Final = 262_144
"""Maximum number of bytes per second from a client: 4,000 requests of usual length."""
BYTES_BURST: Final = 1 << 20
OVER_TICKS_MAX: Final = 100
"""Number of ticks (100 ms each) without allowance after which imud evicts a client."""


@dataclass(slots=True)
class TokenBucket:
    """An allowance: `rate` per second, at most `burst`."""

    rate: int
    burst: int
    at_ns: int  # CLOCK_MONOTONIC of the last call of `fill`
    level: float  # unused allowance; negative after a piece that used more

    def use(self, amount: int) -> None:
        """Subtract the used amount; the debt is at most `burst`."""
        self.level = max(-self.burst, self.level - amount)

    def fill(self, now_ns: int) -> None:
        """Add the allowance of the time since the last call."""
        self.level = min(self.burst, self.level + self.rate * (now_ns - self.at_ns) / NS_PER_S)
        self.at_ns = now_ns


class _State(Enum):
    IDLE = auto()  # the client has no work, or its socket is armed
    QUEUED = auto()
    SERVED = auto()  # `serve` runs
    PARKED = auto()  # the client has work and no allowance
    GONE = auto()


@dataclass(slots=True, eq=False)
class _User:
    """The clients of one user."""

    uid: int
    run_ns: int
    clients: int = 0
    served_ns: int = 0  # run time of the client that was served last
    # heap of the queued clients: False for a light client, run time, number
    queue: list[tuple[bool, int, int, "ScheduledClient"]] = field(default_factory=list)

    def urgency(self) -> tuple[bool, int]:
        """Return the key of the queue: the user with the smallest key is next."""
        return self.queue[0][0], self.run_ns


class ScheduledClient(ABC):
    """Base class of a client: its allowance, and its state in the scheduler."""

    def __init__(self, scheduler: "Scheduler", fd: int, number: int, uid: int) -> None:
        now_ns = scheduler.now_ns()
        self.fd = fd
        self.number = number
        self.state = _State.IDLE
        self.over_ticks = 0
        self.cpu = TokenBucket(CPU_PER_S_NS, CPU_BURST_NS, now_ns, CPU_NEW_NS)
        self.data = TokenBucket(BYTES_PER_S, BYTES_BURST, now_ns, BYTES_BURST)
        self.user = scheduler.add(self, uid)
        self.run_ns = self.user.served_ns

    @property
    def is_over(self) -> bool:
        return self.cpu.level < 0 or self.data.level < 0

    @property
    def is_full(self) -> bool:
        return self.cpu.level >= CPU_BURST_NS and self.data.level >= BYTES_BURST

    @property
    def is_light(self) -> bool:
        """Whether the client has recently used little of its allowance."""
        return self.cpu.level >= CPU_LIGHT_NS and self.data.level >= 0

    def fill(self, now_ns: int) -> None:
        self.cpu.fill(now_ns)
        self.data.fill(now_ns)

    @abstractmethod
    def on_ready(self, events: int) -> None:
        """Note the events that the socket reported (EPOLLIN …)."""

    @abstractmethod
    def serve(self) -> bool:
        """Do one piece of work. Return whether the client has more work without an event of its socket."""

    @abstractmethod
    def wanted_events(self) -> int:
        """Return the events of the socket to wait for; 0 for no events."""

    @abstractmethod
    def on_failure(self, error: Exception) -> None:
        """End the connection because another method raised an exception, which is an internal error."""

    @abstractmethod
    def evict(self, reason: str) -> None:
        """End the connection because the client exceeded a limit."""


class Scheduler:
    """Serves clients in turns. Synchronization: the event loop's thread.

    `now_ns` is the clock that limits a turn, `cpu_ns` the CPU time of this thread, `time` the allowance for serving.
    """

    def __init__(self, now_ns: Callable[[], int], cpu_ns: Callable[[], int], time: TokenBucket) -> None:
        self.now_ns = now_ns
        self._cpu_ns = cpu_ns
        self.serving_time = time
        self._served_all_ns = 0  # time of the last turn that served every client
        self._loop = asyncio.get_running_loop()
        self._epoll = select.epoll()
        self._loop.add_reader(self._epoll.fileno(), self._schedule)
        self._next_turn: asyncio.Handle | None = None
        self._pausing = False  # whether the next turn begins after a pause
        self._clients: dict[int, ScheduledClient] = {}  # all clients by descriptor
        self._users: dict[int, _User] = {}
        self._queued: dict[_User, None] = {}  # users with queued clients
        self._served_ns = 0  # run time of the user that was served last
        self.parked: dict[ScheduledClient, None] = {}  # clients that wait for their allowance
        self._charged: dict[ScheduledClient, None] = {}  # clients whose allowances are not full

    def add(self, client: ScheduledClient, uid: int) -> _User:
        """Wait for input of a new client. Return the user `uid`, who may have other clients."""
        self._epoll.register(client.fd, select.EPOLLIN | select.EPOLLONESHOT)
        user = self._users.get(uid)
        if user is None:
            user = self._users[uid] = _User(uid, self._served_ns)
        user.clients += 1
        self._clients[client.fd] = client
        self._charged[client] = None
        return user

    def remove(self, client: ScheduledClient) -> None:
        """Do not serve a client any longer. A second call does nothing."""
        if client.state is _State.GONE:
            return
        client.state = _State.GONE
        self._clients.pop(client.fd, None)
        self.parked.pop(client, None)
        self._charged.pop(client, None)
        if not self._epoll.closed:
            self._epoll.unregister(client.fd)
        user = client.user
        user.clients -= 1
        if not user.clients:
            del self._users[user.uid]
            self._queued.pop(user, None)

    def enqueue(self, client: ScheduledClient) -> None:
        """Put a client in the queue. Do nothing unless the client is idle."""
        if client.state is not _State.IDLE:
            return
        user = client.user
        client.state = _State.QUEUED
        client.run_ns = max(client.run_ns, user.served_ns - CREDIT_NS)
        if not user.queue:
            user.run_ns = max(user.run_ns, self._served_ns - CREDIT_NS)
            self._queued[user] = None
        heappush(user.queue, (not client.is_light, client.run_ns, client.number, client))
        if self._next_turn is None:
            self._schedule()

    def arm(self, client: ScheduledClient) -> None:
        """Wait for the events that a client wants. Do nothing unless the client is idle: `_serve` arms it later."""
        if client.state is _State.IDLE:
            events = client.wanted_events()
            if events:
                self._epoll.modify(client.fd, events | select.EPOLLONESHOT)

    def tick(self) -> bool:
        """Fill the allowances. Queue parked clients with a new allowance. Evict clients that exceed theirs for 10 s.
        Return whether a client needs the next tick within 100 ms."""
        if not self._charged:
            return False
        now_ns = self.now_ns()
        needs_ticks = False
        for client in list(self._charged):
            client.fill(now_ns)
            is_parked = client.state is _State.PARKED
            if is_parked or client.over_ticks:
                client.over_ticks += 1 if is_parked else -1
                needs_ticks = True
            elif client.is_full:
                del self._charged[client]
        for client in list(self.parked):
            if client.over_ticks > OVER_TICKS_MAX:
                try:
                    client.evict("it keeps asking for more than the allowance of a client")
                except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
                    self._fail(client, error)
            elif not client.is_over:
                del self.parked[client]
                client.state = _State.IDLE
                self.enqueue(client)
        return needs_ticks

    def close(self) -> None:
        """Stop serving."""
        if self._next_turn is not None:
            self._next_turn.cancel()
        self._loop.remove_reader(self._epoll.fileno())
        self._epoll.close()

    # --- a turn -----------------------------------------------------------------------------------------------------

    def _schedule(self, *, pause: bool = False) -> None:
        """Run `_turn` in the next turn of the event loop, or after a pause. An event of a client ends the pause."""
        # not now: the loop reads samples before and after a turn
        if self._next_turn is not None:
            if not (pause or self._pausing):
                return
            self._next_turn.cancel()
        self._next_turn = self._loop.call_later(PAUSE_S, self._turn) if pause else self._loop.call_soon(self._turn)
        self._pausing = pause

    def _turn(self) -> None:
        """Serve pieces until TURN_NS is over, or the queue contains no client that may be served."""
        if self._next_turn is not None:
            self._next_turn.cancel()
            self._next_turn = None
        begun_ns = now_ns = self.now_ns()
        self.serving_time.fill(begun_ns)
        serves_all = self.serving_time.level > 0 or begun_ns - self._served_all_ns >= PAUSE_MAX_NS
        if serves_all:
            self._served_all_ns = begun_ns
        end_ns, collect_ns = begun_ns + TURN_NS, begun_ns + COLLECT_NS
        self._collect()
        for _ in range(PIECES_MAX):
            client = self._next(serves_all)
            if client is None:
                break
            self._serve(client)
            now_ns = self.now_ns()
            if now_ns >= end_ns:
                break
            if now_ns >= collect_ns:
                collect_ns = now_ns + COLLECT_NS
                self._collect()
        self.serving_time.use(now_ns - begun_ns)
        if self._queued and not self._epoll.closed:
            self._schedule(pause=not serves_all)

    def _collect(self) -> None:
        """Queue the clients with events on their sockets."""
        if self._epoll.closed:
            return
        for fd, events in self._epoll.poll(0, EVENTS_MAX):
            client = self._clients.get(fd)
            if client is not None:
                try:
                    client.on_ready(events)
                    self.enqueue(client)
                except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
                    self._fail(client, error)

    def _next(self, serves_all: bool) -> ScheduledClient | None:
        """Take the next client from the queue; None if the queue is empty, or if only light clients are served."""
        while self._queued:
            user = min(self._queued, key=_User.urgency) if len(self._queued) > 1 else next(iter(self._queued))
            is_heavy, _, _, client = user.queue[0]
            is_queued = client.state is _State.QUEUED  # a client that left stays in the heap until now
            if is_queued and is_heavy and not serves_all:
                return None
            heappop(user.queue)
            if not user.queue:
                del self._queued[user]
            if is_queued:
                user.run_ns = max(user.run_ns, self._served_ns - CREDIT_NS)
                user.served_ns = max(user.served_ns, client.run_ns)
                self._served_ns = max(self._served_ns, user.run_ns)
                return client
        return None

    def _serve(self, client: ScheduledClient) -> None:
        """Serve one piece, then queue, park or arm the client."""
        client.state = _State.SERVED
        if client not in self._charged:
            client.fill(self.now_ns())
            self._charged[client] = None
        begun_ns = self._cpu_ns()
        try:
            has_more = client.serve()
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            self._fail(client, error)
            has_more = True
        used_ns = self._cpu_ns() - begun_ns + PIECE_NS
        client.run_ns += used_ns
        client.user.run_ns += used_ns
        client.cpu.use(used_ns)
        if client.state is not _State.SERVED:  # the client has left
            return
        if has_more and client.is_over:
            client.state = _State.PARKED
            self.parked[client] = None
            return
        client.state = _State.IDLE
        if has_more:
            self.enqueue(client)
            return
        try:
            self.arm(client)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            self._fail(client, error)

    def _fail(self, client: ScheduledClient, error: Exception) -> None:
        """End a client after an internal error. If that fails too, remove the client from the scheduler."""
        try:
            client.on_failure(error)
        except Exception:
            log.exception("cannot end client %d after an internal error; it is no longer served", client.number)
            self.remove(client)
