"""Results of a measurement program: conditions and tables as JSON (`--json FILE`), which `make report` reads."""

import argparse
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.formats import kernel

ROOT: Final = Path(__file__).parents[2]
UNKNOWN: Final = "unknown"

Row = Mapping[str, Any]
"""Values by column; the name of a column contains the unit. A list of two numbers is a range."""


class Table(msgspec.Struct, frozen=True):
    title: str
    rows: Sequence[Row]


class Results(msgspec.Struct, frozen=True):
    """Tables of one run of a program, and the conditions of the run."""

    command: str
    begun: str  # date and time, UTC
    seconds: float
    commit: str
    host: str
    python: str
    kernel: str
    load: float  # load average of one minute at the start
    tables: list[Table]
    problems: list[str] = []  # exceeded limits, goals that were not reached, findings
    c_kernel: str = UNKNOWN  # use of the C kernel by imud: active, or the reason why not


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for `make report`")


def commit() -> str:
    """Return the commit of the checkout, with a note if imud or the programs differ from the commit."""
    try:
        words = [_git("rev-parse", "--short=10", "HEAD")]
        words += ["with changes"] * bool(_git("status", "--porcelain", "--", "imud", "include", "tests"))
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN
    return " ".join(words)


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def command() -> str:
    """Return the command line of this program without `--json FILE`."""
    words = sys.orig_argv[1:]
    if "--json" in words:
        at = words.index("--json")
        words = words[:at] + words[at + 2 :]
    return shlex.join(["python", *words])


class ProgramRun:
    """A run of a program, from the start of its measurements."""

    def __init__(self) -> None:
        self._begun, self._load = datetime.now(UTC), os.getloadavg()[0]
        self._c_kernel = f"not active: {kernel.present.problem}" if kernel.present.problem else "active"
        if kernel.present.problem:
            print(f"C kernel {self._c_kernel}", file=sys.stderr)

    def save(self, file: Path | None, tables: Iterable[Table], problems: Sequence[str] = ()) -> None:
        """Write the results to a file; do nothing without a file."""
        if file is None:
            return
        results = Results(
            command(), f"{self._begun:%Y-%m-%d %H:%M}", round((datetime.now(UTC) - self._begun).total_seconds()),
            commit(), f"{os.cpu_count()} × {platform.machine()}",
            f"{platform.python_implementation()} {platform.python_version()}",
            f"{platform.system()} {platform.release()}", round(self._load, 1), list(tables), list(problems),
            self._c_kernel,
        )  # fmt: skip
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(encode(results))


def encode(results: Results) -> bytes:
    """Return the results as JSON, one line for each row."""
    text = msgspec.json.format(msgspec.json.encode(results), indent=1).decode()
    return f"{text}\n".encode()


def decode(file: Path) -> Results:
    """Raises ValidationError if the file contains no results."""
    return msgspec.json.decode(file.read_bytes(), type=Results)


def rows_of(items: Iterable[Any]) -> list[Row]:
    """Return structs as rows: their field names (`msgspec.field(name=…)`) are the columns."""
    return [msgspec.to_builtins(item) for item in items]


def shown(value: Any) -> str:
    """Return a value for a cell: whole numbers exactly, other numbers with three digits, a range as `low–high`."""
    if isinstance(value, list | tuple):
        low, high = map(shown, value)
        return low if low == high else f"{low}–{high}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if abs(value) >= 100:
            return f"{value:,.0f}"
        return f"{value:.{4 if 0.9 < value < 1 else 3}g}"  # a share of 0.9996 is not 1
    return "" if value is None else " ".join(str(value).replace("|", "\\|").split())


def markdown(rows: Sequence[Row]) -> str:
    """Return a table; a row without a column has an empty cell."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = [columns, ["---"] * len(columns), *([shown(row.get(column)) for column in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def printed(row: Row) -> str:
    """Return a row as a line of a program's output."""
    return " | ".join(f"{column} {shown(value)}" if column else shown(value) for column, value in row.items())
