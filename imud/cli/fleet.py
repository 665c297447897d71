"""`imud fleet`: collect the data of all gateways of an MQTT broker, or show the gateways in the terminal."""

import argparse
import asyncio
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from time import monotonic_ns, time_ns
from typing import Final, Protocol

import msgspec

from imud.cli.arguments import CliCommand, add_duration
from imud.cli.fleet_status import DATABASE_ACTIONS, add_rejected, add_status
from imud.cli.output import complain, table
from imud.config import load_options
from imud.fleet.accounts import GatewayState, StreamAccount, StreamKey
from imud.fleet.collector import GC_ALLOCATIONS, FleetCollector, JsonLines, LedgerStore, Selection
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.influx import InfluxStore
from imud.fleet.messages import GatewayClock, Stream
from imud.fleet.metrics_server import CollectorMetricsServer, FleetGauges
from imud.fleet.paho_client import ReaderAccess
from imud.fleet.reader import SHARES_MAX, VERSIONS, Fleet, FleetBatch
from imud.fleet.settings import STATUS_S
from imud.fleet.shares import FleetShares
from imud.host.http_post import HttpPost, PostAccess, post_url
from imud.host.installation import needs_extra
from imud.host.log import STDERR, log_to
from imud.host.threads import rare_garbage_collection
from imud.model.errors import BadArgument
from imud.model.staleness import is_stale
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

ONLINE: Final = "online"
SILENT: Final = "silent"  # the broker has the state `online`, but no message arrives
STATUS_MOST_S: Final = 3600.0  # maximum interval of the states of a gateway, s

TOP_HEAD: Final = (
    "GATEWAY",
    "STATE",
    "DEVICES",
    "SAMPLES/S",
    "LOST",
    "MISSING",
    "SPOOL",
    "AGE S",
    "ERROR µs",
    "UTC ms",
)
NOT_SET: Final = "not set"
RATE_NS: Final = 5 * NS_PER_S  # time over which imud measures rates, ns


class FleetOverview:
    """Table of the gateways of a fleet. Synchronization: one thread."""

    def __init__(
        self, fleet: Fleet, now_ns: Callable[[], int] = monotonic_ns, utc_ns: Callable[[], int] = time_ns
    ) -> None:
        """`now_ns`: CLOCK_MONOTONIC; `utc_ns`: CLOCK_REALTIME."""
        self._fleet = fleet
        self._now_ns, self._utc_ns = now_ns, utc_ns
        # GatewayArrival time and number of received samples, by gateway and stream
        self._counts: dict[tuple[str, Stream], deque[tuple[int, int]]] = {}
        self._newest_ns: dict[str, int] = {}
        self._error_ns: dict[str, int] = {}
        self._clocks: dict[str, GatewayClock] = {}  # state of the wall clock of each gateway, from its newest message

    def add(self, batch: FleetBatch) -> None:
        """Process a received batch."""
        message = batch.message
        name = message.gateway
        if message.clock is not None:
            self._clocks[name] = message.clock
        self._newest_ns[name] = max(message.utc_ns, self._newest_ns.get(name, 0))
        # events are not counted in samples per second
        if batch.stream is not Stream.EVENTS:
            counts = self._counts.setdefault((name, batch.stream), deque())
            counts.append((self._now_ns(), message.last - message.first + 1))
        errors = [sample.t_err_ns for sample in message.samples] or [one.t_err_ns for one in message.intervals]
        if errors:
            self._error_ns[name] = max(errors)

    def text(self) -> str:
        """Format the table, offline gateways first, and a summary with the problem of the broker connection."""
        fleet = self._fleet
        if not fleet.states:
            return f"no gateway yet; {fleet.problem or 'connected'}"
        found: dict[str, list[StreamAccount]] = {}
        for key, account in fleet.accounts.items():
            found.setdefault(key.gateway, []).append(account)
        # False sorts first: offline gateways
        order = sorted(fleet.states, key=lambda key: (self._is_online(key), key))
        rows = [self._row(key, found.get(key[1], [])) for key in order]
        away = sum(not self._is_online(key) for key in fleet.states)
        line = f"{len(rows)} gateway{'s' * (len(rows) != 1)}, {away} away" + (
            f"; {fleet.problem}" * bool(fleet.problem)
        )
        return f"{table(TOP_HEAD, rows)}\n\n{line}"

    def _row(self, key: tuple[str, str], found: list[StreamAccount]) -> tuple[str, ...]:
        state, name = self._fleet.states[key], key[1]
        newest_ns, error_ns = self._newest_ns.get(name), self._error_ns.get(name)
        return (
            "/".join(key),
            self._presence(key),
            str(len(state.devices)),
            f"{self._rate_hz(name):.1f}",
            str(sum(sum(one.counts.dropped.values()) for one in found)),
            str(sum(one.counts.missing for one in found)),
            str(sum(one.in_spool for one in found)),
            "-" if newest_ns is None else f"{max(self._utc_ns() - newest_ns, 0) / NS_PER_S:.1f}",
            "-" if error_ns is None else f"{error_ns / NS_PER_US:.0f}",
            self._utc_text(name, state),
        )

    def _is_online(self, key: tuple[str, str]) -> bool:
        return self._presence(key) == ONLINE

    def _presence(self, key: tuple[str, str]) -> str:
        """Return whether a gateway is online. A broker stores the state of a gateway: after a power failure of both,
        the broker still has the state `online`, and no last will."""
        state = self._fleet.states[key]
        if not state.online:
            return state.reason or "away"
        now_ns = self._now_ns()
        arrival = self._fleet.arrivals.get(key)
        last_ns = now_ns if arrival is None else arrival.t_ns
        if arrival is not None and arrival.is_retained and state.clock is not None and state.clock.synchronised:
            age_ns = self._utc_ns() - state.clock.t_ns - state.clock.utc_offset_ns
            last_ns = min(last_ns, now_ns - age_ns)
        period_s = min(state.status_s or STATUS_S, STATUS_MOST_S)
        return SILENT if is_stale(last_ns, now_ns, round(period_s * NS_PER_S)) else ONLINE

    def _utc_text(self, name: str, state: GatewayState) -> str:
        """Format the error of a gateway's wall clock; `-` if the gateway does not report it."""
        clock = self._clocks.get(name, state.clock)
        if clock is None or (clock.synchronised and clock.error_ns is None):
            return "-"
        return f"{clock.error_ns / NS_PER_MS:.3g}" if clock.synchronised and clock.error_ns is not None else NOT_SET

    def _rate_hz(self, name: str) -> float:
        """Return the received samples per second. Both streams can count the same samples: take the larger rate."""
        begin_ns, most = self._now_ns() - RATE_NS, 0
        for stream in (Stream.SAMPLES, Stream.STATISTICS):
            counts = self._counts.get((name, stream), deque())
            # drop counts older than RATE_NS
            while counts and counts[0][0] < begin_ns:
                counts.popleft()
            most = max(most, sum(count for _, count in counts))
        return most * NS_PER_S / RATE_NS


