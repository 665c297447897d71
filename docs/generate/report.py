"""`make report`: run the measurement programs and write docs/measurements from their results.

    python -m docs.generate.report [SUBJECT …] [--stored]

A run is one measurement program. Its results are in docs/measurements/data/RUN.json, and a page is a function of these
files. For each run of the subjects, the command moves build/results/RUN.json to the data. If this file does not exist,
the command first runs the program. `make report` does not run long programs: it prints their command, with `--json`.
Without new results, the data and the page stay as they are. `--stored` runs no program. The exit status is 1 if a
program wrote no results.
"""

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from tests.support.results import ROOT, Results, Row, decode, encode, markdown

PAGES: Final = ROOT / "docs/measurements"
NEW: Final = ROOT / "build/results"
NICE: Final = ("nice", "-n", "10")


class Run(NamedTuple):
    """A run of a measurement program."""

    name: str
    title: str
    text: str
    short: str = ""  # words after `python -m`; empty if `make report` does not run the program
    by_hand: str = ""  # command of the long form, without `--json`
    problems: str = ""  # name of the problems that the program reports; empty if it has no limits

    @property
    def command_by_hand(self) -> str:
        words = self.by_hand or f"python -m {self.short}"
        return f"{words} --json build/results/{self.name}.json"


class Subject(NamedTuple):
    title: str
    text: str
    runs: tuple[Run, ...]


