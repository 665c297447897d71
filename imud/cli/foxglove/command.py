"""`imud foxglove`: a WebSocket server for Foxglove, Lichtblick and PlotJuggler, which is a client of the daemon."""

import argparse
import signal
from contextlib import closing
from ipaddress import ip_address
from typing import Final

from imud.cli.arguments import CliCommand, add_noise, add_socket, noise_by_device
from imud.cli.foxglove.relay import Relay
from imud.cli.streams import complain
from imud.errors import BadArgument

HOST: Final = "127.0.0.1"
PORT: Final = 8765
"""Where viewers look first."""
PORT_MAX: Final = 65535
RATE_HZ: Final = 100.0
"""Samples a second of each device: smooth on any screen; a viewer draws 60 pictures a second."""
OPEN: Final = (
    "WARNING: {host} is not a loopback address: everybody who reaches port {port} can read all samples, events and "
    "states; there is no password and no encryption. To read from another machine: ssh -L {port}:127.0.0.1:{port}"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud foxglove`."""
    add_socket(parser)
    parser.add_argument("--host", default=HOST, help="address to listen on (default: %(default)s, this machine only)")
    parser.add_argument("--port", type=int, default=PORT, help="port of it (default: %(default)s; 0: a free one)")
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME", help="only this one; may be given several times"
    )
    parser.add_argument(
        "--rate", type=float, default=RATE_HZ, metavar="HZ",
        help="at most this many samples a second of each device; 0: all (default: %(default)g)",
    )  # fmt: skip
    add_noise(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM. Raises BadArgument, ServerError."""
    if not 0 <= args.port <= PORT_MAX:
        raise BadArgument(f"--port: expected 0 to {PORT_MAX}, got {args.port}")
    if not args.rate >= 0:
        raise BadArgument(f"--rate: expected samples a second, 0 for all, got {args.rate}")
    noise = noise_by_device(args.noise)
    try:
        from imud.cli.foxglove.server import FoxgloveServer
    except ModuleNotFoundError as error:
        raise BadArgument(f"imud foxglove: it needs {error.name}: pip install 'imud[foxglove]'") from None
    with closing(FoxgloveServer(args.host, args.port, note=lambda text: complain(f"imud foxglove: {text}"))) as server:
        if not is_loopback(args.host):
            complain(OPEN.format(host=args.host, port=args.port))
        complain(f"imud foxglove: open {server.url} in Foxglove, Lichtblick or PlotJuggler; Ctrl-C ends")
        relay = Relay(args.socket, server, devices=args.device, rate_hz=args.rate or None, noise=noise)
        signal.signal(signal.SIGTERM, lambda *_: relay.stop())
        relay.run()
    return 0


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach the address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


FOXGLOVE = CliCommand(add_arguments, run)