INTERVAL_S: Final = 1.0
INTERVAL_LEAST_S: Final = 0.1
INTERVAL_MOST_S: Final = 3600.0


class _Screen(Protocol):
    def show(self, text: str) -> None: ...
    def close(self) -> None: ...


class _Lines:
    """Output of one text after another."""

    def show(self, text: str) -> None:
        print(text, flush=True)

    def close(self) -> None: ...


class _Redrawn:
    """Full-screen output: each text replaces the previous text. Raises BadArgument without the extra `top`."""

    def __init__(self) -> None:
        try:
            with needs_extra("top"):
                from rich.live import Live
                from rich.text import Text
        except BadArgument as error:
            raise BadArgument(f"{error}; or use --plain") from None
        self._text: Callable[[str], Text] = Text
        self._live = Live(screen=True, auto_refresh=False)
        self._live.start()

    def show(self, text: str) -> None:
        self._live.update(self._text(text), refresh=True)

    def close(self) -> None:
        self._live.stop()


def add_top(parser: argparse.ArgumentParser) -> None:
    """Add the options of `imud fleet top`."""
    parser.add_argument(
        "--interval", type=float, default=INTERVAL_S, metavar="S", help="time between two tables (default: %(default)g)"
    )
    parser.add_argument(
        "--plain", action="store_true", help="print one table after another, as if the output is not a terminal"
    )


async def run_top(args: argparse.Namespace, fleet: Fleet) -> int:
    """Show the gateways until SIGINT, SIGTERM or --duration. Return 1 if no gateway was found. Raises ImudError."""
    if not INTERVAL_LEAST_S <= args.interval <= INTERVAL_MOST_S:
        raise BadArgument(f"--interval: expected {INTERVAL_LEAST_S:g} to {INTERVAL_MOST_S:g}, got {args.interval:g}")
    loop, overview = asyncio.get_running_loop(), FleetOverview(fleet)
    with closing(_Redrawn() if sys.stdout.isatty() and not args.plain else _Lines()) as screen:
        reading = asyncio.ensure_future(_read(args, fleet, overview))
        drawing = asyncio.ensure_future(_draw(screen, overview, args.interval))
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, drawing.cancel)
        await asyncio.wait((reading, drawing), timeout=args.duration, return_when=asyncio.FIRST_COMPLETED)
        # cancel both tasks, also the task that ended
        for task in (drawing, reading):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
    if fleet.problem:
        complain(f"the broker connection failed at the end: {fleet.problem}")
    return 0 if fleet.states else 1


