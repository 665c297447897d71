"""Shares of a fleet: several collectors divide the messages of one fleet and write to one PostgreSQL database.

    ShareLocks (one connection) ──▶ FleetShares ──▶ for each held share: session ──▶ FleetCollector ──▶ PostgresStore

Each share has an advisory lock. One collector at a time holds it. All collectors also hold a common lock, so that each
collector knows the number of running collectors, and holds its part of the shares. PostgreSQL releases the locks if the
collector ends, and after IDLE_S if its host or process stops without an end of the connection.

The locks only divide the work. Each row is stored once even if two collectors hold the same share for a moment: the
ledger in the database decides that.
"""

import asyncio
import logging
from collections.abc import Collection
from contextlib import closing, suppress
from hashlib import blake2s
from typing import Any, Final, NamedTuple

from imud.fleet.collector import FleetCollector, Selection, TransactionTimes, session_of
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.store import PostgresStore, connected, sentence_of
from imud.fleet.database.transaction import StoreCounts
from imud.fleet.reader import SHARES_MAX, Fleet, Share
from imud.model.errors import BadArgument, ServerError, reason_of
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

TURN_S: Final = 2.0  # time between two checks of the locks, s
# Time without a check after which PostgreSQL ends the connection with the locks, s. A slow host can miss some checks.
IDLE_S: Final = 15
# Time for which a collector does not take a share again after a failure, s. Another collector takes the share first.
RETRY_S: Final = 10.0

# Second key of the lock of all collectors with one name, plus 30 bits of the selection. Shares have lower numbers.
PRESENCE: Final = 1 << 30
_LOCKS: Final = (
    "SELECT objid::bigint, count(*) FROM pg_locks WHERE locktype = 'advisory' AND granted AND objsubid = 2 "
    "AND classid = %s::bigint::oid AND database = (SELECT oid FROM pg_database WHERE datname = current_database()) "
    "GROUP BY objid"
)
_TAKE: Final = "SELECT pg_try_advisory_lock(%s, %s)"
# PostgreSQL 13 has no such setting. Keep-alives of TCP then detect a host that stops, but not a process that stops.
_IDLE: Final = f"SELECT set_config(name, '{IDLE_S * 1000}', false) FROM pg_settings WHERE name = 'idle_session_timeout'"


class LockView(NamedTuple):
    """Locks of all collectors with one name."""

    live: int  # number of running collectors, with this collector
    held: frozenset[int]  # numbers of the shares that any collector holds


class ShareLocks:
    """Advisory locks of one collector. Synchronization: one thread at a time."""

    def __init__(self, url: str, name: str, selection: Selection) -> None:
        self.own: set[int] = set()  # numbers of the shares whose locks this collector holds
        self._url, self._name = url, name
        self._group = _hashed(name) >> 1  # the first key of a lock is a positive int4
        self._presence = PRESENCE | _hashed("/".join(one or "" for one in selection)) >> 2
        self._connection: Any = None

    @property
    def is_connected(self) -> bool:
        return self._connection is not None

    def connect(self) -> None:
        """Connect and take the lock of all collectors. Raises ServerError; raises BadArgument if a collector with the
        same name has another selection."""
        self.close()
        self._connection = connected(self._url)
        self._connection.autocommit = True
        self._call(_IDLE)
        self._call("SELECT pg_advisory_lock_shared(%s, %s)", self._group, self._presence)
        if any(key >= PRESENCE and key != self._presence for key, _ in self._locks()):
            raise BadArgument(
                f"--name: expected one selection of gateways for the collectors with the name {self._name!r}, but "
                "another collector of this database has this name and another --site, --gateway or --device; try "
                "another --name"
            )

    def view(self) -> LockView:
        """Return the locks of all collectors. Raises ServerError."""
        locks = dict(self._locks())
        return LockView(locks.get(self._presence, 1), frozenset(key for key in locks if key < PRESENCE))

    def take(self, number: int) -> bool:
        """Take the lock of a share. Return False if another collector holds it. Raises ServerError."""
        # PostgreSQL counts the locks of a connection: a second lock would need a second release
        if number not in self.own and self._call(_TAKE, self._group, number)[0][0]:
            self.own.add(number)
        return number in self.own

    def release(self, number: int) -> None:
        """Release the lock of a share. Do nothing if this collector does not hold it. Raises ServerError."""
        if number in self.own:
            self.own.discard(number)
            self._call("SELECT pg_advisory_unlock(%s, %s)", self._group, number)

    def close(self) -> None:
        """Close the connection and release all locks. A second call does nothing."""
        connection, self._connection = self._connection, None
        self.own.clear()
        if connection is not None:
            connection.close()

    def _locks(self) -> list[tuple[int, int]]:
        """Return the second key of each lock and the number of its holders."""
        return [(int(key), int(count)) for key, count in self._call(_LOCKS, self._group)]

    def _call(self, statement: str, *values: object) -> list[Any]:
        import psycopg

        if self._connection is None:
            raise ServerError("PostgreSQL: the connection with the locks of the shares is closed")
        try:
            found: list[Any] = self._connection.execute(statement, values).fetchall()
        except psycopg.Error as error:
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error
        return found


