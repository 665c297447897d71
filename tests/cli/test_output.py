"""Histograms: bars, edges, lengths. Tables and times."""

import io
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from imud.cli import main
from imud.cli.output import bar_width, fitted, histogram, local_time, paragraph, raise_if_unread, table
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import run_recorded
from tests.support.daemon_process import LIMIT_S, running_daemon
from tests.support.files import ROOT, hi91
from tests.support.surroundings import pipe


def test_a_histogram_and_a_paragraph_with_a_long_label() -> None:
    assert histogram([], "µs") == []
    assert histogram([7.0] * 10, "µs") == ["           7 µs 100.0 % " + "#" * 40]
    lines = histogram([0.0] * 50 + [1.5] * 25 + [8.0] * 25, "ms")
    assert len(lines) == 9
    assert lines[0] == "           0 ms  50.0 % " + "#" * 40
    assert lines[1] == "           1 ms  25.0 % " + "#" * 20
    assert lines[5] == "           5 ms   0.0 % "
    assert lines[8] == "           8 ms  25.0 % " + "#" * 20
    lines = histogram([-0.25, -0.15, 0.05], "ms")
    assert lines[0].startswith("       -0.25 ms")
    assert 3 <= len(lines) <= 13
    assert sum(float(line.split()[2]) for line in lines) == pytest.approx(100, abs=0.2)
    values = [float(v % 10) for v in range(999)] + [1e9]
    lines = histogram(values, "µs")
    assert len(lines) == 10
    assert float(lines[-1].split()[2]) == pytest.approx(10.0)  # the last bar counts the outlier
    for span, width in [(0, 1), (11, 1), (11.1, 2), (22, 2), (50, 5), (100, 10), (0.011, 0.001)]:
        assert bar_width(span) == pytest.approx(width)
    assert paragraph("x" * 200, "some words") == ["x" * 200 + "some words"]


def test_a_table_aligns_numbers_and_cannot_write_to_the_terminal() -> None:
    assert table(("A",), [("x\x1b[2J\ny",)]) == "A\nx\\x1b[2J\\ny"
    rows = [("mode", "6-axis, slowly", 7), ("baud", 115200, 11), ("node", "-", "-")]
    assert table(("SETTING", "ACTUAL", "N"), rows).splitlines() == [
        "SETTING  ACTUAL          N", "mode     6-axis, slowly   7", "baud     115200          11",
        "node     -               -",
    ]  # fmt: skip
    rows[0] = ("mode", "6-axis, slowly 0123456789", 7)
    assert table(("SETTING", "ACTUAL", "N"), rows, 20).splitlines() == [
        "SETTING  ACTUAL   N", "mode     6-axis,   7", "         slowly", "         0123456", "         789",
        "baud     115200   11", "node     -        -",
    ]  # fmt: skip
    for value, width, text in [
        (12.34, 5, "12.34"), (12345.6, 5, "12346"), (123456.0, 5, "1.2e5"), (1234567.0, 4, "1e6"), (-1e300, 3, "###"),
        (-12.34, 5, "-12.3"),
    ]:  # fmt: skip
        assert fitted(value, width, lambda number: f"{number:.2f}") == text


def test_local_time_has_its_offset_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset is the offset at that time, not today's offset: summer and winter time differ."""
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        assert local_time(1_790_000_000_123_456_789).isoformat() == "2026-09-21T16:13:20.123456+02:00"
        assert local_time(1_800_000_000_000_000_000).isoformat() == "2027-01-15T09:00:00+01:00"
        assert local_time(-1_000).isoformat() == "1970-01-01T00:59:59.999999+01:00"
    finally:
        monkeypatch.undo()
        time.tzset()


BUFFERED = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
ASCII = {**BUFFERED, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}


def imud(*words: str | bytes | Path, **options: Any) -> "subprocess.CompletedProcess[bytes]":
    argv = [sys.executable, "-m", "imud", *words]
    return subprocess.run(argv, timeout=LIMIT_S, check=False, **{"stderr": subprocess.PIPE, "env": BUFFERED, **options})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("streams")
    (made / "imud.yaml").write_text("devices: {}\n")
    (made / "capture").write_bytes(b"".join(hi91(10 * n) for n in range(100)))
    run_recorded(made)[2][0].rename(made / "recording")
    return made


Captured = pytest.CaptureFixture[str]
COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "check": lambda folder: ["check", f"{folder}/imud.yaml"], "schema": lambda _: ["schema", "--json"],
    "decode": lambda folder: ["decode", "--driver", "hipnuc-uart", f"{folder}/capture"],
    "replay": lambda folder: ["replay", "--json", f"{folder}/capture"],
    "replay-recording": lambda folder: ["replay", "--json", f"{folder}/recording"],
    "export-csv": lambda folder: ["export", "--to", "csv", f"{folder}/recording"],
    "export-mcap": lambda folder: ["export", "--to", "mcap", f"{folder}/recording"],
    "help": lambda _: ["run", "--help"], "version": lambda _: ["--version"],
}  # fmt: skip


