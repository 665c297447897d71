"""Prints which small changes of imud the tests detect: `make mutants ARGS="--seed 7"`.

Each job has its own copy of the tree. It changes one file of the copy and runs pytest until a test fails: first the
tests of the module, then of its folder, then of the folders above, then the tests in other folders that import the
module. A failure counts if it happens twice with the change and does not happen without the change.
An undetected mutant is a gap of the tests, or it is equivalent to the original: the reader decides.
"""

import argparse
import resource
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Final

from tests.mutants.changes import Mutant, choose, source_of
from tests.mutants.trees import USERS, Run, Tree, stages
from tests.support.results import ProgramRun, Table, add_json

DETECTED, BY_USERS, MISSED, HUNG = "detected", "detected in another folder", "NOT DETECTED", "time-out"
MEMORY_MAX_BYTES: Final = 6 << 30
"""Maximum data of one process: a mutant can append to a list without end."""


def judge(trees: SimpleQueue[Tree], mutant: Mutant) -> tuple[str, str, str]:
    """Run the tests of a mutant until one fails. Returns the result, the failed test, and the output of pytest."""
    tree, output = trees.get(), ""
    try:
        for tests in stages(mutant.path):
            run = run_stage(tree, mutant, tests)
            output += run.output
            if run.status is None:
                return HUNG, "", output
            if not run.passed:
                result = BY_USERS if tests[0] == USERS[0] else DETECTED
                return result, [*run.failed, "the end of pytest"][0], output
        return MISSED, "", output
    finally:
        trees.put(tree)


def run_stage(tree: Tree, mutant: Mutant, tests: list[str]) -> Run:
    """Run test modules with the mutant until a test fails that fails again, and that passes with the original."""
    original, options = source_of(mutant.path), list[str]()
    while True:
        with tree.changed(mutant.path, original, mutant.apply(original)):
            run = tree.pytest(*tests, *options)
            if run.passed or run.status is None:
                return run
            # The failed test with all parameters: pytest does not find every identifier. If no test failed, a signal
            # ended pytest: the mutant crashed pytest, or another program killed pytest.
            again = [name.partition("[")[0] for name in run.failed[:1]] or tests
            is_twice = not tree.pytest(*again).passed
        if is_twice and tree.pytest(*again).passed:
            return run
        print(f"fails now and then, does not count: {' '.join(run.failed or tests)}", file=sys.stderr, flush=True)
        options += [f"--deselect={name}" for name in run.failed]


def main() -> int:
    """Choose the mutants, run the tests, and print the report. Returns 1 if a mutant is not detected."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").partition(":")[0])
    parser.add_argument("--count", type=int, default=120, help="number of mutants (120)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the choice (1)")
    parser.add_argument("--only", default="imud", metavar="PATH", help="only modules below a path: imud/device")
    parser.add_argument("--jobs", type=int, default=2, help="number of copies of the tree that run in parallel (2)")
    parser.add_argument("--show", action="store_true", help="print the mutants as diffs and do not run them")
    parser.add_argument("--mutant", type=int, metavar="K", help="run mutant K only and print the output of its tests")
    add_json(parser)
    options, program_run = parser.parse_args(), ProgramRun()
    mutants = dict(enumerate(choose(options.seed, options.count, options.only), 1))
    if options.mutant:
        mutants = {options.mutant: mutants[options.mutant]}
    if options.show:
        for number, mutant in mutants.items():
            print(f"{number}: {mutant.kind} in {mutant.unit}", *mutant.diff(), "", sep="\n")
        return 0
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
    trees: SimpleQueue[Tree] = SimpleQueue()
    missed, elsewhere = list[str](), 0
    with tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)  # some tests run programs as another user
        for job in range(options.jobs):
            trees.put(Tree(Path(folder, str(job))))
        with ThreadPoolExecutor(options.jobs) as pool:
            verdicts = pool.map(partial(judge, trees), mutants.values())
            for number, (result, test, output) in zip(mutants, verdicts, strict=True):
                missed += [f"not detected: {mutants[number]}"] * (result == MISSED)
                elsewhere += result == BY_USERS
                print(f"{number:3}  {mutants[number]}  |  {result}{' by ' if test else ''}{test}", flush=True)
                if options.mutant:
                    print(output)
    found = len(mutants) - len(missed)
    row = {"mutants": len(mutants), "detected": found, "of these in another folder": elsewhere}
    program_run.save(options.json, [Table("", [row])], missed)
    print(f"\n{found} of {len(mutants)} mutants detected, {found / len(mutants):.1%}; {elsewhere} in another folder")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
