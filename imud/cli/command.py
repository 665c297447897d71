"""`imud command`: what a device can be told to do, and telling it."""

import argparse

import msgspec

from imud.cli.connect import add_socket
from imud.client import Client
from imud.contracts.action import ActionInfo
from imud.errors import BadArgument

LIMIT_S = 180.0
"""The longest action, a calibration with its status asked again and again, ends within two minutes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud command`."""
    add_socket(parser)
    parser.add_argument("device", metavar="DEVICE")
    parser.add_argument("name", nargs="?", metavar="ACTION", help="left out: list what the device can be told")
    parser.add_argument("arguments", nargs="*", metavar="NAME=VALUE", help="as the list says")


def run(args: argparse.Namespace) -> int:
    """Print the list or the answer. Needs the control right for everything but the list."""
    with Client(args.socket, timeout_s=LIMIT_S) as client:
        if args.name is None:
            for action in msgspec.convert(client.call("actions", device=args.device), list[ActionInfo]):
                print("\n".join([f"{action.name:24} {action.help}", *(f"{'':24}   {p}" for p in action.parameters)]))
            return 0
        arguments = dict(map(argument, args.arguments))
        answer = client.call("command", device=args.device, name=args.name, arguments=arguments)
    print(msgspec.json.encode(answer).decode() if answer is not None else "done")
    return 0


def argument(text: str) -> tuple[str, object]:
    """`name=value`: numbers, true, false, null and lists as in JSON, everything else text. Raises BadArgument."""
    name, sign, value = text.partition("=")
    if not name or not sign:
        raise BadArgument(f"expected NAME=VALUE, got {text!r}")
    try:
        return name, msgspec.json.decode(value)
    except msgspec.DecodeError:
        return name, value
