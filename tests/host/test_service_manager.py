"""Datagrams to a service manager, against a real socket."""

import os
import socket
from pathlib import Path

import pytest

from imud.host.service_manager import ServiceManager, notify, watchdog_interval_s
from imud.model.units import NS_PER_S

NO_PROCESS = str(1 << 30)
"""Number above the largest process id (proc(5), pid_max)."""


@pytest.mark.parametrize("is_abstract", [False, True])
def test_state_arrives(is_abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"imud-test-{os.getpid()}" if is_abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" * is_abstract + name)
        manager.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" * is_abstract + name)
        notify("READY=1")
        assert manager.recv(100) == b"READY=1"


def test_no_manager_no_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    assert caplog.text == ""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    notify("READY=1")
    assert "cannot notify the service manager of READY=1" in caplog.text


@pytest.mark.parametrize(
    ("usec", "pid", "expected"),
    [("10000000", "", 5.0), ("", "", None), ("0", "", None), ("x", "", None), ("10000000", NO_PROCESS, None)],
)
def test_watchdog_interval(usec: str, pid: str, expected: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    if pid:
        monkeypatch.setenv("WATCHDOG_PID", pid)
    assert watchdog_interval_s() == expected


def test_a_changed_status_is_sent_and_the_watchdog_is_fed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "4000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        manager = ServiceManager()
        manager.ready()
        for tenth in range(31):
            manager.tick(tenth * NS_PER_S // 10, lambda: f"{min(tenth, 20)}")  # noqa: B023 - called here
        manager.stopping()
        sent = [receiver.recv(100).decode() for _ in range(7)]
    assert sent == ["READY=1", "WATCHDOG=1", "STATUS=0", "STATUS=10", "WATCHDOG=1", "STATUS=20", "STOPPING=1"]
