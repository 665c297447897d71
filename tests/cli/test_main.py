"""All commands: help texts, and one line per error."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pytest

import imud.cli
from imud import __version__
from imud.cli import COMMANDS
from imud.cli.arguments import CliCommand
from tests.cli.conftest import Cli
from tests.support.daemon_process import LIMIT_S


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, cli: Cli) -> None:
    assert f"usage: imud {command}" in cli(command, "--help").out


def test_the_table_has_every_command_of_every_module() -> None:
    """Find commands without a row, and rows with the wrong command."""
    modules = [import_module(name) for _, name, _ in walk_packages(imud.cli.__path__, "imud.cli.")]
    written = {id(value) for module in modules for value in vars(module).values() if isinstance(value, CliCommand)}
    loaded = [id(row.load()) for row in COMMANDS.values()]
    assert len(loaded) == len(set(loaded))
    assert written == set(loaded)


def test_without_a_command_the_usage_is_printed(cli: Cli) -> None:
    cli.refuses("usage: imud ")


def test_version(cli: Cli) -> None:
    assert cli("--version").out == f"imud {__version__}\n"


@pytest.mark.parametrize("command", ["devices", "status", "watch", "events", "clock", "record"])
def test_no_daemon_is_one_line(command: str, tmp_path: Path, cli: Cli) -> None:
    error = cli(command, "--socket", tmp_path / "none", status=2).err
    assert error.count("\n") == 1
    assert error.startswith(f"imud {command}: no daemon at {tmp_path}/none: is imud running?")


def hang(path: str, **_more: object) -> None:
    raise TimeoutError(f"{path}: waited in vain for hello")


def test_a_daemon_that_hangs_is_named_and_an_interrupt_is_status_130(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.cli.arguments.Client", hang)
    printed = cli("status", "--socket", "/run/x.sock", status=2)
    assert printed.err == "imud status: /run/x.sock: waited in vain for hello\n"

    def interrupted(*_arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("imud.cli.arguments.Client", interrupted)
    assert cli("status", "--socket", "/run/x.sock", status=130).err == ""


HEAVY = {"asyncio", "ssl", "http", "email", "multiprocessing", "concurrent", "sqlite3", "unittest", "xml"}
LAYERS = {"imud.daemon", "imud.contracts.driver", "imud.contracts.script", "imud.drivers", "imud.sampling"}
CALLS: dict[str, tuple[list[str], set[str]]] = {
    "help": (["--help"], set()),
    "status": (["status", "--socket", "/nonexistent/socket"], {"msgspec", "typing_extensions"}),
}


@pytest.mark.live
@pytest.mark.parametrize(("words", "foreign"), CALLS.values(), ids=CALLS)
def test_a_command_that_is_called_often_imports_little(words: list[str], foreign: set[str]) -> None:
    """Other imports would take as long as the command."""
    program = (
        "import sys\nbefore = set(sys.modules)\nfrom imud.cli import main\ntry:\n"
        f"    main({words!r})\nexcept SystemExit:\n    pass\nprint()\nprint(*sys.modules.keys() - before)"
    )
    argv = [sys.executable, "-c", program]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=True)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "imud.cli" in loaded
    tops = {name.partition(".")[0] for name in loaded}
    assert tops - sys.stdlib_module_names - {"imud"} <= foreign
    assert not tops & HEAVY
    assert not loaded & LAYERS
    assert "imud.cli.replay" not in loaded, "the module of another command"
    if words == ["--help"]:
        assert "calibrate" in done.stdout
        assert not [name for name in loaded if name.startswith(("imud.c", "imud.d")) and "imud.cli" not in name]
