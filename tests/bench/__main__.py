"""`make bench`: every measurement in one run, side by side, and in build/bench.json.

`make bench ARGS="clock socket"` runs some parts. `make bench ARGS=--short` runs all of them with fewer and shorter
rounds, in SHORT_LIMIT_S at most on a machine that does nothing else; what may boot the lab's kernel is left out there.
"""

import argparse
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Final

import msgspec

from tests.bench.rows import Row

PARTS = (
    "clock", "clock_table", "clock_lines", "lines", "polling", "modbus", "can", "can_devices", "detect",
    "shm", "socket", "metrics", "end_to_end", "latency", "clock_hold", "gpsd", "sout", "recording", "mqtt", "web",
    "start",
)  # fmt: skip
SHORT_LIMIT_S: Final = 300.0
LAB_PARTS: Final = ("can",)
"""Parts that may boot the lab's kernel; the short form runs them only where they are named."""
OUTPUT = Path("build/bench.json")


def measure(parts: Iterable[str], quick: bool) -> list[Row]:
    rows: list[Row] = []
    for part in parts:
        print(f"# {part}", flush=True)
        begun_s = monotonic()
        for row in import_module(f"tests.bench.{part}").rows(quick=quick):
            print(row, flush=True)
            rows.append(row)
        print(f"# {part} took {monotonic() - begun_s:.0f} s", flush=True)
    return rows


def parts_of(*, short: bool) -> tuple[str, ...]:
    return tuple(part for part in PARTS if not (short and part in LAB_PARTS))


def main() -> int:
    parser = argparse.ArgumentParser(prog="make bench")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--short", "--quick", action="store_true", help="shorter runs, rougher figures")
    args = parser.parse_args()
    begun_s = monotonic()
    parts = args.parts or parts_of(short=args.short)
    rows = measure(parts, args.short)
    took_s = monotonic() - begun_s
    OUTPUT.parent.mkdir(exist_ok=True)
    OUTPUT.write_bytes(msgspec.json.format(msgspec.json.encode([row._asdict() for row in rows])))
    missed = sum(row.reached is False for row in rows)
    print(f"# {len(rows)} figures in {OUTPUT}, {missed} short of what was aimed at; {took_s:.0f} s")
    if args.short and took_s > SHORT_LIMIT_S:
        print(f"# the short form is to take {SHORT_LIMIT_S:.0f} s at most: does the machine do something else?")
    return 0


if __name__ == "__main__":
    sys.exit(main())