async def _read(args: argparse.Namespace, fleet: Fleet, overview: FleetOverview) -> None:
    async for batch in fleet.watch(site=args.site, gateway=args.gateway, device=args.device):
        overview.add(batch)


async def _draw(screen: _Screen, overview: FleetOverview, interval_s: float) -> None:
    while True:
        await asyncio.sleep(interval_s)
        screen.show(overview.text())


NAME: Final = "collector"
# Maximum time for the last write to a server of line protocol after a signal, s. The stop takes at most 1 s.
LAST_WRITE_S: Final = 0.5
OPEN: Final = PostAccess()  # no credentials
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
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    collecting = actions.add_parser("collect", help="write the data of the gateways to a store")
    _broker(collecting)
    collecting.add_argument(
        "--to", required=True, metavar="STORE",
        help="postgresql://USER@HOST/DATABASE: write each row exactly once; http or https URL: line protocol to "
        "InfluxDB, VictoriaMetrics, QuestDB or Telegraf; -: print JSON lines",
    )  # fmt: skip
    collecting.add_argument(
        "--to-token-file", metavar="FILE",
        help="for an http or https URL: file with an InfluxDB token, or with a value of the header Authorization such "
        "as 'Bearer TOKEN'",
    )  # fmt: skip
    collecting.add_argument(
        "--to-ca-file", metavar="FILE", help="for an https URL: CA certificates (PEM) (default: the CAs of the system)"
    )
    collecting.add_argument(
        "--name", default=NAME,
        help="name of this collector; the broker keeps messages for it while it does not run (default: %(default)s)",
    )  # fmt: skip
    collecting.add_argument(
        "--from-begin", action="store_true",
        help="count samples as missing that a gateway sent since its boot, before the collector received its first "
        "message",
    )  # fmt: skip
    collecting.add_argument(
        "--shares", type=int, metavar="N",
        help=f"for a postgresql URL: divide the messages among N sessions, 1 to {SHARES_MAX} (default: 1); start the "
        "same command on several hosts, and each collector takes its part",
    )  # fmt: skip
    collecting.add_argument(
        "--metrics", metavar="HOST:PORT",
        help="for a postgresql URL: serve Prometheus metrics at http://HOST:PORT/metrics, for example 127.0.0.1:9322",
    )  # fmt: skip
    collecting.add_argument(
        "--config", metavar="FILE", help="for a postgresql URL: settings of the collector and its database (YAML)"
    )
    add_status(actions.add_parser("status", help="show the state of all gateways in the database, and a summary"))
    add_rejected(actions.add_parser("rejected", help="show the messages that the collector could not store"))
    showing = actions.add_parser("top", help="show all gateways in a full-screen view of the terminal")
    _broker(showing)
    add_top(showing)


