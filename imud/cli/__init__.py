"""The command line: `imud COMMAND`, one file per command, imported only when it is called.

Each command file has `add_arguments(parser)` and `run(args) -> int`; the returned number is the exit status:
0 done, 1 it ran and the answer is no, 2 it could not run.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NamedTuple, cast

from imud import __version__
from imud.errors import ImudError


class Subcommand(NamedTuple):
    """A row of the table of commands."""

    module: str
    help: str


COMMANDS = {
    "run": Subcommand("imud.cli.run", "own the configured devices and serve their samples"),
    "demo": Subcommand("imud.cli.demo", "run the daemon on a simulated sensor and show what it does"),
    "check": Subcommand("imud.cli.check", "check a configuration file without opening any port"),
    "probe": Subcommand("imud.cli.probe", "list what is attached"),
    "modbus": Subcommand("imud.cli.modbus", "find modules on an RS-485 line and give them addresses"),
    "decode": Subcommand("imud.cli.decode", "raw capture in, one JSON object per message out"),
    "replay": Subcommand("imud.cli.replay", "run a capture through the daemon's whole path"),
    "devices": Subcommand("imud.cli.devices", "list the devices of the running daemon"),
    "status": Subcommand("imud.cli.status", "show state, rate, clock and ledger of each device"),
    "watch": Subcommand("imud.cli.watch", "print samples as they come"),
    "clock": Subcommand("imud.cli.clock", "show where time stamps come from, how good they are, and what limits them"),
    "command": Subcommand("imud.cli.command", "list what a device can be told to do, or tell it"),
    "schema": Subcommand("imud.cli.schema", "list the fields of a sample with units and frames"),
}


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line; every command's arguments are loaded."""
    parser = argparse.ArgumentParser(prog="imud", description="A daemon for inertial sensors.")
    parser.add_argument("--version", action="version", version=f"imud {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        sub = commands.add_parser(name, help=command.help, description=command.help.capitalize() + ".")
        import_module(command.module).add_arguments(sub)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Expected errors are one line on standard error."""
    args = build_parser().parse_args(argv)
    run = cast(Callable[[argparse.Namespace], int], import_module(COMMANDS[args.command].module).run)
    try:
        return run(args)
    except ImudError as error:
        print(f"imud {args.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as with `imud watch | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still buffered has no reader
        return 0
