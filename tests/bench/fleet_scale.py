"""`make fleet-scale`: cost of each part of a fleet by the number of gateways, devices and stored rows, and its limits.

`python -m tests.bench.fleet_scale [--short]` runs `fleet_load` with many sizes, about 20 minutes, or 5 minutes with
`--short`. All parts run on this host, so a part cannot use all cores.

- *Growth*: one size changes, and the messages per second stay the same. If a fleet offers more than RATE messages per
  second at 1 Hz, each gateway sends less often (`period`). The table has the CPU time of each part per message.
- *Full rate*: all gateways send at 1 Hz, also with more than one collector, and with NATS.
- *Saturation*: the offered messages exceed the capacity. The phase `load` shows the part that limits the messages per
  second. In the phase `drain`, the gateways have stopped, and collectors and database store the waiting messages.
- *Saturation points*: computed, 1 / CPU time per message, for one core.
- *Plan*: computed, cost × messages per second for fleets of 100 to 100,000 gateways.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from time import monotonic, time
from typing import Final, NamedTuple

from tests.bench.fleet_load import CPU, POSTGRES, Load, Outcome, run
from tests.bench.fleet_parts import FleetDatabase
from tests.fleet.mosquitto import NO_MOSQUITTO
from tests.fleet.nats_cluster import NO_NATS
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, running_server
from tests.support.results import ProgramRun, Row, Table, add_json, printed

PARTS: Final = ("broker", "collectors", "database", "generator")


class Sizes(NamedTuple):
    """Sizes of all runs."""

    rate: float  # messages per second of the runs for the growth
    seconds: float  # time of a measurement
    gateways: Sequence[int]  # with one device each
    devices: Sequence[int]  # per gateway
    device_gateways: int  # number of gateways of the runs with several devices
    batch_s: Sequence[int]  # from 1 to 10: `batch_s` of the gateways
    rows: Sequence[int]  # in the table of intervals before the run
    full: Sequence[Load]
    saturation: Sequence[Load]


LONG: Final = Sizes(
    rate=1000.0, seconds=10.0, gateways=(500, 1000, 2500, 5000, 10_000), devices=(1, 2, 4, 8), device_gateways=1000,
    batch_s=(1, 2, 5, 10), rows=(0, 300_000, 1_000_000, 3_000_000),
    full=(
        Load(1000, 1), Load(1000, 1, is_cluster=True), Load(5000, 1),
        Load(5000, 1, collectors=3), Load(10_000, 1, collectors=2),
    ),
    saturation=tuple(Load(5000, 4, collectors=one, seconds=10) for one in (1, 2, 3)),
)  # fmt: skip
SHORT: Final = Sizes(
    rate=200.0, seconds=5.0, gateways=(50, 100, 200, 400), devices=(1, 2, 4, 8), device_gateways=50,
    batch_s=(1, 2, 5, 10), rows=(0, 20_000, 50_000, 100_000),
    full=(Load(200, 1, seconds=5), Load(200, 1, collectors=2, seconds=5)),
    saturation=(Load(500, 30, seconds=5),),
)  # fmt: skip


class _Scale:
    """All runs. Synchronization: one thread."""

    def __init__(self, sizes: Sizes) -> None:
        self.problems: list[str] = []
        self._sizes = sizes
        self._row_bytes = 0.0  # size of a stored row of intervals with its index

    def tables(self) -> Iterator[Table]:
        sizes = self._sizes
        growth = self._growth("gateways", sizes.gateways, lambda size: self._scaled(size, 1))
        yield growth
        yield self._growth("devices per gateway", sizes.devices, lambda size: self._scaled(sizes.device_gateways, size))
        batches = self._growth("batch_s", sizes.batch_s, self._batched)
        yield batches
        yield from self._table_sizes()
        yield self._runs("Full rate: all devices send at 1 Hz", sizes.full)
        yield self._runs("Saturation: more messages than the host can store", sizes.saturation)
        yield Table("Saturation points of one core, computed from the growth with gateways", list(_points(growth)))
        yield Table(
            "Plan: two devices at 1 Hz, cores computed from the growth with batch_s, disk from the size of a row",
            list(self._plan(batches)),
        )

    def _batched(self, batch_s: int) -> Load:
        return Load(round(self._sizes.rate), 1, float(batch_s), batch_s, seconds=self._sizes.seconds)

    def _plan(self, batches: Table) -> Iterator[Row]:
        """Yield the needs of fleets. Cost × messages per second is the number of cores."""
        for costs in (batches.rows[0], batches.rows[-1]):
            for gateways in (100, 1000, 10_000, 100_000):
                messages = gateways * 2 / float(costs["batch_s"])
                yield {
                    "gateways": gateways, "batch_s": costs["batch_s"], "messages, 1/s": messages,
                    "rows, 1/s": gateways * 2,
                    **{f"cores: {part}": messages * float(costs[part]) / 1000 for part in PARTS[:-1]},
                    "disk, GB per day": gateways * 2 * 86_400 * self._row_bytes / 1e9,
                }  # fmt: skip

    def _scaled(self, gateways: int, devices: int) -> Load:
        period_s = max(1.0, gateways * devices / self._sizes.rate)
        return Load(gateways, devices, period_s, seconds=self._sizes.seconds)

    def _growth(self, name: str, sizes: Sequence[int], load_of: Callable[[int], Load]) -> Table:
        rows = []
        for size in sizes:
            with running_server(options=POSTGRES) as postgres:
                rows.append(self._costs({name: size}, load_of(size), postgres))
        return Table(f"Growth with {name}: {CPU}", rows)

    def _table_sizes(self) -> Iterator[Table]:
        """Measure with more and more rows in one database."""
        sizes = self._sizes
        load = Load(round(sizes.rate), 1, seconds=sizes.seconds)
        rows, filled, bytes_per_row = [], 0, (0.0, 0.0)
        with running_server(options=POSTGRES) as postgres, closing(FleetDatabase(postgres.url)) as database:
            for size in sizes.rows:
                begin_s = monotonic()
                if size > filled:  # the first run creates the tables
                    database.fill(filled, size, time())
                    filled = size
                fill_s = monotonic() - begin_s
                rows.append(self._costs({"rows before": size}, load, postgres) | {"fill, s": fill_s})
            bytes_per_row = database.bytes_per_row()
        yield Table(f"Growth with rows in the table of intervals: {CPU}", rows)
        table, index = bytes_per_row
        self._row_bytes = table + index
        day = 86_400 * (table + index) / 1e9
        yield Table(
            "Size of a row of intervals with 36 values",
            [{"table, bytes": table, "indexes, bytes": index, "GB per day and device at 1 Hz, computed": day}],
        )

    def _costs(self, size: Row, load: Load, postgres: PostgresServer) -> dict[str, object]:
        outcome = self._run(load, postgres)
        row: dict[str, object] = {**size, "period, s": load.period_s, "stored, 1/s": outcome.figures["stored, 1/s"]}
        row |= {part: outcome.cost(part) for part in PARTS}
        row |= {f"memory of the {part}, MB": outcome.memory(part) for part in PARTS}
        row |= {name: outcome.figures[name] for name in ("delay p50, s", "delay p99, s")}
        print(f"  {printed(row)}", flush=True)
        return row

    def _runs(self, title: str, loads: Sequence[Load]) -> Table:
        rows: list[Row] = []
        for load in loads:
            with running_server(options=POSTGRES) as postgres:
                outcome = self._run(load, postgres)
            for phase, limit in outcome.limits.items():
                parts = [row for row in outcome.parts if row["phase"] == phase]
                if not parts:
                    continue
                row = {
                    "gateways": load.gateways, "devices": load.devices, "period, s": load.period_s,
                    "collectors": load.collectors, "broker": "3 × NATS" if load.is_cluster else "mosquitto",
                    "phase": phase, "offered, 1/s": outcome.figures["offered, 1/s"] if phase == "load" else 0.0,
                    "stored, 1/s": parts[0]["messages, 1/s"],
                    **{f"cores: {part['part']}": part["cores"] for part in parts},
                    "limit": limit,
                }  # fmt: skip
                if phase == "load":
                    row |= {name: outcome.figures[name] for name in ("delay p50, s", "delay p99, s")}
                    row |= {"backlog at the end": outcome.figures["backlog at the end"]}
                print(f"  {printed(row)}", flush=True)
                rows.append(row)
        return Table(title, rows)

    def _run(self, load: Load, postgres: PostgresServer) -> Outcome:
        print(load.title, flush=True)
        outcome = run(load, postgres)
        self.problems += outcome.problems
        return outcome


def _points(growth: Table) -> Iterator[Row]:
    """Yield the messages per second of one core of each part, smallest and largest value of all sizes."""
    for part in PARTS:
        costs = [float(row[part]) for row in growth.rows if row[part]]
        if costs:  # a short run can use less CPU time than the clock of /proc resolves
            yield {"part": part, "messages per s and core": [1000 / max(costs), 1000 / min(costs)]}


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-scale")
    parser.add_argument("--short", action="store_true", help="small sizes, 5 minutes")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if missing := NO_MOSQUITTO or NO_POSTGRES or NO_NATS:
        print(missing)
        return 1
    begin_s = monotonic()
    scale = _Scale(SHORT if args.short else LONG)
    tables = list(scale.tables())
    for table in tables[-2:]:
        print(table.title, *(f"  {printed(row)}" for row in table.rows), sep="\n")
    print(f"{monotonic() - begin_s:.0f} s", *scale.problems, sep="\n")
    program_run.save(args.json, tables, scale.problems)
    return int(bool(scale.problems))


if __name__ == "__main__":
    sys.exit(main())
