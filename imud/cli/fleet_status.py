"""`imud fleet status`, `imud fleet rejected`: the state of all gateways and the rejected messages in the database."""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

import msgspec

from imud.cli.arguments import duration_s
from imud.cli.output import complain, paragraph, table
from imud.fleet.database.overview import (
    REASONS_MAX,
    SILENT_S,
    FleetSelection,
    FleetSummary,
    GatewayCondition,
    GatewayRow,
    OverviewReader,
    RejectedCounts,
    RejectedMessage,
)
from imud.host.log import printable, printable_json
from imud.model.errors import BadArgument

ROWS_MAX: Final = 100  # Maximum number of rows of a table without --all. A terminal cannot show more of them together.
VERSIONS_MAX: Final = 10  # maximum number of versions in the summary
STATUS_HEAD: Final = ("GATEWAY", "STATE", "AGE S", "DROPPED", "MISSING", "THINNED", "SPOOL", "VERSION", "UTC")
REJECTED_HEAD: Final = ("ID", "TIME", "BYTES", "TOPIC", "REASON")
# Maximum length of a printed payload, characters: 4096 bytes, each with an escape of 4 characters
PAYLOAD_CHARACTERS: Final = 4 * 4096
_UTC: Final = {True: "set", False: "not set", None: "-"}
STORE_HELP: Final = "database of `imud fleet collect --to`, for example postgresql://USER@HOST/DATABASE"


class FleetReport(msgspec.Struct, frozen=True):
    """Output of `imud fleet status --json`."""

    gateways: list[GatewayRow]
    summary: FleetSummary


class RejectedReport(msgspec.Struct, frozen=True):
    """Output of `imud fleet rejected --json`."""

    messages: list[RejectedMessage]
    total: int
    by_reason: dict[str, int]  # number of messages of the most frequent reasons


