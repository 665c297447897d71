"""The command line, `imud COMMAND`. Each command is a `CliCommand` in its module, imported when it is called.

Exit status: 0 done, 1 it ran and the answer is no, 2 it could not run.
"""

import argparse
import sys
from collections.abc import Collection, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, cast

from imud import __version__
from imud.cli.output import complain, discard_output, open_standard_streams
from imud.model.errors import BadArgument, ConfigError, ImudError, reason_of

if TYPE_CHECKING:
    from imud.cli.arguments import CliCommand


class Subcommand(NamedTuple):
    """A row of the table of commands."""

    target: str
    """`module:NAME` of its `CliCommand`."""
    help: str
    extra: str = ""
    """Extra of the package whose libraries the module imports."""

    def load(self) -> "CliCommand":
        """Import the module of the command. Raises BadArgument if a library of the extra is missing."""
        module, _, name = self.target.partition(":")
        try:
            return cast("CliCommand", getattr(import_module(module), name))
        except ModuleNotFoundError as error:
            if not self.extra:
                raise
            raise BadArgument(f"it needs {error.name}: pip install 'imud[{self.extra}]'") from None


COMMANDS = {
    "run": Subcommand("imud.cli.run:RUN", "own the configured devices and serve their samples"),
    "demo": Subcommand("imud.cli.demo:DEMO", "run the daemon on a simulated sensor and show what it does"),
    "check": Subcommand("imud.cli.run:CHECK", "check a configuration file without opening any port"),
    "probe": Subcommand("imud.cli.probe:PROBE", "list what is attached"),
    "setup": Subcommand(
        "imud.cli.setup.command:SETUP", "find what is attached, configure it, start the service; or take that back"
    ),
    "doctor": Subcommand("imud.cli.doctor.command:DOCTOR", "look for what is wrong, and say what to do next"),
    "modbus": Subcommand("imud.cli.modbus:MODBUS", "find modules on an RS-485 line and give them addresses"),
    "decode": Subcommand("imud.cli.decode:DECODE", "raw capture in, one JSON object per message out"),
    "replay": Subcommand("imud.cli.replay:REPLAY", "run a recording or a capture through the daemon's whole path"),
    "record": Subcommand("imud.cli.record:RECORD", "record what devices deliver, or save the last minutes"),
    "info": Subcommand("imud.cli.record:INFO", "say what is in a recording, and whether it is whole"),
    "noise": Subcommand("imud.cli.analysis:NOISE", "judge the noise of a sensor that lies still"),
    "spectrum": Subcommand("imud.cli.analysis:SPECTRUM", "show vibration by frequency, live or of a file"),
    "export": Subcommand("imud.cli.export:EXPORT", "write a recording or a capture as CSV or MCAP"),
    "devices": Subcommand("imud.cli.devices:DEVICES", "list the devices of the running daemon"),
    "status": Subcommand("imud.cli.status:STATUS", "show state, rate, clock and ledger of each device"),
    "top": Subcommand("imud.cli.top:TOP", "watch all devices in the terminal, redrawn in place", "top"),
    "foxglove": Subcommand(
        "imud.cli.foxglove:FOXGLOVE", "serve samples, attitude, events and status to Foxglove and PlotJuggler"
    ),
    "web": Subcommand("imud.cli.web:WEB", "show all devices in a browser, live"),
    "fleet": Subcommand("imud.cli.fleet:FLEET", "collect or show what gateways send to an MQTT broker"),
    "watch": Subcommand("imud.cli.watch:WATCH", "print samples as they come"),
    "events": Subcommand("imud.cli.events:EVENTS", "print events as they come"),
    "clock": Subcommand(
        "imud.cli.clock:CLOCK", "show where time stamps come from, how good they are, and what limits them"
    ),
    "command": Subcommand("imud.cli.devices:COMMAND", "list the actions of a device, or carry one out"),
    "settings": Subcommand("imud.cli.settings:SETTINGS", "show, set, save or restore a device's own settings"),
    "calibrate": Subcommand("imud.cli.calibrate:CALIBRATE", "calibrate a device, guided step by step"),
    "schema": Subcommand("imud.cli.schema:SCHEMA", "list the fields of a sample with units and frames"),
}


def build_parser(commands: Collection[str] = COMMANDS) -> argparse.ArgumentParser:
    """Build the parser of the command line, with the arguments of these commands; it imports no other."""
    parser = argparse.ArgumentParser(prog="imud", description="A daemon for inertial sensors.")
    parser.add_argument("--version", action="version", version=f"imud {__version__}")
    parsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        description = command.help[:1].upper() + command.help[1:] + "."
        sub = parsers.add_parser(name, help=command.help, description=description)
        if name in commands:
            command.load().add_arguments(sub)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Expected errors are one line on standard error."""
    open_standard_streams()
    words = sys.argv[1:] if argv is None else argv
    name = words[0] if words and words[0] in COMMANDS else ""
    try:
        try:
            args = build_parser((name,)).parse_args(words)
            return COMMANDS[args.command].load().run(args)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has gone, as with `imud watch | head`
        discard_output()
        return 0
    except ConfigError as error:  # each line begins with its place in the file, for editors and scripts
        complain(str(error))
    except ImudError as error:
        complain(f"imud {name}: {error}")
    except OSError as error:
        discard_output()
        place = f"{error.filename or 'standard output'}: " if error.errno is not None else ""
        complain(f"imud {name}: {place}{reason_of(error)}")
    except KeyboardInterrupt:
        return 130
    return 2
