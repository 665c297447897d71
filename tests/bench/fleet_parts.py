"""Parts of a fleet for load tests: collectors, the database, and the CPU time and the memory of each part."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from imud.fleet.database.tables import COMPONENTS
from imud.fleet.statistics import MEASURES
from imud.model.units import NS_PER_S

# All statements select one boot. Rows are counted from a time on: the size of the table does not change the result.
WHOLE: Final = "SELECT coalesce(sum(whole), 0)::bigint FROM imud_ledger WHERE boot = %s"
TOTALS: Final = """SELECT count(*), coalesce(sum(whole), 0)::bigint, coalesce(sum(missing), 0)::bigint,
    coalesce(sum(duplicates), 0)::bigint,
    count(*) FILTER (WHERE newest - begin + 1 <> whole + thinned + dropped + missing)
    FROM imud_ledger WHERE boot = %s"""
ROWS: Final = "SELECT count(*) FROM imud_intervals WHERE time >= to_timestamp(%s) AND boot = %s"
NEWEST: Final = """SELECT gateway, newest FROM imud_ledger
    WHERE boot = %s AND device = 'd0' AND stream = 'statistics' AND gateway = ANY(%s)"""
SIZES: Final = """SELECT (SELECT count(*) FROM imud_intervals), sum(pg_table_size(oid))::bigint,
    sum(pg_indexes_size(oid))::bigint FROM pg_class WHERE relkind = 'r' AND starts_with(relname, 'imud_intervals')"""
OLD_GATEWAYS: Final = 1000  # gateways of the rows that `FleetDatabase.fill` inserts
OLD_BOOT: Final = "old"
# The collector creates partitions for the last 7 days.
OLD_DAYS: Final = 6.5
OLD_STEPS: Final = 10_007  # number of times in OLD_DAYS; prime, so that each number of rows covers all days
_VALUES: Final = [
    one.column(measure)
    for one in COMPONENTS
    if one.field in ("accel_m_s2", "gyro_rad_s", "euler_rad")
    for measure in MEASURES
]
FILL: Final = f"""INSERT INTO imud_intervals (time, site, gateway, boot, device, utc_ns, utc_set, stream, first, last,
    samples, t_ns, end_t_ns, end_utc_ns, t_err_ns, sync, {", ".join(_VALUES)})
    SELECT to_timestamp(s), 'old', 'old-' || g, '{OLD_BOOT}', 'd0', (s * 1e9)::bigint, true, 'statistics', k * 100 + 1,
    k * 100 + 100, 100, k * 1000000000, k * 1000000000 + 990000000, (s * 1e9)::bigint + 990000000, 10000, 'regression',
    {", ".join(f"v + {at}" for at in range(len(_VALUES)))}
    FROM generate_series(0, {OLD_GATEWAYS} - 1) AS g, generate_series(%s::bigint, %s::bigint) AS k,
    LATERAL (SELECT %s::float8 + (k * 7919 %% {OLD_STEPS}) * {OLD_DAYS * 86400 / OLD_STEPS!r}::float8 AS s,
    k * 0.123456789::float8 AS v) AS made"""
TICK_HZ: Final = os.sysconf("SC_CLK_TCK")
END_S: Final = 60.0  # maximum time until a collector ends, s


class Part(NamedTuple):
    """Part of a fleet: its name, and the main processes that belong to it."""

    name: str
    processes: Callable[[], Sequence[int]]
    threads: int = 1  # number of cores that the part can use

    def cpu_s(self) -> float:
        """Return the CPU time of the processes and of all their children, also of ended children, s."""
        return sum(_cpu_s(pid) for pid in _with_children(self.processes()))

    def memory_mb(self) -> float:
        """Return the memory of the processes and their children, MB. Shared memory counts once (Pss)."""
        found = 0
        for pid in _with_children(self.processes()):
            with suppress(OSError):  # the process has ended
                text = Path(f"/proc/{pid}/smaps_rollup").read_text()
                found += next(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
        return found * 1024 / 1e6


def _with_children(pids: Iterable[int]) -> list[int]:
    found = list(pids)
    for pid in found:
        with suppress(OSError):
            found += map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    return found


def _cpu_s(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0  # the process has ended, and its parent counts its time
    # utime, stime, and both of ended children (proc(5))
    return sum(map(int, fields[11:15])) / TICK_HZ


class CollectorProcess:
    """Process of `imud fleet collect`."""

    def __init__(self, ports: Sequence[int], to: str, log: Path, *options: str) -> None:
        urls = [f"mqtt://127.0.0.1:{port}" for port in ports]
        words = [sys.executable, "-m", "imud", "fleet", "collect", *urls, "--to", to, "--from-begin", *options]
        self._log = log
        with log.open("w") as out:
            self._popen = subprocess.Popen(words, stdout=out, stderr=out)
        self.pid = self._popen.pid

    def check(self) -> None:
        """Raise RuntimeError if the process has ended."""
        if self._popen.poll() is not None:
            raise RuntimeError(
                f"the collector ended with status {self._popen.returncode}: {self._log.read_text()[-2000:]}"
            )

    def end(self) -> None:
        """Stop the collector with SIGTERM. It stores the received messages first. Raises RuntimeError if it failed."""
        self._popen.send_signal(signal.SIGTERM)
        if self._popen.wait(END_S):
            self.check()

    def kill(self) -> None:
        self._popen.kill()
        self._popen.wait(END_S)


class StoredTotals(NamedTuple):
    """Totals of the ledgers of all streams."""

    streams: int
    whole: int  # sequence numbers
    missing: int
    duplicates: int
    open: int  # number of streams whose ledger does not balance


class FleetDatabase:
    """Connection that reads the tables of the collector. Synchronization: one thread."""

    def __init__(self, url: str) -> None:
        import psycopg

        self._connection = psycopg.connect(url, autocommit=True)

    def query(self, text: str, *values: object) -> list[Any]:
        cursor = self._connection.execute(text.encode(), values)
        return cursor.fetchall() if cursor.description else []

    def whole(self, boot: str) -> int:
        """Return the number of stored sequence numbers in this boot."""
        return int(self.query(WHOLE, boot)[0][0])

    def totals(self, boot: str) -> StoredTotals:
        return StoredTotals(*self.query(TOTALS, boot)[0])

    def newest(self, boot: str, gateways: Sequence[str]) -> dict[str, int]:
        """Return the newest stored number of the first device of some gateways."""
        return dict(self.query(NEWEST, boot, list(gateways)))

    def rows(self, boot: str, since_utc_ns: int) -> int:
        """Return the number of intervals of a boot. `since_utc_ns` is the time of the first interval."""
        return int(self.query(ROWS, since_utc_ns / NS_PER_S - 1, boot)[0][0])

    def fill(self, begin: int, end: int, now_s: float) -> None:
        """Insert the old rows number `begin` to `end` - 1 (multiples of OLD_GATEWAYS), and finish all work of the
        server that the insertion causes."""
        since_s = now_s - OLD_DAYS * 86400
        self.query(FILL, begin // OLD_GATEWAYS, end // OLD_GATEWAYS - 1, since_s)
        self.query("VACUUM (ANALYZE) imud_intervals")
        self.query("CHECKPOINT")

    def bytes_per_row(self) -> tuple[float, float]:
        """Return the size of a row of intervals in the table and in its indexes, bytes."""
        rows, table, index = self.query(SIZES)[0]
        return table / rows, index / rows

    def close(self) -> None:
        self._connection.close()
