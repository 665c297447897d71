"""`make fleet-load`: cost and delays of a broker, collectors and PostgreSQL with many simulated gateways.

`python -m tests.bench.fleet_load [--gateways 1000] [--devices 2] [--period 1] [--intervals 1] [--seconds 20]`. Each
device sends one message per period. A message contains statistics of acceleration, rotation rate and angles, one
interval per second of data: `--intervals 10 --period 10` is `batch_s: 10`. The collectors are processes of
`imud fleet collect`. All parts run on this host.

The program measures three phases: *warm* (at least one period, all streams exist after it), *load* (the measurement),
and *drain* (the gateways have stopped, the collectors store the rest). The CPU time of a part per message gives its
saturation point, messages per second and core. If more messages are offered than the host can store, both phases
*load* and *drain* show the part that uses the most CPU time. The exit status is 1 if a number or a row is missing.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from time import monotonic, sleep, time_ns
from typing import Final, NamedTuple

from imud.fleet.messages import Stream
from tests.bench.fleet_generator import (
    RESERVED,
    Generators,
    Offer,
    gateway_name,
    raise_descriptor_limit,
)
from tests.bench.fleet_parts import CollectorProcess, FleetDatabase, Part
from tests.fleet.mosquitto import NO_MOSQUITTO, running_broker
from tests.fleet.nats_cluster import NO_NATS, SERVERS, running_cluster
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, running_server
from tests.support.daemon_process import wait_until
from tests.support.results import ProgramRun, Row, Table, add_json, printed

# fsync stays on: its delay is part of the measurement
POSTGRES: Final = "-c fsync=on -c shared_buffers=512MB -c max_wal_size=8GB"
NAME: Final = "load"
READER: Final = f"imud-reader-{NAME}"  # start of the client identifiers of the collectors
LOST: Final = "lost numbers"
MISSING: Final = "missing rows"
OPEN: Final = "open ledgers"
MESSAGES_MIN: Final = 1000  # messages of the phase `drain` from which on its costs are meaningful
WARM_S: Final = 5.0  # minimum time of the phase `warm`, s
DRAIN_S: Final = 300.0  # maximum time of the phase `drain`, s
PROBES: Final = 10  # gateways whose delay is measured
PROBE_S: Final = 0.1  # interval of the polls, s: resolution of the delays
BUSY: Final = 0.9  # Share of the usable cores. A part that uses more limits the messages per second.


class Load(NamedTuple):
    """Load of one run."""

    gateways: int = 1000
    devices: int = 2
    period_s: float = 1.0
    intervals: int = 1
    collectors: int = 1
    generators: int = 1
    seconds: float = 20.0
    is_cluster: bool = False

    def offer(self) -> Offer:
        return Offer(self.gateways, self.devices, self.intervals, self.period_s, time_ns())

    @property
    def title(self) -> str:
        return (
            f"{self.gateways} gateways of {self.devices} devices, a message with {self.intervals} intervals every "
            f"{self.period_s:g} s, {self.collectors} collectors"
        )


class Moment(NamedTuple):
    """Counters at one moment."""

    at_s: float
    acknowledged: int
    stored: int  # messages
    idle_s: float  # idle time of all cores of the host
    cpu_s: Mapping[str, float]  # by part


class Outcome(NamedTuple):
    figures: Mapping[str, float]  # the name contains the unit
    parts: Sequence[Row]  # one row for each phase and part
    limits: Mapping[str, str]  # part that limits the messages per second, by phase
    problems: Sequence[str]

    def cost(self, part: str) -> float:
        """Return the CPU time of a part in the phase `load`, s per 1,000 messages."""
        return self._of_load(part, CPU)

    def memory(self, part: str) -> float:
        """Return the memory of a part, MB."""
        return self._of_load(part, MEMORY)

    def _of_load(self, part: str, column: str) -> float:
        return next(float(row[column]) for row in self.parts if row["part"] == part and row["phase"] == "load")

    def tables(self, title: str) -> list[Table]:
        return [Table(title, [dict(self.figures)]), Table(f"{title}: parts", self.parts)]


CPU: Final = "CPU s per 1,000 messages"
MEMORY: Final = "memory, MB"


class Broker(NamedTuple):
    part: Part
    ports: Sequence[int]
    version: str  # of MQTT
    sessions: Callable[[], int]  # number of sessions with a subscription


@contextmanager
def running_brokers(folder: Path, *, is_cluster: bool) -> Iterator[Broker]:
    if is_cluster:
        with running_cluster(folder) as cluster:
            yield Broker(
                Part("broker", lambda: cluster.pids, SERVERS), cluster.ports, "3.1.1",
                lambda: sum(Stream.STATISTICS in one for one in cluster.filters()),
            )  # fmt: skip
        return
    lines = ("allow_anonymous true", "log_type error", "log_type information", "log_type subscribe")
    with running_broker(folder / "broker", *lines) as one:
        yield Broker(
            Part("broker", lambda: [one.pid]), [one.port], "5",
            lambda: len({word for line in one.log for word in line.split() if word.startswith(READER)}),
        )  # fmt: skip


class _Measurement:
    """One run. Synchronization: one thread."""

    def __init__(self, load: Load, broker: Broker, database: FleetDatabase, postgres: PostgresServer) -> None:
        self._load, self._offer, self._database = load, load.offer(), database
        self._generators: Generators
        self._collectors: list[CollectorProcess] = []
        self._parts = [broker.part, Part("database", lambda: [postgres.pid], load.collectors)]
        self._broker, self._postgres = broker, postgres
        self._delays_s: list[float] = []

    def run(self, folder: Path, stack: ExitStack) -> Outcome:
        load, offer = self._load, self._offer
        options = ["--name", NAME, "--mqtt-version", self._broker.version]
        options += ["--shares", str(load.collectors)] if load.collectors > 1 else []
        for at in range(load.collectors):
            log = folder / f"collector-{at}.log"
            one = CollectorProcess(self._broker.ports, self._postgres.url, log, *options)
            stack.callback(one.kill)
            self._collectors.append(one)
        pids = [one.pid for one in self._collectors]
        self._parts.append(Part("collectors", lambda: pids, load.collectors))
        # a message before the subscription would be lost
        wait_until(
            lambda: self._are_running() and self._broker.sessions() >= load.collectors, "all collectors subscribe"
        )
        self._generators = stack.enter_context(Generators(offer, self._broker.ports, load.generators))
        self._parts.append(Part("generator", lambda: self._generators.pids))
        begin_s = self._generators.begin()
        self._wait(begin_s, max(WARM_S, load.period_s))
        before = self._moment()
        self._delays_s.clear()
        self._generators.forget_delays()
        self._wait(begin_s, max(load.seconds, load.period_s))
        after = self._moment()
        memory = {part.name: part.memory_mb() for part in self._parts}
        late_s, delays_s = self._generators.late_s, sorted(self._delays_s) or [0.0]
        self._generators.end()
        drained = self._drain()
        for one in self._collectors:
            one.end()
        offered, seconds = self._generators.offered, after.at_s - before.at_s
        totals = self._database.totals(offer.boot)
        rows = self._database.rows(offer.boot, offer.begin_utc_ns)
        figures = {
            "offered, 1/s": offer.per_second,
            "acknowledged, 1/s": (after.acknowledged - before.acknowledged) / seconds,
            "stored, 1/s": (after.stored - before.stored) / seconds,
            "delay p50, s": delays_s[len(delays_s) // 2],
            "delay p99, s": delays_s[len(delays_s) * 99 // 100],
            "backlog at the end": after.acknowledged - after.stored,
            "drain, s": drained.at_s - after.at_s,
            "delay of the generator, s": late_s,
            "streams": totals.streams,
            "duplicates": totals.duplicates,
            LOST: offered * offer.numbers - totals.whole,
            MISSING: offered * offer.intervals - rows,
            OPEN: totals.open,
        }
        phases = {"load": (before, after), "drain": (after, drained)}
        parts = [row for name, (begin, end) in phases.items() for row in self._rows(name, begin, end, memory)]
        limits = {name: limit_of(self._parts, begin, end) for name, (begin, end) in phases.items()}
        problems = [f"{load.title}: {name} {figures[name]:g}" for name in (LOST, MISSING, OPEN) if figures[name]]
        return Outcome(figures, parts, limits, problems)

    def _are_running(self) -> bool:
        for one in self._collectors:
            one.check()
        return True

    def _moment(self) -> Moment:
        acknowledged = self._generators.acknowledged
        stored = self._database.whole(self._offer.boot) // self._offer.numbers
        cpu_s = {part.name: part.cpu_s() for part in self._parts}
        return Moment(monotonic(), acknowledged, stored, idle_s(), cpu_s)

    def _wait(self, begin_s: float, seconds: float) -> None:
        """Wait, and measure the delay of some gateways: from the due time of a message until other programs see its
        rows."""
        offer, end_s = self._offer, monotonic() + seconds
        step = max(1, offer.gateways // PROBES)
        numbers = range(0, offer.gateways, step)
        due_s = {gateway_name(at): begin_s + offer.period_s * at / offer.gateways for at in numbers}
        newest = self._database.newest(offer.boot, list(due_s))
        while monotonic() < end_s:
            sleep(PROBE_S)
            self._are_running()
            found = self._database.newest(offer.boot, list(due_s))
            now_s = monotonic()
            for name, number in found.items():
                for at in range(newest.get(name, 0) // offer.numbers, number // offer.numbers):
                    self._delays_s.append(now_s - due_s[name] - at * offer.period_s)
            newest = found

    def _drain(self) -> Moment:
        """Wait until all offered messages are stored, at most DRAIN_S."""
        end_s = monotonic() + DRAIN_S
        while (moment := self._moment()).stored < self._generators.offered and moment.at_s < end_s:
            self._are_running()
            sleep(PROBE_S)
        return moment

    def _rows(self, phase: str, begin: Moment, end: Moment, memory: Mapping[str, float]) -> Iterator[Row]:
        seconds = end.at_s - begin.at_s
        stored, acknowledged = end.stored - begin.stored, end.acknowledged - begin.acknowledged
        for name, end_cpu_s in end.cpu_s.items():
            used_s = end_cpu_s - begin.cpu_s[name]
            # the cost of a broker depends on both directions; in the phase `drain`, it only delivers
            count = acknowledged if name == "generator" else stored
            if phase == "drain" and (count < MESSAGES_MIN or name == "generator"):
                continue
            yield {
                "phase": phase, "part": name, "messages, 1/s": count / seconds, CPU: 1000 * used_s / max(count, 1),
                "messages per s and core": count / used_s if used_s else None, "cores": used_s / seconds,
                MEMORY: memory[name],
            }  # fmt: skip


def idle_s() -> float:
    """Return the idle time of all cores of the host, s."""
    fields = Path("/proc/stat").read_text().split()
    return (int(fields[4]) + int(fields[5])) / os.sysconf("SC_CLK_TCK")


def limit_of(parts: Sequence[Part], begin: Moment, end: Moment) -> str:
    """Return the part that limits the messages per second. A part with one thread cannot use two cores."""
    seconds = end.at_s - begin.at_s
    used = {part: (end.cpu_s[part.name] - begin.cpu_s[part.name]) / seconds for part in parts}
    if busy := [part for part in parts if used[part] >= BUSY * part.threads]:
        return " and ".join(part.name for part in busy)
    busiest = max(parts, key=lambda part: used[part])
    if end.idle_s - begin.idle_s < (1 - BUSY) * seconds * (os.cpu_count() or 1):
        return f"all cores of the host; most of it: {busiest.name}"
    return "none"


def run(load: Load, postgres: PostgresServer) -> Outcome:
    """Start the parts, measure, and stop the parts. Raises RuntimeError or AssertionError if a part fails."""
    raise_descriptor_limit(load.gateways + RESERVED)
    with tempfile.TemporaryDirectory(prefix="imud-load-") as name, ExitStack() as stack:
        folder = Path(name)
        broker = stack.enter_context(running_brokers(folder, is_cluster=load.is_cluster))
        database = stack.enter_context(closing(FleetDatabase(postgres.url)))
        return _Measurement(load, broker, database, postgres).run(folder, stack)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-load")
    default = Load()
    parser.add_argument("--gateways", type=int, default=default.gateways)
    parser.add_argument("--devices", type=int, default=default.devices, help="devices per gateway")
    parser.add_argument(
        "--period", type=float, default=default.period_s, help="time between two messages of a device, s"
    )
    parser.add_argument("--intervals", type=int, default=default.intervals, help="intervals per message")
    parser.add_argument("--collectors", type=int, default=default.collectors)
    parser.add_argument("--generators", type=int, default=default.generators, help="processes with simulated gateways")
    parser.add_argument("--seconds", type=float, default=default.seconds, help="time of the measurement")
    parser.add_argument("--cluster", action="store_true", help="use three NATS servers with JetStream")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if missing := (NO_NATS if args.cluster else NO_MOSQUITTO) or NO_POSTGRES:
        print(missing)
        return 1
    load = Load(
        args.gateways, args.devices, args.period, args.intervals, args.collectors, args.generators, args.seconds,
        args.cluster,
    )  # fmt: skip
    print(f"{load.title}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before", flush=True)
    with running_server(options=POSTGRES) as postgres:
        outcome = run(load, postgres)
    for row in (outcome.figures, *outcome.parts, outcome.limits, *({"problem": one} for one in outcome.problems)):
        print(f"  {printed(row)}")
    program_run.save(args.json, outcome.tables(load.title), outcome.problems)
    return int(bool(outcome.problems))


if __name__ == "__main__":
    sys.exit(main())
