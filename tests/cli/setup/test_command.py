"""The command `imud setup`: arguments, and a dry run on the real host."""

import argparse
import json
from pathlib import Path
from unittest.mock import Mock, call

import pytest

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup import command
from imud.cli.setup.command import numbered, sudo_user
from imud.cli.setup.hardware import Wanted
from tests.cli.conftest import Cli


def test_names_with_a_rate() -> None:
    assert (numbered("can0=500000"), numbered("/dev/ttyUSB0")) == (("can0", 500000), ("/dev/ttyUSB0", 0))
    for text in ["", "=5", "can0=", "can0=fast", "can0=0", "can0=-5"]:
        with pytest.raises(argparse.ArgumentTypeError, match="500000"):
            numbered(text)


def test_arguments_that_do_not_go_together(cli: Cli) -> None:
    for words, reason in [
        (["--json"], "add --yes or --dry-run"),
        (["--json", "--yes", "--undo"], "omit --undo"),
        (["--yes", "--can", "can0"], "expected the bit rate"),
        (["--yes", "--can", "can0=2000000"], "expected for example can0=500000"),
        (["--yes", "--can", "../x=500000"], "expected for example can0=500000"),
        (["--yes", "--i2c", "/dev/i2c-1"], "expected the number of a bus"),
    ]:
        cli.refuses(reason, "setup", *words)


def test_the_user_that_ran_sudo(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, user in [("ann", "ann"), ("root", ""), ("", "")]:
        monkeypatch.setenv("SUDO_USER", value)
        assert sudo_user() == user


def test_a_look_at_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    """The dry run uses a folder without ports. It opens nothing on the host."""
    real = Surroundings

    def elsewhere(file: Path, *arguments: object, **more: object) -> object:
        return real(file, *arguments, root=tmp_path, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(command, "Surroundings", elsewhere)
    words = ("setup", "--dry-run", "--json", "--socket", tmp_path / "none", "-c", "/etc/imud.yaml")
    said = json.loads(cli(*words, status=1).out)
    assert said == {"found": [], "changes": [], "made": False, "notes": [], "devices": []}
    assert list(tmp_path.iterdir()) == []


def test_options_have_an_effect(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Mock(set_up=Mock(return_value=1), undo=Mock(return_value=0))
    made = Mock(return_value=steps)
    monkeypatch.setattr(command, "SetupSteps", made)
    monkeypatch.setenv("SUDO_USER", "ann")
    ports = ("/dev/ttyS0", "--active", "/dev/ttyS1", "--rs485", "/dev/ttyS2=9600")
    places = (*ports, "--i2c", "1", "--spi", "/dev/spidev0.0")
    buses = (("i2c", "1"), ("spi", "/dev/spidev0.0"))
    wanted = Wanted(("/dev/ttyS0",), ("/dev/ttyS1",), (("/dev/ttyS2", 9600),), buses)
    more = ("--control", "--wait", "5", "--can", "can0=1000000")
    for words, can, options in [
        ((), [], {"control": False, "wait_s": 30.0}), (more, [("can0", 1_000_000)], {"control": True, "wait_s": 5.0}),
    ]:  # fmt: skip
        cli("setup", *places, "--yes", *words, status=1)
        assert made.call_args.args[1].asks is False
        assert (made.call_args.kwargs["dry_run"], made.call_args.kwargs["user"]) == (False, "ann")
        assert steps.set_up.call_args == call(wanted, can, **options)
    cli("setup", "--undo")
