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
from collections.abc import Sequence
from time import monotonic, time_ns
from typing import Any, Final

from imud.fleet.accounts import Accounts, FleetLedger
from imud.fleet.collector import GC_ALLOCATIONS, FleetCollector, Offsets
from imud.fleet.postgres import PostgresStore
from imud.fleet.reader import VERSIONS, Fleet, FleetBatch
from imud.host.threads import rare_garbage_collection
from imud.model.units import NS_PER_MS

END_S: Final = 180.0  # wait for the last samples
LOOK_S: Final = 0.05  # interval of polls


class MeasuredStore:
    def __init__(self, to: PostgresStore | None) -> None:
        self.came = 0
        self.delays_ms: list[float] = []
        self._to = to

    def restore(self, ledger: FleetLedger) -> None:
        if self._to is not None:
            self._to.restore(ledger)

    def write(self, batches: Sequence[FleetBatch], accounts: Accounts, offsets: Offsets) -> None:
        if self._to is not None:
            self._to.write(batches, accounts, offsets)
        now_ns = time_ns()
        self.came += sum(one.message.count for one in batches)
        self.delays_ms += [(now_ns - one.message.utc_ns) / NS_PER_MS for one in batches]

    def close(self) -> None:
        if self._to is not None:
            self._to.close()


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
    store = MeasuredStore(PostgresStore(to) if to else None)
    collector = FleetCollector(fleet, store)
    running = asyncio.ensure_future(collector.run())
    while not fleet.connections:
        await asyncio.sleep(LOOK_S)
    print("ready", flush=True)
    due = int(await asyncio.to_thread(sys.stdin.readline))
    end_s = monotonic() + END_S
    # after END_S, return the counters although samples are missing: the caller reports the difference
    while store.came < due and monotonic() < end_s and not running.done():
        await asyncio.sleep(LOOK_S)
    collector.stop()
    await running
    store.close()
    counts, delays_ms = fleet.ledger.counts.values(), sorted(store.delays_ms)
    return {
        "came": store.came, "missing": sum(one.missing for one in counts), "connects": fleet.connections,
        "duplicates": sum(one.duplicates for one in counts), "streams": len(counts),
        "open": sum(one.balance != 0 for one in counts), "p50_ms": delays_ms[len(delays_ms) // 2],
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
