"""`make bench`: run all measurements, print one table, and write the same rows to build/bench.json.

`make bench ARGS="latency gpsd"` runs only these parts.
`make bench ARGS=--short` runs all parts with fewer and shorter rounds. It takes at most SHORT_LIMIT_S on an idle host.
"""

import argparse
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Final

import msgspec

from tests.bench.rows import Row, table
from tests.support.results import ProgramRun, add_json

PARTS = ("clock_table", "latency", "devices", "gpsd")
SHORT_LIMIT_S: Final = 300.0  # goal on an idle host
OUTPUT = Path("build/bench.json")


def measure(parts: Iterable[str], quick: bool) -> dict[str, list[Row]]:
    """Return the rows of each part."""
    found: dict[str, list[Row]] = {}
    for part in parts:
        print(f"# {part}", flush=True)
        # the time includes the import of the part
        begun_s = monotonic()
        for row in import_module(f"tests.bench.{part}").rows(quick=quick):
            print(row, flush=True)
            found.setdefault(part, []).append(row)
        print(f"# {part} took {monotonic() - begun_s:.0f} s", flush=True)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="make bench")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"one of {', '.join(PARTS)}")
    parser.add_argument(
        "--short", "--quick", action="store_true", help="use shorter runs; the figures are less precise"
    )
    add_json(parser)
    args = parser.parse_args()
    begun_s, program_run = monotonic(), ProgramRun()
    found = measure(args.parts or PARTS, args.short)
    rows = [row for part in found.values() for row in part]
    took_s = monotonic() - begun_s
    missed = [f"{row.name}: {row.value:.3g} {row.unit}, goal {row.reach}" for row in rows if row.reached is False]
    program_run.save(args.json, (table(part, one) for part, one in found.items()), missed)
    OUTPUT.parent.mkdir(exist_ok=True)
    # compare.py reads this file and matches rows by name
    OUTPUT.write_bytes(msgspec.json.format(msgspec.json.encode([row._asdict() for row in rows])))
    print(f"# {len(rows)} figures in {OUTPUT}, {len(missed)} goals not reached; {took_s:.0f} s")
    if args.short and took_s > SHORT_LIMIT_S:
        print(f"# expected at most {SHORT_LIMIT_S:.0f} s for the short form; is the host busy with other programs?")
    return 0


if __name__ == "__main__":
    sys.exit(main())
