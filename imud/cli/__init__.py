"""Command line `imud COMMAND`. imud imports only the module of the called command, which defines a `CliCommand`.

Exit status: 0 success, 1 the command ran and found a problem, 2 the command could not run.
"""

import argparse
import sys
from collections.abc import Collection, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from imud import __version__
from imud.cli.output import complain, discard_output, open_standard_streams
from imud.host.installation import documents, needs_extra
from imud.host.process_end import end_process
from imud.model.errors import ConfigError, DriverFailed, ImudError, reason_of

if TYPE_CHECKING:
    from imud.cli.arguments import CliCommand


class Subcommand(NamedTuple):
    """A row of the table of commands."""

    target: str  # `module:NAME` of the `CliCommand`
    help: str
    # Extra of the package with the libraries that the module imports; empty if the module needs no extra
    extra: str = ""

    def load(self) -> "CliCommand":
        """Import the module of the command and return the command. Raises BadArgument if the extra is missing."""
        path, _, name = self.target.partition(":")
        with needs_extra(self.extra):
            module = import_module(path)
        return cast("CliCommand", getattr(module, name))


COMMANDS = {
    "run": Subcommand("imud.cli.run:RUN", "run the daemon in the foreground"),
    "demo": Subcommand("imud.cli.demo:DEMO", "run the daemon with a simulated device and print samples"),
    "sim": Subcommand("imud.cli.sim:SIM", "simulate a device on a pseudo-terminal or a CAN interface"),
    "check": Subcommand("imud.cli.run:CHECK", "check a configuration file; do not open any port"),
    "probe": Subcommand("imud.cli.probe:PROBE", "list attached devices"),
    "setup": Subcommand(
        "imud.cli.setup.command:SETUP", "detect attached devices, write the configuration, start the service"
    ),
    "doctor": Subcommand("imud.cli.doctor.command:DOCTOR", "find problems and print the next steps"),
    "modbus": Subcommand("imud.cli.modbus:MODBUS", "find devices on an RS-485 bus and set their addresses"),
    "decode": Subcommand("imud.cli.decode:DECODE", "decode a capture to one JSON object per frame"),
    "replay": Subcommand("imud.cli.replay:REPLAY", "replay a recording or a capture"),
    "record": Subcommand("imud.cli.record:RECORD", "record the data of devices, or save a snapshot"),
    "info": Subcommand("imud.cli.record:INFO", "print the content of a recording and check the file"),
    "noise": Subcommand("imud.cli.analysis:NOISE", "measure the noise of a device at rest"),
    "spectrum": Subcommand("imud.cli.analysis:SPECTRUM", "print the vibration spectrum of a device or a file"),
    "export": Subcommand("imud.cli.export:EXPORT", "convert a recording or a capture to CSV or MCAP"),
    "devices": Subcommand("imud.cli.devices:DEVICES", "list the devices of the running daemon"),
    "status": Subcommand("imud.cli.status:STATUS", "print state, rate, clock and ledger of each device"),
    "top": Subcommand("imud.cli.top:TOP", "show all devices in a full-screen view of the terminal", extra="top"),
    "foxglove": Subcommand(
        "imud.cli.foxglove:FOXGLOVE", "serve samples, attitude, events and status to Foxglove and PlotJuggler"
    ),
    "web": Subcommand("imud.cli.web:WEB", "serve a web page that shows all devices"),
    "fleet": Subcommand("imud.cli.fleet:FLEET", "collect or show the data of all gateways of an MQTT broker"),
    "watch": Subcommand("imud.cli.watch:WATCH", "print samples"),
    "events": Subcommand("imud.cli.events:EVENTS", "print events"),
    "clock": Subcommand("imud.cli.clock:CLOCK", "print the source, error and limiting cause of the time stamps"),
    "command": Subcommand("imud.cli.devices:COMMAND", "list the commands of a device, or run one command"),
    "settings": Subcommand("imud.cli.settings:SETTINGS", "print, change, save, back up or restore device settings"),
    "calibrate": Subcommand("imud.cli.calibrate:CALIBRATE", "guide a calibration of a device"),
    "firmware": Subcommand(
        "imud.cli.firmware:FIRMWARE", "update the firmware of a device from a file of the vendor", extra="firmware"
    ),
    "schema": Subcommand("imud.cli.schema:SCHEMA", "list the fields of a sample with units and coordinate frames"),
}


class CommandParser(argparse.ArgumentParser):
    """Parser that rejects unknown arguments with the usage of its own command, not of `imud`."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[argparse.Namespace, list[str]]:  # type: ignore[override]
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


def build_parser(commands: Collection[str] = COMMANDS) -> argparse.ArgumentParser:
    """Build the parser of the command line. Only `commands` get their arguments; other modules are not imported."""
    parser = CommandParser(
        prog="imud", description="A daemon for inertial sensors.", epilog=f"Documents: {documents()}."
    )
    parser.add_argument("--version", action="version", version=f"imud {__version__}")
    parsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        description = command.help[:1].upper() + command.help[1:] + "."
        sub = parsers.add_parser(name, help=command.help, description=description)
        # importing the modules of all commands would slow down the start
        if name in commands:
            command.load().add_arguments(sub)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Print an expected error as one line to standard error.

    Without `argv`, the command is the process: threads of other packages do not keep it alive after its end.
    """
    status = _run(argv)
    if argv is None:
        end_process(status)
    return status


def _run(argv: Sequence[str] | None) -> int:
    # first: an argparse error also needs a usable standard error
    open_standard_streams()
    words = sys.argv[1:] if argv is None else argv
    # without a known command, argparse prints the help or the error
    name = words[0] if words and words[0] in COMMANDS else ""
    try:
        try:
            args = build_parser((name,)).parse_args(words)
            return COMMANDS[args.command].load().run(args)
        finally:
            # inside `try`: a full disk or a closed pipe often appears only here
            sys.stdout.flush()
    except BrokenPipeError:  # the reader closed the pipe, for example `imud watch | head`
        discard_output()
        return 0
    except DriverFailed as error:  # the command ran until the code of another package failed
        complain(f"imud {name}: {error}")
        return 1
    except ConfigError as error:  # each line starts with file:line:column, for editors and scripts
        complain(str(error))
    except ImudError as error:
        complain(f"imud {name}: {error}")
    except OSError as error:
        discard_output()
        place = f"{error.filename or 'standard output'}: " if error.errno is not None else ""
        complain(f"imud {name}: {place}{reason_of(error)}")
    except KeyboardInterrupt:
        return 130  # 128 + SIGINT, as in a shell
    return 2
