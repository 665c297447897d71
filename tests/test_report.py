"""Test `make report`: pages from results, new results, and hand-written pages without measurement tables."""

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest

from docs.generate.report import PAGES, SUBJECTS, Run, Subject, page, stored, update
from tests.support.results import ROOT, ProgramRun, Results, Table, decode, encode

RESULTS: Final = Results(
    "python -m tests.one", "2026-11-28 07:30", 12.0, "815965b0f9", "2 × x86_64", "CPython 3.11.7", "Linux 6.1", 8.14,
    [
        Table("", [{"link": "a|b", "rms, µs": [9.0, 9.4], "share": 0.9996}, {"link": "c", "rms, µs": [3.04, 5127.4]}]),
        Table("Counts", [{"samples": 24042, "time, s": 0.01234, "exact": True, "rest": None}]),
    ],
    ["p99 9 ms, expected at most 5 ms"], "active",
)  # fmt: skip
ONE: Final = Run("one", "One", "Text of one.", "tests.one", problems="limits")
LONG: Final = Run("long", "Long", "Text of long.", by_hand="python -m tests.long")
PAGE: Final = """# Title

About.

`make report` generates this page from the files in `docs/measurements/data`. Do not edit it.

| measurement | start, UTC | duration, s | commit | host | Python | kernel | C kernel | load at the start |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
| One | 2026-11-28 07:30 | 12 | `815965b0f9` | 2 × x86_64 | CPython 3.11.7 | Linux 6.1 | active | 8.14 |

## One

Text of one.

Command: `python -m tests.one`

| link | rms, µs | share |
| --- | --- | --- |
| a\\|b | 9–9.4 | 0.9996 |
| c | 3.04–5,127 |  |

### Counts

| samples | time, s | exact | rest |
| --- | --- | --- | --- |
| 24,042 | 0.0123 | yes |  |

Reported limits:

- p99 9 ms, expected at most 5 ms

## Long

Text of long.

Not measured. Run `python -m tests.long --json build/results/long.json`, then `make report`.
"""


