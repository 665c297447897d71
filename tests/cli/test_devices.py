"""`imud devices` and `imud command` with a running daemon and a simulated device."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.conftest import Cli
from tests.support.daemon_process import RunningDaemon, daemon_with_module, running_daemon

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with daemon_with_module(tmp_path_factory.mktemp("command")) as daemon:
        yield daemon


def test_devices_and_verbs_are_listed_and_a_module_obeys(daemon: RunningDaemon, cli: Cli) -> None:
    head, bow = cli("devices", "--socket", daemon.socket).out.splitlines()
    assert head.split() == ["DEVICE", "CONDITION", "RATE", "HZ", "DRIVER", "PRODUCT", "SERIAL", "NUMBER", "LINK"]
    assert bow.split()[:2] == ["bow", "ok"]
    assert f"{daemon.folder}/port at 115200 baud" in bow
    out = cli("command", "--socket", daemon.socket, "bow").out
    assert [line.split()[0] for line in out.splitlines() if not line.startswith(" ")] == [
        "save", "restart", "factory_reset", "wake", "output_once", "level", "yaw",
    ]  # fmt: skip
    assert "angle_deg (a number from -180 to 180)" in out
    out = cli("command", "--socket", daemon.socket, "bow", "yaw", "angle_deg=16").out
    assert out.startswith("sent, not verified: the device moves: ")


def test_mistakes_are_explained(daemon: RunningDaemon, cli: Cli) -> None:
    for words, expected in [
        (["yaw", "angle_deg=181"], "arguments: angle_deg (a number from -180 to 180)"),
        (["mode", "axes=9"], "mode is a setting: imud settings bow --set mode=9-axis"),
        (["output", "message=HI91", "rate_hz=200"], "output is a setting: imud settings bow --set output.hi91=200"),
        (["baud"], "baud is a setting: imud settings bow --set baud=BAUD --save"),
        (["yaw", "angle_deg=1", "angle_deg=2"], "angle_deg: expected one value, got 1 and 2"),
        (["dance"], "unknown command 'dance'; expected: save, restart"),
        (["mode", "nine"], "expected NAME=VALUE, got 'nine'"),
    ]:
        cli.refuses(expected, "command", "--socket", daemon.socket, "bow", *words)
    cli.refuses("the following arguments are required: DEVICE", "command")


def test_without_a_running_device_the_status_is_1(tmp_path: Path, cli: Cli) -> None:
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        assert "bow" in cli("devices", "--socket", daemon.socket, status=1).out
