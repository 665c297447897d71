"""Prints which small changes of imud the tests detect: `make mutants ARGS="--seed 7"`.

Each job has its own copy of the tree. It changes one file of the copy and runs pytest until a test fails: first the
tests of the module, then of its folder, then of the folders above. A failure counts if it happens twice with the change
and does not happen without the change.
An undetected mutant is a gap of the tests, or it is equivalent to the original: the reader decides.
"""

import argparse
import json
import resource
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from time import monotonic
from typing import Final

from tests.mutants.changes import ROOT, Mutant, choose, package_of, source_of
from tests.mutants.trees import Run, Tree, stages, tests_in

DETECTED, MISSED, HUNG = "detected", "NOT DETECTED", "time-out"
LIMIT_MIN_S: Final = 120
BASELINE_LIMIT_S: Final = 3600
MEMORY_MAX_BYTES: Final = 6 << 30
"""Maximum data of one process: a mutant can append to a list without end."""


@dataclass
class Verdict:
    """The result of one mutant, and the test that detected it."""

    number: int
    mutant: Mutant
    result: str
    test: str
    seconds: float
    output: str

    def __str__(self) -> str:
        """Return the line of the report."""
        return f"{self.number:3}  {self.mutant}  |  {self.result}{' by ' if self.test else ''}{self.test}"


class Jobs:
    """Copies of the tree that run in parallel. `seconds` has the duration of the unchanged tests of each folder."""

    def __init__(self, folder: Path, number: int, options: list[str]) -> None:
        self.number = number
        self.options = options
        self.seconds: dict[str, float] = {}
        self.free: SimpleQueue[Tree] = SimpleQueue()
        for job in range(number):
            self.free.put(Tree(folder / str(job)))

    def check_folders(self, folders: set[str]) -> None:
        """Run the unchanged tests of each folder. Ends the program if a test fails twice."""
        with ThreadPoolExecutor(self.number) as pool:
            for folder, run in zip(sorted(folders), pool.map(self._run_folder, sorted(folders)), strict=True):
                if not run.passed:
                    pool.shutdown(cancel_futures=True)
                    sys.exit(f"{run.output}\ncannot test mutants: the unchanged tests of {folder} fail")
                self.seconds[folder] = run.seconds
                print(f"unchanged tests of {folder} pass in {run.seconds:.0f} s", file=sys.stderr, flush=True)

    def _run_folder(self, folder: str) -> Run:
        tree = self.free.get()
        run = again = tree.pytest(*tests_in(ROOT / folder), *self.options, limit_s=BASELINE_LIMIT_S)
        if run.status == 1 and run.failed:
            again = tree.pytest(*run.failed, *self.options, limit_s=BASELINE_LIMIT_S)
            print(f"in {folder} failed once: {' '.join(run.failed)}", file=sys.stderr, flush=True)
        self.free.put(tree)
        return Run(again.status, run.output + again.output, run.seconds)

    def judge_all(self, mutants: dict[int, Mutant]) -> Iterator[Verdict]:
        """Generate the verdicts in the order of the mutants."""
        with ThreadPoolExecutor(self.number) as pool:
            yield from pool.map(self._judge, mutants, mutants.values())

    def _judge(self, number: int, mutant: Mutant) -> Verdict:
        tree = self.free.get()
        start, result, test, output = monotonic(), MISSED, "", ""
        for tests in stages(mutant.path):
            run = self._run_stage(tree, mutant, tests)
            output += run.output
            if not run.passed:
                result = HUNG if run.status is None else DETECTED
                test = "" if run.status is None else [*run.failed, "the end of pytest"][0]
                break
        self.free.put(tree)
        return Verdict(number, mutant, result, test, round(monotonic() - start, 1), output)

    def _run_stage(self, tree: Tree, mutant: Mutant, tests: list[str]) -> Run:
        """Run test modules with the mutant until a test fails that fails again, and that passes with the original."""
        original = source_of(mutant.path)
        limit_s = max(LIMIT_MIN_S, 60 + 3 * sum(self.seconds[folder] for folder in {parent(test) for test in tests}))
        options = list(self.options)
        while True:
            with tree.changed(mutant.path, original, mutant.apply(original)):
                run = tree.pytest("-x", *tests, *options, limit_s=limit_s)
                if run.passed or not run.failed:
                    return run
                test = run.failed[0].partition("[")[0]  # with all parameters: pytest does not find every identifier
                again = tree.pytest("-x", test, *self.options, limit_s=limit_s)
            if not again.passed and tree.pytest("-x", test, *self.options, limit_s=limit_s).passed:
                return run
            print(f"fails now and then, does not count: {run.failed[0]}", file=sys.stderr, flush=True)
            options.append(f"--deselect={run.failed[0]}")


def parent(test: str) -> str:
    """Return the folder of a test module."""
    return test.rpartition("/")[0]


def table(verdicts: list[Verdict]) -> Iterator[str]:
    """Generate the lines of the table: mutants and detected mutants of each package."""
    total = Counter(package_of(verdict.mutant.path) for verdict in verdicts)
    missed = Counter(package_of(verdict.mutant.path) for verdict in verdicts if verdict.result == MISSED)
    yield f"{'package':<18} {'mutants':>8} {'detected':>9} {'share':>6}"
    rows = [(package, total[package], missed[package]) for package in sorted(total)]
    for package, number, gone in [*rows, ("total", total.total(), missed.total())]:
        yield f"{package:<18} {number:>8} {number - gone:>9} {100 * (number - gone) / number:>5.0f}%"


def arguments() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").partition(":")[0])
    parser.add_argument("--count", type=int, default=120, help="number of mutants (120)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the choice (1)")
    parser.add_argument("--only", default="imud", metavar="PATH", help="only modules below a path: imud/runtime")
    parser.add_argument("--jobs", type=int, default=2, help="number of copies of the tree that run in parallel (2)")
    parser.add_argument("--show", action="store_true", help="print the mutants as diffs and do not run them")
    parser.add_argument("--mutant", type=int, metavar="K", help="run mutant K only and print the output of its tests")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the verdicts to a file")
    parser.add_argument(
        "--deselect", action="append", default=[], metavar="TEST", help="leave out a test, as in pytest"
    )
    return parser.parse_args()


def main() -> int:
    """Choose the mutants, run the tests, and print the report. Returns 1 if a mutant is not detected."""
    options = arguments()
    mutants = dict(enumerate(choose(options.seed, options.count, options.only), 1))
    if options.mutant:
        mutants = {options.mutant: mutants[options.mutant]}
    if options.show:
        for number, mutant in mutants.items():
            print(f"{number}: {mutant.kind} in {mutant.unit}", *mutant.diff(), "", sep="\n")
        return 0
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
    verdicts = []
    with tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)  # some tests run programs as another user
        jobs = Jobs(Path(folder), options.jobs, [f"--deselect={test}" for test in options.deselect])
        jobs.check_folders({parent(test) for one in mutants.values() for tests in stages(one.path) for test in tests})
        for verdict in jobs.judge_all(mutants):
            verdicts.append(verdict)
            print(verdict, *[verdict.output] * bool(options.mutant), sep="\n", flush=True)
    print("", *table(verdicts), sep="\n")
    if options.json:
        options.json.write_text(
            json.dumps([asdict(verdict) | {"text": str(verdict)} for verdict in verdicts], indent=1)
        )
    return int(any(verdict.result == MISSED for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
