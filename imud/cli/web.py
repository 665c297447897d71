"""`imud web`: show the devices in a browser."""

import argparse
import asyncio
import signal
import socket
import sys
from time import time
from typing import TYPE_CHECKING, Final

from imud.cli.arguments import CliCommand, add_socket, check_port
from imud.model.errors import BadArgument, LinkError, reason_of
from imud.web.guard import WebGuard, is_loopback, read_token

if TYPE_CHECKING:
    from aiohttp import web

ADDRESS: Final = "127.0.0.1"
PORT: Final = 9322
"""Beside that of the metrics."""
STOP_S: Final = 3.0
"""How long the end waits for pages that are open."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud web`."""
    add_socket(parser)
    parser.add_argument(
        "--address", default=ADDRESS, metavar="ADDRESS",
        help="listen here (default: %(default)s, which only this machine reaches); another one needs --token-file",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=PORT, metavar="N", help="listen there (default: %(default)s; 0: any)"
    )
    parser.add_argument(
        "--token-file", metavar="FILE",
        help="its first line is what a browser has to give before it may change anything; without it nobody may",
    )  # fmt: skip
    parser.add_argument(
        "--reading", choices=("open", "token"),
        help="whether looking needs the token too (default: open on this machine's own address, else token)",
    )  # fmt: skip
    parser.add_argument(
        "--host", action="append", default=[], metavar="NAME",
        help="a further name under which browsers may ask for the page; IP addresses and localhost are known",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Serve until a signal. Raises BadArgument without the library, and for what cannot be served, or not safely."""
    check_port(args.port)
    guard = guard_of(args)
    try:
        from imud.web.server import WebServer
    except ModuleNotFoundError as error:
        raise BadArgument(f"it needs {error.name}: pip install 'imud[web]'") from None
    asyncio.run(_serve(WebServer(args.socket, guard).make_app(), args))
    return 0


def guard_of(args: argparse.Namespace) -> WebGuard:
    """Make the rules that the arguments ask for. Raises BadArgument for an open address without a token."""
    token = read_token(args.token_file) if args.token_file else b""
    local = is_loopback(args.address)
    if not token and not local:
        raise BadArgument(
            f"--address {args.address} can be reached from other machines: expected --token-file FILE as well, "
            "or no --address, and a tunnel: ssh -L 9322:127.0.0.1:9322 GATEWAY"
        )
    reading = args.reading or ("open" if local else "token")
    if reading == "token" and not token:
        raise BadArgument("--reading token: expected --token-file FILE as well")
    return WebGuard(token, time, reading_needs_token=reading == "token", names=args.host)


async def _serve(app: "web.Application", args: argparse.Namespace) -> None:
    from aiohttp import web

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=STOP_S)
    await runner.setup()
    try:
        site = web.TCPSite(runner, args.address, args.port)
        try:
            await site.start()
        except (OSError, socket.gaierror) as error:
            raise LinkError(f"cannot listen on {args.address} port {args.port}: {reason_of(error)}") from error
        _say(args, runner.addresses[0][1])
        await stopped.wait()
    finally:
        await runner.cleanup()


def _say(args: argparse.Namespace, port: int) -> None:
    """Print where the page is, and to whom it is open."""
    host = f"[{args.address}]" if ":" in args.address else args.address
    print(f"http://{host}:{port}/", flush=True)
    if not args.token_file:
        print("nothing can be changed here: there is no --token-file", flush=True)
    if not is_loopback(args.address):
        who = "everybody on these networks can look" if args.reading == "open" else "who has the token can look"
        print(
            f"OPEN: {args.address} port {port} is reached from other machines: {who}, and who has the token can change "
            "devices. HTTP is not encrypted: on networks of others use ssh -L or a proxy with TLS.",
            file=sys.stderr, flush=True,
        )  # fmt: skip


WEB = CliCommand(add_arguments, run)
