"""The daemon as a process that is treated badly: its log is not read, it is reloaded without end, and killed."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until, write_config
from tests.support.surroundings import pipe
from tests.test_daemon import cable, device, samples

MISSING = 250


def missing(folder: Path, count: int, **more: Any) -> dict[str, Any]:
    """Devices whose ports are not there."""
    return {f"m{number}": device(folder / f"none{number}", **more) for number in range(count)}


@contextmanager
def daemon_logging_to(folder: Path, descriptor: int, devices: dict[str, Any]) -> Iterator[RunningDaemon]:
    """A daemon whose standard error is `descriptor`; it must end well."""
    file = write_config(folder, devices)
    argv = [sys.executable, "-m", "imud", "run", "--config", str(file)]
    with subprocess.Popen(argv, stderr=descriptor, stdin=subprocess.DEVNULL, text=True) as process:
        daemon = RunningDaemon(folder, process)
        try:
            wait_until(daemon.socket.exists, "the daemon's socket")
            yield daemon
        finally:
            process.terminate()
            try:
                status = process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        assert status == 0


def test_a_log_that_nobody_reads_costs_no_sample(tmp_path: Path) -> None:
    """1 kHz, and messages all the time: noise that is reported, reloads of good and bad files."""
    with (
        pipe(full=True) as (_, descriptor),
        cable(tmp_path) as port,
        daemon_logging_to(tmp_path, descriptor, {"bow": device(port.name)}) as daemon,
    ):
        daemon.wait_for("bow", "searching")
        begin = time.monotonic()
        for number in range(2000):
            port.send()
            if number % 400 == 0:
                os.write(port.master, b"\x5a\xa5garbage")
                daemon.signal(signal.SIGHUP)
            time.sleep(max(0.0, begin + number / 1000 - time.monotonic()))
        wait_until(lambda: samples(daemon) == 2000, "every sample is there")
        assert daemon.statuses()["bow"].ledger["lost_queue"] == 0


class Manager:
    """A service manager's socket, and what came over it with the time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self.states: list[str] = []
        self.status = ""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while (data := self._socket.recv(4096)) != b"end":
            state, _, value = data.decode().partition("=")
            if state == "STATUS":
                self.status = value
            else:
                self.states.append(state)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"end", str(self.path))
        self._thread.join(10)
        self._socket.close()


def test_reloads_that_come_together_are_one_and_the_manager_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager = Manager(tmp_path / "manager")
    monkeypatch.setenv("NOTIFY_SOCKET", str(manager.path))
    quiet: dict[str, Any] = {"shm": {"enabled": False}}
    try:
        with running_daemon(tmp_path, {}, python=(), **quiet) as daemon:
            wait_until(lambda: manager.states == ["READY"], "it is ready")
            write_config(tmp_path, missing(tmp_path, MISSING), **quiet)
            for _ in range(50):
                daemon.signal(signal.SIGHUP)
                time.sleep(0.001)
            wait_until(lambda: len(daemon.statuses()) == MISSING, "all devices are there")
            wait_until(lambda: manager.status.startswith(f"0 of {MISSING} devices running; not: "), "it is told")
            write_config(tmp_path, {}, **quiet)
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: not daemon.statuses(), "the newest file counts")
            wait_until(lambda: manager.states[-1] == "READY", "it is ready again")
    finally:
        manager.close()
    reloads = manager.states[1:-1]
    assert reloads == ["RELOADING", "READY"] * (len(reloads) // 2)
    assert 2 <= len(reloads) // 2 <= 20
    assert manager.states[-1] == "STOPPING"


def test_a_stop_during_a_reload_ends_well(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {}, python=()) as daemon:
        write_config(tmp_path, missing(tmp_path, MISSING))
        daemon.signal(signal.SIGHUP)
        time.sleep(0.05)


@pytest.mark.timeout(20)
def test_a_file_that_became_a_fifo_leaves_everything_as_it_is(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {}) as daemon, daemon.client() as client:
        events = client.events(timeout_s=10)
        (tmp_path / "imud.yaml").unlink()
        os.mkfifo(tmp_path / "imud.yaml")
        daemon.signal(signal.SIGHUP)
        assert "is a FIFO" in next(events).message
        assert daemon.statuses() == {}


def test_killed_at_any_moment_it_starts_again(tmp_path: Path) -> None:
    file = write_config(tmp_path, missing(tmp_path, 20))
    argv = [sys.executable, "-m", "imud", "run", "--config", str(file)]
    for after_s in (0.2, 0.3, 0.4, 0.5, 0.6, 0.8):
        with (tmp_path / "log").open("wb") as log, subprocess.Popen(argv, stderr=log) as process:
            time.sleep(after_s)
            process.kill()
            process.wait(10)
    with running_daemon(tmp_path, missing(tmp_path, 20)) as daemon:
        assert len(daemon.statuses()) == 20


def test_a_holder_of_the_port_with_a_name_that_is_no_text(tmp_path: Path) -> None:
    """Its name is in the problem of the device, in the log and in answers; it ended the process."""
    name = b"\xff\n\x1b[31m"
    with cable(tmp_path) as port:
        holder = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(port.name), name.hex()], stdout=subprocess.PIPE, stdin=subprocess.PIPE
        )
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"held\n"
            with running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
                problem = daemon.wait_for("bow", "failed").problem
                assert str(holder.pid) in problem
                assert problem.isprintable()
            lines = (tmp_path / "log").read_text().splitlines()
            assert any("pid" in line for line in lines)
            assert all(line.isprintable() for line in lines)
        finally:
            holder.communicate(b"")


HOLD = """
import ctypes, fcntl, os, sys, termios
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
fcntl.flock(fd, fcntl.LOCK_EX)
fcntl.ioctl(fd, termios.TIOCEXCL)
ctypes.CDLL(None).prctl(15, bytes.fromhex(sys.argv[2]), 0, 0, 0)
print("held", flush=True)
sys.stdin.read()
"""
