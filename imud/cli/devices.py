"""`imud devices`: one line per device of the running daemon; `imud command`: list and carry out actions of one."""

import argparse
from typing import Final

import msgspec

from imud.cli.arguments import CliCommand, add_socket, argument, confirmed, connect, statuses
from imud.cli.output import table
from imud.client.connection import Client
from imud.contracts.command import ActionInfo

HEAD: Final = ("DEVICE", "STATE", "RATE HZ", "DRIVER", "PRODUCT", "SERIAL NUMBER", "LINK")
LIMIT_S: Final = 180.0
"""The longest action, a calibration with its status asked again and again, ends within two minutes."""


def devices_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud devices`."""
    add_socket(parser)


def devices(args: argparse.Namespace) -> int:
    """Print the table; 1 when no device is running."""
    with connect(args) as client:
        found = statuses(client)
    rows = [
        (
            d.name,
            d.state,
            d.rate_hz,
            d.driver,
            d.identity.get("product", "-"),
            d.identity.get("serial_number", "-"),
            d.link,
        )
        for d in found
    ]
    print(table(HEAD, rows))
    return 0 if any(d.state == "running" for d in found) else 1


def command_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud command`."""
    add_socket(parser)
    parser.add_argument("device", metavar="DEVICE")
    parser.add_argument("name", nargs="?", metavar="ACTION", help="without it: list the actions of the device")
    parser.add_argument("arguments", nargs="*", default=[], metavar="NAME=VALUE", help="as the list says")
    parser.add_argument("--yes", action="store_true", help="do not ask before an action that cannot be taken back")


def command(args: argparse.Namespace) -> int:
    """Print the list or the answer. All but the list needs permission to control."""
    with Client(args.socket, timeout_s=LIMIT_S) as client:
        known = msgspec.convert(client.call("actions", device=args.device), list[ActionInfo])
        if args.name is None:
            for action in known:
                print("\n".join([f"{action.name:24} {action.help}", *(f"{'':24}   {p}" for p in action.parameters)]))
            return 0
        arguments = dict(map(argument, args.arguments))
        risk = next((action.risk for action in known if action.name == args.name), "")
        if risk and not confirmed(f"{args.name} on {args.device}", risk, yes=args.yes):
            return 1
        answer = client.call("command", device=args.device, name=args.name, arguments=arguments)
    print(msgspec.json.encode(answer).decode() if answer is not None else "done")
    return 0


DEVICES = CliCommand(devices_arguments, devices)
COMMAND = CliCommand(command_arguments, command)
