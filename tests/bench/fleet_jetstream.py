"""`make fleet-jetstream`: a cluster of three NATS servers stores an hour of messages while the collector is offline.

`python -m tests.bench.fleet_jetstream [--gateways 50] [--devices 2] [--hours 1] [--kill-every 15]`. JetStream stores
the sessions and messages of MQTT 3.1.1, each on all three servers.

1. *session*: the collector creates its session and ends.
2. *fill*: simulated gateways send statistics of some hours at 1 Hz, as fast as the cluster acknowledges them.
3. *catch-up*: the collector starts and stores the messages in PostgreSQL. SIGKILL ends one server after another. Each
   server starts again after DOWN_S, and the next server is killed only if the cluster is healthy. OUTPUTS further
   gateways are the output `mqtt` in processes of their own, each with a device at 1 kHz: they send live messages.

The exit status is 1 if a number or a row is missing, if a ledger does not balance, or if the catch-up is slower than
GOAL times real time.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from time import monotonic, sleep, time_ns
from typing import Final, NamedTuple

from imud.fleet.messages import boot_text
from imud.model.units import NS_PER_S
from tests.bench.fleet_generator import RESERVED, Generators, Offer, raise_descriptor_limit
from tests.bench.fleet_load import LOST, MISSING, OPEN, POSTGRES
from tests.bench.fleet_parts import CollectorProcess, FleetDatabase
from tests.fleet.gateways import KilledGateway, in_spool
from tests.fleet.nats_cluster import MESSAGES, NO_NATS, SERVERS, NatsCluster, program_version, running_cluster
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, running_server
from tests.support.daemon_process import wait_until
from tests.support.results import ProgramRun, Row, Table, add_json, printed

GOAL: Final = 10.0  # times real time
OUTPUTS: Final = 3
OUTPUT_BOOT: Final = boot_text(1)
VERSION: Final = "3.1.1"
TIMES: Final = "catch-up, times real time"
# Time after which a server sends a message without an acknowledgement again; the default is 30 s. Some messages of a
# long backlog arrive only after this time.
MQTT: Final = 'ack_wait: "10s"'
TOPICS: Final = 5  # topics of the collector's session
DOWN_S: Final = 3.0  # time between the end of a server and its start, s
PROGRESS_S: Final = 120.0  # maximum time without a new message, s
POLL_S: Final = 0.5
DRAIN_S: Final = 120.0  # maximum time until a spool is empty, s


class Plan(NamedTuple):
    gateways: int = 50
    devices: int = 2
    seconds: int = 3600  # time of the data in the cluster, s
    kill_every_s: float = 15.0
    kills_max: int = 1000
    outputs: int = OUTPUTS


class Outcome(NamedTuple):
    figures: Mapping[str, float]
    kills: Sequence[Row]
    problems: Sequence[str]


class Progress:
    """Number that must increase. Synchronization: one thread."""

    def __init__(self, name: str) -> None:
        self._name, self._newest, self._changed_s = name, -1, monotonic()

    def check(self, number: int) -> None:
        """Raise TimeoutError if the number is the same for PROGRESS_S."""
        if number != self._newest:
            self._newest, self._changed_s = number, monotonic()
        elif monotonic() - self._changed_s > PROGRESS_S:
            raise TimeoutError(f"{self._name}: expected more than {number} messages within {PROGRESS_S:g} s")


class _Catchup:
    """One run. Synchronization: one thread."""

    def __init__(self, plan: Plan, cluster: NatsCluster, postgres: PostgresServer, folder: Path) -> None:
        self._plan, self._cluster, self._postgres, self._folder = plan, cluster, postgres, folder
        begin_ns = time_ns() - plan.seconds * NS_PER_S
        self._offer = Offer(plan.gateways, plan.devices, 1, 0.0, begin_ns, plan.seconds)
        self._total = plan.gateways * plan.devices * plan.seconds
        self._kills: list[Row] = []

    def run(self, stack: ExitStack) -> Outcome:
        plan, offer = self._plan, self._offer
        begin_s = monotonic()
        self._make_session()
        session_s = monotonic() - begin_s
        begin_s = monotonic()
        self._fill()
        fill_s = monotonic() - begin_s
        database = stack.enter_context(closing(FleetDatabase(self._postgres.url)))
        disk_bytes = [size_of(store) for store in self._cluster.stores]
        stream_bytes = int(self._cluster.streams()[MESSAGES]["state"]["bytes"])
        spools = [self._folder / f"spool-{at}" for at in range(plan.outputs)]
        outputs = [
            KilledGateway(self._cluster.ports, spool, epoch=1, name=f"imud-{at}", version=VERSION)
            for at, spool in enumerate(spools)
        ]
        for one in outputs:
            stack.callback(one.kill)
            one.wait_until(0)
        begin_s = monotonic()
        collector = self._collector("second")
        stack.callback(collector.kill)
        self._catch_up(collector, database, begin_s)
        catchup_s = monotonic() - begin_s
        numbered = self._end_outputs(outputs, spools)
        wait_until(lambda: database.whole(OUTPUT_BOOT) >= numbered, "the messages of the outputs", DRAIN_S)
        collector.end()
        totals, others = database.totals(offer.boot), database.totals(OUTPUT_BOOT)
        ratio = self._total / catchup_s / (plan.gateways * plan.devices)
        figures = {
            "messages": self._total,
            "session, s": session_s,
            "fill, s": fill_s,
            "fill, 1/s": self._total / fill_s,
            "stream, bytes per message": stream_bytes / self._total,
            "disk of a server, bytes per message": max(disk_bytes) / self._total,
            "disk of a server, GB per hour and 1,000 devices": max(disk_bytes) / self._total * 3.6e6 / 1e9,
            "catch-up, s": catchup_s,
            "catch-up, 1/s": self._total / catchup_s,
            TIMES: ratio,
            "killed servers": len(self._kills),
            "duplicates": totals.duplicates + others.duplicates,
            "live numbers of the outputs": numbered,
            LOST: self._total * offer.numbers - totals.whole + numbered - others.whole,
            MISSING: self._total - database.rows(offer.boot, offer.begin_utc_ns),
            OPEN: totals.open + others.open,
        }
        problems = [f"{name}: {figures[name]:g}" for name in (LOST, MISSING, OPEN) if figures[name]]
        if ratio < GOAL:
            problems.append(f"{TIMES}: expected at least {GOAL:g}, got {ratio:.1f}")
        return Outcome(figures, self._kills, problems)

    def _collector(self, name: str) -> CollectorProcess:
        log = self._folder / f"{name}.log"
        return CollectorProcess(self._cluster.ports, self._postgres.url, log, "--mqtt-version", VERSION)

    def _make_session(self) -> None:
        collector = self._collector("first")
        try:
            wait_until(lambda: len(self._cluster.filters()) >= TOPICS, "the session of the collector")
        finally:
            collector.end()

    def _fill(self) -> None:
        """Send all messages to the cluster."""
        progress = Progress("fill")
        with Generators(self._offer, self._cluster.ports) as generators:
            generators.begin()
            while (count := generators.acknowledged) < self._total:
                progress.check(count)
                sleep(POLL_S)

    def _catch_up(self, collector: CollectorProcess, database: FleetDatabase, begin_s: float) -> None:
        """Wait until all messages are stored. Kill one server after another."""
        progress, cluster = Progress("catch-up"), self._cluster
        killed_s, down = begin_s, -1  # time of the last kill, and the server that does not run
        while (count := database.whole(self._offer.boot) // self._offer.numbers) < self._total:
            collector.check()
            progress.check(count)
            now_s = monotonic()
            if down >= 0 and now_s - killed_s >= DOWN_S:
                cluster.start(down)
                down = -1
            elif down < 0 and count and now_s - killed_s >= self._plan.kill_every_s and self._may_kill():
                # the collector uses the first server of its list
                down, killed_s = len(self._kills) % SERVERS, now_s
                self._kills.append({"killed server": down, "time, s": now_s - begin_s, "stored messages": count})
                cluster.kill(down)
            sleep(POLL_S)
        if down >= 0:
            cluster.start(down)

    def _may_kill(self) -> bool:
        """Return whether all servers have all messages. A server that catches up can be the only one with a message."""
        return len(self._kills) < self._plan.kills_max and (not self._kills or self._cluster.is_healthy())

    def _end_outputs(self, outputs: Sequence[KilledGateway], spools: Sequence[Path]) -> int:
        """End the outputs. Return the number of their sequence numbers. Raises TimeoutError if a spool is not empty."""
        numbered = 0
        for one, spool in zip(outputs, spools, strict=True):
            is_drained = one.drain(DRAIN_S)
            one.kill()
            rows, positions = in_spool(spool)
            if not is_drained or rows:
                raise TimeoutError(f"expected an empty spool within {DRAIN_S:g} s, got {len(rows)} messages")
            numbered += sum(position.last - position.begin + 1 for position in positions)
        return numbered


def size_of(folder: Path) -> int:
    """Return the size of all files of a folder on the disk, bytes."""
    return sum(file.stat().st_blocks * 512 for file in folder.rglob("*") if file.is_file())


def run(plan: Plan) -> Outcome:
    """Start the parts, measure, and stop the parts. Raises an error if a part fails."""
    raise_descriptor_limit(plan.gateways + RESERVED)
    with (
        tempfile.TemporaryDirectory(prefix="imud-jetstream-") as name,
        running_server(options=POSTGRES) as postgres,
        running_cluster(Path(name), MQTT) as cluster,
        ExitStack() as stack,
    ):
        return _Catchup(plan, cluster, postgres, Path(name)).run(stack)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-jetstream")
    default = Plan()
    parser.add_argument("--gateways", type=int, default=default.gateways)
    parser.add_argument("--devices", type=int, default=default.devices, help="devices per gateway")
    parser.add_argument("--hours", type=float, default=default.seconds / 3600, help="time of the data in the cluster")
    parser.add_argument("--kill-every", type=float, default=default.kill_every_s, help="time between two kills, s")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if missing := NO_NATS or NO_POSTGRES:
        print(missing)
        return 1
    plan = Plan(args.gateways, args.devices, round(args.hours * 3600), args.kill_every)
    title = f"{plan.gateways} gateways of {plan.devices} devices at 1 Hz, {args.hours:g} h offline"
    title += f", nats-server {program_version()}"
    print(title, flush=True)
    outcome = run(plan)
    for row in (outcome.figures, *outcome.kills, *({"problem": one} for one in outcome.problems)):
        print(f"  {printed(row)}")
    figures = [{"figure": name, "value": value} for name, value in outcome.figures.items()]
    program_run.save(args.json, [Table(title, figures), Table("Killed servers", outcome.kills)], outcome.problems)
    return int(bool(outcome.problems))


if __name__ == "__main__":
    sys.exit(main())
