"""`imud devices` and `imud command` with a running daemon and a simulated device."""

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from imud.contracts.command import Risk
from tests.cli.conftest import Cli
from tests.support.daemon_process import RunningDaemon, daemon_with_module, running_daemon

live = pytest.mark.live


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with daemon_with_module(tmp_path_factory.mktemp("command")) as daemon:
        yield daemon


@live
def test_devices_and_verbs_are_listed_and_a_module_obeys(daemon: RunningDaemon, cli: Cli) -> None:
    head, bow = cli("devices", "--socket", daemon.socket).out.splitlines()
    assert head.split() == ["DEVICE", "CONDITION", "RATE", "HZ", "DRIVER", "PRODUCT", "SERIAL", "NUMBER", "LINK"]
    assert bow.split()[:2] == ["bow", "ok"]
    assert f"{daemon.folder}/port at 115200 baud" in bow
    out = cli("command", "--socket", daemon.socket, "bow").out
    assert [line.split()[0] for line in out.splitlines() if not line.startswith(" ")] == [
        "save", "restart", "factory_reset", "wake", "output_once", "level", "yaw", "reset_attitude", "ins_config",
    ]  # fmt: skip
    assert "angle_deg (a number from -180 to 360)" in out
    out = cli("command", "--socket", daemon.socket, "bow", "yaw", "angle_deg=16").out
    assert out.startswith("sent, not verified: the device moves: ")


@live
def test_mistakes_are_explained(daemon: RunningDaemon, cli: Cli) -> None:
    for words, expected in [
        (["yaw", "angle_deg=361"], "arguments: angle_deg (a number from -180 to 360)"),
        (["mode", "axes=9"], "mode is a setting: imud settings bow --set mode=9-axis"),
        (["output", "message=HI91", "rate_hz=200"], "output is a setting: imud settings bow --set output.hi91=200"),
        (["baud"], "baud is a setting: imud settings bow --set baud=BAUD --save"),
        (["yaw", "angle_deg=1", "angle_deg=2"], "angle_deg: expected one value, got 1 and 2"),
        (["dance"], "unknown command 'dance'; expected: save, restart"),
        (["mode", "nine"], "expected NAME=VALUE, got 'nine'"),
    ]:
        cli.refuses(expected, "command", "--socket", daemon.socket, "bow", *words)
    cli.refuses("the following arguments are required: DEVICE", "command")


def test_a_risk_is_confirmed_and_the_result_has_its_evidence(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    result = {"verified": True, "evidence": "it replied", "result": [1], "not_saved": "lasts until power-off"}
    answers = iter([result, result | {"result": None, "not_saved": ""}, {"verified": True}, None])
    verbs = [{"name": "reset", "help": "h", "parameters": [], "risk": Risk.RESET}]
    client = MagicMock(call=lambda method, **_more: verbs if method == "actions" else next(answers))
    monkeypatch.setattr("imud.cli.devices.Client", made := MagicMock())
    made.return_value.__enter__.return_value = client
    cli.refuses(f"{Risk.RESET}: cannot ask for confirmation without a terminal", "command", "bow", "reset")
    for words in (
        "verified: it replied\n[1]\nlasts until power-off", "verified: it replied", '{"verified":true}', "done",
    ):  # fmt: skip
        assert cli("command", "bow", "reset", "--yes").out == words + "\n"
    answers = iter([result | {"verified": False, "failed": failed} for failed in (True, False)])
    for status in (1, 0):  # 1 if the device has ignored the command
        answer = cli("command", "bow", "reset", "--yes", status=status).out
        assert answer.startswith("sent, not verified: it replied")
    assert made.call_args.kwargs == {"timeout_s": 180.0}, "a calibration takes two minutes"


@live
def test_without_a_running_device_the_status_is_1(tmp_path: Path, cli: Cli) -> None:
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        assert "bow" in cli("devices", "--socket", daemon.socket, status=1).out
