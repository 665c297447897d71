"""`make bench-instructions`: instructions per sample and stage, counted by callgrind, next to the stored figures.

The count does not depend on other load on the host: two runs agree within 0.5 %. It contains the instructions of the
process, not of the kernel, and it does not include the effect of caches. The program fails if a stage takes 5 % more
instructions than its figure in `figures.json`. A commit that lowers a figure updates the file with ARGS=--update.
Arguments select stages: ARGS="clock slot".

The figures are valid for one build of Python on one architecture. With another build, the program prints
the counts without a comparison.
"""

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from tests.bench.instructions.measured import INTERPRETER, MARK, MARKS
from tests.support.results import ProgramRun, Table, add_json

FILE: Final = Path(__file__).with_name("figures.json")
GROWTH_MOST: Final = 0.05  # Maximum growth of a stage, as a share. Two runs of the same code agree within 0.5 %.
LESS_NOTED: Final = 0.005  # report a decrease above this share
BUILD_MOST: Final = 0.01
"""Maximum difference of the stage `interpreter`, as a share. A larger difference means another build of Python."""

Figures = dict[str, int]


class Line(NamedTuple):
    stage: str
    now: int
    kept: int | None

    @property
    def growth(self) -> float:
        """Return the growth since the stored figure, as a share."""
        return self.now / self.kept - 1 if self.kept else 0.0

    @property
    def is_good(self) -> bool:
        return self.kept is not None and self.now <= self.kept * (1 + GROWTH_MOST)

    def __str__(self) -> str:
        if self.kept is None:
            return f"{self.stage:58} {self.now:8}  NO FIGURE"
        mark = "" if self.is_good else "  TOO MANY"
        return f"{self.stage:58} {self.now:8} {self.kept:8} {self.growth:+8.1%}{mark}"


def python_build() -> str:
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return f"{python}, {platform.python_compiler()}, {platform.machine()}"


def load() -> dict[str, Figures]:
    return msgspec.json.decode(FILE.read_bytes(), type=dict[str, Figures])


def keep(build: str, measured: Mapping[str, int]) -> None:
    """Store the figures of one build. Keep the figures of stages that were not measured."""
    kept = load()
    kept[build] = {**kept.get(build, {}), **measured}
    FILE.write_bytes(msgspec.json.format(msgspec.json.encode(kept), indent=1) + b"\n")


def is_same_build(kept: Figures | None, measured: Mapping[str, int]) -> bool:
    """Return whether the figures are from this build of Python: the same loop takes the same number of instructions."""
    if kept is None or INTERPRETER not in kept:
        return False
    return abs(measured[INTERPRETER] / kept[INTERPRETER] - 1) <= BUILD_MOST


def compare(kept: Figures, measured: Mapping[str, int]) -> list[Line]:
    return [Line(stage, now, kept.get(stage)) for stage, now in measured.items()]


LIMIT_S: Final = 900.0  # whole run under valgrind
ROOT: Final = Path(__file__).parents[3]
PASSED_ON: Final = ("PATH", "PYTHONPATH", "TMPDIR", "IMUD_KERNEL")
"""Environment variables for the measured program. imud removes all others, because their size moves the stack."""


class MeasurementError(Exception):
    """The measured program failed, or callgrind wrote an unexpected set of dumps."""


def total(dump: str) -> int:
    found = re.search(r"^totals: (\d+)$", dump, re.MULTILINE)
    if found is None:
        raise MeasurementError("expected totals in the dump of callgrind, got none; was callgrind interrupted?")
    return int(found[1])


def per_operation(count: int, totals: Sequence[int]) -> int:
    """Return the instructions per operation from the totals of the dumps before, after n, and after 2 n operations."""
    if len(totals) != MARKS:
        raise MeasurementError(f"expected {MARKS} dumps of a stage, got {len(totals)}")
    _, once, twice = totals
    return round((twice - once) / count)


def measure(words: Sequence[str]) -> dict[str, int]:
    environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
    # a fixed hash seed, because the order of sets changes the number of instructions
    environment |= {"PYTHONHASHSEED": "0", "LC_ALL": "C.UTF-8"}
    with ExitStack() as stack:
        dumps, files = (
            Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-", dir=place)))
            for place in (None, "/dev/shm")
        )
        valgrind = ["valgrind", "--quiet", "--tool=callgrind", f"--dump-before={MARK}"]
        valgrind += [f"--callgrind-out-file={dumps}/%p"]
        python = [sys.executable, "-m", "tests.bench.instructions.measured", str(files), *words]
        done = subprocess.run(
            [*valgrind, *python], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT_S,
            check=False,
        )  # fmt: skip
        if done.returncode:
            raise MeasurementError(done.stderr)
        found = {}
        for line in done.stdout.splitlines():
            pid, count, name = line.split(" ", 2)
            parts = sorted(dumps.glob(f"{pid}.*"), key=lambda path: int(path.suffix[1:]))
            found[name] = per_operation(int(count), [total(part.read_text()) for part in parts])
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="make bench-instructions")
    parser.add_argument("words", nargs="*", metavar="WORD", help="count only stages with WORD in their names")
    parser.add_argument("--update", action="store_true", help="store the counts as the figures of this Python")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if shutil.which("valgrind") is None:
        print("cannot find valgrind; try `make bench-deps` as root", file=sys.stderr)
        return 2
    try:
        measured = measure([*args.words, INTERPRETER] if args.words else [])
    except MeasurementError as error:
        print(f"cannot count instructions: {error}", file=sys.stderr)
        return 1
    rows = [{"stage": stage, "instructions": count} for stage, count in measured.items()]
    program_run.save(args.json, [Table("", rows)])
    build = python_build()
    kept = load().get(build)
    known = kept is not None and is_same_build(kept, measured)
    print(f"# instructions per sample or frame; {build}")
    lines = compare(kept if known and kept else {}, measured)
    for line in lines:
        print(line if known else f"{line.stage:58} {line.now:8}")
    if args.update:
        keep(build, measured)
        print(f"# stored in {FILE.relative_to(ROOT)}")
        return 0
    if not known:
        print("# no comparison: figures.json has no figures for this build of Python; try ARGS=--update")
        return 0
    bad = [line.stage for line in lines if not line.is_good]
    if any(line.growth < -LESS_NOTED for line in lines):
        print('# some counts are lower than the stored figures; store them with ARGS="--update"')
    if bad:
        print(f"# {len(bad)} stages take more than {GROWTH_MOST:.0%} above their figure or have no figure")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
