"""`imud foxglove`: a WebSocket server for Foxglove, Lichtblick and PlotJuggler, which is a client of the daemon."""

import argparse
import signal
from collections.abc import Callable
from contextlib import closing
from typing import Final

from imud.bridges.channel import Dialect
from imud.bridges.json import JsonDialect
from imud.bridges.ros2 import Ros2Dialect
from imud.cli.arguments import CliCommand, add_noise, add_socket, check_port, noise_by_device
from imud.cli.output import complain
from imud.model.errors import BadArgument
from imud.web.foxglove import Relay, ViewerOrigins
from imud.web.guard import is_loopback

ADDRESS: Final = "127.0.0.1"
PORT: Final = 8765
"""Where viewers look first."""
RATE_HZ: Final = 100.0
"""Samples a second of each device: smooth on any screen; a viewer draws 60 pictures a second."""
DIALECTS: Final[dict[str, Callable[[], Dialect]]] = {"ros2": Ros2Dialect, "json": JsonDialect}
SCHEMA: Final = "ros2"
"""PlotJuggler passes over every channel that is not CDR with a definition of ROS 2 or IDL."""
OPEN: Final = (
    "WARNING: {address} is not a loopback address: everybody who reaches port {port} can read all samples, events and "
    "states; there is no password and no encryption"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud foxglove`."""
    add_socket(parser)
    parser.add_argument(
        "--address", default=ADDRESS, metavar="ADDRESS",
        help="listen here (default: %(default)s, which only this machine reaches); another one needs --open",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=PORT, metavar="N", help="listen there (default: %(default)s; 0: any)"
    )
    parser.add_argument(
        "--open", action="store_true",
        help="let everybody who reaches --address read, without a password and without encryption",
    )  # fmt: skip
    parser.add_argument(
        "--host", action="append", default=[], metavar="NAME",
        help="a further name under which viewers may ask for this host; IP addresses and localhost are known",
    )  # fmt: skip
    parser.add_argument(
        "--allow-origin", action="append", default=[], metavar="SITE",
        help="pages of this site in a browser may read too, as https://viewer.example; those of app.foxglove.dev "
        "and of this machine may, and the viewers that are programs",
    )  # fmt: skip
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME", help="only this one; may be given several times"
    )
    parser.add_argument(
        "--rate", type=float, default=RATE_HZ, metavar="HZ",
        help="at most this many samples a second of each device; 0: all (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--schema", choices=list(DIALECTS), default=SCHEMA,
        help="messages: of ROS 2 in CDR, which all viewers read, or JSON, which PlotJuggler does not read "
        "(default: %(default)s)",
    )  # fmt: skip
    add_noise(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM. Raises BadArgument, ServerError."""
    check_port(args.port)
    if not args.rate >= 0:
        raise BadArgument(f"--rate: expected samples a second, 0 for all, got {args.rate}")
    noise = noise_by_device(args.noise)
    if not (args.open or is_loopback(args.address)):
        raise BadArgument(
            f"--address {args.address} can be reached from other machines, and there is no password: expected "
            f"--open as well, or no --address, and a tunnel: ssh -L {PORT}:127.0.0.1:{PORT} GATEWAY"
        )
    origins = ViewerOrigins(names=args.host, origins=args.allow_origin)
    try:
        from imud.web.foxglove import FoxgloveServer
    except ModuleNotFoundError as error:
        raise BadArgument(f"it needs {error.name}: pip install 'imud[foxglove]'") from None
    server = FoxgloveServer(args.address, args.port, origins, note=lambda text: complain(f"imud foxglove: {text}"))
    with closing(server):
        if not is_loopback(args.address):
            complain(OPEN.format(address=args.address, port=server.url.rpartition(":")[2]))
        complain(f"imud foxglove: open {server.url} in Foxglove, Lichtblick or PlotJuggler; Ctrl-C ends")
        dialect = DIALECTS[args.schema]()
        relay = Relay(args.socket, server, dialect, devices=args.device, rate_hz=args.rate or None, noise=noise)
        signal.signal(signal.SIGTERM, lambda *_: relay.stop())
        relay.run()
    return 0


FOXGLOVE = CliCommand(add_arguments, run)
