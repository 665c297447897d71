"""`make bench-compare BASE=COMMIT`: run parts of `make bench` in two checkouts and print the ratio of each figure.

    make bench-compare BASE=v0.1.0 ARGS="clock_table latency --rounds 5"

Both checkouts use this Python and the same dependencies. The checkout of BASE is temporary. The rounds alternate, so
that other load on the host affects both checkouts equally. The table compares the medians of the rounds.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

import msgspec

from tests.bench.__main__ import OUTPUT, PARTS

ROOT: Final = Path(__file__).parents[2]
ROUNDS: Final = 3
LIMIT_S: Final = 3600.0  # one part in one checkout


class _Named(msgspec.Struct):
    name: str
    value: float


Figures = Mapping[str, float]


class Compared(NamedTuple):
    name: str
    base: float
    here: float

    def __str__(self) -> str:
        ratio = f"{self.here / self.base:8.3f}" if self.base else "       –"
        return f"{self.name:64} {self.base:12.3f} {self.here:12.3f} {ratio}"


def compare(base: Sequence[Figures], here: Sequence[Figures]) -> list[Compared]:
    # compare only the rows that all rounds of both checkouts contain
    names = [name for name in here[0] if all(name in figures for figures in (*base, *here))]
    return [Compared(name, median(f[name] for f in base), median(f[name] for f in here)) for name in names]


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check out a commit in a temporary directory. Raises CalledProcessError if git does not know the commit."""
    with tempfile.TemporaryDirectory(prefix="imud-compare-") as directory:
        tree = Path(directory) / "base"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], cwd=ROOT, check=True)
        try:
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)


def measure(tree: Path, parts: Sequence[str]) -> Figures:
    program = [sys.executable, "-m", "tests.bench", *parts, "--quick"]
    subprocess.run(program, cwd=tree, stdout=subprocess.DEVNULL, timeout=LIMIT_S, check=True)
    rows = msgspec.json.decode((tree / OUTPUT).read_bytes(), type=list[_Named])
    return {row.name: row.value for row in rows}


def main() -> int:
    parser = argparse.ArgumentParser(prog="make bench-compare")
    parser.add_argument("parts", nargs="+", metavar="PART", help=f"one of {', '.join(PARTS)}")
    parser.add_argument("--base", required=True, metavar="COMMIT")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    args = parser.parse_args()
    measured: dict[Path, list[Figures]] = {}
    with checked_out(args.base) as base:
        for number in range(args.rounds):
            # alternate the order, so that a drift of the load does not favor a checkout
            for tree in (base, ROOT) if number % 2 else (ROOT, base):
                print(f"# round {number + 1}: {'here' if tree == ROOT else args.base}", flush=True)
                measured.setdefault(tree, []).append(measure(tree, args.parts))
        print(f"{'':64} {args.base[:12]:>12} {'here':>12}    ratio")
        for line in compare(measured[base], measured[ROOT]):
            print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
