"""`imud info`: begin, size, devices, rates, losses and integrity of a recording."""

import json
from pathlib import Path

import pytest

from imud.cli import main
from tests.cli.recording.recorded_daemon import run_recorded


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    _, _, (made,) = run_recorded(tmp_path_factory.mktemp("info"))
    return made


def test_a_whole_file(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(file)]) == 0
    page = capsys.readouterr().out
    assert "integrity  whole" in page
    assert "dropped    nothing" in page
    assert "bow: " in page
    assert "driver imu61x-can" in page
    assert "bytes per sample" in page
    assert all(len(line) <= 80 for line in page.splitlines())


def test_numbers_for_programs(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json", str(file)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [device["name"] for device in told["devices"]] == ["bow", "mast"]
    bow, mast = told["devices"]
    assert (bow["samples"], bow["reads"], bow["lost"]) == (300, 300, 0)
    assert bow["input_bytes"] == 300 * (82 + 17)
    assert mast["samples"] > 190
    assert told["stored_bytes"] == file.stat().st_size
    assert told["problems"] == []
    assert told["file_number"] == 0


def test_a_damaged_file_is_an_answer_of_no_and_a_cut_one_is_not(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(file.read_bytes())
    (tmp_path / "cut").write_bytes(data[:-3])
    assert main(["info", str(tmp_path / "cut")]) == 0
    assert "no regular end" in " ".join(capsys.readouterr().out.split())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged").write_bytes(data + file.read_bytes())
    assert main(["info", str(tmp_path / "damaged")]) == 1
    assert "are damaged" in capsys.readouterr().out


def test_what_is_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("t_ns,accel\n" * 50)
    assert main(["info", str(tmp_path / "a.csv")]) == 2
    assert "no recording of imud" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "none")]) == 2
    assert "No such file" in capsys.readouterr().err
