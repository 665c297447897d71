"""Shares of a fleet: several collectors divide the messages of one fleet and write to one PostgreSQL database.

    ShareLeases (one connection) ──▶ FleetShares ──▶ for each held share: session ──▶ FleetCollector ──▶ PostgresStore

Each share has a lease in the database. One collector at a time holds it. Each collector also holds a lease of its own,
so that the others know the number of running collectors, and hold their part of the shares. The leases end when the
collector ends, and after LEASE_S if its host or process stops without an end of the connection.
"""

import asyncio
import logging
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from typing import Final, NamedTuple, TypeVar

from imud.fleet.collector import FleetCollector, Selection, TransactionTimes, session_of
from imud.fleet.database.leases import Lease, LeaseHolder, LeaseKey, LeaseKind
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.store import PostgresStore
from imud.fleet.database.transaction import StoreCounts
from imud.fleet.reader import SHARES_MAX, Fleet, Share
from imud.model.errors import BadArgument, ServerError, reason_of
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

T = TypeVar("T")

TURN_S: Final = 2.0  # time between two renewals of the leases, s
# Time for which a collector does not take a share again after a failure, s. Another collector takes the share first.
RETRY_S: Final = 10.0

# Duration of a transaction that is a problem, s. With TURN_S, the log and the metrics report it within 10 s.
PROBLEM_S: Final = 8.0


class ShareView(NamedTuple):
    """Leases of all collectors with one name."""

    live: int  # number of running collectors, with this collector
    held: frozenset[int]  # numbers of the shares that any collector holds


class ShareLeases:
    """Leases of one collector. Synchronization: one thread at a time."""

    def __init__(self, url: str, name: str, selection: Selection) -> None:
        self.own: set[int] = set()  # numbers of the shares that this collector holds
        self._name = name
        self._selection = "/".join(part or "" for part in selection)
        self._holder = LeaseHolder(url)

    @property
    def is_connected(self) -> bool:
        return self._holder.is_connected

    def connect(self) -> None:
        """Connect and take the lease of this collector. Raises ServerError; raises BadArgument if a collector with the
        same name has another selection."""
        self.close()
        self._holder.connect()
        key = LeaseKey(LeaseKind.COLLECTOR, self._name, self._holder.number)
        self._holder.take(key, self._selection)
        if any(lease.detail != self._selection for lease in self._collectors()):
            raise BadArgument(
                f"--name: expected one selection of gateways for the collectors with the name {self._name!r}, but "
                "another collector of this database has this name and another --site, --gateway or --device; try "
                "another --name"
            )

    def view(self) -> ShareView:
        """Renew the leases of this collector. Return the leases of all collectors. Raises ServerError."""
        self._holder.renew()
        leases = self._holder.read(self._name)
        live = sum(lease.key.kind is LeaseKind.COLLECTOR for lease in leases)
        held = frozenset(lease.key.number for lease in leases if lease.key.kind is LeaseKind.SHARE)
        return ShareView(live, held)

    def take(self, number: int) -> bool:
        """Take a share. Return False if another collector holds it. Raises ServerError."""
        if number not in self.own and self._holder.take(self._key(number)):
            self.own.add(number)
        return number in self.own

    def release(self, number: int) -> None:
        """Release a share. Do nothing if this collector does not hold it. Raises ServerError."""
        if number in self.own:
            self.own.discard(number)
            self._holder.release(self._key(number))

    def blocking_sessions(self, pid: int) -> str:
        """Return the sessions that the server process `pid` waits for; empty if there are none. Raises ServerError."""
        return self._holder.blocking_sessions(pid)

    def close(self) -> None:
        """Release all leases and close the connection. A second call does nothing."""
        self.own.clear()
        self._holder.close()

    def _collectors(self) -> list[Lease]:
        return [lease for lease in self._holder.read(self._name) if lease.key.kind is LeaseKind.COLLECTOR]

    def _key(self, number: int) -> LeaseKey:
        return LeaseKey(LeaseKind.SHARE, self._name, number)


class Changes(NamedTuple):
    """Numbers of the shares that a collector takes and releases."""

    take: tuple[int, ...] = ()
    release: tuple[int, ...] = ()


def changes(total: int, view: ShareView, own: Collection[int], paused: Collection[int]) -> Changes:
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
    database_connected: bool  # False also while a transaction has not ended for PROBLEM_S
    write_s: float  # duration of the longest transaction that has not ended, s; 0.0 without one


