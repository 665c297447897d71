"""`make bench`: run all measurements, print one table, and write the same rows to build/bench.json.

`make bench ARGS="clock socket"` runs only these parts. `make bench ARGS=--short` runs all parts with fewer and shorter
rounds. The short form takes at most SHORT_LIMIT_S on an idle host. It omits the parts that may boot the lab's kernel.
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
SHORT_LIMIT_S: Final = 300.0  # goal on an idle host
LAB_PARTS: Final = ("can",)
"""Parts that may boot the lab's kernel. The short form runs them only if the command line names them."""
OUTPUT = Path("build/bench.json")


def measure(parts: Iterable[str], quick: bool) -> list[Row]:
    rows: list[Row] = []
    for part in parts:
        print(f"# {part}", flush=True)
        # the time includes the import of the part
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
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"one of {', '.join(PARTS)}")
    parser.add_argument(
        "--short", "--quick", action="store_true", help="use shorter runs; the figures are less precise"
    )
    args = parser.parse_args()
    begun_s = monotonic()
    parts = args.parts or parts_of(short=args.short)
    rows = measure(parts, args.short)
    took_s = monotonic() - begun_s
    OUTPUT.parent.mkdir(exist_ok=True)
    # compare.py reads this file and matches rows by name
    OUTPUT.write_bytes(msgspec.json.format(msgspec.json.encode([row._asdict() for row in rows])))
    missed = sum(row.reached is False for row in rows)
    print(f"# {len(rows)} figures in {OUTPUT}, {missed} goals not reached; {took_s:.0f} s")
    if args.short and took_s > SHORT_LIMIT_S:
        print(f"# expected at most {SHORT_LIMIT_S:.0f} s for the short form; is the host busy with other programs?")
    return 0


if __name__ == "__main__":
    sys.exit(main())
