"""The account of `make bench-instructions`; the counting itself takes a minute and is no part of `make test`."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.instructions import figures
from tests.bench.instructions.__main__ import ROOT, MeasurementError, per_operation, total
from tests.bench.instructions.figures import INTERPRETER, compare, is_same_build
from tests.bench.instructions.stages import STAGES


def test_a_stage_costs_what_the_second_half_costs_more_than_the_first() -> None:
    assert per_operation(100, [9_999_999, 2_050_000, 4_050_000]) == 20_000  # before, n, 2 n


def test_dumps_that_do_not_belong_to_a_stage_are_refused() -> None:
    with pytest.raises(MeasurementError, match="2 dumps of a stage, expected 3"):
        per_operation(1, [1, 2])
    with pytest.raises(MeasurementError, match="without totals"):
        total("fn=(1) main\n1 5\n")
    assert total("events: Ir\nfn=(1) main\n1 5\ntotals: 45010244\n") == 45_010_244


@pytest.mark.parametrize(("now", "good"), [(9_000, True), (10_500, True), (10_501, False)])
def test_five_percent_more_than_the_figure_are_too_many(now: int, good: bool) -> None:
    (line,) = compare({"slot": 10_000}, {"slot": now})
    assert line.is_good is good
    assert ("TOO MANY" in str(line)) is not good


def test_a_stage_without_a_figure_is_not_good() -> None:
    (line,) = compare({"slot": 10_000}, {"ring": 1})
    assert not line.is_good
    assert "NO FIGURE" in str(line)


def test_figures_of_another_build_do_not_count() -> None:
    kept = {INTERPRETER: 1000, "slot": 10_000}
    assert is_same_build(kept, {INTERPRETER: 1009})
    assert not is_same_build(kept, {INTERPRETER: 1011})
    assert not is_same_build(kept, {INTERPRETER: 989})
    assert not is_same_build(None, {INTERPRETER: 1000})
    assert not is_same_build({"slot": 10_000}, {INTERPRETER: 1000})


def test_figures_are_kept_beside_those_of_other_builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FILE", tmp_path / "figures.json")
    figures.FILE.write_text('{"A": {"slot": 1, "ring": 2}, "B": {"slot": 3}}')
    figures.keep("A", {"slot": 7})
    assert figures.load() == {"A": {"slot": 7, "ring": 2}, "B": {"slot": 3}}


def test_every_build_has_a_figure_for_every_stage_and_no_other() -> None:
    assert figures.load()
    for build, kept in figures.load().items():
        assert set(kept) == {stage.name for stage in STAGES}, build


def test_every_stage_runs(tmp_path: Path) -> None:
    """In a process of its own, whose clocks stand still."""
    program = [sys.executable, "-m", "tests.bench.instructions.measured", str(tmp_path)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=50, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert [line.split(" ", 2)[2] for line in done.stdout.splitlines()] == [stage.name for stage in STAGES]
