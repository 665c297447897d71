"""`imud setup`: detect attached devices, configure imud, start the service. `--undo` restores the previous state."""

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

COMMAND_LIMIT_S: Final = 330.0  # Time limit of a command, s. Longer than the start limit of the unit on a slow board.
WAIT_S: Final = 30.0  # Default wait for samples, s. Detection takes 2 s on a fast host, more on a slow board.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "place", nargs="*", metavar="PORT",
        help="check these ports and CAN interfaces only (default: all unused ports); imud removes a console from a "
        "named port",
    )  # fmt: skip
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE",
        help="configuration file (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--yes", action="store_true", help="make all proposed changes without questions")
    parser.add_argument("--dry-run", action="store_true", help="print the changes, change nothing")
    parser.add_argument("--undo", action="store_true", help="undo all changes of earlier runs of imud setup")
    parser.add_argument(
        "--active", action="append", default=[], metavar="PORT", help="port or CAN interface to send requests to"
    )
    parser.add_argument(
        "--can", action="append", default=[], type=numbered, metavar="NAME=BITRATE",
        help="bring a CAN interface up with this bit rate, now and at every boot",
    )  # fmt: skip
    parser.add_argument(
        "--rs485", action="append", default=[], type=numbered, metavar="PORT[=BAUD]",
        help="send requests to Modbus devices on the RS-485 bus at this port",
    )  # fmt: skip
    parser.add_argument(
        "--i2c", action="append", default=[], metavar="BUS",
        help="send requests on an I2C bus, for example 1 for /dev/i2c-1",
    )  # fmt: skip
    parser.add_argument(
        "--spi", action="append", default=[], metavar="PORT", help="send requests on SPI, for example /dev/spidev0.0"
    )
    parser.add_argument(
        "--control", action="store_true", help="allow the user of sudo to change device settings (group imud-control)"
    )
    parser.add_argument(
        "--wait", type=finite, default=WAIT_S, metavar="S", help="maximum wait for samples (default: %(default)g s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, with --yes or --dry-run")


def numbered(text: str) -> tuple[str, int]:
    """Parse `NAME=NUMBER`. Return 0 if the number is missing. Raises ArgumentTypeError."""
    name, sign, number = text.partition("=")
    if not name or (sign and not (number.isdecimal() and int(number) > 0)):
        raise argparse.ArgumentTypeError(
            f"expected a name, or a name with a rate in bit/s, for example {name or 'can0'}=500000, got {text!r}"
        )
    return name, int(number or 0)


def check(args: argparse.Namespace) -> None:
    """Raise BadArgument for arguments that exclude each other."""
    if args.json and not (args.yes or args.dry_run):
        raise BadArgument("--json: add --yes or --dry-run, because imud setup otherwise asks questions")
    if args.json and args.undo:
        raise BadArgument("--json: omit --undo, which prints text only")
    for bus in args.i2c:
        if not bus.isdecimal():
            raise BadArgument(f"--i2c: expected the number of a bus, for example 1 for /dev/i2c-1, got {bus!r}")
    for name, bitrate in args.can:
        if bitrate > BITRATE_MAX or "/" in name:
            raise BadArgument(f"--can: expected for example can0={BITRATE_DEFAULT}, got {name}={bitrate}")
        # imud cannot ask for the bit rate
        if not bitrate and (args.yes or args.dry_run):
            raise BadArgument(f"--can {name}: expected the bit rate of the bus, for example {name}={BITRATE_DEFAULT}")


def run(args: argparse.Namespace) -> int:
    """Set up, or undo. Return 0 if all devices send samples, or if all changes are undone."""
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
        sys.stdout.write(steps.as_json() + "\n")
    return status


def sudo_user() -> str:
    """Return the user of sudo; empty for root."""
    user = os.environ.get("SUDO_USER", "")
    return "" if user == "root" else user


SETUP = CliCommand(add_arguments, run)
