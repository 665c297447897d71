"""`imud record`: a file that replays as the daemon ran, from the middle of its run, and what goes wrong meanwhile."""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from imud.cli import main
from imud.cli.arguments import duration_s
from tests.cli.recording.recorded_daemon import stamped_capture
from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon, wait_until
from tests.support.files import ROOT


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A daemon without `recorder`, that plays a capture again and again for two devices."""
    folder = tmp_path_factory.mktemp("daemon")
    capture = str(stamped_capture(folder / "capture"))
    played = {"driver": "hipnuc-uart", "replay": {"path": capture, "speed": "recorded", "repeat": True}}
    with running_daemon(folder, {"bow": played, "mast": played}) as made:
        for name in ("bow", "mast"):
            made.wait_for(name, "running")
        yield made


def command(daemon: RunningDaemon, *words: str) -> list[str]:
    return [sys.executable, "-m", "imud", "record", "--socket", str(daemon.socket), *words]


def record(daemon: RunningDaemon, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(command(daemon, *words), capture_output=True, text=True, timeout=LIMIT_S, check=False)


def replayed(file: Path, capsys: pytest.CaptureFixture[str], *names: str) -> list[dict[str, object]]:
    """The samples of a replay, which must be the same as the live run at several checks, of these devices only."""
    capsys.readouterr()
    assert main(["replay", "--json", str(file)]) == 0
    printed = capsys.readouterr()
    assert printed.err.count("the same as the live run") == len(names)
    assert "0 of 0" not in printed.err
    assert "the file" not in printed.err
    found: list[dict[str, object]] = [json.loads(line) for line in printed.out.splitlines()]
    assert {one["device"] for one in found} == set(names)
    return found


def test_a_recording_from_the_middle_of_a_run_replays_as_it_ran(
    daemon: RunningDaemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = daemon.statuses()["bow"].newest_seq
    done = record(daemon, "--device", "bow", "--for", "2.2s", str(tmp_path / "a.imudrec"))
    assert done.returncode == 0, done.stderr
    assert " samples of 1 device, no records dropped" in done.stderr
    found = replayed(tmp_path / "a.imudrec", capsys, "bow")
    assert len(found) >= 150
    assert isinstance(found[0]["seq"], int)
    assert found[0]["seq"] > before
    assert main(["info", str(tmp_path / "a.imudrec")]) == 0


def test_an_interrupt_ends_it_regularly(
    daemon: RunningDaemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "b.imudrec"
    with subprocess.Popen(command(daemon, str(file)), stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: file.exists() and file.stat().st_size > 20_000, "a second of records")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, said
    assert "of 2 devices" in said
    replayed(file, capsys, "bow", "mast")


def test_standard_output_takes_it(daemon: RunningDaemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "c.imudrec"
    with file.open("wb") as out:
        argv = command(daemon, "--for", "1.2s", "--device", "mast", "-")
        done = subprocess.run(argv, stdout=out, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("standard output: ")
    replayed(file, capsys, "mast")


def test_what_cannot_be_recorded_or_written(daemon: RunningDaemon, tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.write_bytes(b"mine")
    for words, said in (
        ([str(there)], "exists already: expected the name of a new file"),
        ([str(tmp_path / "no" / "folder")], "No such file or directory"),
        (["--device", "keel", str(tmp_path / "d")], "no device named 'keel'; there are: bow, mast"),
        (["--snapshot", str(tmp_path / "e")], "there is no flight recorder"),
        (["--snapshot", "--for", "1s"], "expected neither --device nor --for"),
        (["--for", "soon"], "expected a duration as 90s, 10min or 2h, got 'soon'"),
    ):
        done = record(daemon, *words)
        assert done.returncode == 2, done.stderr
        assert said in done.stderr
    assert there.read_bytes() == b"mine"
    assert sorted(tmp_path.iterdir()) == [there]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this machine")
def test_a_full_disk_ends_it_with_a_message(daemon: RunningDaemon) -> None:
    with open("/dev/full", "wb") as full:
        argv = command(daemon, "--for", "5s", "-")
        done = subprocess.run(argv, stdout=full, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 2
    assert "standard output: No space left on device; what was written before is whole" in done.stderr


def test_a_pipe_that_nobody_reads_is_no_recording(daemon: RunningDaemon) -> None:
    read, write = os.pipe()
    os.close(read)
    argv = command(daemon, "--for", "5s", "-")
    done = subprocess.run(argv, stdout=write, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)
    os.close(write)
    assert done.returncode == 2
    words = "imud record: standard output: nobody reads it any more; the recording ended before it was to\n"
    assert done.stderr == words


def test_a_daemon_that_stops_ends_it_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = str(stamped_capture(tmp_path / "capture"))
    played = {"driver": "hipnuc-uart", "replay": {"path": capture, "speed": "recorded", "repeat": True}}
    file = tmp_path / "f.imudrec"
    with running_daemon(tmp_path, {"bow": played}) as made:
        made.wait_for("bow", "running")
        process = subprocess.Popen(command(made, str(file)), stderr=subprocess.PIPE, text=True)
        wait_until(lambda: file.exists() and file.stat().st_size > 10_000, "a second of records")
    _, said = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1
    assert "the recording ended before it was to: imud stopped" in said
    replayed(file, capsys, "bow")


def test_the_example_of_the_document(daemon: RunningDaemon) -> None:
    document = (ROOT / "docs" / "recording.md").read_text()
    (code,) = (one for one in re.findall(r"```python\n(.*?)```", document, re.DOTALL) if "imud.client" in one)
    argv, environment = [sys.executable, "-c", code], os.environ | {"IMUD_SOCKET": str(daemon.socket)}
    done = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False, env=environment)
    assert done.stdout == "b'\\x89imudREC'\n", done.stderr


def test_raw_bytes_are_read_as_the_document_does(daemon: RunningDaemon, tmp_path: Path) -> None:
    """The frames of HI91 that a program without imud finds, in the order of their time."""
    done = record(daemon, "--for", "1s", "--device", "bow", str(tmp_path / "file"))
    assert done.returncode == 0, done.stderr
    document = (ROOT / "docs" / "recording.md").read_text()
    (code,) = (one for one in re.findall(r"```python\n(.*?)```", document, re.DOTALL) if "zstandard" in one)
    argv = [sys.executable, "-c", code]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=tmp_path)
    reads = [line.split() for line in done.stdout.splitlines()]
    assert len(reads) >= 20, done.stderr
    assert [int(t_ns) for _, t_ns, _ in reads] == sorted(int(t_ns) for _, t_ns, _ in reads)
    assert b"\x5a\xa5\x4c\x00" in bytes.fromhex("".join(data for *_, data in reads)), "HI91 has 76 bytes"


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("90s", 90), ("10min", 600), ("1.5h", 5400), ("2 d", 172_800), (".5s", 0.5)]
)
def test_durations(text: str, seconds: float) -> None:
    assert duration_s(text) == seconds


@pytest.mark.parametrize("text", ["", "min", "0", "-1s", "1 week", "1e3", "10m", "nan", "9" * 400 + "s"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected a duration as 90s, 10min or 2h"):
        duration_s(text)
