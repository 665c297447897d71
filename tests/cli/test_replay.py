"""`imud replay`: a capture through the whole path, to its end."""

import json
from pathlib import Path

import pytest

from imud.cli import main
from tests.hi91 import hi91


def capture(file: Path, count: int) -> Path:
    file.write_bytes(b"".join(hi91(10 * i) for i in range(count)))
    return file


def test_every_sample_is_printed_and_the_account_is_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = capture(tmp_path / "c.raw", 50)
    assert main(["replay", "--json", "--baud", "115200", str(file)]) == 0
    printed = capsys.readouterr()
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 51))
    assert [s["t_dev_ns"] for s in samples] == [10_000_000 * i for i in range(50)]
    times = [s["t_ns"] for s in samples]
    assert times == sorted(set(times))
    assert "samples   50; lost 0" in printed.err
    assert "closed" in printed.err


def test_capture_without_samples_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "noise").write_bytes(b"\x00" * 500)
    assert main(["replay", str(tmp_path / "noise")]) == 1
    assert "samples   0" in capsys.readouterr().err


def test_missing_capture_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
