"""`imud devices`: list the devices of the running daemon. `imud command`: list or run the commands of a device."""

import argparse
from typing import Any, Final

from imud.cli.arguments import CliCommand, add_socket, confirmed, connect, named_values, statuses
from imud.cli.output import table, terminal_width
from imud.client.connection import Client, decoded
from imud.contracts.command import VerbInfo
from imud.contracts.condition import Condition
from imud.host.log import printable_json

HEAD: Final = ("DEVICE", "CONDITION", "RATE HZ", "DRIVER", "PRODUCT", "SERIAL NUMBER", "LINK")
LIMIT_S: Final = 180.0  # Time limit of a command, s. The longest command, a calibration, ends within two minutes.


def devices_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)


def devices(args: argparse.Namespace) -> int:
    """Print one line per device. Return 1 if all devices are missing, otherwise 0."""
    with connect(args) as client:
        found = statuses(client)
    identity = ("product", "serial_number")
    rows = [
        (d.name, d.word, d.rate_hz, d.driver, *(d.identity.get(name, "-") for name in identity), d.link) for d in found
    ]
    print(table(HEAD, rows, terminal_width()))
    return 0 if any(d.word != Condition.MISSING for d in found) else 1


def command_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", metavar="DEVICE", help="name of the device")
    parser.add_argument("name", nargs="?", metavar="COMMAND", help="command to run (default: list all commands)")
    parser.add_argument(
        "arguments", nargs="*", default=[], metavar="NAME=VALUE", help="argument of the command, as in the list"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask before a command that cannot be undone")


def command(args: argparse.Namespace) -> int:
    """Print the list of verbs, or run a verb and print its reply. A verb requires the right to control."""
    with Client(args.socket, timeout_s=LIMIT_S) as client:
        known = decoded(client.call("actions", device=args.device), list[VerbInfo], "actions")
        if args.name is None:
            for verb in known:
                print("\n".join([f"{verb.name:24} {verb.help}", *(f"{'':24}   {p}" for p in verb.parameters)]))
            return 0
        arguments = named_values(args.arguments)
        risk = next((verb.risk for verb in known if verb.name == args.name), "")
        if risk and not confirmed(f"{args.name} on {args.device}", risk, yes=args.yes):
            return 1
        answer = client.call("command", device=args.device, name=args.name, arguments=arguments)
    print(_verb_words(answer))
    # also 1 if the device has ignored the command
    return 1 if isinstance(answer, dict) and answer.get("failed") else 0


def _verb_words(answer: Any) -> str:
    """Format the result of a verb: evidence for its effect, and its values."""
    if not isinstance(answer, dict) or not {"verified", "evidence"} <= answer.keys():
        return printable_json(answer) if answer is not None else "done"
    lines = [f"{'verified' if answer['verified'] else 'sent, not verified'}: {answer['evidence']}"]
    lines += [] if answer["result"] is None else [printable_json(answer["result"])]
    return "\n".join([*lines, *filter(None, [answer["not_saved"]])])


DEVICES = CliCommand(devices_arguments, devices)
COMMAND = CliCommand(command_arguments, command)