def ended(words: list[str], output: int) -> object:
    """Run a command with this descriptor as standard output. Return the exit status."""
    with open(os.dup(output), "w", encoding="utf-8") as out, mock.patch.object(sys, "stdout", out):
        try:
            return main(words)
        except SystemExit as end:
            return end.code


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_is_an_error_and_a_closed_pipe_is_none(command: str, folder: Path, capsys: Captured) -> None:
    words = COMMANDS[command](folder)
    with open("/dev/full", "wb") as full:
        assert ended(words, full.fileno()) == 2
    error = capsys.readouterr().err
    assert "standard output: No space left on device" in error.splitlines()[-1]
    assert "Traceback" not in error
    with pipe() as (reader, writer):
        os.close(reader)
        assert ended(words, writer) == 0
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "Broken pipe" not in error


@pytest.mark.live
def test_processes_with_a_full_disk_or_without_a_reader(folder: Path, tmp_path: Path) -> None:
    """The interpreter writes its buffer at exit, which fails too."""
    good = folder / "imud.yaml"
    with open("/dev/full", "wb") as full:
        done = imud("check", good, stdout=full)
        assert (done.returncode, done.stderr) == (2, b"imud check: standard output: No space left on device\n")
        assert imud("check", tmp_path / "none", stdout=full, stderr=full).returncode == 2
    capture = tmp_path / "noise"
    capture.write_bytes(b"A\r\n" * 100_000)
    script = '"$0" -m imud decode --driver hipnuc-uart "$1" | head -n 1; echo ${PIPESTATUS[0]}'
    argv = ["bash", "-c", script, sys.executable, str(capture)]
    done = subprocess.run(argv, capture_output=True, timeout=LIMIT_S, check=True)
    assert (done.stdout, done.stderr) == (b'{"text":"A"}\n0\n', b"")
    with pipe(full=True) as (_, writer):  # the command ends even if no program reads its standard error
        assert imud("run", "--config", tmp_path / "none", stderr=writer).returncode == 78


def test_a_reader_that_has_gone_is_seen_without_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pipe() as (reader, writer), open(writer, "w", closefd=False) as output:
        monkeypatch.setattr(sys, "stdout", output)
        raise_if_unread()
        os.close(reader)
        with pytest.raises(BrokenPipeError):
            raise_if_unread()
    with (tmp_path / "file").open("w") as file:
        for stream in (file, io.StringIO()):
            monkeypatch.setattr(sys, "stdout", stream)
            raise_if_unread()
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.live
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_descriptors(closed: str, folder: Path) -> None:
    script = f'''"$0" -m imud check "$1" {closed}; echo "status $?"
        "$0" -m imud decode --driver hipnuc-uart - {closed}; echo "status $?"'''
    argv = ["bash", "-c", script, sys.executable, str(folder / "imud.yaml")]
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, timeout=LIMIT_S, check=True, text=True)
    assert [line for line in done.stdout.splitlines() if line.startswith("status")] == ["status 0", "status 1"]
    assert [line for line in done.stderr.splitlines() if not line.startswith("{")] == []


@pytest.mark.live
def test_ascii_locale(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "Größe.yaml"
    file.write_text("devices: {}\n")
    done = imud("check", file, env=ASCII, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"Gr\udcc3\udcb6\udcc3\udc9fe.yaml: valid" in done.stdout
    file.write_text("devices: {größe: 1}\n", encoding="utf-8")
    done = imud("check", file, env=ASCII, stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert rb"gr\xf6\xdfe" in done.stderr
    assert b"Traceback" not in done.stderr
    done = imud("schema", env=ASCII, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()


def test_a_configuration_from_standard_input(cli: Cli) -> None:
    with mock.patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"devices: {}\n"))):
        assert cli("check", "-") == ("-: valid; devices: none\n", "")
    with mock.patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"devices: {a: 1}\n"))):
        cli.refuses("standard input:1:", "check", "-")


def test_check_of_what_is_no_file_and_names_with_escapes(tmp_path: Path, cli: Cli) -> None:
    os.mkfifo(tmp_path / "fifo")
    for special in ("fifo", "/dev/zero", "/dev/tty", "."):
        cli.refuses("cannot read", "check", tmp_path / special)
    error = cli("check", os.fsdecode(os.fsencode(tmp_path) + b"/\xff\x1b[31m\nimud: fine"), status=2).err
    assert "\x1b" not in error
    assert "\\udcff\\x1b[31m" in error


@pytest.mark.live
def test_a_full_disk_is_an_error_of_commands_that_ask_the_daemon(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {}) as daemon, open("/dev/full", "wb") as full:
        for words in (["status"], ["status", "--json"], ["devices"], ["clock"]):
            assert ended([*words, "--socket", str(daemon.socket)], full.fileno()) == 2, words


def test_commands_print_escaped_json() -> None:
    """A text of a device can contain U+202E and C1 control characters. `printable_json` escapes them."""
    unescaped = re.compile(r"msgspec\.json\.encode\((?!tree|self\.records)")
    modules = [file for file in (ROOT / "imud/cli").rglob("*.py") if unescaped.search(file.read_text())]
    assert modules == []
