"""`make fuzz`: run each target for some seconds, two at a time, and print a table. A finding causes exit status 1.

make fuzz                                            60 s each with atheris, or with hypothesis without atheris
make fuzz ARGS="--seconds 4 --seed 25"               the short form: all targets in at most 100 s on two idle cores
make fuzz ARGS="--seconds 3600 --target stream/"     an hour for each target with this text in its name
make fuzz ARGS="--seed 7"                            the same inputs in the same order, up to the time limit
make fuzz ARGS="--replay FILE --target shm/ring"     one input, with its traceback
make fuzz ARGS="--corpus"                            create tests/fuzz/corpus again from the seeds of the targets
"""

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.fuzz import c_header
from tests.fuzz.target import all_names, inputs_of, load, write_all
from tests.support.results import ProgramRun, Row, Table, add_json

BUILD: Final = Path("build/fuzz")
SECONDS: Final = 60.0
JOBS: Final = 2
NICE: Final = 10  # fuzzing must not disturb other programs
STARTING_S: Final = 600.0
"""Maximum time to import and instrument a target, s: 1 s of CPU time, which takes minutes on a busy host."""

_COVERAGE: Final = re.compile(r"cov: (\d+) ft: (\d+) corp: (\d+)")
_RUNS: Final = re.compile(r"stat::number_of_executed_units: *(\d+)|^#(\d+)", re.MULTILINE)
_HEADINGS: Final = (
    f"{'target':24} {'engine':10} {'executions':>11} {'per s':>8} {'edges':>6} {'features':>8} {'corpus':>6}  findings"
)


@dataclass(frozen=True, slots=True)
class Result:
    target: str
    engine: str
    executions: int
    seconds: float
    edges: str
    features: str
    inputs: str
    findings: tuple[Path, ...]
    failed: bool

    @property
    def per_s(self) -> float:
        return self.executions / self.seconds if self.seconds else 0

    @property
    def outcome(self) -> str:
        return ", ".join(map(str, self.findings)) or (f"FAILED, see {_log(self.target)}" if self.failed else "none")

    @property
    def row(self) -> Row:
        return {
            "target": self.target, "engine": self.engine, "inputs": self.executions, "inputs per second": self.per_s,
            "covered edges": self.edges, "findings": self.outcome,
        }  # fmt: skip

    def __str__(self) -> str:
        return (
            f"{self.target:24} {self.engine:10} {self.executions:11} {self.per_s:8.0f} {self.edges:>6} "
            f"{self.features:>8} {self.inputs:>6}  {self.outcome}"
        )


def fuzz(target: str, engine: str, seconds: float, seed: int) -> Result:
    folder = BUILD / target.replace("/", "-")
    grown = folder / ("corpus-of-seed" if seed else "corpus")
    if seed:
        shutil.rmtree(grown, ignore_errors=True)
    grown.mkdir(parents=True, exist_ok=True)
    paths = [str(path) for path in inputs_of(target)]
    command = [sys.executable, "-m", "tests.fuzz.worker", engine, target, str(seconds), str(seed), str(folder)]
    command += [str(grown), *paths]
    if engine == "clang":
        command = c_header.command(seconds, seed, folder, grown, paths)
    before = _artifacts(folder)
    begin_s = time.monotonic()
    with _log(target).open("wb") as log:
        status = _run(command, log.fileno(), seconds)
    text = _log(target).read_text(errors="replace")
    coverage = _COVERAGE.findall(text)
    edges, features, inputs = coverage[-1] if coverage else ("-", "-", "-")
    runs = max((int(a or b) for a, b in _RUNS.findall(text)), default=0)
    took_s = min(time.monotonic() - begin_s, seconds)
    findings = tuple(sorted(_artifacts(folder) - before))
    return Result(target, engine, runs, took_s, edges, features, inputs, findings, status != 0)


def _run(command: Sequence[str], log: int, seconds: float) -> int:
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, check=False, timeout=seconds + STARTING_S,
            env=environment(), preexec_fn=_be_nice,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 1
    return done.returncode


def environment() -> dict[str, str]:
    """Return the environment of a target's process. The order of sets is the same in each process."""
    return {**c_header.environment(), "PYTHONHASHSEED": "0"}


def _be_nice() -> None:
    os.nice(NICE)


def _artifacts(folder: Path) -> set[Path]:
    return {path for kind in ("crash", "timeout", "oom", "leak") for path in folder.glob(f"{kind}-*")}


def _log(target: str) -> Path:
    return BUILD / f"{target.replace('/', '-')}.log"


def plan(wanted: Sequence[str], engine: str) -> list[tuple[str, str]]:
    """Return the targets with their engines. Print the skipped targets with the reason.

    Raises SystemExit if a required target cannot be built.
    """
    chosen = [name for name in all_names() if not wanted or any(part in name for part in wanted)]
    if engine == "auto":
        engine = "atheris" if importlib.util.find_spec("atheris") else "hypothesis"
        if engine == "hypothesis":
            print("cannot import atheris; using hypothesis, without coverage")
    found = [(name, engine) for name in chosen]
    if not wanted or any(part in c_header.TARGET for part in wanted):
        problem = c_header.build(BUILD)
        if problem and c_header.is_needed():
            raise SystemExit(f"cannot build {c_header.TARGET}: {problem}; try make fuzz-deps, CI requires it")
        if problem:
            print(f"skipping {c_header.TARGET}: {problem}")
        else:
            found.append((c_header.TARGET, "clang"))
    return found


def replay(path: Path, wanted: Sequence[str]) -> int:
    for name in all_names():
        if any(part in name for part in wanted):
            print(f"{name}: {path}", flush=True)
            load(name).run(path.read_bytes())
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fuzz")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="time for each target, s (default %(default)s)")
    parser.add_argument(
        "--target", action="append", default=[], help="part of a target's name; repeat it for more targets"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the inputs; 0 uses the clock (default)")
    parser.add_argument(
        "--jobs", type=int, default=JOBS, help="number of targets that run at the same time (default %(default)s)"
    )
    parser.add_argument("--engine", choices=("auto", "atheris", "hypothesis"), default="auto")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run one input through --target")
    parser.add_argument("--corpus", action="store_true", help="create the corpus in the tree again")
    parser.add_argument("--list", action="store_true", help="print the targets")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if args.list:
        print("\n".join([*all_names(), c_header.TARGET]))
        return 0
    if args.corpus:
        return write_all()
    if args.replay:
        return replay(args.replay, args.target)
    BUILD.mkdir(parents=True, exist_ok=True)
    print(_HEADINGS, flush=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        planned = plan(args.target, args.engine)
        running = [pool.submit(fuzz, name, engine, args.seconds, args.seed) for name, engine in planned]
        results = []
        for each in running:
            results.append(each.result())
            print(results[-1], flush=True)
    problems = [f"{result.target}: {result.outcome}" for result in results if result.failed or result.findings]
    program_run.save(args.json, [Table("", [result.row for result in results])], problems)
    found = len(problems)
    total = sum(result.executions for result in results)
    print(f"{len(results)} targets, {total} executions, {found} with findings; logs in {BUILD}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
