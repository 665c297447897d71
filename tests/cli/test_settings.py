"""`imud settings` with a running daemon and a simulated HiPNUC device on a pseudo-terminal."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from imud import config
from imud.cli import settings as cli_settings
from imud.cli.settings import device_after, given_values
from imud.client.connection import Client
from imud.contracts import setting
from imud.contracts.setting import SettingsReport, declared_values
from imud.device.settings_plan import described_settings
from imud.drivers import DRIVERS
from imud.formats.jsonrpc import Code, RpcError
from imud.model.errors import BadArgument
from tests.cli.conftest import Cli, Terminal
from tests.support.daemon_process import LIMIT_S, RunningDaemon, daemon_with_module

pytestmark = pytest.mark.live

Words = tuple[object, ...]
DECLARED = {"mode": "9-axis", "output": {"hi91": 50}}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with daemon_with_module(tmp_path_factory.mktemp("settings"), settings=DECLARED) as daemon:
        yield daemon


@pytest.fixture
def words(daemon: RunningDaemon) -> Words:
    return "settings", "--socket", daemon.socket, "bow"


def actual(daemon: RunningDaemon) -> dict[str, Any]:
    with Client(daemon.socket, timeout_s=LIMIT_S) as client:
        found = client.call("settings.get", device="bow", fresh=True)
    return {one["name"]: one["actual"] for one in found["settings"]}


def test_a_backup_leaves_out_values_that_imud_does_not_know() -> None:
    table = DRIVERS["hipnuc-uart"].device_settings
    assert table is not None
    for values, kept in (({"mode": "3", "coordinates": 2}, {}), ({"mode": "humanoid", "coordinates": 4}, None)):
        report = Mock(settings=described_settings(table, {}, values))
        assert cli_settings._settable(report) == (values if kept is None else kept)


def test_from_difference_to_agreement(daemon: RunningDaemon, words: Words, cli: Cli, tmp_path: Path) -> None:
    out = cli(*words, status=1).out  # report
    assert out.splitlines()[0].split() == ["SETTING", "DECLARED", "ACTUAL"]
    (mode,) = [line.split() for line in out.splitlines() if line.startswith("mode")]
    assert mode == ["mode", "9-axis", "6-axis", "differs"]
    assert "2 of 20 differ; set them with --apply" in out
    assert "2.2.4" not in out
    assert "2.2.4" in cli(*words, "--verbose", status=1).out
    assert json.loads(cli(*words, "--json", status=1).out)["status"]["state"] == "differ"
    file = tmp_path / "bow.yaml"  # backup, and output as YAML
    cli(*words, "--backup", file)
    before = actual(daemon)
    pasted = cli(*words, "--yaml").out
    text = "devices:\n  bow:\n    driver: hipnuc-uart\n    uart: {port: x}\n" + "".join(
        f"    {line}\n" for line in pasted.splitlines()
    )
    (device,) = config.parse(text, "pasted").devices
    assert declared_values(device.declared)["output"] == before["output"]
    out = cli(*words, "--apply").out  # apply the declared settings
    assert "plan:\n  mode: 6-axis → 9-axis\n" in out
    assert "done:\n  mode: verified\n  output: verified" in out
    assert (actual(daemon)["mode"], actual(daemon)["output"]["hi91"]) == ("9-axis", 50)
    assert "all readable settings are as declared" in cli(*words).out
    assert cli(*words, "--apply").out == "no changes needed\n"
    assert "save to flash: sent, not verified: " in cli(*words, "--save").out
    assert "imud wrote the flash 1 time, 1 within 24 hours" in cli(*words).out
    # restore the backup
    assert (json.loads(cli(*words, "--restore", file, "--json").out)["problem"], actual(daemon)) == ("", before)
    out = cli("status", "--socket", daemon.socket).out
    assert '  settings  differ: mode is "6-axis", declared "9-axis"' in out


def test_values_in_place_of_the_declared_ones(daemon: RunningDaemon, words: Words, cli: Cli) -> None:
    cli(*words, "--set", "sout_divisor=4", 'output={"hi91": 20}')
    assert (actual(daemon)["sout_divisor"], actual(daemon)["output"]["hi91"]) == (4, 20)
    cli(*words, "--set", "sout_divisor=5", "magnetic_calibration=false", "--set", "mode=6-axis")
    assert [actual(daemon)[name] for name in ("sout_divisor", "magnetic_calibration", "mode")] == [5, False, "6-axis"]
    cli(*words, "--set", "output.hi91=50", "alarm.x.min_deg=-10", "alarm.x.max_deg=10")
    cli(*words[:-1], "--set", "alarm.x.min_deg=-5", "--set", "pins.led=7", words[-1])  # the device at the end
    found = actual(daemon)
    assert (found["output"]["hi91"], found["alarm"]["x"]["min_deg"], found["alarm"]["x"]["max_deg"]) == (50, -5, 10)
    assert (found["pins"]["led"], found["pins"]["sin"]) == (7, 1)
    cli.refuses("pins: expected another pin for each function, got IO1 for sin and led", *words, "--set", "pins.led=1")
    assert "not set: mounting needs a save and a restart" in cli(*words, "--set", "mounting=x_up", status=1).out


def test_another_rate(daemon: RunningDaemon, words: Words, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    more = (*words, "--save", "--set", "baud=460800")
    cli.refuses("the device may not be reached afterwards: cannot ask for confirmation without a terminal", *more)
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))
    assert "imud changed nothing" in cli(*more, status=1).out
    cli(*more, "--yes")
    assert actual(daemon)["baud"] == 460800
    daemon.wait_for("bow", "running")
    monkeypatch.setattr(sys, "stdin", Terminal("y\n"))
    cli(*words, "--save", "--set", "baud=115200")
    assert actual(daemon)["baud"] == 115200


def test_mistakes_are_explained(words: Words, cli: Cli, tmp_path: Path) -> None:
    for value, problem in {
        "mode": "expected NAME=VALUE, got 'mode'",
        "mod=9": 'expected a setting that imud knows, got "mod"; did you mean mode?',
        "mode=7": 'mode: expected one of "6-axis", "9-axis", "humanoid", "low_dynamics", "slow_vehicle", got 7',
        "magnetometer_bias=1": "magnetometer_bias: it is read-only",
    }.items():
        cli.refuses(problem, *words, "--set", value)
    file = tmp_path / "bow.yaml"
    cli.refuses("bow.yaml: No such file or directory", *words, "--restore", file)
    for text, problem in {
        "[1]": "expected the key settings with values",
        "settings:\n  a: b: c": "bow.yaml:2:",
        "driver: imu61x-uart\nsettings: {}": "expected a backup of driver hipnuc-uart, which bow uses; got imu61x-uart",
    }.items():
        file.write_text(text)
        cli.refuses(problem, *words, "--restore", file)


def test_a_backup_of_another_device_and_an_existing_backup(
    words: Words, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "other.yaml"
    file.write_text(
        'driver: hipnuc-uart\nidentity: {product: "CH020", serial_number: "77"}\nsettings: {mode: 6-axis, strange: 1}\n'
    )
    err = cli(*words, "--restore", file, status=2).err
    for problem in (
        "product: the backup contains CH020, bow has ",
        "serial number: the backup contains 77, bow has ",
        "ignored: strange; hipnuc-uart cannot set it",
        "the backup is from another device: cannot ask for confirmation without a terminal",
    ):
        assert problem in err
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", Terminal("n\n"))
        assert "plan:" not in cli(*words, "--restore", file, status=1).out
    cli(*words, "--restore", file, "--yes")
    assert json.loads(cli(*words, "--restore", file, "--yes", "--json").out)["steps"] == []
    file = tmp_path / "bow.yaml"
    file.write_text("mine")
    cli(*words, "--backup", file, status=2)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", Terminal("n\n"))
        cli(*words, "--backup", file, status=1)
    assert file.read_text() == "mine"
    cli(*words, "--backup", file, "--yes")
    assert 'driver: "hipnuc-uart"' in file.read_text()
    assert 'driver: "hipnuc-uart"' in cli(*words, "--backup", "-").out


def test_a_factory_reset_is_asked_for_and_backed_up(
    daemon: RunningDaemon, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("command", "--socket", daemon.socket, "bow", "factory_reset")
    cli.refuses("all settings of the device are lost: cannot ask for confirmation without a terminal", *command)
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))
    cli(*command, status=1)
    backups = daemon.folder / "backups"
    assert not backups.exists()
    cli(*command, "--yes")
    assert len(list(backups.iterdir())) == 1


def test_settings_that_cannot_be_read_now(capsys: pytest.CaptureFixture[str]) -> None:
    status = setting.SettingsStatus(
        setting.SettingsState.UNKNOWN, setting.OnDifference.REPORT, problem="no reply", read_ns=5
    )
    known = SettingsReport("bow", "hipnuc-uart", {}, status, ())
    failed, denied = RpcError(Code.FAILED, "no reply"), RpcError(Code.DENIED, "no")
    rights = Mock(rights=["watch", "control"])

    def report(*replies: object, rights: object = rights, needed: bool = False) -> SettingsReport:
        return cli_settings._report(Mock(hello=rights, call=Mock(side_effect=replies)), "bow", needed=needed)

    assert report(failed, msgspec.to_builtins(known)) == known
    assert "no reply; imud prints the last reported settings:\n" in capsys.readouterr().err
    for replies, more in (((denied,), {}), ((failed,), {"needed": True}), ((failed,), {"rights": Mock(rights=[])})):
        with pytest.raises(RpcError):
            report(*replies, known, **more)
    assert report(msgspec.to_builtins(known), needed=True) == known
    unread = msgspec.structs.replace(known, status=msgspec.structs.replace(status, read_ns=None))
    with pytest.raises(BadArgument, match="bow has not reported its settings yet"):
        report(msgspec.to_builtins(unread), needed=True)
    assert cli_settings._shown(known, verbose=False).splitlines()[1:] == [
        "", "the device has not reported its settings", "problem: no reply",
        "imud wrote the flash 0 times, 0 within 24 hours",
    ]  # fmt: skip
    done = setting.AppliedSettings(problem="it is missing", advice="plug it in")
    assert cli_settings._account(done).splitlines() == ["tried:", "FAILED: it is missing", "plug it in"]


def test_values_in_the_notation_of_yaml() -> None:
    for word, value in [
        ("output={hi91: 50}", {"hi91": 50}), ('output={"hi91": 50}', {"hi91": 50}), ("mounting=[1, 0]", [1, 0]),
        ("mode=9-axis", "9-axis"), ("mode=a{b", "a{b"),
    ]:  # fmt: skip
        assert list(given_values([word]).values()) == [value]
    for given in ([], ["a=1"], ["bow"], ["a=1", "bow", "stern"]):
        with pytest.raises(BadArgument, match="expected one device, as in `imud settings bow`"):
            device_after(given)
    for word in ("output={hi91: ", "output={hi91: 50} {}", "output={a: 1, a: 2}"):
        with pytest.raises(BadArgument, match=r"output: expected YAML, for example \{hi91: 50\}, got "):
            given_values([word])
