"""`imud settings` on a running daemon with a simulated HiPNUC module on a pseudo-terminal, to the module and back."""

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from imud import config
from imud.cli import main
from imud.client import Client
from imud.contracts.device_settings import declared_values
from tests.support.daemon_process import RunningDaemon, daemon_with_module

DECLARED = {"mode": "9-axis", "output": {"hi91": 50}}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A daemon with a simulated module, which differs from what is declared."""
    with daemon_with_module(tmp_path_factory.mktemp("settings"), settings=DECLARED) as daemon:
        yield daemon


class Terminal(io.StringIO):
    """A terminal on which something is typed."""

    def isatty(self) -> bool:
        return True


def run(daemon: RunningDaemon, *words: str) -> int:
    return main(["settings", "--socket", str(daemon.socket), "bow", *words])


def actual(daemon: RunningDaemon) -> dict[str, Any]:
    """What the module says now."""
    with Client(daemon.socket, timeout_s=30) as client:
        found = client.call("settings.get", device="bow", fresh=True)
    return {one["name"]: one["actual"] for one in found["settings"]}


def test_from_difference_to_agreement_and_back(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # what there is
    assert run(daemon) == 1
    out = capsys.readouterr().out
    assert out.splitlines()[0].split() == ["SETTING", "DECLARED", "ACTUAL"]
    assert [line.split() for line in out.splitlines() if line.startswith("mode")] == [
        ["mode", "9-axis", "6-axis", "differs"]
    ]
    assert "2 of 10 differ; `--apply` sets them" in out
    assert run(daemon, "--verbose") == 1
    assert "2.2.4" in capsys.readouterr().out
    assert run(daemon, "--json") == 1
    assert json.loads(capsys.readouterr().out)["status"]["state"] == "differ"
    # a backup, and the module as YAML
    file = tmp_path / "bow.yaml"
    assert run(daemon, "--backup", str(file)) == 0
    before = actual(daemon)
    capsys.readouterr()
    assert run(daemon, "--yaml") == 0
    pasted = capsys.readouterr().out
    text = "devices:\n  bow:\n    driver: hipnuc-uart\n    uart: {port: x}\n" + "".join(
        f"    {line}\n" for line in pasted.splitlines()
    )
    (device,) = config.parse(text, "pasted").devices
    assert declared_values(device.declared)["output"] == before["output"]
    # set what is declared
    assert run(daemon, "--apply") == 0
    out = capsys.readouterr().out
    assert "to do:\n  mode: 6-axis → 9-axis\n" in out
    assert "done:\n  mode: done\n  output: done" in out
    assert (actual(daemon)["mode"], actual(daemon)["output"]["hi91"]) == ("9-axis", 50)
    assert run(daemon) == 0
    assert "all that can be read is as declared" in capsys.readouterr().out
    assert run(daemon, "--apply") == 0
    assert capsys.readouterr().out == "nothing to do\n"
    assert run(daemon, "--save") == 0
    assert "saved to flash" in capsys.readouterr().out
    assert run(daemon) == 0
    assert "flash written by imud: 1 time, 1 within 24 hours" in capsys.readouterr().out
    # and back
    assert run(daemon, "--restore", str(file), "--json") == 0
    assert json.loads(capsys.readouterr().out)["problem"] == ""
    assert actual(daemon) == before


def test_values_in_place_of_the_declared_ones(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(daemon, "--set", "sout_divisor=4", 'output={"hi91": 20}') == 0
    assert (actual(daemon)["sout_divisor"], actual(daemon)["output"]["hi91"]) == (4, 20)
    assert run(daemon, "--set", "mounting=x_up") == 1
    assert "left out: mounting comes into force by save and restart only" in capsys.readouterr().out


def test_another_rate_is_asked_for_and_followed(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--save", "--set", "baud=460800")
    assert run(daemon, *words) == 2
    assert (
        "the device may not be reached afterwards: expected a terminal to ask on, or --yes" in capsys.readouterr().err
    )
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))
    assert run(daemon, *words) == 1
    assert "nothing was done" in capsys.readouterr().out
    assert run(daemon, *words, "--yes") == 0
    assert actual(daemon)["baud"] == 460800
    daemon.wait_for("bow", "running")
    monkeypatch.setattr(sys, "stdin", Terminal("y\n"))
    assert run(daemon, "--save", "--set", "baud=115200") == 0
    assert actual(daemon)["baud"] == 115200


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--set", "mode"], "expected NAME=VALUE, got 'mode'"),
        (["--set", "mod=9"], 'expected a setting that imud knows, got "mod"; did you mean mode?'),
        (["--set", "mode=7"], 'mode: expected one of "6-axis", "9-axis", got 7'),
        (["--set", "magnetometer_bias=1"], "magnetometer_bias: it can only be read"),
        (["--restore", "{none}"], "none.yaml: No such file or directory"),
        (["--restore", "{list}"], "expected the key settings with values"),
        (["--restore", "{broken}"], "broken.yaml:2:"),
        (["--restore", "{foreign}"], "is of imu61x-uart, bow has driver hipnuc-uart"),
    ],
)
def test_mistakes_are_explained(
    daemon: RunningDaemon, words: list[str], expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = {
        "none": None,
        "list": "[1]",
        "broken": "settings:\n  a: b: c",
        "foreign": "driver: imu61x-uart\nsettings: {}",
    }
    for name, text in files.items():
        if text is not None:
            (tmp_path / f"{name}.yaml").write_text(text)
    given = [word.format(**{name: tmp_path / f"{name}.yaml" for name in files}) for word in words]
    assert run(daemon, *given) == 2
    assert expected in capsys.readouterr().err


def test_a_backup_of_another_module_is_told_of(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "other.yaml"
    file.write_text(
        'driver: hipnuc-uart\nidentity: {product: "CH020", serial_number: "77"}\nsettings: {mode: 6-axis, strange: 1}\n'
    )
    assert run(daemon, "--restore", str(file)) == 2
    err = capsys.readouterr().err
    assert "the backup is of product CH020, bow has " in err
    assert "the backup is of serial number 77, bow has " in err
    assert "left out: strange, which hipnuc-uart cannot set" in err
    assert "the backup is of another module: expected a terminal to ask on, or --yes" in err
    assert run(daemon, "--restore", str(file), "--yes") == 0


def test_a_backup_is_not_written_over_unasked(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "bow.yaml"
    file.write_text("mine")
    assert run(daemon, "--backup", str(file)) == 2
    assert file.read_text() == "mine"
    assert run(daemon, "--backup", str(file), "--yes") == 0
    capsys.readouterr()
    assert run(daemon, "--backup", "-") == 0
    assert 'driver: "hipnuc-uart"' in capsys.readouterr().out


def test_status_has_the_difference(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(daemon, "--set", "mode=6-axis") in (0, 1)
    capsys.readouterr()
    main(["status", "--socket", str(daemon.socket)])
    out = capsys.readouterr().out
    assert '  settings  differ: mode is "6-axis", declared "9-axis"' in out


def test_a_factory_reset_is_asked_for_and_backed_up(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["command", "--socket", str(daemon.socket), "bow", "factory_reset"]
    assert main(command) == 2
    assert "all settings of the device are lost: expected a terminal to ask on, or --yes" in capsys.readouterr().err
    backups = daemon.folder / "backups"
    assert not backups.exists()
    assert main([*command, "--yes"]) == 0
    assert len(list(backups.iterdir())) == 1
