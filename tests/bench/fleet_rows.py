"""`imud fleet collect --to postgresql://…` as a process that tests end and kill, and queries of its tables."""

import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from time import monotonic

LOOK_S = 0.5  # interval of queries
LIMIT_S = 120.0  # wait for rows, and for the end of the process


class RowCollector:
    """The process of the collector. Synchronization: one thread."""

    def __init__(self, broker: str, database: str, log: Path, options: Sequence[str] = ()) -> None:
        """`options` contains further options of the command line."""
        words = [sys.executable, "-m", "imud", "fleet", "collect", broker, "--to", database, "--from-begin", *options]
        self._words, self._database, self._log = words, database, log
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(self._words, stdout=log, stderr=log)

    def end(self, number: int = signal.SIGTERM) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(number)
            process.wait(LIMIT_S)

    def rows_after(self, due: int) -> int:
        end_s, pause = monotonic() + LIMIT_S, threading.Event()
        while (found := self._number("SELECT count(*) FROM imud_samples")) < due and monotonic() < end_s:
            pause.wait(LOOK_S)
        return found

    def missing(self) -> int:
        return self._number(
            "SELECT COALESCE(sum((account->'counts'->>'missing')::bigint), 0) FROM imud_ledger WHERE stream = 'samples'"
        )

    def _number(self, query: str) -> int:
        import psycopg

        with psycopg.connect(self._database) as connection:
            row = connection.execute(query).fetchone()
        assert row is not None
        return int(row[0])