SUBJECTS: Final[Mapping[str, Subject]] = {
    "timestamps": Subject(
        "Measurements: time stamps",
        "Errors of `t_ns` against the known time of simulated devices. [clock](../clock.md) explains the method.",
        (
            Run(
                "clock", "Without lines",
                "A device and a host are simulated for each kind of arrival and rate. Figures are from the best to "
                "the worst of six crystals: 0, ±50 ppm, ±5 %, and with drift (0.1 ppm/s), after 70 s. "
                "`usb-16ms-packet` is an FT232 adapter, which also sends a full packet of 62 bytes. `loaded` is a "
                "UART on a busy host.\n\n![error of time stamps by link and rate, measured and "
                "reported](../pictures/clock_arrivals.svg)\n\nThe bar is the range of the rms error, the thin line is "
                "`t_err_ns`.",
                "tests.bench.clock --short", "python -m tests.bench.clock",
            ),
            Run(
                "clock_lines", "With SOUT, PPS, UTC and triggers",
                "Figures after 20 s. The simulated kernel time-stamps edges 3 µs late, with an exponential scatter of "
                "4 µs.\n\n![error of time stamps with SOUT, PPS, UTC and triggers](../pictures/clock_lines.svg)\n\n"
                "The filled dot is σ, the hollow dot is the mean, and the dash is `t_err_ns`. Values below 0.1 µs are "
                "drawn at 0.1 µs.",
                "tests.bench.clock_lines",
            ),
            Run(
                "clock_table", "Difficult conditions",
                "Combinations of a link and a difficulty, each on simulated hosts. The goals are: at least 97 % of "
                "the samples within 2 × `t_err_ns` after 30 s, at least 95 % before, and a median of `t_err_ns` of "
                "0.8 to 3 times the rms error.",
                "tests.bench.clock_table --quick", "python -m tests.bench.clock_table", "missed goals",
            ),
        ),
    ),
    "attitude": Subject(
        "Measurements: attitude on the host",
        "Errors of `attitude: host` ([attitude](../attitude.md)).",
        (
            Run(
                "attitude", "Filters",
                "A simulated sensor rests for 20 s and then rotates for 10 s at 200 °/s, in three directions. Gyro: "
                "noise 0.005 (°/s)/√Hz, bias 0.2 °/s. Accelerometer: noise 100 µg/√Hz. The table has the largest "
                "error of the three directions. A scale error of the gyro is not simulated: 0.1 % adds 2° of yaw in "
                "2000° of rotation. The CPU time of vqf contains the work of imud for the sample. The recording of "
                "the device does not show which attitude is right.",
                "tests.bench.attitude",
            ),
        ),
    ),
    "latency": Subject(
        "Measurements: CPU time and latency",
        "Cost of the daemon from the serial port to its clients. [latency](../latency.md) explains the settings. On a "
        "busy host, use the ratios and the instructions.",
        (
            Run(
                "instructions", "Instructions per sample",
                "Instructions of the process for one sample or frame, counted by callgrind. Other load on the host "
                "does not change the count. It contains no instructions of the kernel of the operating system.",
                "tests.bench.instructions", problems="stages above their stored figure",
            ),
            Run(
                "bench", "CPU time",
                "`latency`: one HiPNUC device at 1 kHz. The *bare loop* is a Python program that reads, checks, packs "
                "and sends each frame, without clock, ledger and shared memory. Ratios are medians of rounds. "
                "`devices`: many devices with one client each, on one core. `gpsd`: gpsd receives sentences of about "
                "the same size.",
                "tests.bench latency devices gpsd --short", "python -m tests.bench latency devices gpsd",
                "missed goals",
            ),
        ),
    ),
    "outputs": Subject(
        "Measurements: export",
        "Size and cost of converted files.",
        (
            Run(
                "export", "Export",
                "Captures of simulated devices with noise and motion ([export](../export.md)).",
                "tests.bench.export",
            ),
        ),
    ),
    "fleet": Subject(
        "Measurements: MQTT",
        "Gateways, brokers and collectors ([fleet](../fleet.md)).",
        (
            Run(
                "fleet_faults", "Faults",
                "A gateway with one device at 1 kHz (all samples as slots), mosquitto, a proxy and a collector. At "
                "the end of each fault, the ledger must balance. `thinned`: samples that statistics replaced.",
                "tests.bench.fleet_faults --seconds 5", "python -m tests.bench.fleet_faults --tls",
                "lost samples and unbalanced ledgers",
            ),
            Run(
                "fleet_scale", "Load",
                "Simulated gateways send one message per second and device with the statistics of one second (36 "
                "values), mosquitto or NATS delivers them to `imud fleet collect`, and PostgreSQL stores one row for "
                "each message. All parts run on the same host. The costs are CPU time per 1,000 messages: other load "
                "on the host changes them only a little. For the growth, gateways send less often if the fleet would "
                "offer more than the given messages per second (`period`). A delay is the time from the due time of "
                "a message until its row is visible, with a resolution of 0.1 s.",
                by_hand="python -m tests.bench.fleet_scale",
                problems="lost numbers, missing rows and open ledgers",
            ),
            Run(
                "fleet_retention", "Retention",
                "The table `imud_intervals` with 24 values per row and one partition or chunk per day, after different "
                "numbers of days. The values are random, so that compression has little effect on them. Times are the "
                "minimum of five calls, or of the calls in five seconds. The just-in-time compiler of PostgreSQL is "
                "off.",
                by_hand="python -m tests.bench.fleet_retention",
            ),
            Run(
                "fleet_jetstream", "JetStream as a buffer",
                "Three NATS servers store an hour of messages while the collector is offline. Then the collector "
                "catches up, while SIGKILL ends one server after another. Three more gateways with a device at 1 kHz "
                "send live messages.",
                by_hand="python -m tests.bench.fleet_jetstream",
                problems="lost numbers, missing rows, open ledgers and missed goals",
            ),
            Run(
                "fleet_collectors", "Several collectors",
                "Three processes `imud fleet collect --shares 3` write to one PostgreSQL database. SIGKILL ends one of "
                "them every 20 s. This process starts again after 10 s. The time without a collector is the time from "
                "SIGKILL until another collector acknowledges a message of the same share.",
                by_hand="python -m tests.bench.fleet_collectors",
                problems="repeated or missing rows, open ledgers, and shares without a collector",
            ),
        ),
    ),
    "security": Subject(
        "Measurements: fuzzing, attacks, endurance",
        "Results of the tests with invalid input, hostile clients and long runs ([security](../security.md)).",
        (
            Run(
                "fuzz", "Fuzzing",
                "Random input for every decoder of foreign bytes.",
                "tests.fuzz --seconds 4 --seed 25", "python -m tests.fuzz", "findings",
            ),
            Run(
                "attack", "Hostile clients",
                "Clients of two users attack the daemon next to a device at 1 kHz and a client that must receive "
                "every sample. The short form has no limits of delays.",
                "tests.attack --short", "python -m tests.attack", "exceeded limits",
            ),
            Run(
                "soak", "Endurance",
                "Serial devices, a Modbus bus and replays with clients, scrapes and recordings.",
                by_hand="python -m tests.bench.soak", problems="errors",
            ),
            Run(
                "mutants", "Quality of the tests",
                "Small changes of imud, and how many of them the tests detect. A change that is not detected is a gap "
                "of the tests, or it does not change the behavior.",
                by_hand="python -m tests.mutants", problems="changes that no test detected",
            ),
        ),
    ),
}  # fmt: skip


