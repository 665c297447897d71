"""Fixtures that run `imud` in this process (`cli`) and in a second process (`imud_process`)."""

import io
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import pytest

from imud.cli import main
from tests.fleet.conftest import broker
from tests.support.daemon_process import LIMIT_S
from tests.support.surroundings import Machine

__all__ = ["broker"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Printed(NamedTuple):
    out: str
    err: str


class Cli:
    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: object, status: int = 0) -> Printed:
        """Run a command, check its exit status, and return its output."""
        self._capsys.readouterr()
        got: object = None
        try:
            got = main([str(word) for word in words])
        except SystemExit as ended:  # argparse ends the program
            got = ended.code
        printed = Printed(*self._capsys.readouterr())
        assert got == status, f"expected exit status {status}, got {got}: {printed.err}"
        return printed

    def refuses(self, problem: str, *words: object) -> None:
        """Run a command. Check that it ends with status 2 and prints this problem to standard error."""
        assert problem in " ".join(self(*words, status=2).err.split())


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


class ImudProcess:
    def __init__(self, process: "subprocess.Popen[str]") -> None:
        assert process.stderr is not None
        self.process = process
        self.out: IO[str] = process.stdout or io.StringIO()
        self.err: IO[str] = process.stderr

    def end(self, number: signal.Signals | None = None, *, status: int = 0) -> Printed:
        """Send a signal, wait for the end, check the exit status. Return the remaining output."""
        if number is not None:
            self.process.send_signal(number)
        out, err = self.process.communicate(timeout=LIMIT_S)
        assert self.process.returncode == status, err
        return Printed(out or "", err)


@contextmanager
def imud_process(*words: object, python: tuple[str, ...] = (), **options: Any) -> Iterator[ImudProcess]:
    argv = [sys.executable, *python, "-m", "imud", *map(str, words)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    with subprocess.Popen(argv, text=True, **options) as process:
        try:
            yield ImudProcess(process)
        finally:
            process.kill()


@pytest.fixture
def in_kolkata(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "IST-5:30")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()
