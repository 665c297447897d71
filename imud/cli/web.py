"""`imud web`: serve a web page that shows and controls the devices."""

import argparse
import asyncio
import signal
import socket
import sys
from time import monotonic_ns, thread_time_ns, time
from typing import TYPE_CHECKING, Final

from imud.cli.arguments import CliCommand, add_socket, check_port
from imud.host.installation import needs_extra
from imud.model.errors import BadArgument, LinkError, reason_of
from imud.web.budgets import WebClock
from imud.web.guard import WebGuard, is_loopback, read_token

if TYPE_CHECKING:
    from imud.web.server import WebServer

ADDRESS: Final = "127.0.0.1"
PORT: Final = 9322  # Default port. The metrics use port 9321.
STOP_S: Final = 3.0  # maximum wait for open pages at the end, s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "--address", default=ADDRESS, metavar="ADDRESS",
        help="address to listen on (default: %(default)s, reachable from this host only); other addresses need "
        "--token-file",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=PORT, metavar="N", help="port to listen on (default: %(default)s; 0: a free port)"
    )
    parser.add_argument(
        "--token-file", metavar="FILE",
        help="file with the token in its first line; a browser needs the token to change devices (default: the page "
        "cannot change devices)",
    )  # fmt: skip
    parser.add_argument(
        "--reading", choices=("open", "token"),
        help="token: a browser needs the token also to see the page (default: open on a loopback address, otherwise "
        "token)",
    )  # fmt: skip
    parser.add_argument(
        "--host", action="append", default=[], metavar="NAME",
        help="additional host name of the page; IP addresses and localhost are always accepted",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Serve the page until SIGINT or SIGTERM. Raises BadArgument for unsafe arguments or without the extra `web`."""
    check_port(args.port)
    guard = guard_of(args)
    with needs_extra("web"):
        from imud.web.server import WebServer
    clock = WebClock(monotonic_ns, thread_time_ns)
    asyncio.run(_serve(WebServer(args.socket, guard, clock), args))
    return 0


def guard_of(args: argparse.Namespace) -> WebGuard:
    """Return the access rules. Raises BadArgument for an address that other hosts can reach, without a token."""
    token = read_token(args.token_file) if args.token_file else b""
    local = is_loopback(args.address)
    if not token and not local:
        raise BadArgument(
            f"--address {args.address}: other hosts can reach this address; add --token-file FILE, or omit --address "
            "and use a tunnel: ssh -L 9322:127.0.0.1:9322 GATEWAY"
        )
    reading = args.reading or ("open" if local else "token")
    if reading == "token" and not token:
        raise BadArgument("--reading token: add --token-file FILE")
    return WebGuard(token, time, reading_needs_token=reading == "token", names=args.host)


async def _serve(server: "WebServer", args: argparse.Namespace) -> None:
    from aiohttp import web

    from imud.web.connections import LimitedSite
    from imud.web.server import server_log

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    # no log line per request
    runner = web.AppRunner(server.make_app(), access_log=None, logger=server_log(), shutdown_timeout=STOP_S)
    await runner.setup()
    try:
        site = LimitedSite(runner, args.address, args.port, server.connections)
        try:
            await site.start()
        except (OSError, socket.gaierror) as error:
            raise LinkError(f"cannot listen on {args.address} port {args.port}: {reason_of(error)}") from error
        _say(args, runner.addresses[0][1])
        await stopped.wait()
    finally:
        await runner.cleanup()


def _say(args: argparse.Namespace, port: int) -> None:
    """Print the address of the page and who can use the page."""
    host = f"[{args.address}]" if ":" in args.address else args.address
    print(f"http://{host}:{port}/", flush=True)
    if not args.token_file:
        print("the page cannot change devices, because --token-file is not set", flush=True)
    if not is_loopback(args.address):
        who = "every user of these networks" if args.reading == "open" else "every user with the token"
        print(
            f"OPEN: other hosts can reach {args.address} port {port}: {who} can see the page, and every user with the "
            "token can change devices. HTTP is not encrypted: on untrusted networks, use ssh -L or a proxy with TLS.",
            file=sys.stderr, flush=True,
        )  # fmt: skip


WEB = CliCommand(add_arguments, run)
