"""`imud record`: the recording replays like the live run, and errors during the recording."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import Cli, imud_process
from tests.cli.recorded_daemon import stamped_capture
from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon, wait_until
from tests.support.files import ROOT
from tests.support.surroundings import pipe

pytestmark = pytest.mark.live


def played(folder: Path) -> dict[str, object]:
    capture = str(stamped_capture(folder / "capture"))
    return {"driver": "hipnuc-uart", "replay": {"path": capture, "speed": "recorded", "repeat": True}}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    folder = tmp_path_factory.mktemp("daemon")
    device = played(folder)
    with running_daemon(folder, {"bow": device, "mast": device}) as made:
        for name in ("bow", "mast"):
            made.wait_for(name, "running")
        yield made


@pytest.fixture
def words(daemon: RunningDaemon) -> tuple[object, ...]:
    return "record", "--socket", daemon.socket


def replayed(file: Path, cli: Cli, *names: str) -> list[dict[str, Any]]:
    """Return the samples of a replay. The replay must be equal to the live run and contain only these devices."""
    printed = cli("replay", "--json", file)
    assert printed.err.count("equal to the live run") == len(names)
    assert "0 of 0" not in printed.err
    assert "the file" not in printed.err
    found = [json.loads(line) for line in printed.out.splitlines()]
    assert {one["device"] for one in found} == set(names)
    return found


def test_a_recording_from_the_middle_of_a_run_replays_as_it_ran(
    daemon: RunningDaemon, words: tuple[object, ...], tmp_path: Path, cli: Cli
) -> None:
    before, file = daemon.statuses()["bow"].newest_seq, tmp_path / "a.imudrec"
    assert " samples of 1 device, no records dropped" in cli(*words, "--device", "bow", "--for", "2.2s", file).err
    assert replayed(file, cli, "bow")[0]["seq"] > before
    cli("info", file)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_regularly(
    words: tuple[object, ...], tmp_path: Path, cli: Cli, number: signal.Signals
) -> None:
    file = tmp_path / "b.imudrec"
    with imud_process(*words, file) as record:
        wait_until(lambda: file.exists() and file.stat().st_size > 20_000, "a second of records")
        assert "of 2 devices" in record.end(number).err
    replayed(file, cli, "bow", "mast")


def written_to(stdout: Any, *words: object) -> "subprocess.CompletedProcess[str]":
    argv = [sys.executable, "-m", "imud", *map(str, words), "-"]
    return subprocess.run(argv, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)


def test_standard_output_takes_it(words: tuple[object, ...], tmp_path: Path, cli: Cli) -> None:
    with (tmp_path / "c.imudrec").open("wb") as out:
        done = written_to(out, *words, "--for", "1.2s", "--device", "mast")
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("standard output: ")
    replayed(tmp_path / "c.imudrec", cli, "mast")


def test_a_full_disk_and_a_pipe_without_a_reader_end_it_with_a_message(words: tuple[object, ...]) -> None:
    with open("/dev/full", "wb") as full:
        done = written_to(full, *words, "--for", "50s")
    assert done.returncode == 2
    assert "cannot write standard output: No space left on device; the data before is complete" in done.stderr
    with pipe() as (reader, writer):
        os.close(reader)
        done = written_to(writer, *words, "--for", "50s")
    assert done.returncode == 2
    said = "imud record: standard output: the reader closed the pipe; the recording ended before its planned end\n"
    assert done.stderr == said


def test_a_recording_or_file_that_cannot_be_made(words: tuple[object, ...], tmp_path: Path, cli: Cli) -> None:
    there = tmp_path / "there"
    there.write_bytes(b"mine")
    cli.refuses("exists; name a new file", *words, there)
    cli.refuses("No such file or directory", *words, tmp_path / "no" / "folder")
    cli.refuses("no device named 'keel'; there are: bow, mast", *words, "--device", "keel", tmp_path / "d")
    cli.refuses("the flight recorder is off", *words, "--snapshot", tmp_path / "e")
    for option in (("--for", "1s"), ("--device", "bow")):
        cli.refuses("omit --device and --for", *words, "--snapshot", *option)
    cli.refuses("expected a duration, for example 90s, 10min or 2h, got 'soon'", *words, "--for", "soon")
    assert there.read_bytes() == b"mine"
    assert sorted(tmp_path.iterdir()) == [there]


def test_a_daemon_that_stops_ends_it_and_says_so(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "f.imudrec"
    with running_daemon(tmp_path, {"bow": played(tmp_path)}) as made:
        made.wait_for("bow", "running")
        with imud_process("record", "--socket", made.socket, file) as record:
            wait_until(lambda: file.exists() and file.stat().st_size > 10_000, "a second of records")
            made.process.terminate()
            assert "the recording ended before its planned end: imud stopped" in record.end(status=1).err
    replayed(file, cli, "bow")


def example(word: str, **options: Any) -> str:
    """Return the output of the program in docs/recording.md that contains this word."""
    codes = re.findall(r"```python\n(.*?)```", (ROOT / "docs/recording.md").read_text(), re.DOTALL)
    (code,) = (one for one in codes if word in one)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT_S, check=True, **options
    )
    return str(done.stdout)


def test_the_examples_of_the_document(
    daemon: RunningDaemon, words: tuple[object, ...], tmp_path: Path, cli: Cli
) -> None:
    """The second program finds the HI91 frames in the order of time without imud."""
    assert example("imud.client", env=os.environ | {"IMUD_SOCKET": str(daemon.socket)}) == "b'\\x89imudREC'\n"
    cli(*words, "--for", "1s", "--device", "bow", tmp_path / "file")
    reads = [line.split() for line in example("zstandard", cwd=tmp_path).splitlines()]
    assert reads
    assert [int(t_ns) for _, t_ns, _ in reads] == sorted(int(t_ns) for _, t_ns, _ in reads)
    assert b"\x5a\xa5\x4c\x00" in bytes.fromhex("".join(data for *_, data in reads)), "HI91 has 76 bytes"
