"""`imud foxglove`: WebSocket server for Foxglove, Lichtblick and PlotJuggler. The server is a client of the daemon."""

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
from imud.host.installation import needs_extra
from imud.model.errors import BadArgument
from imud.web.guard import is_loopback

ADDRESS: Final = "127.0.0.1"
PORT: Final = 8765  # default port of Foxglove WebSocket servers
RATE_HZ: Final = 100.0  # Default maximum rate per device, Hz. A viewer draws 60 pictures per second.
DIALECTS: Final[dict[str, Callable[[], Dialect]]] = {"ros2": Ros2Dialect, "json": JsonDialect}
SCHEMA: Final = "ros2"  # Default schema. PlotJuggler ignores all channels except CDR with a definition of ROS 2 or IDL.
OPEN: Final = (
    "WARNING: {address} is not a loopback address: every user who can reach port {port} can read all samples, events "
    "and device states; the server uses no password and no encryption"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "--address", default=ADDRESS, metavar="ADDRESS",
        help="address to listen on (default: %(default)s, reachable from this host only); other addresses need --open",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=PORT, metavar="N", help="port to listen on (default: %(default)s; 0: a free port)"
    )
    parser.add_argument(
        "--open", action="store_true",
        help="allow every user who can reach --address to read, without password and encryption",
    )  # fmt: skip
    parser.add_argument(
        "--host", action="append", default=[], metavar="NAME",
        help="additional host name of this server; IP addresses and localhost are always accepted",
    )  # fmt: skip
    parser.add_argument(
        "--allow-origin", action="append", default=[], metavar="SITE",
        help="additional web site with a viewer, for example https://viewer.example; app.foxglove.dev, pages of this "
        "host, and desktop viewers are always accepted",
    )  # fmt: skip
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME",
        help="serve this device only; repeat for more devices (default: all devices)",
    )  # fmt: skip
    parser.add_argument(
        "--rate", type=float, default=RATE_HZ, metavar="HZ",
        help="maximum samples per second of each device; 0: every sample (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--schema", choices=list(DIALECTS), default=SCHEMA,
        help="message format: ros2 (CDR, for all viewers) or json (not for PlotJuggler) (default: %(default)s)",
    )  # fmt: skip
    add_noise(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM. Raises BadArgument, ServerError."""
    check_port(args.port)
    if not args.rate >= 0:  # also refuses NaN
        raise BadArgument(f"--rate: expected samples per second, or 0 for every sample, got {args.rate}")
    noise = noise_by_device(args.noise)
    if not (args.open or is_loopback(args.address)):
        raise BadArgument(
            f"--address {args.address}: other hosts can reach this address without a password; add --open, or omit "
            f"--address and use a tunnel: ssh -L {PORT}:127.0.0.1:{PORT} GATEWAY"
        )
    with needs_extra("foxglove"):
        from imud.web.foxglove import FoxgloveServer, Relay, ViewerOrigins
    origins = ViewerOrigins(names=args.host, origins=args.allow_origin)
    server = FoxgloveServer(args.address, args.port, origins, note=lambda text: complain(f"imud foxglove: {text}"))
    with closing(server):
        if not is_loopback(args.address):
            complain(OPEN.format(address=args.address, port=server.url.rpartition(":")[2]))
        complain(f"imud foxglove: open {server.url} in Foxglove, Lichtblick or PlotJuggler; stop with Ctrl-C")
        dialect = DIALECTS[args.schema]()
        relay = Relay(args.socket, server, dialect, devices=args.device, rate_hz=args.rate or None, noise=noise)
        signal.signal(signal.SIGTERM, lambda *_: relay.stop())
        relay.run()
    return 0


FOXGLOVE = CliCommand(add_arguments, run)
