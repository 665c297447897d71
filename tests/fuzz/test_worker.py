"""The engines themselves: what fails is found, saved and reported; what holds is not."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz import __main__ as runner
from tests.fuzz import worker
from tests.fuzz.corpus import inputs_of
from tests.fuzz.target import Target
from tests.support.files import ROOT


def fails_on_a_bracket(data: bytes) -> None:
    assert b"[" not in data


@pytest.mark.parametrize(("run", "status"), [(fails_on_a_bracket, 1), (bytes, 0)])
def test_hypothesis_saves_what_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run: object, status: int
) -> None:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    (corpus / "seed").write_bytes(b"a[b")
    monkeypatch.setattr(worker, "load", lambda _name: Target(run, list))  # type: ignore[arg-type]
    assert worker.fuzz_with_hypothesis("any", 0.2, 1, tmp_path, [corpus / "seed"]) == status
    found = list(tmp_path.glob("crash-*"))
    assert [path.read_bytes() for path in found] == ([b"["] if status else [])
    assert "stat::number_of_executed_units: " in capsys.readouterr().out


def test_atheris_tries_the_same_again_with_the_same_seed(tmp_path: Path) -> None:
    """Which inputs were kept, and after how many; one of the runs comes further than the other."""
    pytest.importorskip("atheris")
    kept = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        (folder / "grown").mkdir(parents=True)
        inputs = map(str, inputs_of("utc/rmc"))
        options = ["-m", "tests.fuzz.worker", "atheris", "utc/rmc", "1", "7", str(folder), str(folder / "grown")]
        done = subprocess.run(
            [sys.executable, *options, *inputs], cwd=ROOT, capture_output=True, text=True, check=False,
            env=runner.environment(),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "stat::number_of_executed_units: " in done.stderr
        assert not list(folder.glob("crash-*"))
        kept.append(re.findall(r"^#(\d+)\t(NEW|REDUCE).* (corp: \S+)", done.stderr, re.MULTILINE))
    shared = min(map(len, kept))
    assert shared > 5
    assert kept[0][:shared] == kept[1][:shared]


@pytest.mark.parametrize(
    ("ci", "user", "apt"), [("true", 0, True), ("", 0, True), ("true", 1000, True), ("true", 0, False)]
)
def test_a_gate_that_could_install_clang_does_not_leave_the_header_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], ci: str, user: int, *, apt: bool
) -> None:
    monkeypatch.setenv("CI", ci)
    monkeypatch.setattr("os.geteuid", lambda: user)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/apt-get" if name == "apt-get" and apt else None)
    if ci and not user and apt:
        with pytest.raises(SystemExit, match="there is no clang"):
            runner.plan([], "hypothesis")
        return
    assert ("c-header", "clang") not in runner.plan([], "hypothesis")
    assert "c-header is left out: there is no clang" in capsys.readouterr().out


def test_a_result_shows_its_findings() -> None:
    good = runner.Result("utc/rmc", "atheris", 1000, 10.0, "82", "145", "22", (), failed=False)
    assert str(good).split() == ["utc/rmc", "atheris", "1000", "100", "82", "145", "22", "none"]
    bad = runner.Result("utc/rmc", "atheris", 1, 1.0, "-", "-", "-", (Path("build/fuzz/utc-rmc/crash-1"),), failed=True)
    assert str(bad).endswith("build/fuzz/utc-rmc/crash-1")


def test_words_of_a_dictionary_are_ascii() -> None:
    assert worker.escaped(b'aZ9_"\\\x00\x80\xff') == r"aZ9\x5F\x22\x5C\x00\x80\xFF"
