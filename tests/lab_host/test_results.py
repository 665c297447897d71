"""What a run leaves in the output folder."""

import os
from pathlib import Path

import pytest

from tests.lab.host import results
from tests.lab.host.errors import LabError


def write_all(folder: Path) -> None:
    """The files of a run."""
    for name in ("junit.xml", "console.log"):
        (folder / name).write_text(f"new {name}", encoding="utf-8")
    (folder / "qemu.log").touch()


def test_success_leaves_the_report_only(tmp_path: Path) -> None:
    (tmp_path / "console.log").write_text("old", encoding="utf-8")
    with results.run_folder(tmp_path) as folder:
        write_all(folder)
        assert results.keep(folder, tmp_path, failed=False) == []
    assert sorted(os.listdir(tmp_path)) == ["junit.xml"]
    assert (tmp_path / "junit.xml").read_text(encoding="utf-8") == "new junit.xml"


def test_failure_keeps_the_logs_that_say_something(tmp_path: Path) -> None:
    with results.run_folder(tmp_path) as folder:
        write_all(folder)
        assert results.keep(folder, tmp_path, failed=True) == [tmp_path / "console.log"]
    assert sorted(os.listdir(tmp_path)) == ["console.log", "junit.xml"]


def test_guest_that_died_leaves_no_old_report(tmp_path: Path) -> None:
    (tmp_path / "junit.xml").write_text("of an earlier run", encoding="utf-8")
    with results.run_folder(tmp_path) as folder:
        results.keep(folder, tmp_path, failed=True)
    assert os.listdir(tmp_path) == []


def test_runs_at_once_have_their_own_folders(tmp_path: Path) -> None:
    with results.run_folder(tmp_path) as first, results.run_folder(tmp_path) as second:
        assert first != second


def test_leftovers_of_killed_runs_go(tmp_path: Path) -> None:
    old = tmp_path / "run-old"
    old.mkdir()
    os.utime(old, (0, 0))
    with results.run_folder(tmp_path):
        assert not old.exists()


def test_output_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(LabError, match=r"output folder .*: Not a directory"),
        results.run_folder(tmp_path / "file" / "lab"),
    ):
        pass
