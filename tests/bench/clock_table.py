"""Compare `t_err_ns` with the real error in difficult conditions: `python -m tests.bench.clock_table` (3 minutes).

A cell is one condition on one link, simulated in several installations (`adversity`). The table shows the figures of
each cell next to the figures of the commit in `clock_table.json`:

    σ           root mean square of `t_ns` - truth, µs, over the whole run
    settling    share of samples within 2 × t_err_ns in the first 30 s
    settled     the same share after 30 s
    t_err/rms   median of t_err_ns divided by σ, settled; a value far above 1 is as useless as a value far below 1
    rms/rms     root mean square of t_err_ns divided by σ, settled

The median describes normal samples. A few samples with a large error dominate σ. If a cell has both, t_err/rms is low
even if each t_err_ns is exact. rms/rms is 1 in this case. If a few samples have a much too large t_err_ns, rms/rms is
high. The goals are: settling ≥ 0.95, settled ≥ 0.97, t_err/rms from 0.8 to 3, σ not larger than at the base commit.

On hosts with steered, stepped or stopped clocks, the truth is CLOCK_MONOTONIC as it ran. The error of a sample is the
larger error of `t_ns` and `utc_ns`.

`--quick`: two installations instead of six. `--only TEXT`: cells whose name contains TEXT. `--seeds FIRST`: other
installations. `--base COMMIT`: run this commit now and compare with it. `--keep COMMIT`: also store the
figures.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from inspect import signature
from math import sqrt
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sampling.clock import SampleClock
from tests.bench.adversity import (
    CAN,
    FT232,
    LINKS,
    LOADED,
    LOG_NORMAL,
    PARETO,
    SECONDS,
    STAMP_MODULUS,
    UART,
    USB_1,
    USB_16,
    Cell,
    Device,
    HostClocks,
    Link,
    Stalls,
    messages,
)
from tests.bench.compare import ROOT, checked_out
from tests.bench.rows import Row, at_least
from tests.support.results import ProgramRun, Table, add_json, decode

if TYPE_CHECKING:  # older base commits do not have this module
    from imud.host.clock import SteadyTime

FILE: Final = Path(__file__).with_suffix(".json")
SETTLING_NS: Final = 30 * NS_PER_S  # first part of a run
MACHINES: Final = 6  # seeds per cell
QUICK: Final = (1, 4)  # installations of the short form: their minimum wake-up times are 1/4 and 3/4 of the maximum
SETTLED_LEAST: Final = 0.97
SETTLING_LEAST: Final = 0.95
RATIO_LEAST: Final = 0.8  # below: t_err_ns is too small
RATIO_MOST: Final = 3.0  # above: t_err_ns is too large
WORSE_MOST: Final = 1.02  # Maximum ratio of σ to the base. 2 % allow for the random values of two runs.


class CellFigures(msgspec.Struct, frozen=True):
    sigma_us: float
    settling: float
    settled: float
    ratio: float
    rms_ratio: float | None = None  # None in figures that an older version stored

    def short_of(self, base: "CellFigures | None") -> list[str]:
        missed = []
        if self.settling < SETTLING_LEAST:
            missed.append("settling")
        if self.settled < SETTLED_LEAST:
            missed.append("settled")
        if not RATIO_LEAST <= self.ratio <= RATIO_MOST:
            missed.append("t_err/rms")
        if base is not None and self.sigma_us > WORSE_MOST * base.sigma_us:
            missed.append("σ")
        return missed


Figures = Mapping[str, CellFigures]
COLUMNS: Final = (
    "condition, link", "σ, µs", "within 2 t_err before 30 s", "after 30 s", "median t_err / rms error",
    "rms t_err / rms error",
)  # fmt: skip


class Dated(NamedTuple):
    off_ns: int
    t_err_ns: int
    settling: bool


# --- cells ----------------------------------------------------------------------------------------------------------

FAST: Final = Link("uart-921600", 921_600)
FAST_USB: Final = Link("usb-1ms-921600", 921_600, timer_ns=NS_PER_MS)
SLOW_RATE: Final = Device(rates_hz=((0.0, 10.0),))
TIMELESS: Final = Device(says="nothing")


def cells() -> Iterator[Cell]:
    for adversity in _everywhere():
        for link in LINKS:
            yield adversity.on(link)
    for hz in (400.0, 1000.0):
        device = Device(rates_hz=((0.0, hz),))
        for link in (FAST, FAST_USB, replace(USB_16, name="usb-16ms-921600", baud=921_600)):
            yield Cell(f"{hz:g} Hz", link, device)
            yield Cell(f"{hz:g} Hz, loaded host", link, device, LOADED)
    for link in LINKS:
        fast = replace(link, baud=921_600 if link.baud else 0)
        yield Cell("100 Hz to 400 to 50", fast, Device(rates_hz=((0.0, 100.0), (40.0, 400.0), (80.0, 50.0))))
    for link in (USB_1, FT232):
        # the adapter has a timer of 16 ms, the operating system reports 1 ms
        untold = replace(link, name=f"{link.name}, told 1 ms", timer_ns=16 * NS_PER_MS, told_hold_ns=NS_PER_MS)
        yield Cell("wrong timer", untold)
        yield Cell("wrong timer, loaded host", untold, wake=LOADED)
    yield from _timeless()
    yield from _host_clocks()
    for link in LINKS:
        yield Cell("hold-out: log-normal host", link, wake=LOG_NORMAL)
        yield Cell(
            "hold-out: log-normal host, 50 Hz to 125", link,
            Device(rates_hz=((0.0, 50.0), (55.0, 125.0)), swing_ppm=3.0, swing_s=60.0), LOG_NORMAL,
        )  # fmt: skip


def _everywhere() -> Iterator[Cell]:
    yield Cell("plain", UART)
    yield Cell("loaded host", UART, wake=LOADED)
    yield Cell("Pareto wake-ups", UART, wake=PARETO)
    yield Cell("10 Hz", UART, SLOW_RATE)
    yield Cell("hub stalls 200 ms every 5 s", UART, stalls=Stalls(5 * NS_PER_S, 200 * NS_PER_MS))
    yield Cell("stalls of 2 s", UART, stalls=Stalls(25 * NS_PER_S, 2 * NS_PER_S, 7 * NS_PER_S))
    yield Cell("flood", UART, stalls=Stalls(350 * NS_PER_MS, 120 * NS_PER_MS))
    yield Cell("bursts of loss", UART, Device(loss=0.01, loss_burst_s=(9.0, 0.4)))
    yield Cell("temperature", UART, Device(swing_ppm=8.0, swing_s=100.0))
    yield Cell("restart", UART, Device(restarts_s=(50.0,)))
    yield Cell("wrap", UART, Device(ticks_before_wrap=60_000))


def _timeless() -> Iterator[Cell]:
    for host, wake in (("", PARETO), (", loaded host", LOADED)):
        yield Cell(f"HI92{host}", UART, Device(says="stamp", size_bytes=54), wake)
        yield Cell(f"HI92 on mark{host}", UART, Device(says="trigger", size_bytes=54), wake)
        yield Cell(f"HI92 on mark{host}", USB_16, Device(says="trigger", size_bytes=54), wake)
        yield Cell(f"TPDO{host}", CAN, TIMELESS, wake)
        yield Cell(f"PGN 10 Hz{host}", CAN, replace(TIMELESS, rates_hz=((0.0, 10.0),)), wake)
        yield Cell(f"numbered{host}", CAN, Device(says="number"), wake)
        yield Cell(f"TPDO, loss{host}", CAN, replace(TIMELESS, loss=0.005), wake)
        yield Cell(f"TPDO, stalls of 2 s{host}", CAN, TIMELESS, wake, Stalls(25 * NS_PER_S, 2 * NS_PER_S, 7 * NS_PER_S))


HOST_CLOCKS: Final = (
    HostClocks("20 ppm steered", ((-1000, 20),)),
    HostClocks("500 ppm slewed for 40 s, twice", ((30, 500), (70, -500), (110, 0))),
    HostClocks("83,333 ppm slewed for 5 s, twice", ((2, 83_333), (7, 0), (80, -83_333), (85, 0))),
    HostClocks("CLOCK_REALTIME steps", steps=((20, 3600), (60, -1), (90, -50e-6))),
    HostClocks("suspended for 20 s", ((-1000, 20),), suspend_s=(60, 20)),
    HostClocks("virtual machine stopped for 5 s", ((-1000, 20),), stop_s=(60, 5)),
)


def _host_clocks() -> Iterator[Cell]:
    if "host" not in signature(SampleClock).parameters:
        return  # the base commit has no `host` argument
    for host in HOST_CLOCKS:
        for link in LINKS:
            yield Cell(host.name, link, host=host)
        yield Cell(f"TPDO, {host.name}", CAN, TIMELESS, host=host)


# --- figures --------------------------------------------------------------------------------------------------------


def clock_of(cell: Cell, host: "SteadyTime | None" = None) -> SampleClock:
    says = cell.device.says
    clock = partial(
        SampleClock, "bench", tick_ns=0 if says == "number" else NS_PER_MS,
        tick_modulus=256 if says == "number" else 1 << 32, byte_ns=uart_byte_ns(cell.link.baud),
        hold_ns=cell.link.hold_ns, stamp_modulus=STAMP_MODULUS if says in {"stamp", "trigger"} else 0,
    )  # fmt: skip
    return clock() if host is None else clock(host=host)


def dated(cell: Cell, seed: int, seconds: int = SECONDS) -> Iterator[Dated]:
    if cell.host is not None:
        yield from _dated_on(cell.host, cell, seed, seconds)
        return
    clock, settled_ns = clock_of(cell), 0
    for message in messages(cell, seed, seconds):
        settled_ns = settled_ns or message.truth_ns + SETTLING_NS
        sample = clock.sample(message.measurement, message.t_rx_ns, 0, message.t_begin_ns)
        yield Dated(sample.t_ns - message.truth_ns, sample.t_err_ns, message.truth_ns < settled_ns)


def _dated_on(clocks: HostClocks, cell: Cell, seed: int, seconds: int) -> Iterator[Dated]:
    # import here: older base commits do not have host_clocks.py
    from tests.bench.host_clocks import BEGIN_NS, DECODE_NS, UTC_AHEAD_NS, SteeredHost, Steering

    host = SteeredHost(Steering(clocks.name, clocks.slews))
    host.at(BEGIN_NS)
    clock, to, settled_ns = clock_of(cell, host.clock.steady), host.steering.monotonic_ns, 0
    for message in messages(cell, seed, seconds):
        settled_ns = settled_ns or message.truth_ns + SETTLING_NS
        read_ns = message.t_rx_ns + DECODE_NS
        host.ahead_ns = UTC_AHEAD_NS + clocks.stepped_ns(read_ns - BEGIN_NS)
        offset_ns = host.at(read_ns)
        begin_ns = None if message.t_begin_ns is None else to(message.t_begin_ns)
        sample = clock.sample(message.measurement, to(message.t_rx_ns), offset_ns, begin_ns)
        truth_ns = to(message.truth_ns)
        # the larger error of both clocks counts
        off_ns = max(sample.t_ns - truth_ns, sample.utc_ns - host.ahead_ns - truth_ns, key=abs)
        yield Dated(off_ns, sample.t_err_ns, message.truth_ns < settled_ns)


def figures_of(cell: Cell, seeds: Sequence[int], seconds: int = SECONDS) -> CellFigures:
    samples = [d for seed in seeds for d in dated(cell, seed, seconds)]
    settled = [d for d in samples if not d.settling]
    settling = [d for d in samples if d.settling]
    rms_ns = sqrt(sum(d.off_ns**2 for d in settled) / len(settled))
    return CellFigures(
        round(sqrt(sum(d.off_ns**2 for d in samples) / len(samples)) / 1000, 1), round(_share(settling), 4),
        round(_share(settled), 4), round(median(d.t_err_ns for d in settled) / rms_ns, 2),
        round(sqrt(sum(d.t_err_ns**2 for d in settled) / len(settled)) / rms_ns, 2),
    )  # fmt: skip


def _share(samples: Sequence[Dated]) -> float:
    return sum(abs(d.off_ns) <= 2 * d.t_err_ns for d in samples) / len(samples)


def table(seeds: Sequence[int], only: str = "") -> Iterator[tuple[str, CellFigures]]:
    for cell in cells():
        if only in cell.name:
            yield cell.name, figures_of(cell, seeds)


# --- the base -------------------------------------------------------------------------------------------------------


class Base(msgspec.Struct, frozen=True):
    commit: str
    cells: dict[str, CellFigures]


def kept_base() -> Base:
    return msgspec.json.decode(FILE.read_bytes(), type=Base)


def base_of(commit: str, arguments: Sequence[str]) -> Base:
    # imud of the base commit, tests of this tree
    with checked_out(commit) as tree, tempfile.TemporaryDirectory(prefix="imud-clock-table-") as folder:
        (Path(folder) / "imud").symlink_to(tree / "imud")
        (Path(folder) / "tests").symlink_to(ROOT / "tests")
        file = Path(folder) / "figures.json"
        program = [sys.executable, "-P", "-m", "tests.bench.clock_table", "--json", str(file), *arguments]
        subprocess.run(
            program, env={**os.environ, "PYTHONPATH": folder}, cwd=folder, stdout=subprocess.DEVNULL, check=True
        )
        rows = decode(file).tables[0].rows
    return Base(commit, {name: CellFigures(*figures) for name, *figures in map(dict.values, map(dict, rows))})


def row_of(name: str, got: CellFigures) -> Mapping[str, object]:
    return dict(zip(COLUMNS, (name, *msgspec.structs.astuple(got)), strict=True))


def rows(*, quick: bool = False) -> Iterator[Row]:
    for name, got in table(QUICK, "loaded host") if quick else table(range(MACHINES)):
        yield Row(f"{name}: sigma", got.sigma_us, "µs")
        yield at_least(f"{name}: share settled", got.settled, "", SETTLED_LEAST)
        yield at_least(f"{name}: share settling", got.settling, "", SETTLING_LEAST)
        yield Row(f"{name}: median t_err / rms", got.ratio, "")
        yield Row(f"{name}: rms t_err / rms", got.rms_ratio or 0.0, "")


def show(found: Iterable[tuple[str, CellFigures]], base: Figures) -> int:
    columns = "σ, µs | settling | settled | t_err/rms | rms/rms"
    print(f"| cell | {columns} | base: {columns} | missed |")
    print(f"|{12 * '---|'}")
    short = 0
    for name, got in found:
        was = base.get(name)
        before = _cells_of(was) if was else "– | – | – | – | –"
        missed = got.short_of(was)
        short += bool(missed)
        print(f"| {name} | {_cells_of(got)} | {before} | {', '.join(missed)} |", flush=True)
    return short


def _cells_of(got: CellFigures) -> str:
    rms_ratio = "–" if got.rms_ratio is None else f"{got.rms_ratio:.2f}"
    return f"{got.sigma_us:.0f} | {got.settling:.3f} | {got.settled:.3f} | {got.ratio:.2f} | {rms_ratio}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.clock_table")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="", metavar="TEXT")
    parser.add_argument("--seeds", type=int, default=0, metavar="FIRST")
    add_json(parser)
    parser.add_argument("--base", metavar="COMMIT")
    parser.add_argument("--keep", metavar="COMMIT")
    args = parser.parse_args()
    seeds = [args.seeds + i for i in (QUICK if args.quick else range(MACHINES))]
    program_run, found = ProgramRun(), table(seeds, args.only)
    if args.json:
        got = dict(found)
        missed = [f"{name}: {', '.join(words)}" for name, one in got.items() if (words := one.short_of(None))]
        program_run.save(args.json, [Table("", [row_of(name, one) for name, one in got.items()])], missed)
        return 0
    if args.base or args.keep:
        arguments = ["--only", args.only, "--seeds", str(args.seeds), *(["--quick"] if args.quick else [])]
        base = base_of(args.base or args.keep, arguments)
        if args.keep:
            FILE.write_bytes(msgspec.json.format(msgspec.json.encode(base)) + b"\n")
    else:
        # the stored figures are from six installations from seed 0 on
        base = kept_base() if not args.quick and not args.seeds and FILE.exists() else Base("", {})
    short = show(found, base.cells)
    print(f"\n{short} cells miss a goal")
    return 0


if __name__ == "__main__":
    sys.exit(main())
