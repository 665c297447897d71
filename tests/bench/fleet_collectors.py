"""`make fleet-collectors`: three collectors divide a fleet, and SIGKILL ends one of them every 20 s.

`python -m tests.bench.fleet_collectors [--gateways 60] [--seconds 600]`. Simulated gateways
(`tests.bench.fleet_generator`) send one message per second for each of their two devices to mosquitto. Three processes
`imud fleet collect --shares 3` write to one PostgreSQL database. SIGKILL ends the processes in turn. Each starts again
after half of the interval.

The program measures the time from each kill until another collector acknowledges a message of the same share. It reads
this time from the log of mosquitto. A collector acknowledges a message after it has committed the message. At the end,
each number must be in the database exactly once, and the ledger of each stream must balance without a missing number.
The exit status is 1 otherwise, or if a share was without a collector for more than 30 s.
"""

import argparse
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep, time_ns
from typing import Any, Final

from tests.bench.fleet_generator import Generators, Offer
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, running_server
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.results import ProgramRun, Table, add_json, printed

NAME: Final = "divided"
DEVICES: Final = 2
INTERVALS: Final = 10  # per message
COLLECTORS: Final = 3
TAKEOVER_MAX_S: Final = 30.0
LOOK_S: Final = 0.1  # time between two reads of the log of the broker, s
END_S: Final = 180.0  # wait for the last rows, s
# a session with a higher number does not belong to a share: a collector checks whether it exists
_SESSION: Final = rf"(imud-reader-{NAME}(?:\.[1-{COLLECTORS - 1}])?)"
_LOST: Final = re.compile(f"Client {_SESSION} closed its connection")
_ACKNOWLEDGED: Final = re.compile(f"Received PUBACK from {_SESSION} ")
_COUNTS: Final = (
    "SELECT count(*), coalesce(sum(samples), 0), count(DISTINCT (gateway, boot, device, first)) FROM imud_intervals"
)
_LEDGER: Final = (
    "SELECT count(*), coalesce(sum(whole), 0), coalesce(sum(missing), 0), coalesce(sum(duplicates), 0), count(*) "
    "FILTER (WHERE begin <> 1 OR newest <> whole OR newest - begin + 1 <> whole + thinned + dropped + missing) "
    "FROM imud_ledger"
)


class Collectors:
    """Processes `imud fleet collect`, and the time that each share is without a collector."""

    def __init__(self, broker: Mosquitto, url: str, folder: Path) -> None:
        self.takeovers_s: list[float] = []
        self.kills = 0
        self._broker = broker
        self._words = [
            sys.executable, "-m", "imud", "fleet", "collect", f"mqtt://127.0.0.1:{broker.port}", "--to", url,
            "--name", NAME, "--shares", str(COLLECTORS),
        ]  # fmt: skip
        self._log = (folder / "collectors.log").open("w")
        self._processes: list[subprocess.Popen[bytes] | None] = [None] * COLLECTORS
        self._at = 0  # number of the read lines of the broker's log
        self._killed_s = 0.0
        self._without: dict[str, float] = {}  # time of the kill, by session without a collector
        for number in range(COLLECTORS):
            self.start(number)
        wait_until(lambda: self._subscribed() == COLLECTORS, "the broker has the sessions of all shares")

    def _subscribed(self) -> int:
        """Return the number of sessions with a subscription."""
        return len(
            {line.split()[-1] for line in self._broker.log if f"Received SUBSCRIBE from imud-reader-{NAME}" in line}
        )

    def start(self, number: int) -> None:
        """Start a process that does not run."""
        if self._processes[number] is None:
            self._processes[number] = subprocess.Popen(self._words, stdout=self._log, stderr=self._log)

    def kill(self, number: int) -> None:
        process, self._processes[number] = self._processes[number], None
        assert process is not None
        assert process.poll() is None, "a collector ended"
        self.look()
        self.kills += 1
        self._killed_s = monotonic()
        process.kill()
        process.wait(LIMIT_S)

    def look(self) -> None:
        """Read the new lines of the broker's log."""
        now_s, lines = monotonic(), self._broker.log[self._at :]
        self._at += len(lines)
        for line in lines:
            if lost := _LOST.search(line):
                self._without.setdefault(lost[1], self._killed_s)
            elif (found := _ACKNOWLEDGED.search(line)) and found[1] in self._without:
                self.takeovers_s.append(now_s - self._without.pop(found[1]))

    @property
    def without(self) -> Sequence[str]:
        """Return the sessions that have no collector since a kill."""
        return sorted(self._without)

    def end(self) -> list[int]:
        """End all processes with SIGTERM. Return their exit statuses."""
        running = [one for one in self._processes if one is not None]
        for one in running:
            one.send_signal(signal.SIGTERM)
        return [one.wait(LIMIT_S) for one in running]

    def close(self) -> None:
        """Kill the processes that still run."""
        for one in self._processes:
            if one is not None:
                one.kill()
                one.wait(LIMIT_S)
        self._log.close()


