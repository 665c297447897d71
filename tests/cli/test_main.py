"""All commands: help texts, and one line per error. `imud schema`: fields of a sample, conventions of the drivers."""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from unittest import mock

import pytest

import imud.cli
from imud import __version__
from imud.cli import COMMANDS, build_parser
from imud.cli.arguments import CliCommand
from imud.cli.schema import driver_schemas
from imud.drivers import DRIVERS
from imud.model.sample import SAMPLE_FIELDS
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
    assert (len(loaded), written) == (len(set(loaded)), set(loaded))


def test_version_and_usage_without_a_command(cli: Cli) -> None:
    cli.refuses("usage: imud ")
    assert cli("--version").out == f"imud {__version__}\n"


ARGUMENTS = """\
schema: json; doctor: config json; info F: file=F json; status: device json; probe: active json port
clock: device duration json; record: device duration file snapshot; command B: arguments device=B name yes
calibrate B: device=B json kind save stop yes; events: count device follow json priority=debug since
web: address=127.0.0.1 host port=9322 reading token_file; demo: bus device duration interface plain port rate=100.0
replay F: baud driver file=F fresh interface json option speed
watch: convention count device fields follow format=table latency rate
settings B: apply backup device=B json restore save set verbose yaml yes
decode --driver hipnuc-uart F: driver=hipnuc-uart file=F interface option
noise B: baud device driver duration input=B interface json option output sheet skip
modbus scan P: action=scan addresses=range(1, 248) baud=115200 json port=P reply_ms=20
foxglove: address=127.0.0.1 allow_origin device host noise open port=8765 rate=100.0 schema=ros2
setup: active can config=/etc/imud.yaml control dry_run i2c json place rs485 spi undo wait=30.0 yes
spectrum B: bands baud device driver duration input=B interface json option output resolution sensor skip
modbus assign P --from 2: action=assign address=2 baud=115200 id json no_save port=P random reply_ms=20 serial
export --to csv F: baud convention device driver fields file=F force interface noise option output schema table to=csv
"""  # arguments of each command, with the defaults that are not empty


@pytest.mark.parametrize("line", ARGUMENTS.strip().replace("; ", "\n").splitlines())
def test_arguments_and_their_defaults(line: str) -> None:
    words, _, expected = line.partition(": ")
    parsed = vars(build_parser(words.split()[:1]).parse_args(words.split()))
    shown = [name + (f"={parsed[name]}" if parsed[name] else "") for name in sorted(parsed)]
    assert " ".join(one for one in shown if one.partition("=")[0] not in ("command", "parser", "socket")) == expected


def test_no_daemon_a_daemon_that_hangs_and_an_interrupt(tmp_path: Path, cli: Cli) -> None:
    for command in ("devices", "status", "watch", "events", "clock", "record"):
        error = cli(command, "--socket", tmp_path / "none", status=2).err
        assert error.count("\n") == 1, error
        assert error.startswith(f"imud {command}: no daemon at {tmp_path}/none: is imud running?")
    words, hang = ("status", "--socket", "/run/x.sock"), TimeoutError("/run/x.sock: waited in vain for hello")
    for failure, status, said in [(hang, 2, f"imud status: {hang}\n"), (KeyboardInterrupt, 130, "")]:
        with mock.patch("imud.client.connection.Client", side_effect=failure):
            assert cli(*words, status=status).err == said


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


def test_schema_has_every_field_and_every_driver(cli: Cli) -> None:
    text = cli("schema").out
    for word in ("accel_m_s2", "m/s²", "gyro_rad_s", "rad/s", "hipnuc-uart", "ENU"):
        assert word in text
    row = next(line for line in text.splitlines() if "magnetic disturbance" in line)
    assert row.split()[:2] == ["hipnuc-uart", "4"]
    found = json.loads(cli("schema", "--json").out)
    assert tuple(field["name"] for field in found["fields"]) == SAMPLE_FIELDS
    assert found["drivers"].keys() == DRIVERS.keys() == driver_schemas().keys()
    assert found["drivers"]["hipnuc-uart"]["navigation_frame"] == "ENU"
    assert found["drivers"]["hipnuc-uart"]["status_bits"]["3"] == "gyroscope bias not converged"
