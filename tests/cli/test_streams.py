"""No command ends in a traceback for what its standard streams are: a full disk, closed, ASCII, or not read."""

import io
import os
import subprocess
import sys
from pathlib import Path
from time import monotonic

import pytest

from imud.cli.streams import raise_if_unread
from tests.support.daemon_process import running_daemon
from tests.support.files import hi91
from tests.support.surroundings import pipe

BUFFERED = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
ASCII = {**BUFFERED, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
NAME = "Grüße\x1b[31m"


def imud(*words: str | bytes | Path, **options: object) -> subprocess.CompletedProcess[bytes]:
    """Run a command to its end."""
    argv = [sys.executable, "-m", "imud", *words]
    return subprocess.run(argv, timeout=30, check=False, **{"stderr": subprocess.PIPE, "env": BUFFERED, **options})  # type: ignore[call-overload,no-any-return]


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A configuration that is good."""
    file = tmp_path / "imud.yaml"
    file.write_text("devices: {}\n")
    return file


def commands_that_print(tmp_path: Path) -> list[list[str]]:
    """A call of each command that works without a daemon."""
    config, capture = tmp_path / "imud.yaml", tmp_path / "capture"
    config.write_text("devices: {}\n")
    capture.write_bytes(b"".join(hi91(10 * n) for n in range(100)))
    return [
        ["check", str(config)],
        ["schema"],
        ["schema", "--json"],
        ["decode", "--driver", "hipnuc-uart", str(capture)],
        ["replay", "--json", str(capture)],
        ["run", "--help"],
        ["--version"],
    ]


def test_full_disk(tmp_path: Path) -> None:
    with open("/dev/full", "wb") as full:
        for words in commands_that_print(tmp_path):
            done = imud(*words, stdout=full)
            assert done.returncode == 2, words
            assert done.stderr.endswith(b"standard output: No space left on device\n"), (words, done.stderr)
            assert b"Traceback" not in done.stderr


def test_full_disk_of_both(tmp_path: Path, good: Path) -> None:
    with open("/dev/full", "wb") as full:
        assert imud("check", good, stdout=full, stderr=full).returncode == 2
        assert imud("check", tmp_path / "none", stdout=full, stderr=full).returncode == 2


def test_reader_that_has_gone(tmp_path: Path) -> None:
    for words in commands_that_print(tmp_path):
        with pipe() as (reader, writer):
            os.close(reader)
            done = imud(*words, stdout=writer)
        assert done.returncode == 0, words
        assert b"Traceback" not in done.stderr
        assert b"Broken pipe" not in done.stderr


def test_a_reader_that_has_gone_is_seen_without_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    with pipe() as (reader, writer), open(writer, "w", closefd=False) as output:
        monkeypatch.setattr(sys, "stdout", output)
        raise_if_unread()
        os.close(reader)
        with pytest.raises(BrokenPipeError):
            raise_if_unread()


def test_files_and_streams_in_memory_are_always_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "file").open("w") as file:
        for stream in (file, io.StringIO()):
            monkeypatch.setattr(sys, "stdout", stream)
            raise_if_unread()
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_descriptors(closed: str, good: Path, tmp_path: Path) -> None:
    script = f'"$0" -m imud check "$1" {closed}; echo "status $?"'
    done = subprocess.run(
        ["bash", "-c", script, sys.executable, good], capture_output=True, timeout=30, check=True, text=True
    )
    assert done.stdout.endswith("status 0\n")
    assert done.stderr == ""
    script = f'"$0" -m imud decode --driver hipnuc-uart - {closed}; echo "status $?"'
    done = subprocess.run(
        ["bash", "-c", script, sys.executable],
        stdin=subprocess.DEVNULL, capture_output=True, timeout=30, check=True, text=True,
    )  # fmt: skip
    assert done.stdout.endswith("status 1\n")
    assert "Traceback" not in done.stderr


def test_ascii_locale(tmp_path: Path) -> None:
    file = tmp_path / "Größe.yaml"
    file.write_text("devices: {}\n")
    done = imud("check", file, env=ASCII, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"Gr\udcc3\udcb6\udcc3\udc9fe.yaml: good" in done.stdout
    file.write_text("devices: {größe: 1}\n", encoding="utf-8")
    done = imud("check", file, env=ASCII, stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert rb"gr\xf6\xdfe" in done.stderr
    assert b"Traceback" not in done.stderr
    for words in commands_that_print(tmp_path):
        done = imud(*words, env=ASCII, stdout=subprocess.PIPE)
        assert done.returncode == 0, (words, done.stderr)
        assert done.stdout.isascii()
        assert done.stderr.isascii()


def test_names_of_files_are_escaped_in_errors(tmp_path: Path) -> None:
    done = imud("check", os.fsencode(tmp_path) + b"/\xff\x1b[31m\nimud: fine", stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert b"\x1b" not in done.stderr
    assert b"\\udcff\\x1b[31m" in done.stderr


def test_a_configuration_from_standard_input() -> None:
    done = imud("check", "-", input=b"devices: {}\n", stdout=subprocess.PIPE)
    assert (done.returncode, done.stdout) == (0, b"-: good; devices: none\n")
    done = imud("check", "-", input=b"devices: {a: 1}\n", stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert b"standard input:1:" in done.stderr


@pytest.mark.parametrize("special", ["fifo", "/dev/zero", "/dev/tty", "."])
def test_check_of_what_is_no_file(special: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    done = imud("check", tmp_path / special, stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert b"cannot be read" in done.stderr
    assert b"Traceback" not in done.stderr


def test_an_error_that_nobody_reads_does_not_keep_the_command(tmp_path: Path) -> None:
    with pipe(full=True) as (_, writer):
        begin = monotonic()
        assert imud("run", "--config", tmp_path / "none", stderr=writer).returncode == 78
        assert monotonic() - begin < 10


def test_a_daemon_that_is_not_understood_is_no_traceback(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {}) as daemon:
        for words in (["status"], ["status", "--json"], ["devices"], ["clock"]):
            with open("/dev/full", "wb") as full:
                done = imud(*words, "--socket", daemon.socket, stdout=full)
            assert b"Traceback" not in done.stderr
            assert done.returncode == 2, (words, done.stderr)
