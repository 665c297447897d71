"""What the commands that ask a running daemon share: the socket option, the connection, the status."""

import argparse

import msgspec

from imud.client import Client
from imud.client.connection import default_path
from imud.contracts.status import DeviceStatus


def add_socket(parser: argparse.ArgumentParser) -> None:
    """`--socket PATH`, with the environment variable IMUD_SOCKET as its default."""
    parser.add_argument(
        "--socket",
        default=default_path(),
        metavar="PATH",
        help="the daemon's socket (default: $IMUD_SOCKET or %(default)s)",
    )


def connect(args: argparse.Namespace) -> Client:
    """A connection to the daemon. Raises LinkMissing, LinkDenied, ServerError with what to look at."""
    return Client(args.socket)


def statuses(client: Client) -> list[DeviceStatus]:
    """The state of every device."""
    return msgspec.convert(client.status()["devices"], list[DeviceStatus])
