"""`imud replay` of a recording is equal to the published samples, line by line."""

from io import BytesIO
from pathlib import Path

import msgspec
import pytest

from imud.cli.replay import play_to_end
from imud.recording.player import Player
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import FRAMES, run_recorded
from tests.support.files import hi91


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], dict[str, dict[str, int]]]:
    daemon, collector, (file,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    lines = [msgspec.json.encode(sample).decode() for sample in collector.samples]
    return file, lines, {status.name: status.ledger for status in daemon.status()}


Recorded = tuple[Path, list[str], dict[str, dict[str, int]]]


def test_the_samples_are_those_that_the_daemon_published(recorded: Recorded, cli: Cli) -> None:
    file, lines, ledgers = recorded
    printed = cli("replay", "--json", file)
    assert len(lines) > FRAMES
    assert printed.out.splitlines() == lines
    for name, ledger in ledgers.items():
        assert f"{name}: replayed" in printed.err
        assert f"samples   {ledger['samples']}; lost 0" in printed.err
        assert f"bytes     {ledger['bytes_in']}: balanced" in printed.err
    assert printed.err.count("equal to the live run") == 2
    assert "the file" not in printed.err


def test_records_that_were_dropped_are_an_answer_of_no(recorded: Recorded) -> None:
    for lost, status in ((0, 0), (3, 1)):
        player = Player(lambda _batch: None)
        player.lost = lost
        with recorded[0].open("rb") as file:
            report, got = play_to_end(file, "a", player)
        assert (got, "the recorder dropped 3 records" in report) == (status, lost == 3)


def test_options_of_captures_are_refused(recorded: Recorded, cli: Cli) -> None:
    for words in (["--driver", "hipnuc-uart"], ["--baud", "9600"], ["--speed", "real"], ["--option", "a=1"]):
        cli.refuses(f"{words[0]} applies to captures only", "replay", *words, str(recorded[0]))


def test_a_fresh_clock_gives_other_numbers_and_says_why(recorded: Recorded, cli: Cli) -> None:
    printed = cli("replay", "--json", "--fresh", recorded[0])
    assert len(printed.out.splitlines()) == len(recorded[1])
    assert printed.err.count("a new clock was requested") == 2
    assert cli("replay", recorded[0]).out == "", "samples need --json"


def test_a_cut_file_is_replayed_as_far_as_it_goes(recorded: Recorded) -> None:
    """A slow host writes several blocks, so the blocks before the cut can contain samples."""
    file, lines, _ = recorded
    printed: list[str] = []
    player = Player(lambda batch: printed.extend(msgspec.json.encode(sample).decode() for sample in batch.samples))
    report, status = play_to_end(BytesIO(file.read_bytes()[:-7]), "cut", player)
    assert printed == lines[: len(printed)]
    assert status == (0 if printed else 1)
    assert "no regular end" in report
    assert "incomplete" in report


def test_a_damaged_file_is_an_answer_of_no(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    file = recorded[0]
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged").write_bytes(data)
    assert "damaged" in cli("replay", tmp_path / "damaged", status=1).err


def test_a_recording_whose_first_bytes_are_damaged_is_no_capture(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "damaged.imudrec"
    file.write_bytes(bytes(8) + recorded[0].read_bytes()[8:])
    for command in (["replay"], ["export", "--to", "csv"]):
        printed = cli(*command, file, status=1).err
        assert "bytes from byte 0 are damaged" in printed
        assert "the capture" not in printed


def test_a_file_that_only_begins_as_a_recording_is_an_error(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "a").write_bytes(b"\x89imudREC" + bytes(100))
    cli.refuses("at least one complete block", "replay", tmp_path / "a")


def test_a_raw_capture_says_what_it_cannot_know(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.raw").write_bytes(b"".join(hi91(10 * i) for i in range(300)))
    printed = " ".join(cli("replay", tmp_path / "c.raw").err.split())
    assert "times unknown: a raw capture does not contain arrival times" in printed
    assert "ppm" not in printed
    assert "Hz" not in printed
    assert "samples 300; lost 0" in printed
