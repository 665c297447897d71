"""Every command is reachable, explains itself, and answers mistakes with one line."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pytest

import imud.cli
from imud import __version__
from imud.cli import COMMANDS, main
from imud.cli.arguments import CliCommand


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([command, "--help"])
    assert done.value.code == 0
    assert f"imud {command}" in capsys.readouterr().out


def test_the_table_has_every_command_of_every_module() -> None:
    """A command that is written and has no row, or a row that points at another command, is seen here."""
    modules = [import_module(name) for _, name, _ in walk_packages(imud.cli.__path__, "imud.cli.")]
    written = {id(value) for module in modules for value in vars(module).values() if isinstance(value, CliCommand)}
    loaded = [id(row.load()) for row in COMMANDS.values()]
    assert len(loaded) == len(set(loaded))
    assert written == set(loaded)


def test_a_command_imports_no_other() -> None:
    code = (
        "import sys; from imud.cli import main; main(['check', '/dev/null']); print('imud.cli.replay' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    assert done.stdout == "False\n"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"imud {__version__}\n"


@pytest.mark.parametrize("command", ["devices", "status", "watch", "events"])
def test_no_daemon_is_one_line(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--socket", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "is imud running?" in error


def test_a_daemon_that_hangs_is_named_and_not_standard_output(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imud.cli.arguments.Client", hang)
    assert main(["status", "--socket", "/run/x.sock"]) == 2
    assert capsys.readouterr().err == "imud status: /run/x.sock: waited in vain for hello\n"


def hang(path: str, **_more: object) -> None:
    """What a client does whose daemon is stopped, without the seconds of waiting."""
    raise TimeoutError(f"{path}: waited in vain for hello")


def test_reader_of_the_output_that_goes_away_is_no_error(tmp_path: Path) -> None:
    capture = tmp_path / "noise"
    capture.write_bytes(b"A\r\n" * 100_000)
    decode = f"{sys.executable} -m imud decode --driver hipnuc-uart {capture} 2>/dev/null"
    script = decode + " | head -n 1; echo ${PIPESTATUS[0]}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=30, check=True)
    first, status = done.stdout.splitlines()
    assert first == '{"text":"A"}'
    assert status == "0"


def test_help_of_all_imports_no_command() -> None:
    """The list of commands is there at once, whatever the commands need."""
    program = (
        "import sys\nfrom imud.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([name for name in sys.modules if name.startswith(('imud.c', 'imud.d')) and 'imud.cli' not in name])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "calibrate" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "foreign"),
    [(["--help"], set()), (["status", "--socket", "/nonexistent/socket"], {"msgspec", "typing_extensions"})],
    ids=["help", "status"],
)
def test_what_is_called_often_imports_nothing_heavy(arguments: list[str], foreign: set[str]) -> None:
    """Of other packages msgspec alone, and nothing of asyncio, TLS, HTTP or what drivers promise: each takes as long to
    import as the command needs (`make bench ARGS=start`)."""
    program = (
        "import sys\nbefore = set(sys.modules)\nfrom imud.cli import main\ntry:\n"
        f"    main({arguments!r})\nexcept SystemExit:\n    pass\nprint()\nprint(*sys.modules.keys() - before)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20, check=True)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "imud.cli" in loaded
    tops = {name.partition(".")[0] for name in loaded}
    assert tops - sys.stdlib_module_names - {"imud"} <= foreign
    assert not tops & {"asyncio", "ssl", "http", "email", "multiprocessing", "concurrent", "sqlite3", "unittest", "xml"}
    assert not loaded & {"imud.daemon", "imud.contracts.driver", "imud.contracts.session", "imud.devices", "imud.clock"}
