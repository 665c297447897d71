"""A real daemon in a process of its own, for tests from outside."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from time import monotonic, sleep
from typing import Any

import msgspec

from imud.client.connection import Client
from imud.contracts.status import DeviceStatus
from tests.support.pty_port import PtyPort

LIMIT_S = 60.0
"""Deadline of a wait for another process, s. A loaded host is slow, and a wait ends as soon as its condition holds."""


def wait_until(condition: Callable[[], object], what: str, limit_s: float = LIMIT_S) -> None:
    """Poll a condition of another process until it is true. Use it only if the process has no event to wait for."""
    end = monotonic() + limit_s
    while not condition():
        assert monotonic() < end, f"not within {limit_s} s: {what}"
        sleep(0.005)


class RunningDaemon:
    def __init__(self, folder: Path, process: subprocess.Popen[str]) -> None:
        self.folder = folder
        self.process = process
        self.socket = folder / "imud.sock"

    def client(self) -> Client:
        return Client(self.socket)

    def statuses(self) -> dict[str, DeviceStatus]:
        with self.client() as client:
            devices = msgspec.convert(client.status()["devices"], list[DeviceStatus])
        return {device.name: device for device in devices}

    def wait_for(self, device: str, state: str) -> DeviceStatus:
        wait_until(lambda: self.statuses()[device].state == state, f"{device} is {state}")
        return self.statuses()[device]

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)


def write_config(folder: Path, devices: Mapping[str, Any], **more: Any) -> Path:
    tree = {
        "log_level": "debug", "state_dir": str(folder), "socket": {"path": str(folder / "imud.sock")},
        "shm": {"directory": str(folder)}, "metrics": {"port": 0}, "devices": devices, **more,
    }  # fmt: skip
    file = folder / "imud.yaml"
    file.write_bytes(msgspec.json.encode(tree))  # each JSON text is a YAML text
    return file


def inode_of(path: Path) -> int | None:
    """Return the inode of a file; None if the file does not exist."""
    return path.stat().st_ino if path.exists() else None


@contextmanager
def running_daemon(
    folder: Path,
    devices: Mapping[str, Any],
    *,
    limit_s: float = LIMIT_S,
    python: Sequence[str] = ("-X", "dev", "-W", "error"),
    **more: Any,
) -> Iterator[RunningDaemon]:
    """Start a daemon, wait for its socket, stop it at the end, and check its exit status.

    `python` contains options of the interpreter. Without them, the daemon is as fast as in normal operation.
    """
    file = write_config(folder, devices, **more)
    argv = [sys.executable, *python, "-m", "imud", "run", "--config", str(file)]
    stale = inode_of(folder / "imud.sock")  # a killed daemon does not remove its socket
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(argv, stderr=log, stdin=subprocess.DEVNULL, text=True) as process,
    ):
        daemon = RunningDaemon(folder, process)
        try:
            wait_until(
                lambda: inode_of(daemon.socket) not in (None, stale) or process.poll() is not None,
                "the daemon's socket",
                limit_s,
            )
            assert process.poll() is None, (folder / "log").read_text()
            yield daemon
        finally:
            process.terminate()
            status = process.wait(limit_s)
    text = (folder / "log").read_text()
    assert status == 0, text
    assert "Traceback" not in text, text
    assert "ResourceWarning" not in text, text
    assert not daemon.socket.exists()


@contextmanager
def daemon_with_module(
    folder: Path, *options: str, driver: str = "hipnuc-uart", **device: Any
) -> Iterator[RunningDaemon]:
    """Run a daemon with `bow`, a simulated device on a pseudo-terminal, or on RS-485 for Modbus.

    `options` are options of the simulator, `device` are keys of the configuration.
    """
    port = str(folder / "port")
    uart, rs485 = {"port": port, "baud": 115200}, {"line": port, "baud": 115200, "address": 80}
    link = {"rs485": rs485} if driver == "hipnuc-modbus" else {"uart": uart}
    argv = [sys.executable, "-m", "imud.sim", "--device", driver, "--path", port, *options]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as simulator:
        assert simulator.stdout is not None
        assert simulator.stdout.readline()
        try:
            with running_daemon(folder, {"bow": {"driver": driver, **link, **device}}) as daemon:
                daemon.wait_for("bow", "running")
                yield daemon
        finally:
            simulator.terminate()
            simulator.communicate()


@contextmanager
def sending_daemon(folder: Path, frame: Callable[[int], bytes], every_s: float = 0.01) -> Iterator[RunningDaemon]:
    """Run a daemon with one HiPNUC device, `bow`, that sends `frame(n)`, n from 1, 100 times a second.

    After a stall of the host, the device sends the missing frames, so that the mean rate is correct.
    """
    port, ended = PtyPort(), Event()

    def send() -> None:
        number, begin_s = 0, monotonic()
        while not ended.wait(max(begin_s + (number + 1) * every_s - monotonic(), 0)):
            number += 1
            port.send(frame(number))

    sender = Thread(target=send)
    device = {"driver": "hipnuc-uart", "identify": False, "uart": {"port": port.path, "baud": 115200}}
    with running_daemon(folder, {"bow": device}) as daemon:
        sender.start()
        try:
            daemon.wait_for("bow", "running")
            yield daemon
        finally:
            ended.set()
            sender.join()
            port.unplug()
