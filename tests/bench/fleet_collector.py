"""The collector in a process of its own, for measurements: `FleetCollector`, with or without rows in PostgreSQL.

    python -m tests.bench.fleet_collector --version 3.1.1 --to postgresql://… URL …

The process prints `ready` after it has connected. It reads the number of published samples from standard input, waits
until all these samples have arrived, and prints its counters as JSON.
"""

import argparse
import asyncio
import json
import subprocess
import sys
from collections.abc import Collection, Sequence
from threading import Lock
from time import monotonic, time_ns
from typing import Any, Final, NamedTuple

import msgspec

from imud.fleet.accounts import StreamCounts
from imud.fleet.collector import GC_ALLOCATIONS, FleetCollector, FleetStore, LedgerStore, Offsets
from imud.fleet.connection import FleetDelivery
from imud.fleet.database.store import PostgresStore
from imud.fleet.messages import MAGIC
from imud.fleet.reader import VERSIONS, Fleet, FleetBatch
from imud.host.threads import rare_garbage_collection
from imud.model.units import NS_PER_MS

END_S: Final = 180.0  # wait for the last samples
LOOK_S: Final = 0.05  # interval of polls


_PREFIX_BYTES: Final = 8  # of a message with slots, before its header


class _Head(msgspec.Struct):
    utc_ns: int


_HEADS: Final = msgspec.json.Decoder(_Head)


class MeasuredStore:
    """Store that measures the delays of messages. It gives the messages to `to`."""

    def __init__(self, to: FleetStore) -> None:
        self.delays_ms: list[float] = []
        self.lock = Lock()  # held during a write
        self._to = to

    def write(self, deliveries: Sequence[FleetDelivery]) -> None:
        with self.lock:
            self._to.write(deliveries)
        now_ns = time_ns()
        self.delays_ms += [(now_ns - _utc_ns(one.payload)) / NS_PER_MS for one in deliveries]

    def close(self) -> None:
        self._to.close()


def _utc_ns(payload: bytes) -> int:
    if payload.startswith(MAGIC):
        size = int.from_bytes(payload[_PREFIX_BYTES - 2 : _PREFIX_BYTES], "little")
        payload = payload[_PREFIX_BYTES : _PREFIX_BYTES + size]
    return _HEADS.decode(payload).utc_ns


class Nothing:
    """Destination of batches that does nothing."""

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        pass

    def close(self) -> None:
        pass


class LedgerSums(NamedTuple):
    """Sums over the ledgers of all streams."""

    streams: int
    came: int
    missing: int
    duplicates: int
    open: int  # number of streams whose ledger does not balance


def sums_of(counts: Collection[StreamCounts]) -> LedgerSums:
    return LedgerSums(
        len(counts), sum(one.whole + one.thinned for one in counts), sum(one.missing for one in counts),
        sum(one.duplicates for one in counts), sum(one.balance != 0 for one in counts),
    )  # fmt: skip


def sums_in(url: str) -> LedgerSums:
    """Return the sums of the ledger in a database."""
    import psycopg

    with psycopg.connect(url) as connection:
        row = connection.execute(
            "SELECT count(*), coalesce(sum(whole + thinned), 0)::bigint, coalesce(sum(missing), 0)::bigint, "
            "coalesce(sum(duplicates), 0)::bigint, count(*) FILTER (WHERE newest - begin + 1 <> whole + thinned + "
            "dropped + missing) FROM imud_ledger"
        ).fetchone()
    assert row is not None
    return LedgerSums(*row)


class CollectorProcess:
    def __init__(self, ports: Sequence[int], *, version: str, to: str = "") -> None:
        words = [sys.executable, "-m", "tests.bench.fleet_collector", "--version", version, "--to", to]
        urls = [f"mqtt://127.0.0.1:{port}" for port in ports]
        self.popen = subprocess.Popen([*words, *urls], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.popen.stdout is not None
        assert self.popen.stdout.readline().strip() == "ready"

    def end(self, numbered: int) -> dict[str, Any]:
        """Wait until the collector has received `numbered` samples. Return its counters."""
        said, _ = self.popen.communicate(f"{numbered}\n", timeout=2 * END_S)
        found: dict[str, Any] = json.loads(said)
        return found


async def collect(urls: Sequence[str], version: str, to: str) -> dict[str, Any]:
    """Collect until the number of samples from standard input has arrived. Return the counters."""
    fleet = Fleet(*urls, name="load", version=version, from_begin=True, retry_max_s=1.0)
    store = MeasuredStore(PostgresStore(to, from_begin=True) if to else LedgerStore(fleet, Nothing()))
    collector = FleetCollector(fleet, store)
    running = asyncio.ensure_future(collector.run())
    while not fleet.connections:
        await asyncio.sleep(LOOK_S)
    print("ready", flush=True)
    due = int(await asyncio.to_thread(sys.stdin.readline))
    end_s = monotonic() + END_S

    def ledger() -> LedgerSums:
        if to:
            return sums_in(to)
        with store.lock:  # the write changes the ledger
            return sums_of(fleet.ledger.counts.values())

    # after END_S, return the counters although samples are missing: the caller reports the difference
    while ledger().came < due and monotonic() < end_s and not running.done():
        await asyncio.sleep(LOOK_S)
    collector.stop()
    await running
    store.close()
    delays_ms = sorted(store.delays_ms)
    return ledger()._asdict() | {
        "connects": fleet.connections, "p50_ms": delays_ms[len(delays_ms) // 2],
        "p99_ms": delays_ms[len(delays_ms) * 99 // 100], "max_ms": delays_ms[-1],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("urls", nargs="+")
    parser.add_argument("--version", choices=VERSIONS, default=VERSIONS[0])
    parser.add_argument("--to", default="")
    args = parser.parse_args()
    with rare_garbage_collection(GC_ALLOCATIONS):
        print(json.dumps(asyncio.run(collect(args.urls, args.version, args.to))))


if __name__ == "__main__":
    main()
