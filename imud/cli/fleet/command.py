"""`imud fleet`: collect what the gateways of a broker send, or show them all in the terminal."""

import argparse
import asyncio
import signal
import sys
from collections.abc import Mapping
from typing import Final

from imud.cli.arguments import CliCommand, duration_s
from imud.cli.fleet.top import add_top, run_top
from imud.cli.output import table
from imud.errors import BadArgument
from imud.fleet import Fleet, ReaderAccess
from imud.fleet.collect import GC_ALLOCATIONS, FleetCollector, FleetStore, Selection
from imud.fleet.json_lines import JsonLines
from imud.fleet.postgres import PostgresStore
from imud.fleet.reader import VERSIONS
from imud.formats.fleet.ledger import StreamKey
from imud.formats.fleet.state import StreamAccount
from imud.worker import rare_garbage_collection

NAME: Final = "collector"
HEAD: Final = (
    "GATEWAY",
    "BOOT",
    "DEVICE",
    "STREAM",
    "SENT",
    "RECEIVED",
    "DROPPED",
    "MISSING",
    "IN SPOOL",
    "DUPLICATES",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud fleet`."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    collecting = actions.add_parser("collect", help="write what the gateways send into a store")
    _broker(collecting)
    collecting.add_argument(
        "--to", required=True, metavar="STORE",
        help="postgresql://USER@HOST/DATABASE writes rows, exactly once; - prints JSON lines",
    )  # fmt: skip
    collecting.add_argument(
        "--name", default=NAME,
        help="of the session that the broker keeps for this one collector while it is away (default: %(default)s)",
    )  # fmt: skip
    collecting.add_argument(
        "--from-begin", action="store_true",
        help="count as missing what a gateway had sent of its present boot before the collector first heard of it",
    )  # fmt: skip
    showing = actions.add_parser("top", help="show all gateways, redrawn in place")
    _broker(showing)
    add_top(showing)


def _broker(parser: argparse.ArgumentParser) -> None:
    """Arguments for the connection, and for what is read."""
    parser.add_argument(
        "urls", nargs="+", metavar="URL",
        help="broker: mqtt, mqtts, ws or wss, for example mqtts://HOST:8883; several of one cluster are tried in turn",
    )  # fmt: skip
    parser.add_argument(
        "--mqtt-version", choices=VERSIONS, default=VERSIONS[0], help="version of MQTT (default: %(default)s)"
    )
    parser.add_argument("--user", default="", help="name for the broker")
    parser.add_argument("--password-file", metavar="FILE", help="file that has the password in its first line")
    parser.add_argument(
        "--ca-file",
        metavar="FILE",
        help="certificates (PEM) that the broker's is to be signed by (default: the system's)",
    )
    parser.add_argument("--cert-file", metavar="FILE", help="certificate (PEM) of this client")
    parser.add_argument("--key-file", metavar="FILE", help="its key (PEM), where the certificate's file has none")
    for name, words in (("site", "this site"), ("gateway", "this gateway"), ("device", "this device")):
        parser.add_argument(f"--{name}", help=f"of {words} only")
    parser.add_argument("--duration", type=duration_s, metavar="TIME", help="end after so long, as 90s, 10min or 2h")


def run(args: argparse.Namespace) -> int:
    """Carry out one of the actions. Raises ImudError."""
    if args.action == "top":
        return asyncio.run(run_top(args, fleet_of(args, "", from_begin=False)))
    return asyncio.run(_collect(args))


def fleet_of(args: argparse.Namespace, name: str, *, from_begin: bool) -> Fleet:
    """The fleet that the arguments name. Raises BadArgument, ServerError."""
    if args.password_file is not None and not args.user:
        raise BadArgument("--password-file: expected --user as well")
    if args.key_file is not None and args.cert_file is None:
        raise BadArgument("--key-file: expected --cert-file as well")
    access = ReaderAccess(args.user, args.password_file, args.ca_file, args.cert_file, args.key_file)
    return Fleet(*args.urls, access=access, name=name, version=args.mqtt_version, from_begin=from_begin)


async def _collect(args: argparse.Namespace) -> int:
    fleet = fleet_of(args, args.name, from_begin=args.from_begin)
    store = store_of(args.to)
    collector = FleetCollector(fleet, store, Selection(args.site, args.gateway, args.device))
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, collector.stop)
    try:
        with rare_garbage_collection(GC_ALLOCATIONS):
            await collector.run(stop_after_s=args.duration)
    finally:
        store.close()
    if ledger := account_table(fleet.accounts):
        print(ledger, file=sys.stderr)
    if fleet.problem:
        print(f"nothing comes at the end: {fleet.problem}", file=sys.stderr)
    return 1 if fleet.problem else 0


def store_of(text: str) -> FleetStore:
    """The store that `--to` names. Raises BadArgument, ServerError."""
    if text == "-":
        return JsonLines(sys.stdout)
    if text.startswith(("postgresql://", "postgres://")):
        return PostgresStore(text)
    raise BadArgument("--to: expected - for standard output, or a URL as postgresql://USER@HOST/DATABASE")


def account_table(accounts: Mapping[StreamKey, StreamAccount]) -> str:
    """The ledger as a table; empty for none."""
    rows = [
        (
            key.gateway, key.boot, key.device or "-", key.stream, str(one.sent), str(one.received),
            ", ".join(f"{number} {cause}" for cause, number in sorted(one.counts.dropped.items())) or "0",
            str(one.counts.missing), str(one.in_spool), str(one.counts.duplicates),
        )
        for key, one in sorted(accounts.items())
    ]  # fmt: skip
    return table(HEAD, rows) if rows else ""


FLEET = CliCommand(add_arguments, run)