def play(folder: Path, server: PostgresServer, gateways: int, seconds: float, interval_s: float) -> dict[str, Any]:
    """Run gateways and collectors. Return the figures. All gateways stop after `seconds`."""
    with ExitStack() as stack:
        broker = stack.enter_context(running_broker(folder / "broker"))
        collectors = Collectors(broker, server.url, folder)
        stack.callback(collectors.close)
        offer = Offer(gateways, DEVICES, INTERVALS, 1.0, time_ns())
        fleet = stack.enter_context(Generators(offer, [broker.port]))
        begin_s, victim = fleet.begin(), 0
        kill_s, start_s = begin_s + interval_s, 0.0
        while (now_s := monotonic()) < begin_s + seconds:
            sleep(LOOK_S)
            collectors.look()
            if start_s and now_s >= start_s:
                collectors.start(victim)
                start_s, victim = 0.0, (victim + 1) % COLLECTORS
            if now_s >= kill_s:
                collectors.kill(victim)
                kill_s, start_s = kill_s + interval_s, now_s + interval_s / 2
        fleet.end()
        end_s = monotonic() + END_S
        while monotonic() < end_s:
            sleep(LOOK_S)
            collectors.look()
            if not collectors.without and stored(server.url, _LEDGER)[1] >= fleet.offered * offer.numbers:
                break
        statuses = collectors.end()
        return figures(server, offer, fleet.offered, collectors, statuses)


def figures(
    server: PostgresServer, offer: Offer, messages: int, collectors: Collectors, statuses: Sequence[int]
) -> dict[str, Any]:
    streams, _, missing, duplicates, open_streams = stored(server.url, _LEDGER)
    rows, samples, different = stored(server.url, _COUNTS)
    takeovers_s = sorted(collectors.takeovers_s)
    return {
        "kills": collectors.kills, "shares that another collector took": len(takeovers_s),
        "shares without a collector at the end": len(collectors.without),
        "longest time without a collector, s": max(takeovers_s, default=0.0),
        "median, s": takeovers_s[len(takeovers_s) // 2] if takeovers_s else 0.0,
        "numbered samples": messages * offer.numbers, "samples in the database": int(samples),
        "expected rows": messages * offer.intervals, "rows": rows, "different rows": different,
        "streams": streams, "expected streams": offer.gateways * offer.devices, "missing": int(missing),
        "open ledgers": open_streams, "repeated numbers, not stored again": int(duplicates),
        "violations of a primary key": (server.folder / "log").read_text().count('violates unique constraint "imud_'),
        "exit statuses other than 0": sum(status != 0 for status in statuses),
    }  # fmt: skip


def stored(url: str, statement: str) -> Sequence[Any]:
    import psycopg

    with psycopg.connect(url) as connection:
        row = connection.execute(statement.encode()).fetchone()
        assert row is not None
        return row


def problems_of(found: dict[str, Any], takeover_max_s: float = TAKEOVER_MAX_S) -> list[str]:
    """Return the goals that a run did not reach."""
    none = (
        "shares without a collector at the end", "missing", "open ledgers", "violations of a primary key",
        "exit statuses other than 0",
    )  # fmt: skip
    equal = (
        ("numbered samples", "samples in the database"), ("expected rows", "rows"), ("rows", "different rows"),
        ("expected streams", "streams"),
    )  # fmt: skip
    problems = [f"{name}: {found[name]}" for name in none if found[name]]
    problems += [f"{one}: {found[one]}, {two}: {found[two]}" for one, two in equal if found[one] != found[two]]
    if found["shares that another collector took"] < found["kills"]:
        problems.append(f"{found['kills']} kills, but only {found['shares that another collector took']} shares taken")
    if found["longest time without a collector, s"] > takeover_max_s:
        problems.append(f"a share was without a collector for {found['longest time without a collector, s']:.1f} s")
    return problems


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-collectors")
    parser.add_argument("--gateways", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--interval", type=float, default=20.0, help="time between two kills, s (default: %(default)g)")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if missing := NO_MOSQUITTO or NO_POSTGRES:
        print(missing)
        return 1
    with tempfile.TemporaryDirectory(prefix="imud-collectors-") as name, running_server() as server:
        found = play(Path(name), server, args.gateways, args.seconds, args.interval)
    problems = problems_of(found)
    for figure, value in found.items():
        print(printed({figure: value}))
    for one in problems:
        print(f"problem: {one}")
    title = f"{args.gateways} gateways, {args.seconds:g} s, one collector killed every {args.interval:g} s"
    rows = [{"figure": figure, "value": value} for figure, value in found.items()]
    program_run.save(args.json, [Table(title, rows)], problems)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
