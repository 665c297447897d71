"""What the commands that ask a running daemon share: the socket option and the connection."""

import argparse
import os

from imud.client import Client

DEFAULT_SOCKET = "/run/imud/imud.sock"


def add_socket(parser: argparse.ArgumentParser) -> None:
    """`--socket PATH`, with the environment variable IMUD_SOCKET as its default."""
    parser.add_argument(
        "--socket",
        default=os.environ.get("IMUD_SOCKET", DEFAULT_SOCKET),
        metavar="PATH",
        help="the daemon's socket (default: $IMUD_SOCKET or %(default)s)",
    )


def connect(args: argparse.Namespace) -> Client:
    """A connection to the daemon. Raises LinkMissing, LinkDenied, ServerError with what to look at."""
    return Client(args.socket)