def add_status(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `imud fleet status`."""
    parser.add_argument("store", metavar="STORE", help=STORE_HELP)
    parser.add_argument("--site", help="select this site only")
    parser.add_argument("--gateway", help="select this gateway only")
    parser.add_argument("--problems", action="store_true", help="print only gateways with a problem")
    parser.add_argument("--silent-only", action="store_true", help="print only offline and silent gateways")
    parser.add_argument(
        "--silent-after", type=duration_s, default=SILENT_S, metavar="DURATION",
        help="time without a message after which a gateway is silent (default: %(default)g s)",
    )  # fmt: skip
    _add_output(parser)


def add_rejected(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `imud fleet rejected`."""
    parser.add_argument("store", metavar="STORE", help=STORE_HELP)
    parser.add_argument("--gateway", help="select the messages of this gateway only")
    parser.add_argument(
        "--since", type=duration_s, metavar="TIME", help="print the messages of this time, as 30min, 2d"
    )
    parser.add_argument(
        "--payload", type=int, metavar="ID",
        help="write the stored bytes of the message with this ID to standard output; a terminal gets them with escapes",
    )  # fmt: skip
    _add_output(parser)


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--all", action="store_true", help=f"print all rows (default: at most {ROWS_MAX})")
    parser.add_argument("--json", action="store_true", help="print one JSON object, with all rows")


def run_status(args: argparse.Namespace) -> int:
    """Print the gateways and the summary. Return 1 if a selected gateway has a problem, or if no gateway is selected.
    Raises ImudError."""
    selection = FleetSelection(args.site, args.gateway, args.silent_after)
    limit = None if args.all or args.json else ROWS_MAX
    with OverviewReader(args.store) as reader:
        summary = reader.summary(selection)
        rows = reader.gateways(selection, problems=args.problems, absent=args.silent_only, limit=limit)
    report = FleetReport(rows, summary)
    print(printable_json(report) if args.json else status_page(report, _matching(summary, args)))
    return 1 if summary.with_problem or not summary.gateways else 0


def _matching(summary: FleetSummary, args: argparse.Namespace) -> int:
    """Return the number of gateways that the options select."""
    if args.silent_only:
        return summary.silent + summary.offline
    return summary.with_problem if args.problems else summary.gateways


def status_page(report: FleetReport, matching: int) -> str:
    """Format the table and the summary. `matching`: number of selected gateways, including rows that are not shown."""
    rows, summary = report.gateways, report.summary
    if not summary.gateways:
        return "no gateway; check --site and --gateway, and whether `imud fleet collect` runs"
    parts = []
    if rows:
        text = table(STATUS_HEAD, [_status_row(row) for row in rows])
        parts.append(text + (f"\n… {matching - len(rows)} more; use --all" if matching > len(rows) else ""))
    versions = [f"{version or 'unknown'} ({number})" for version, number in summary.versions.items()]
    more = len(versions) - VERSIONS_MAX
    versions = [*versions[:VERSIONS_MAX], *([f"{more} more"] if more > 0 else [])]
    lines = (
        ("gateways", f"{summary.gateways}: {summary.online} online, {summary.silent} silent, "
         f"{summary.offline} offline; {summary.with_problem} with a problem"),
        ("versions", ", ".join(versions)),
        ("losses", f"{summary.with_losses} gateways; {summary.dropped} numbers dropped, {summary.missing} "
         f"missing, {summary.thinned} thinned"),
        ("backlog", f"{summary.in_spool} numbers in the spools"),
        ("clocks", f"{summary.clock_not_set} not set"),
        ("newest", f"message {summary.newest_s or 0:.0f} s ago"),
        ("ledger", f"{summary.streams} streams, {summary.boots} boots"),
        ("collectors", f"{summary.collectors} running, with {summary.shares} shares"),
    )  # fmt: skip
    parts.append("\n".join(line for name, text in lines for line in paragraph(f"{name:<12}", text)))
    return "\n\n".join(parts)


def _status_row(row: GatewayRow) -> tuple[object, ...]:
    offline = row.state is GatewayCondition.OFFLINE and row.reason
    dropped = ", ".join(f"{number} {cause}" for cause, number in row.dropped_by_cause.items()) or row.dropped
    return (
        f"{row.site}/{row.gateway}", f"{row.state}: {printable(row.reason)}" if offline else row.state,
        f"{row.silent_s:.0f}", dropped, row.missing, row.thinned, row.in_spool,
        row.version or "-", _UTC[row.utc_set],
    )  # fmt: skip


def run_rejected(args: argparse.Namespace) -> int:
    """Print the rejected messages, or the stored bytes of one message. Raises ImudError."""
    with OverviewReader(args.store) as reader:
        if args.payload is not None:
            _write_payload(reader, args.payload)
            return 0
        messages, counts = reader.rejected(args.gateway, args.since, None if args.all or args.json else ROWS_MAX)
    if args.json:
        print(printable_json(RejectedReport(messages, *counts)))
    else:
        print(rejected_page(messages, counts))
    return 0


def rejected_page(messages: Sequence[RejectedMessage], counts: RejectedCounts) -> str:
    """Format the table of the messages and the number of messages by reason."""
    if not counts.total:
        return "no rejected messages"
    rows = [
        (one.id, one.time.astimezone().isoformat(" ", "seconds"), one.bytes, one.topic, one.reason) for one in messages
    ]
    parts = [table(REJECTED_HEAD, rows)]
    if counts.total > len(messages):
        parts[0] += f"\n… {counts.total - len(messages)} more; use --all"
    lines = [f"{number:>8}  {printable(reason)}" for reason, number in counts.by_reason.items()]
    rest = counts.total - sum(counts.by_reason.values())
    if rest:
        lines.append(f"{rest:>8}  other reasons, after the {REASONS_MAX} most frequent reasons")
    return "\n\n".join([*parts, "\n".join([f"{counts.total} messages by reason:", *lines])])


def _write_payload(reader: OverviewReader, number: int) -> None:
    """Write the stored bytes of a message. Raises ImudError."""
    found = reader.payload(number)
    if found is None:
        raise BadArgument(f"--payload: expected the ID of a rejected message, got {number}; run it without --payload")
    payload, length = found
    if sys.stdout.isatty():
        print(printable(payload.decode("utf-8", "surrogateescape"), PAYLOAD_CHARACTERS))
    else:
        sys.stdout.buffer.write(payload)
        sys.stdout.buffer.flush()
    if length > len(payload):
        complain(f"the message had {length} bytes; the database contains the first {len(payload)}")


DATABASE_ACTIONS: Final = {"status": run_status, "rejected": run_rejected}