def test_a_page_is_a_function_of_the_stored_results(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data/one.json").write_bytes(encode(RESULTS))
    subject = Subject("Title", "About.", (ONE, LONG))
    assert page(subject, stored(tmp_path)) == PAGE
    (tmp_path / "data/one.json").write_bytes(encode(msgspec.structs.replace(RESULTS, problems=[])))
    assert "\nReported limits: none.\n" in page(subject, stored(tmp_path))


def test_the_pages_of_the_tree_are_those_of_the_stored_results() -> None:
    found = stored(PAGES)
    for name, subject in SUBJECTS.items():
        text = (PAGES / f"{name}.md").read_text()
        assert text == page(subject, found), f"{name}.md: run `make report ARGS=--stored`"
    assert {path.stem for path in PAGES.glob("*.md")} == SUBJECTS.keys()
    assert found.keys() <= {run.name for subject in SUBJECTS.values() for run in subject.runs}


def test_new_results_replace_the_stored_ones_and_missing_ones_do_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new, data = tmp_path / "new", tmp_path / "data"
    new.mkdir()
    (new / "one.json").write_bytes(encode(RESULTS))
    assert update(ONE, new, data, measure=True)
    assert decode(data / "one.json") == RESULTS
    assert not (new / "one.json").exists()
    assert update(LONG, new, data, measure=True)
    assert "not measured: long, run python -m tests.long --json build/results/long.json" in capsys.readouterr().out
    (new / "one.json").write_text('{"command": 1}')
    assert not update(ONE, new, data, measure=True)
    assert "expected results of `--json`" in capsys.readouterr().out
    assert decode(data / "one.json") == RESULTS


def test_a_program_that_writes_no_results_is_not_measured(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert not update(ONE._replace(short="tests.no_such_program"), tmp_path, tmp_path, measure=True)
    assert "not measured: one, exit status 1 without results" in capfd.readouterr().out
    assert update(ONE._replace(short="tests.no_such_program"), tmp_path, tmp_path, measure=False)


def test_a_program_stores_its_command_without_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "orig_argv", ["/usr/bin/python3", "-m", "tests.one", "--json", "x.json", "--only", "a b"])
    ProgramRun().save(tmp_path / "new/one.json", RESULTS.tables, RESULTS.problems)
    found = decode(tmp_path / "new/one.json")
    assert found.command == "python -m tests.one --only 'a b'"
    assert found.tables[1] == RESULTS.tables[1]
    assert found.problems == RESULTS.problems


# --- hand-written pages -----------------------------------------------------------------------------------------------

UNIT: Final = r"(?: ?(?:µs|ms|s|kB|MB|GB|%|°))?"
FIGURE: Final = re.compile(rf"[<≤~]?-?[\d,]*\d\.\d+{UNIT}(?: (?:to|±) ?[\d.]+{UNIT})?")
"""A cell with a decimal number: a measured figure. Defaults and values are in backticks."""
FIGURES: Final = re.compile(r"CPU|lost samples|median|p99|99 %|σ|rms|, (?:µs|MB|cores)")
"""Words in the head of a table of measured figures."""


def is_measured(table: str) -> bool:
    head, _, *rows = table.splitlines()
    cells = [cell.strip() for row in rows for cell in row.strip("| ").split(" | ")]
    return bool(FIGURES.search(head)) or any(map(FIGURE.fullmatch, cells))


def test_hand_written_pages_have_no_table_of_measurements() -> None:
    wrong = []
    for file in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = re.sub(r"<!-- (\S+) -->\n.*?<!-- end of \1 -->", "", file.read_text(), flags=re.DOTALL)
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
            wrong += [f"{file.name}: {table.splitlines()[0]}"] * is_measured(table)
    assert not wrong, "the results of a measurement program belong to docs/measurements (docs/generate/report.py)"


def column(results: Results, table: int, name: str, **wanted: str) -> list[Any]:
    """Return the values of a column, for the rows that contain the wanted texts."""
    rows = results.tables[table].rows
    return [row[name] for row in rows if all(text in row[key] for key, text in wanted.items()) and name in row]


def latency_ratio(found: Mapping[str, Results]) -> float:
    held, default = (
        column(found["bench"], 0, "CPU per sample, µs", case=f"1 kHz, 10 binary clients, {case}")[0]
        for case in ("latency 10 ms", "default latency")
    )
    return float(held / default)


def largest_tilt(found: Mapping[str, Results]) -> float:
    names = ("at rest: roll and pitch, °", "after the rotation: roll and pitch, °")
    return max(float(value) for name in names for value in column(found["attitude"], 0, name, filter="vqf"))


def largest_filter_time(found: Mapping[str, Results]) -> float:
    return float(max(column(found["attitude"], 0, "CPU time, µs", filter="vqf")))


def error_of_whole_packets_ms(found: Mapping[str, Results]) -> float:
    ((low_us, high_us),) = column(found["clock"], 0, "rms, µs", arrival="usb-16ms-packet")[:1]
    return float(low_us + high_us) / 2e3


Quoted = Callable[[Mapping[str, Results]], float]
QUOTES: Final[Mapping[tuple[str, str, str], Quoted]] = {
    ("latency.md", "bench", r"needs about ([\d.]+) times the CPU time of latency 0"): latency_ratio,
    ("clock.md", "clock", r"constant error of about ([\d.]+) ms"): error_of_whole_packets_ms,
    ("attitude.md", "attitude", r"roll and pitch is about ([\d.]+)°"): largest_tilt,
    ("attitude.md", "attitude", r"needs about\s+([\d.]+) µs of CPU time"): largest_filter_time,
}
"""Figures in hand-written pages, the run with the same figures, and the stored value."""
QUOTE_FACTOR: Final = 2.0  # maximum ratio of both


@pytest.mark.parametrize(("name", "run", "pattern"), QUOTES)
def test_figures_in_hand_written_pages_agree_with_the_stored_results(name: str, run: str, pattern: str) -> None:
    (quoted,) = re.findall(pattern, (ROOT / "docs" / name).read_text())
    found = stored(PAGES)
    if run not in found:
        pytest.skip(f"not verified: docs/measurements/data has no results of {run}; run make report")
    measured = QUOTES[name, run, pattern](found)
    assert 1 / QUOTE_FACTOR <= float(quoted) / measured <= QUOTE_FACTOR, measured