class _ShareRun:
    """Collector of one share. Synchronization: one event loop."""

    def __init__(self, share: Share) -> None:
        self.share = share
        self.collector: FleetCollector | None = None
        self.store: PostgresStore | None = None
        self.reported_ns: int | None = None  # start of the transaction that the log reports as slow
        self._stopped = False

    def begin(self, collector: FleetCollector, store: PostgresStore) -> None:
        """Set the collector that `stop` stops, and its store."""
        self.collector = collector
        self.store = store
        if self._stopped:
            collector.stop()

    def write_s(self, now_ns: int) -> float:
        """Return the duration of the transaction that has not ended, s; 0.0 without one."""
        start_ns = None if self.collector is None else self.collector.write_start_ns
        return 0.0 if start_ns is None else (now_ns - start_ns) / NS_PER_S

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
        self._leases = ShareLeases(url, fleet.name, selection)
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
        # The threads of the stores can all wait for the database. The leases need a thread of their own.
        self._thread = ThreadPoolExecutor(1, "fleet leases")

    @property
    def held(self) -> frozenset[int]:
        """Return the numbers of the shares that this collector holds."""
        return frozenset(self._leases.own)

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
        now_ns = self._fleet.now_ns()
        write_s = max((run.write_s(now_ns) for run in runs), default=0.0)
        return CollectorStatus(
            self.counts, self._times.read(), sum(one.waiting for one in sessions), len(self._leases.own), self._free,
            broker_connected=sum(one.is_connected for one in sessions) == len(runs),
            database_connected=self._leases.is_connected and write_s < PROBLEM_S,
            write_s=write_s,
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
            await self._in_thread(self._check)
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
            await self._in_thread(self._leases.close)
            self._thread.shutdown(wait=False)

    async def _in_thread(self, work: Callable[..., T], *arguments: object) -> T:
        """Call a function in the thread of the leases."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, work, *arguments)

    def _check(self) -> None:
        """Create missing tables and take the lease of this collector. Raises ServerError, BadArgument."""
        PostgresStore(self._url, self._settings).close()
        self._leases.connect()

    async def _turn(self) -> None:
        """Take and release shares. Without a database, release all shares."""
        try:
            for number in self._take_results():
                await self._in_thread(self._leases.release, number)
            await self._divide()
            await self._report_writes()
        except (ServerError, BadArgument) as error:
            if self._problem != str(error):
                log.warning("%s; this collector has no share until the database is available", error)
            self._problem = str(error)
            self._free = None
            self._stop_runs()
            await self._in_thread(self._leases.close)

    async def _divide(self) -> None:
        """Take free shares and release shares of others. Raises ServerError, BadArgument."""
        if not self._leases.is_connected:
            await self._in_thread(self._check)
        self._problem = ""
        view = await self._in_thread(self._leases.view)
        own = {number for number in self._leases.own if number < self._total}
        todo = changes(self._total, view, own, self._waiting())
        for number in todo.release:
            self._runs[number].stop()
        surplus = () if self._surplus is None or self._surplus in self._waiting() else (self._surplus,)
        for number in (*todo.take, *surplus):
            if number not in self._leases.own and await self._in_thread(self._leases.take, number):
                self._start(Share(number, self._total))
        self._free = sum(number not in view.held | self._leases.own for number in range(self._total))
        if self.live != view.live or todo != Changes():
            self.live = view.live
            names = ", ".join(map(str, sorted(self._leases.own))) or "none"
            log.info("shares of %d: %s; running collectors: %d", self._total, names, self.live)

    async def _report_writes(self) -> None:
        """Log each transaction that is longer than PROBLEM_S, with the sessions that block it. Raises ServerError."""
        now_ns = self._fleet.now_ns()
        for number, run in list(self._runs.items()):
            start_ns = None if run.collector is None else run.collector.write_start_ns
            if run.write_s(now_ns) < PROBLEM_S or start_ns == run.reported_ns or run.store is None:
                continue
            run.reported_ns = start_ns
            pid = run.store.server_pid
            sessions = "" if pid is None else await self._in_thread(self._leases.blocking_sessions, pid)
            cause = f"other sessions hold locks: {sessions}" if sessions else "see pg_stat_activity"
            log.warning("share %d: PostgreSQL has not stored the messages for %g s; %s", number, PROBLEM_S, cause)

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
            run.begin(collector, store)
            await collector.run()
        finally:
            await asyncio.to_thread(store.close)
