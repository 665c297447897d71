"""`make bench`: every measurement in one run, side by side, and in build/bench.json.

`make bench ARGS="decode clock"` runs a part; `--quick` shortens the end-to-end runs.
"""

import argparse
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

import msgspec

from tests.bench.rows import Row

PARTS = (
    "decode", "clock", "clock_lines", "lines", "polling", "modbus", "can", "can_devices", "detect", "coalesce", "shm",
    "socket", "metrics", "end_to_end", "sout",
)  # fmt: skip
OUTPUT = Path("build/bench.json")


def show(row: Row) -> str:
    """One line of the printed table."""
    mark = {True: "reached", False: "NOT REACHED", None: ""}[row.reached]
    return f"{row.name:64} {row.value:12.3f} {row.unit:12} {row.reach:10} {mark}".rstrip()


def measure(parts: Iterable[str], quick: bool) -> list[Row]:
    """Run the parts in order, printing each row as it is known."""
    rows: list[Row] = []
    for part in parts:
        print(f"# {part}", flush=True)
        for row in import_module(f"tests.bench.{part}").rows(quick=quick):
            print(show(row), flush=True)
            rows.append(row)
    return rows


def main() -> int:
    """Run as `python -m tests.bench`."""
    parser = argparse.ArgumentParser(prog="make bench")
    parser.add_argument("parts", nargs="*", default=PARTS, metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--quick", action="store_true", help="shorter runs, rougher figures")
    args = parser.parse_args()
    rows = measure(args.parts, args.quick)
    OUTPUT.parent.mkdir(exist_ok=True)
    OUTPUT.write_bytes(msgspec.json.format(msgspec.json.encode([row._asdict() for row in rows])))
    missed = sum(row.reached is False for row in rows)
    print(f"# {len(rows)} figures in {OUTPUT}, {missed} short of what was aimed at")
    return 0


if __name__ == "__main__":
    sys.exit(main())