def _hashed(text: str) -> int:
    """Return a hash of 32 bits that is equal in all processes."""
    return int.from_bytes(blake2s(text.encode(), digest_size=4).digest(), "big")


class Changes(NamedTuple):
    """Numbers of the shares that a collector takes and releases."""

    take: tuple[int, ...] = ()
    release: tuple[int, ...] = ()


def changes(total: int, view: LockView, own: Collection[int], paused: Collection[int]) -> Changes:
    """Return the changes after which this collector holds its part of `total` shares: at most total / live, rounded up.

    `own` are the shares that this collector holds, `paused` the shares that it does not take now.
    """
    most = -(-total // max(1, view.live))
    free = [number for number in range(total) if number not in view.held and number not in paused]
    return Changes(tuple(free[: max(0, most - len(own))]), tuple(sorted(own)[most:]))


class CollectorStatus(NamedTuple):
    """State of this process and counters since its start."""

    counts: StoreCounts
    transactions: tuple[list[int], float]  # as `TransactionTimes.read`
    waiting: int  # received messages without an acknowledgement
    shares: int  # shares that this process holds
    free_shares: int | None  # shares that no collector holds; None without a connection to the database
    broker_connected: bool  # False if a share of this process has no connection to a broker
    database_connected: bool


class _ShareRun:
    """Collector of one share. Synchronization: one event loop."""

    def __init__(self, share: Share) -> None:
        self.share = share
        self.collector: FleetCollector | None = None
        self._stopped = False

    def begin(self, collector: FleetCollector) -> None:
        """Set the collector that `stop` stops."""
        self.collector = collector
        if self._stopped:
            collector.stop()

    def stop(self) -> None:
        """End after the present transaction."""
        self._stopped = True
        if self.collector is not None:
            self.collector.stop()


class FleetShares:
    """Collector of one process: it holds its part of the shares. Synchronization: one event loop, also for `stop`."""

    def __init__(
        self, fleet: Fleet, url: str, settings: CollectorSettings, selection: Selection, *, from_begin: bool = False
    ) -> None:
        """`url` is the database. Raises BadArgument if a name of the selection is invalid, or if MQTT 3.1.1 cannot
        divide the messages."""
        self.live = 1  # number of running collectors with the same name
        self._fleet, self._url, self._settings, self._selection = fleet, url, settings, selection
        self._from_begin = from_begin
        self._total = settings.shares
        session_of(fleet, selection, Share(0, self._total))  # check the selection and the version of MQTT
        self._locks = ShareLocks(url, fleet.name, selection)
        self._runs: dict[int, _ShareRun] = {}
        self._tasks: dict[int, asyncio.Task[None]] = {}  # tasks of the runs
        self._counts: dict[int, StoreCounts] = {}  # counters of each share since the start
        self._times = TransactionTimes()
        self._free: int | None = None  # number of shares that no collector holds
        self._paused_ns: dict[int, int] = {}  # time until which this collector does not take a share again
        # Next surplus share to check; None after the last. MQTT 3.1.1 has no shares.
        self._surplus = self._total if fleet.is_v5 else None
        self._stopped = False
        self._problem = ""
        self._changed = asyncio.Event()

    @property
    def held(self) -> frozenset[int]:
        """Return the numbers of the shares that this collector holds."""
        return frozenset(self._locks.own)

    @property
    def counts(self) -> StoreCounts:
        """Return the counters of all shares since the start."""
        total = StoreCounts()
        for one in list(self._counts.values()):
            total.add(one)
        return total

    def status(self) -> CollectorStatus:
        """Return the state of this process. Any thread may call this function."""
        runs = list(self._runs.values())
        sessions = [run.collector.session for run in runs if run.collector is not None]
        return CollectorStatus(
            self.counts, self._times.read(), sum(one.waiting for one in sessions), len(self._locks.own), self._free,
            broker_connected=sum(one.is_connected for one in sessions) == len(runs),
            database_connected=self._locks.is_connected,
        )  # fmt: skip

    def stop(self) -> None:
        """End after the present transactions. `run` stores the received messages first."""
        self._stopped = True
        self._changed.set()

    def ledger_text(self) -> str:
        """Return a summary of this run and of the ledger in the database. Raises ServerError."""
        with closing(PostgresStore(self._url, self._settings)) as store:
            store.counts = self.counts
            return store.ledger_text()

    async def run(self, *, stop_after_s: float | None = None) -> None:
        """Collect until `stop`, or for `stop_after_s`. Raises ServerError or BadArgument if the database is not ready
        at the start. After the start, try again after each failure."""
        now_ns = self._fleet.now_ns
        end_ns = None if stop_after_s is None else now_ns() + round(stop_after_s * NS_PER_S)
        try:
            await asyncio.to_thread(self._check)
            while not self._stopped and (end_ns is None or now_ns() < end_ns):
                await self._turn()
                left_s = TURN_S if end_ns is None else min(TURN_S, max(0.0, (end_ns - now_ns()) / NS_PER_S))
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), left_s)
                self._changed.clear()
        finally:
            self._stop_runs()
            if self._tasks:
                await asyncio.wait(self._tasks.values())
                self._take_results()
            await asyncio.to_thread(self._locks.close)

    def _check(self) -> None:
        """Create missing tables and take the lock of all collectors. Raises ServerError, BadArgument."""
        PostgresStore(self._url, self._settings).close()
        self._locks.connect()

    async def _turn(self) -> None:
        """Take and release shares. Without a database, release all shares."""
        try:
            for number in self._take_results():
                await asyncio.to_thread(self._locks.release, number)
            await self._divide()
        except (ServerError, BadArgument) as error:
            if self._problem != str(error):
                log.warning("%s; this collector has no share until the database is available", error)
            self._problem = str(error)
            self._free = None
            self._stop_runs()
            await asyncio.to_thread(self._locks.close)

    async def _divide(self) -> None:
        """Take free shares and release shares of others. Raises ServerError, BadArgument."""
        if not self._locks.is_connected:
            await asyncio.to_thread(self._locks.connect)
        self._problem = ""
        view = await asyncio.to_thread(self._locks.view)
        own = {number for number in self._locks.own if number < self._total}
        todo = changes(self._total, view, own, self._waiting())
        for number in todo.release:
            self._runs[number].stop()
        surplus = () if self._surplus is None or self._surplus in self._waiting() else (self._surplus,)
        for number in (*todo.take, *surplus):
            if number not in self._locks.own and await asyncio.to_thread(self._locks.take, number):
                self._start(Share(number, self._total))
        self._free = sum(number not in view.held | self._locks.own for number in range(self._total))
        if self.live != view.live or todo != Changes():
            self.live = view.live
            names = ", ".join(map(str, sorted(self._locks.own))) or "none"
            log.info("shares of %d: %s; running collectors: %d", self._total, names, self.live)

    def _start(self, share: Share) -> None:
        run = self._runs[share.number] = _ShareRun(share)
        task = self._tasks[share.number] = asyncio.ensure_future(self._collect(run))
        task.add_done_callback(lambda _: self._changed.set())

    def _waiting(self) -> set[int]:
        """Return the shares that this collector does not take now: after a failure, or because a run has not ended."""
        now_ns = self._fleet.now_ns()
        return {number for number, until_ns in self._paused_ns.items() if now_ns < until_ns} | self._runs.keys()

    def _stop_runs(self) -> None:
        for run in self._runs.values():
            run.stop()

    def _take_results(self) -> list[int]:
        """Remove the runs that ended. Return the numbers of their shares."""
        ended = [number for number, task in self._tasks.items() if task.done()]
        for number in ended:
            run, error = self._runs.pop(number), self._tasks.pop(number).exception()
            if error is not None:
                self._paused_ns[number] = self._fleet.now_ns() + round(RETRY_S * NS_PER_S)
                known = isinstance(error, ServerError | OSError)
                log.warning("share %d: %s; trying again", number, reason_of(error), exc_info=None if known else error)
            elif number == self._surplus and run.collector is not None and run.collector.is_drained:
                if run.collector.session.is_kept:
                    log.info("share %d: the session of an earlier number of shares is empty", number)
                # these sessions are consecutive
                is_last = not run.collector.session.is_kept or number + 1 >= SHARES_MAX
                self._surplus = None if is_last else number + 1
        return ended

    async def _collect(self, run: _ShareRun) -> None:
        """Collect the messages of a share. Raises ServerError or OSError if the store fails."""
        store = await asyncio.to_thread(PostgresStore, self._url, self._settings, from_begin=self._from_begin)
        store.counts = self._counts.setdefault(run.share.number, store.counts)
        try:
            collector = FleetCollector(self._fleet, store, self._selection, run.share, self._times)
            run.begin(collector)
            await collector.run()
        finally:
            await asyncio.to_thread(store.close)
