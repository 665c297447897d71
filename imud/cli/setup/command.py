"""`imud setup`: find what is attached, tell what would change, change it, wait for samples; `--undo` goes back."""

import argparse
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final

from imud.cli.arguments import CliCommand, add_socket, finite
from imud.cli.doctor.surroundings import Surroundings, ask_daemon, run_command
from imud.cli.run import DEFAULT_FILE
from imud.cli.setup.hardware import BITRATE_DEFAULT, BITRATE_MAX, FINDERS, Wanted
from imud.cli.setup.steps import Conversation, SetupSteps
from imud.model.errors import BadArgument

COMMAND_LIMIT_S: Final = 330.0
"""Longer than the unit's own limit for a start, on a slow board."""
WAIT_S: Final = 30.0
"""Searching all rates of a port takes two seconds; a slow board gets more."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud setup`."""
    add_socket(parser)
    parser.add_argument(
        "place", nargs="*", metavar="PORT",
        help="look only at these ports and CAN interfaces (default: all that nobody uses); a console is taken off a "
        "port that is named",
    )  # fmt: skip
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE", help="configuration (default: %(default)s)"
    )
    parser.add_argument("--yes", action="store_true", help="ask nothing, make all changes that are proposed")
    parser.add_argument("--dry-run", action="store_true", help="only tell what would be changed")
    parser.add_argument("--undo", action="store_true", help="take back all changes that imud setup has made")
    parser.add_argument("--active", action="append", default=[], metavar="PORT", help="one that may be sent queries")
    parser.add_argument(
        "--can", action="append", default=[], type=numbered, metavar="NAME=BITRATE",
        help="bring a CAN interface up, now and at every start",
    )  # fmt: skip
    parser.add_argument(
        "--rs485", action="append", default=[], type=numbered, metavar="PORT[=BAUD]",
        help="ask for Modbus modules on the RS-485 line at this port",
    )  # fmt: skip
    parser.add_argument("--i2c", action="append", default=[], metavar="BUS", help="ask on an I2C bus: 1 for /dev/i2c-1")
    parser.add_argument("--spi", action="append", default=[], metavar="PORT", help="ask on SPI: /dev/spidev0.0")
    parser.add_argument(
        "--control", action="store_true", help="the user that runs sudo may also change settings of modules"
    )
    parser.add_argument(
        "--wait", type=finite, default=WAIT_S, metavar="S", help="longest wait for samples (default: %(default)g s)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object, with --yes or --dry-run")


def numbered(text: str) -> tuple[str, int]:
    """Parse `NAME=NUMBER`; 0 without a number. Raises ArgumentTypeError."""
    name, sign, number = text.partition("=")
    if not name or (sign and not (number.isdecimal() and int(number) > 0)):
        raise argparse.ArgumentTypeError(
            f"expected a name, or a name and a rate in bit/s as {name or 'can0'}=500000, got {text!r}"
        )
    return name, int(number or 0)


def check(args: argparse.Namespace) -> None:
    """Raises BadArgument for arguments that do not go together."""
    if args.json and not (args.yes or args.dry_run):
        raise BadArgument("--json: expected --yes or --dry-run beside it, since questions are asked on the terminal")
    if args.json and args.undo:
        raise BadArgument("--json: expected it without --undo, which has nothing to report but text")
    for bus in args.i2c:
        if not bus.isdecimal():
            raise BadArgument(f"--i2c: expected the number of a bus, 1 for /dev/i2c-1, got {bus!r}")
    for name, bitrate in args.can:
        if bitrate > BITRATE_MAX or "/" in name:
            raise BadArgument(f"--can: expected for example can0={BITRATE_DEFAULT}, got {name}={bitrate}")
        if not bitrate and (args.yes or args.dry_run):
            raise BadArgument(f"--can {name}: expected the bit rate of the bus, for example {name}={BITRATE_DEFAULT}")


def run(args: argparse.Namespace) -> int:
    """Set up, or take back; 0 when samples come, or nothing is left to take back."""
    check(args)
    talk = Conversation(ask=not args.yes and not args.dry_run, silent=args.json)
    steps = SetupSteps(
        lambda: Surroundings(
            args.config.absolute(), partial(ask_daemon, args.socket), run=partial(run_command, limit_s=COMMAND_LIMIT_S)
        ),
        talk, FINDERS, time.monotonic, time.sleep,
        dry_run=args.dry_run, user=sudo_user(), date=time.strftime("%Y-%m-%dT%H-%M-%S"),
    )  # fmt: skip
    if args.undo:
        return steps.undo()
    wanted = Wanted(
        tuple(args.place), tuple(args.active), tuple(args.rs485),
        (*(("i2c", bus) for bus in args.i2c), *(("spi", port) for port in args.spi)),
    )  # fmt: skip
    status = steps.set_up(wanted, args.can, control=args.control, wait_s=args.wait)
    if args.json:
        sys.stdout.write(steps.as_json().decode() + "\n")
    return status


def sudo_user() -> str:
    """The user that ran sudo; empty for root itself."""
    user = os.environ.get("SUDO_USER", "")
    return "" if user == "root" else user


SETUP = CliCommand(add_arguments, run)
