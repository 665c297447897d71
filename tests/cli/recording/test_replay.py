"""`imud replay` of a recording: what the daemon published, line by line, from the file that it wrote meanwhile."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from imud.cli import main
from tests.cli.recording.recorded_daemon import FRAMES, run_recorded


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], dict[str, dict[str, int]]]:
    """The file, the samples as JSON lines, and the ledgers."""
    daemon, collector, (file,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    lines = [msgspec.json.encode(sample).decode() for sample in collector.samples]
    return file, lines, {status.name: status.ledger for status in daemon.status()}


Recorded = tuple[Path, list[str], dict[str, dict[str, int]]]


def test_the_samples_are_those_that_the_daemon_published(
    recorded: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    file, lines, ledgers = recorded
    assert main(["replay", "--json", str(file)]) == 0
    printed = capsys.readouterr()
    assert len(lines) > FRAMES
    assert printed.out.splitlines() == lines
    for name, ledger in ledgers.items():
        assert f"{name}: replayed" in printed.err
        assert f"samples   {ledger['samples']}; lost 0" in printed.err
        assert f"bytes     {ledger['bytes_in']}: closed" in printed.err
    assert printed.err.count("the same as the live run") == 2
    assert "the file" not in printed.err


def test_options_of_captures_are_refused(recorded: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--driver", "hipnuc-uart"], ["--baud", "9600"], ["--speed", "real"], ["--option", "a=1"]):
        assert main(["replay", *words, str(recorded[0])]) == 2
        assert f"{words[0]}: expected none with a recording" in capsys.readouterr().err


def test_a_fresh_clock_gives_other_numbers_and_says_why(recorded: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    main(["replay", "--json", "--fresh", str(recorded[0])])
    printed = capsys.readouterr()
    found = [json.loads(line) for line in printed.out.splitlines()]
    assert len(found) == len(recorded[1])
    assert printed.err.count("it was asked for a fresh clock") == 2


def test_a_file_that_was_cut_is_replayed_as_far_as_it_goes(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, lines, _ = recorded
    cut = tmp_path / "cut.imudrec"
    cut.write_bytes(file.read_bytes()[:-7])
    main(["replay", "--json", str(cut)])
    printed = capsys.readouterr()
    assert printed.out.splitlines() == lines[: len(printed.out.splitlines())]
    assert "no regular end" in printed.err
    assert "cut short" in printed.err


def test_a_damaged_file_is_an_answer_of_no(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(recorded[0].read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.imudrec").write_bytes(data)
    assert main(["replay", str(tmp_path / "damaged.imudrec")]) in (1, 2)
    assert "damaged" in capsys.readouterr().err


def test_a_recording_whose_first_bytes_are_damaged_is_no_capture(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "damaged.imudrec"
    file.write_bytes(bytes(8) + recorded[0].read_bytes()[8:])
    for command in (["replay"], ["export", "--to", "csv"]):
        assert main([*command, str(file)]) == 1
        printed = capsys.readouterr().err
        assert "bytes from byte 0 on are damaged" in printed
        assert "the capture" not in printed


def test_a_reader_that_goes_away_ends_it(recorded: Recorded) -> None:
    argv = [sys.executable, "-m", "imud", "replay", "--json", str(recorded[0])]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(argv, stdout=write, stderr=subprocess.PIPE, text=True, check=False, timeout=30)
    os.close(write)
    assert done.returncode == 0, done.stderr


def test_a_file_that_only_begins_as_a_recording_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").write_bytes(b"\x89imudREC" + bytes(100))
    assert main(["replay", str(tmp_path / "a")]) == 2
    assert "no whole block" in capsys.readouterr().err


def test_a_raw_capture_says_what_it_cannot_know(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.support.files import hi91

    (tmp_path / "c.raw").write_bytes(b"".join(hi91(10 * i) for i in range(300)))
    assert main(["replay", str(tmp_path / "c.raw")]) == 0
    printed = " ".join(capsys.readouterr().err.split())
    assert "times not known: the capture has bytes and no time of any read" in printed
    assert "ppm" not in printed
    assert "Hz" not in printed
    assert "samples 300; lost 0" in printed


def test_the_same_file_under_another_name_is_known(recorded: Recorded, tmp_path: Path) -> None:
    shutil.copy(recorded[0], tmp_path / "field.bin")
    assert main(["replay", str(tmp_path / "field.bin")]) == 0