def page(subject: Subject, found: Mapping[str, Results]) -> str:
    """Return the page of a subject for the results by name of the run."""
    lines = [f"# {subject.title}", "", subject.text, ""]
    lines += ["`make report` generates this page from the files in `docs/measurements/data`. Do not edit it.", ""]
    conditions = [conditions_of(run, found[run.name]) for run in subject.runs if run.name in found]
    lines += [markdown(conditions), ""] if conditions else []
    for run in subject.runs:
        lines += [f"## {run.title}", "", run.text, "", *part(run, found.get(run.name))]
    return "\n".join(lines)


def conditions_of(run: Run, results: Results) -> Row:
    return {
        "measurement": run.title, "start, UTC": results.begun, "duration, s": results.seconds,
        "commit": f"`{results.commit}`", "host": results.host, "Python": results.python, "kernel": results.kernel,
        "C kernel": results.c_kernel, "load at the start": results.load,
    }  # fmt: skip


def part(run: Run, results: Results | None) -> list[str]:
    if results is None:
        return [f"Not measured. Run `{run.command_by_hand}`, then `make report`.", ""]
    lines = [f"Command: `{results.command}`", ""]
    for table in results.tables:
        lines += [f"### {table.title}", ""] if table.title else []
        lines += [markdown(table.rows), ""]
    if run.problems and not results.problems:
        lines += [f"Reported {run.problems}: none.", ""]
    elif results.problems:
        lines += [f"Reported {run.problems or 'problems'}:", "", *(f"- {one}" for one in results.problems), ""]
    return lines


def stored(folder: Path) -> dict[str, Results]:
    return {file.stem: decode(file) for file in sorted((folder / "data").glob("*.json"))}


def write_pages(folder: Path, subjects: Sequence[str]) -> None:
    found = stored(folder)
    if "timestamps" in subjects and {"clock", "clock_lines"} <= found.keys():
        from docs.generate.clock_pictures import draw  # needs matplotlib

        draw(found["clock"], found["clock_lines"])
    for name in subjects:
        (folder / f"{name}.md").write_text(page(SUBJECTS[name], found))


def update(run: Run, new: Path, data: Path, *, measure: bool) -> bool:
    """Move new results of a run to the data. Return whether the run has new results, or needs none."""
    file = new / f"{run.name}.json"
    is_started = measure and bool(run.short) and not file.exists()
    if is_started:
        print(f"{run.name}: python -m {run.short}", flush=True)
        program = [*NICE, sys.executable, "-m", *run.short.split(), "--json", str(file)]
        status = subprocess.run(program, cwd=ROOT, stdout=subprocess.DEVNULL, check=False).returncode
    if file.exists():
        try:
            results = decode(file)
        except msgspec.DecodeError as error:
            print(f"{file}: expected results of `--json`: {error}; remove the file and run `make report` again")
            return False
        data.mkdir(parents=True, exist_ok=True)
        (data / file.name).write_bytes(encode(results))
        file.unlink()
        print(f"{run.name}: new results, {len(results.problems)} problems")
        return True
    reason = f"exit status {status} without results, run {sys.executable} -m {run.short}" if is_started else ""
    print(f"not measured: {run.name}, {reason or f'run {run.command_by_hand}'}")
    return not is_started


def main() -> int:
    parser = argparse.ArgumentParser(prog="make report")
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT", help=f"{', '.join(SUBJECTS)}; default: all")
    parser.add_argument("--stored", action="store_true", help="measure nothing; use the results that exist")
    args = parser.parse_args()
    if unknown := [name for name in args.subjects if name not in SUBJECTS]:
        parser.error(f"unknown subject {unknown[0]!r}; expected {', '.join(SUBJECTS)}")
    subjects = args.subjects or list(SUBJECTS)
    done = [update(run, NEW, PAGES / "data", measure=not args.stored) for s in subjects for run in SUBJECTS[s].runs]
    write_pages(PAGES, subjects)
    return int(not all(done))


if __name__ == "__main__":
    sys.exit(main())
