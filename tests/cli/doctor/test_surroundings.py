"""Input of the checks: commands, files and the daemon; real ones if the test does no harm."""

import os
import sys
from pathlib import Path
from subprocess import TimeoutExpired
from unittest.mock import Mock, call, patch

import pytest

from imud.cli.doctor import surroundings
from imud.cli.doctor.surroundings import Surroundings, ask_daemon, fetch_over_http, measure_sync_s, run_command
from imud.model.errors import LinkMissing, ServerError
from tests.support.metrics import device
from tests.support.surroundings import Machine


@pytest.mark.live
def test_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    program = "import sys, os; print(os.environ['LC_ALL']); sys.stderr.write('one\\ntwo\\n'); sys.exit(3)"
    assert run_command([sys.executable, "-c", program]) == (3, "C\n", "two")
    with pytest.raises(FileNotFoundError):
        run_command(["/no/such/command"])
    with pytest.raises(TimeoutError, match=r"sleep did not end within 0\.01 s"):
        run_command(["sleep", "60"], limit_s=0.01)
    monkeypatch.setattr(surroundings, "OUTPUT_CHARACTERS_MAX", 4)
    assert run_command([sys.executable, "-c", "print('abcdef')"]).text == "def\n"
    monkeypatch.setattr(surroundings, "COMMAND_S", 0.01)
    with pytest.raises(TimeoutError):
        run_command(["sleep", "60"])


def test_limits_of_commands_pages_and_files(machine: Machine) -> None:
    with patch("subprocess.run", side_effect=[TimeoutExpired("ip", 5), Mock(stdout=b"x" * (1 << 21), stderr=b"")]):
        with pytest.raises(TimeoutError, match="the command ip did not end within 5 s"):
            run_command(["ip"])
        assert len(run_command(["ip"]).text) == 1 << 20
    with patch.object(surroundings, "HTTPConnection") as made:
        made().getresponse.return_value = Mock(status=200, read=bytes)
        assert len(fetch_over_http("::1", 9321, "/scrapes")) == 65536
    assert made.call_args == call("::1", 9321, timeout=3.0)
    made().close.assert_called_once()
    machine.write("/proc/mounts", "x" * 70_000)
    assert len(machine.surroundings().text("/proc/mounts") or "") == 65536


def test_storage_servers_and_the_daemon(tmp_path: Path) -> None:
    assert measure_sync_s(tmp_path) > 0
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ConnectionRefusedError):
        fetch_over_http("127.0.0.1", 1, "/")
    with pytest.raises(LinkMissing):
        ask_daemon(str(tmp_path / "none"))


def test_the_daemon_files_and_the_unit(machine: Machine) -> None:
    machine.status = [device("bow")]
    at = machine.surroundings()
    assert at.status is not None
    machine.status = ServerError("gone")
    assert at.status_of("bow") is not None
    assert at.status_of("stern") is None
    assert at.status_error is None
    assert Surroundings(Path("imud.yaml"), Mock()).uid == os.geteuid()
    machine.write("/proc/device-tree/model", "Raspberry Pi\0\n")
    at = machine.surroundings()
    assert at.text("/proc/device-tree/model") == "Raspberry Pi"
    assert at.text("/proc/none") is None
    assert (at.at("/dev/ttyUSB0"), machine.surroundings().unit) == (machine.root / "dev/ttyUSB0", {})
    machine.unit("DeviceAllow=char-ttyUSB rw", "DeviceAllow=/dev/i2c-1 rw", "Environment=A=b")
    at = machine.surroundings()
    assert at.installed
    assert at.unit["DeviceAllow"] == ["char-ttyUSB rw", "/dev/i2c-1 rw"]
    assert (at.unit_value("Environment"), at.unit_value("User")) == ("A=b", "")