def _broker(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the broker connection and of the selection."""
    parser.add_argument(
        "urls", nargs="+", metavar="URL",
        help="broker: mqtt, mqtts, ws or wss, for example mqtts://HOST:8883; name all brokers of a cluster",
    )  # fmt: skip
    parser.add_argument(
        "--mqtt-version", choices=VERSIONS, default=VERSIONS[0], help="MQTT version (default: %(default)s)"
    )
    parser.add_argument("--user", default="", help="user name for the broker")
    parser.add_argument("--password-file", metavar="FILE", help="file with the password in its first line")
    parser.add_argument(
        "--ca-file", metavar="FILE",
        help="CA certificates (PEM) that sign the certificate of the broker (default: the CAs of the system)",
    )  # fmt: skip
    parser.add_argument("--cert-file", metavar="FILE", help="client certificate (PEM)")
    parser.add_argument("--key-file", metavar="FILE", help="client key (PEM), if --cert-file does not contain the key")
    for name in ("site", "gateway", "device"):
        parser.add_argument(f"--{name}", help=f"select this {name} only")
    add_duration(parser, "stop after this time (default: at Ctrl-C)")


def run(args: argparse.Namespace) -> int:
    """Run the action. Raises ImudError."""
    if args.action in DATABASE_ACTIONS:
        return DATABASE_ACTIONS[args.action](args)
    if args.action == "top":
        return asyncio.run(run_top(args, fleet_of(args, "", from_begin=False)))
    return asyncio.run(_collect(args))


def fleet_of(args: argparse.Namespace, name: str, *, from_begin: bool) -> Fleet:
    """Return the reader of the fleet for these arguments. Raises BadArgument, ServerError."""
    if args.password_file is not None and not args.user:
        raise BadArgument("--password-file: add --user")
    if args.key_file is not None and args.cert_file is None:
        raise BadArgument("--key-file: add --cert-file")
    access = ReaderAccess(args.user, args.password_file, args.ca_file, args.cert_file, args.key_file)
    return Fleet(*args.urls, access=access, name=name, version=args.mqtt_version, from_begin=from_begin)


async def _collect(args: argparse.Namespace) -> int:
    fleet = fleet_of(args, args.name, from_begin=args.from_begin)
    selection = Selection(args.site, args.gateway, args.device)
    is_postgres = args.to.startswith(("postgresql://", "postgres://"))
    if PostAccess(args.to_token_file, args.to_ca_file) != OPEN and post_url(args.to) is None:
        raise BadArgument("--to-token-file, --to-ca-file: expected --to with an http or https URL")
    if not is_postgres and not (args.config is None and args.shares is None and args.metrics is None):
        raise BadArgument("--config, --shares, --metrics: expected --to with a postgresql URL")
    store = None if is_postgres else store_of(args, fleet)
    with ExitStack() as stack:
        collector: FleetShares | FleetCollector
        if store is None:
            settings = settings_of(args)
            collector = FleetShares(fleet, args.to, settings, selection, from_begin=args.from_begin)
            if settings.metrics:
                gauges = FleetGauges(args.to, settings.silent_s, monotonic_ns)
                server = CollectorMetricsServer(settings.metrics, collector.status, gauges)
                stack.enter_context(closing(server))
                server.start()
        else:
            stack.enter_context(closing(store))
            collector = FleetCollector(fleet, store, selection)

        loop = asyncio.get_running_loop()

        def stop() -> None:
            collector.stop()
            if store is not None and isinstance(store.to, InfluxStore):
                loop.call_later(LAST_WRITE_S, store.to.stop)

        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop)
        # collections would take a large share of the CPU time at high rates
        with log_to(STDERR, "info"), rare_garbage_collection(GC_ALLOCATIONS):
            await collector.run(stop_after_s=args.duration)
        for line in _results(fleet, collector, store):
            print(line, file=sys.stderr)
    if fleet.ignored:
        print(f"{fleet.ignored} messages were invalid and not stored; the log names them", file=sys.stderr)
    if fleet.problem:
        print(f"the broker connection failed at the end: {fleet.problem}", file=sys.stderr)
    return 1 if fleet.problem else 0


def _results(fleet: Fleet, collector: FleetShares | FleetCollector, store: LedgerStore | None) -> Iterator[str]:
    """Yield the ledger and the rejected messages at the end of `collect`."""
    if isinstance(collector, FleetShares):
        yield collector.ledger_text()
    elif ledger := account_table(fleet.accounts):
        yield ledger
    if fleet.expired_boots or fleet.ledger.removed_streams:
        yield (
            f"not in the table: {fleet.expired_boots} old boots ({fleet.expired_incomplete} with missing numbers), "
            f"{fleet.ledger.removed_streams} streams above the limit of the memory"
        )
    if store is not None and isinstance(store.to, InfluxStore) and store.to.refused:
        yield f"the server rejected {store.to.refused} messages; the log has the reasons"


def settings_of(args: argparse.Namespace) -> CollectorSettings:
    """Return the settings of --config, --shares and --metrics. Raises BadArgument, ConfigError."""
    settings = CollectorSettings() if args.config is None else load_options(args.config, CollectorSettings)
    shares = settings.shares if args.shares is None else args.shares
    if not 1 <= shares <= SHARES_MAX:
        raise BadArgument(f"--shares: expected 1 to {SHARES_MAX}, got {shares}")
    metrics = settings.metrics if args.metrics is None else args.metrics
    return msgspec.structs.replace(settings, shares=shares, metrics=metrics)


def store_of(args: argparse.Namespace, fleet: Fleet) -> LedgerStore:
    """Open a store without a ledger of its own. Raises BadArgument, ServerError."""
    url = post_url(args.to)
    if url is not None:
        access = PostAccess(args.to_token_file, args.to_ca_file)
        return LedgerStore(fleet, InfluxStore(HttpPost(url, access, monotonic_ns)))
    if args.to == "-":
        return LedgerStore(fleet, JsonLines(sys.stdout))
    raise BadArgument(
        "--to: expected - for standard output, a URL like postgresql://USER@HOST/DATABASE, or a write URL like "
        "http://HOST:8086/write?db=imud without user, password and token"
    )


def account_table(accounts: Mapping[StreamKey, StreamAccount]) -> str:
    """Format the ledger as a table; empty if there are no accounts."""
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
