"""The daemon under stress: an unread log, continuous reloads, and kills."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from imud.config.model import Config
from imud.daemon import Daemon, Reloader
from imud.host.clock import HostClock
from imud.model.errors import ConfigError
from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon, wait_until, write_config
from tests.support.event_loops import in_loop
from tests.support.surroundings import pipe
from tests.test_daemon import cable, device, samples

MISSING = 250
RUN = (sys.executable, "-m", "imud", "run", "--config")


def missing(folder: Path, count: int, **more: Any) -> dict[str, Any]:
    """Return devices with missing ports."""
    return {f"m{number}": device(folder / f"none{number}", **more) for number in range(count)}


@pytest.mark.live
def test_a_log_that_nobody_reads_costs_no_sample(tmp_path: Path) -> None:
    """Reports of noise and of reloads fill the log. Its pipe is full from the start."""
    file = write_config(tmp_path, {"bow": device(tmp_path / "port")})
    with (
        pipe(full=True) as (_, descriptor),
        cable(tmp_path) as port,
        subprocess.Popen([*RUN, str(file)], stderr=descriptor, stdin=subprocess.DEVNULL, text=True) as process,
    ):
        daemon = RunningDaemon(tmp_path, process)
        try:
            wait_until(daemon.socket.exists, "the daemon's socket")
            daemon.wait_for("bow", "searching")
            for sent in range(0, 1000, 100):
                os.write(port.master, b"\x5a\xa5garbage")
                daemon.signal(signal.SIGHUP)
                for _ in range(4):
                    port.send(25)
                wait_until(lambda: samples(daemon) == sent + 100, "every sample is there")  # noqa: B023 - called here
            assert daemon.statuses()["bow"].ledger["lost_queue"] == 0
        finally:
            process.terminate()
            assert process.wait(LIMIT_S) == 0


class Manager:
    """Socket of a service manager, and the received messages with their times."""

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
        self._thread.join(LIMIT_S)
        self._socket.close()


class SlowTarget(Daemon):
    """A daemon that applies a configuration when `go` is set."""

    def __init__(self) -> None:
        self.begun, self.go = asyncio.Event(), asyncio.Event()
        self.applied: list[str] = []

    async def change_to(self, new: Config) -> None:
        self.begun.set()
        await self.go.wait()
        self.applied.append(new.log_level)

    def refuse(self, error: ConfigError) -> None:
        self.applied.append(str(error))


@in_loop
async def test_requests_during_a_reload_are_one_more_of_the_file_as_it_is_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("imud.daemon.notify", told.append)
    file, target, done = tmp_path / "imud.yaml", SlowTarget(), asyncio.Event()
    reloader = Reloader(file, cast(Daemon, target), HostClock(lambda: 5000))

    def request(level: str) -> None:
        file.write_text(f"log_level: {level}\ndevices: {{}}")
        reloader.request(lambda _task: done.set())

    request("debug")
    await target.begun.wait()
    for level in ("error", "info", "warning"):
        request(level)
    target.go.set()
    await done.wait()
    assert target.applied == ["debug", "warning"]
    done.clear()
    request("loud")
    await done.wait()
    assert target.applied[2].startswith(f"{file}:1:12: log_level: ")
    done.clear()
    monkeypatch.setattr("imud.daemon.configuration.load", lambda _file, pause: pause() or 1 // 0)
    request("info")
    await done.wait()
    assert target.applied[3].startswith(f"{file}: ZeroDivisionError: ")
    assert told == ["RELOADING=1\nMONOTONIC_USEC=5", "READY=1"] * 4
    await reloader.close()
    await reloader.close()


@in_loop
async def test_a_reload_ends_with_an_error_of_its_own_and_with_the_daemon(tmp_path: Path) -> None:
    file, target = tmp_path / "imud.yaml", SlowTarget()
    file.write_text("devices: {}")
    reloader = Reloader(file, cast(Daemon, target), HostClock())
    tasks: list[asyncio.Task[None]] = []
    reloader.request(tasks.append)
    await asyncio.sleep(0)
    await reloader.close()
    await asyncio.sleep(0)
    assert [task.cancelled() for task in tasks] == [True]
    assert target.applied == []


@pytest.mark.live
def test_the_manager_knows_of_reloads_and_one_may_be_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = Manager(tmp_path / "manager")
    monkeypatch.setenv("NOTIFY_SOCKET", str(manager.path))
    quiet: dict[str, Any] = {"shm": {"enabled": False}}
    try:
        with running_daemon(tmp_path, {}, python=(), **quiet) as daemon:
            wait_until(lambda: manager.states == ["READY"], "it is ready")
            write_config(tmp_path, missing(tmp_path, MISSING), **quiet)
            for _ in range(20):
                daemon.signal(signal.SIGHUP)
            wait_until(lambda: len(daemon.statuses()) == MISSING, "all devices are there")
            problem = f"{MISSING} of {MISSING} devices have a problem: "
            wait_until(lambda: manager.status.startswith(problem), "the status line names the devices")
            write_config(tmp_path, {}, **quiet)
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: not daemon.statuses(), "the newest file counts")
            wait_until(lambda: manager.states[-1] == "READY", "it is ready again")
            reloads = manager.states[1:]
            assert reloads == ["RELOADING", "READY"] * (len(reloads) // 2)
            write_config(tmp_path, missing(tmp_path, MISSING), **quiet)
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: manager.states[-1] == "RELOADING" or daemon.statuses(), "the reload has begun")
    finally:
        manager.close()
    assert manager.states[-1] == "STOPPING"


@pytest.mark.live
def test_killed_at_any_moment_it_starts_again(tmp_path: Path) -> None:
    devices, log, state = missing(tmp_path, 20), tmp_path / "log", tmp_path / "imud.sock"
    file = write_config(tmp_path, devices)
    moments: list[Callable[[], object]] = [
        lambda: True, lambda: list(tmp_path.glob("imud.m*")), state.exists, lambda: "has started" in log.read_text()
    ]  # fmt: skip
    for moment in moments:
        for left in tmp_path.glob("imud.[ms]*"):
            left.unlink()
        with log.open("wb") as stream, subprocess.Popen([*RUN, str(file)], stderr=stream) as process:
            wait_until(moment, "the moment")
            process.kill()
            process.wait(LIMIT_S)
    with running_daemon(tmp_path, devices) as daemon:
        assert len(daemon.statuses()) == 20


@pytest.mark.live
def test_a_holder_of_the_port_with_a_name_that_is_no_text(tmp_path: Path) -> None:
    """The name of the process is in the problem of the device, in the log and in replies. Before, it ended the
    daemon."""
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


def test_a_second_signal_at_the_end_does_not_change_the_exit_status() -> None:
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]

    @in_loop
    async def run() -> None:
        daemon = Daemon(Config("info", "", {}, ()))
        daemon.install_signals()
        running = asyncio.create_task(daemon.run())
        await asyncio.sleep(0)
        signal.raise_signal(signal.SIGTERM)
        await running

    try:
        run()
        assert [signal.getsignal(number) for number in numbers] == [signal.SIG_IGN] * 3
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
