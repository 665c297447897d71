"""Overview of a fleet from its database: state of the gateways, totals, and rejected messages.

`imud fleet status`, `imud fleet rejected` and the metrics of the collector read it. A user with SELECT on the tables
is sufficient. Messages of any client of the broker can fill the tables: numbers can be as large as 2**62, and texts can
contain control characters.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from enum import StrEnum
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import msgspec

from imud.fleet.database.connection import connected, sentence_of
from imud.fleet.database.leases import COUNT
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.views import GATEWAY_STATUS
from imud.host.installation import needs_extra
from imud.model.errors import BadArgument, ServerError

STATEMENT_S: Final = 60  # maximum time of a statement, s; 10,000 gateways with 30 streams need less than 1 s
REASONS_MAX: Final = 20  # maximum number of reasons in `RejectedCounts`
SILENT_S: Final = CollectorSettings().silent_s


class GatewayCondition(StrEnum):
    """State of a gateway."""

    ONLINE = "online"
    SILENT = "silent"  # online, but no message for the limit
    OFFLINE = "offline"


class FleetSelection(NamedTuple):
    """Selected gateways."""

    site: str | None = None  # None: all sites
    gateway: str | None = None  # None: all gateways
    silent_s: float = SILENT_S  # time without a message after which a gateway is silent, s


class GatewayRow(msgspec.Struct, frozen=True):
    """State of one gateway. The counters are sums over all boots, devices and streams in the ledger."""

    site: str
    gateway: str
    state: GatewayCondition
    reason: str  # reason of an offline gateway
    version: str  # version of imud
    devices: list[str]
    silent_s: float  # time since the newest message, or since the state before the first message, s
    missing: int  # numbers that no message contained; they can still arrive
    dropped: int  # numbers that the gateway dropped
    thinned: int  # numbers that arrived as statistics because the spool was full
    duplicates: int
    in_spool: int  # numbers in the spool of the gateway or on the way to the collector
    utc_set: bool | None  # whether the wall clock is synchronized; None if unknown
    dropped_by_cause: dict[str, int] = {}  # msgspec copies a mutable default

    @property
    def has_problem(self) -> bool:
        """Return whether the gateway is offline or silent, lost numbers, or has no synchronized clock."""
        return self.state is not GatewayCondition.ONLINE or bool(self.missing or self.dropped) or self.utc_set is False


class FleetGroup(NamedTuple):
    """Gateways of one site with one version: number of gateways and sums of the counters."""

    site: str
    version: str
    gateways: int
    online: int
    silent: int
    offline: int
    with_problem: int  # gateways with `has_problem`
    with_losses: int  # gateways with dropped or missing numbers
    clock_not_set: int
    missing: int
    dropped: int
    thinned: int
    in_spool: int
    newest_s: float  # time since the newest message, s


class FleetSummary(msgspec.Struct, frozen=True):
    """Sums over the selected gateways. The numbers from `streams` on are about the whole database."""

    gateways: int
    online: int
    silent: int
    offline: int
    with_problem: int
    with_losses: int
    clock_not_set: int
    missing: int
    dropped: int
    thinned: int
    in_spool: int
    newest_s: float | None  # time since the newest message, s; None without a gateway
    versions: dict[str, int]  # number of gateways by version, the most frequent version first
    streams: int
    boots: int
    collectors: int  # number of running collectors
    shares: int  # number of shares that the collectors hold


class RunningCollectors(NamedTuple):
    """Collectors that are connected to the database."""

    collectors: int  # number of running collectors
    shares: int  # number of shares that they hold


class RejectedMessage(msgspec.Struct, frozen=True):
    """Message that the collector could not store."""

    id: int
    time: datetime  # time of the database
    topic: str
    reason: str
    bytes: int  # length of the message


class RejectedCounts(NamedTuple):
    """Number of rejected messages: of all reasons, and of the REASONS_MAX most frequent reasons."""

    total: int
    by_reason: dict[str, int]


# `online` is NULL for a gateway that sent messages but no state
_OFFLINE: Final = "online IS FALSE"
_SILENT: Final = "silent_s > %(silent_s)s"
_LOST: Final = "(missing > 0 OR dropped > 0)"
_PROBLEM: Final = f"({_OFFLINE} OR {_SILENT} OR {_LOST} OR utc_set IS FALSE)"
_SELECTED: Final = (
    f"FROM {GATEWAY_STATUS.name} WHERE (%(site)s::text IS NULL OR site = %(site)s) "
    "AND (%(gateway)s::text IS NULL OR gateway = %(gateway)s)"
)
_GATEWAYS: Final = (
    f"SELECT site, gateway, CASE WHEN {_OFFLINE} THEN 'offline' WHEN {_SILENT} THEN 'silent' ELSE 'online' END, "
    "coalesce(reason, ''), coalesce(version, ''), coalesce(devices, '{}'), silent_s, missing, dropped, thinned, "
    f"duplicates, in_spool, utc_set {_SELECTED} AND (NOT %(problems)s OR {_PROBLEM}) "
    f"AND (NOT %(absent)s OR {_OFFLINE} OR {_SILENT}) "
    f"ORDER BY {_OFFLINE} OR {_SILENT} DESC, {_PROBLEM} DESC, site, gateway LIMIT %(limit)s"
)
_CAUSES: Final = (
    "SELECT gateway, cause, sum(number::numeric) "
    "FROM imud_ledger, jsonb_each_text(dropped_by_cause) AS causes(cause, number) "
    "WHERE dropped > 0 AND gateway = ANY(%(gateways)s) GROUP BY gateway, cause ORDER BY gateway, cause"
)
_GROUPS: Final = (
    "SELECT site, coalesce(version, ''), count(*), "
    f"count(*) FILTER (WHERE NOT ({_OFFLINE} OR {_SILENT})), "
    f"count(*) FILTER (WHERE {_SILENT} AND NOT ({_OFFLINE})), count(*) FILTER (WHERE {_OFFLINE}), "
    f"count(*) FILTER (WHERE {_PROBLEM}), count(*) FILTER (WHERE {_LOST}), "
    "count(*) FILTER (WHERE utc_set IS FALSE), sum(missing), sum(dropped), sum(thinned), sum(in_spool), min(silent_s) "
    f"{_SELECTED} GROUP BY 1, 2 ORDER BY 1, 2"
)
_SIZES: Final = "SELECT (SELECT count(*) FROM imud_ledger), (SELECT count(*) FROM imud_boots)"
_OF_GATEWAY: Final = "(%(gateway)s::text IS NULL OR split_part(topic, '/', 3) = %(gateway)s)"
_SINCE: Final = "(%(since_s)s::float8 IS NULL OR rejected_at > now() - make_interval(secs => %(since_s)s))"
_REJECTED: Final = (
    "SELECT id, rejected_at, topic, reason, payload_bytes FROM imud_rejected "
    f"WHERE {_OF_GATEWAY} AND {_SINCE} ORDER BY id DESC LIMIT %(limit)s"
)
_REASONS: Final = (
    "SELECT reason, count(*), (sum(count(*)) OVER ())::bigint FROM imud_rejected "
    f"WHERE {_OF_GATEWAY} AND {_SINCE} GROUP BY reason ORDER BY 2 DESC, 1 LIMIT {REASONS_MAX}"
)


class OverviewReader:
    """Read-only connection to the database of a fleet. Synchronization: one thread at a time."""

    def __init__(self, url: str, *, statement_s: float = STATEMENT_S) -> None:
        """Connect. `statement_s`: maximum time of a statement, s. Raises ServerError, BadArgument if `url` is not a
        postgresql:// URL."""
        if not url.startswith(("postgresql://", "postgres://")):
            raise BadArgument("expected the database as a URL like postgresql://USER@HOST/DATABASE")
        with needs_extra("fleet", ServerError):
            import psycopg
        self._error: type[Exception] = psycopg.Error
        self._connection: Any = connected(url)
        self._connection.autocommit = True
        for name, value in (
            ("application_name", "imud fleet status"),
            ("default_transaction_read_only", "on"),
            ("statement_timeout", f"{round(statement_s * 1000)}ms"),
        ):
            self._rows("SELECT set_config(%(name)s, %(value)s, false)", {"name": name, "value": value})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
        with suppress(self._error):
            self._connection.close()

    def gateways(
        self, selection: FleetSelection, *, problems: bool = False, absent: bool = False, limit: int | None = None
    ) -> list[GatewayRow]:
        """Return at most `limit` gateways, absent gateways first, then gateways with a problem. `problems`: only
        gateways with a problem; `absent`: only offline and silent gateways. Raises ServerError."""
        values = {**selection._asdict(), "problems": problems, "absent": absent, "limit": limit}
        rows = [_gateway(*row) for row in self._rows(_GATEWAYS, values)]
        lossy = [row.gateway for row in rows if row.dropped]
        causes: dict[str, dict[str, int]] = {}
        for gateway, cause, number in self._rows(_CAUSES, {"gateways": lossy}) if lossy else ():
            causes.setdefault(gateway, {})[cause] = int(number)
        return [msgspec.structs.replace(row, dropped_by_cause=causes.get(row.gateway, {})) for row in rows]

    def groups(self, selection: FleetSelection) -> list[FleetGroup]:
        """Return the sums of the selected gateways by site and version. Raises ServerError."""
        return [
            FleetGroup._make((site, version, *[int(number or 0) for number in numbers], float(newest_s)))
            for site, version, *numbers, newest_s in self._rows(_GROUPS, selection._asdict())
        ]

    def summary(self, selection: FleetSelection) -> FleetSummary:
        """Return the sums of the selected gateways. Raises ServerError."""
        groups = self.groups(selection)
        sums = {name: sum(getattr(group, name) for group in groups) for name in FleetGroup._fields[2:-1]}
        versions = Counter[str]()
        for group in groups:
            versions[group.version] += group.gateways
        ((streams, boots),) = self._rows(_SIZES, {})
        newest_s = min((group.newest_s for group in groups), default=None)
        collectors, shares = self.collectors()
        return FleetSummary(**sums, newest_s=newest_s, versions=dict(versions.most_common()), streams=streams,
                            boots=boots, collectors=collectors, shares=shares)  # fmt: skip

    def rejected(
        self, gateway: str | None = None, since_s: float | None = None, limit: int | None = None
    ) -> tuple[list[RejectedMessage], RejectedCounts]:
        """Return at most `limit` rejected messages of the last `since_s` seconds, newest first, and the number of all
        of them. Raises ServerError."""
        values = {"gateway": gateway, "since_s": since_s, "limit": limit}
        reasons = list(self._rows(_REASONS, values))
        counts = RejectedCounts(reasons[0][2] if reasons else 0, {reason: number for reason, number, _ in reasons})
        return [RejectedMessage(*row) for row in self._rows(_REJECTED, values)], counts

    def payload(self, number: int) -> tuple[bytes, int] | None:
        """Return the stored bytes of a rejected message and the length of the message; None if the database does not
        contain the message. Raises ServerError."""
        rows = list(
            self._rows("SELECT payload, payload_bytes FROM imud_rejected WHERE id = %(id)s::numeric", {"id": number})
        )
        return (bytes(rows[0][0]), rows[0][1]) if rows else None

    def collectors(self) -> RunningCollectors:
        """Return the number of running collectors and of the shares that they hold. Raises ServerError."""
        return RunningCollectors(*self._rows(COUNT, {})[0])

    def _rows(self, statement: str, values: Mapping[str, object]) -> Sequence[Any]:
        """Return the rows of a statement. Raises ServerError."""
        try:
            rows: list[Any] = self._connection.execute(statement, values).fetchall()
        except (self._error, ValueError) as error:  # ValueError: text in another encoding than UTF-8
            raise ServerError(_problem(error)) from error
        return rows


def _gateway(site: str, gateway: str, state: str, reason: str, version: str, devices: list[str], silent_s: float,
             *rest: Any) -> GatewayRow:  # fmt: skip
    *numbers, utc_set = rest
    missing, dropped, thinned, duplicates, in_spool = (int(number or 0) for number in numbers)
    return GatewayRow(
        site, gateway, GatewayCondition(state), reason, version, devices, silent_s, missing, dropped, thinned,
        duplicates, in_spool, utc_set,
    )  # fmt: skip


def _problem(error: Any) -> str:
    """Return the message for an error of psycopg, with the next step."""
    text = sentence_of(error)
    match getattr(error, "sqlstate", None):
        case "42P01":  # undefined table
            return f"PostgreSQL: {text}; is this the database of `imud fleet collect --to`?"
        case "42501":  # insufficient privilege
            return f"PostgreSQL: {text}; grant SELECT on all tables imud_* to this user"
        case "57014":  # statement timeout
            return f"PostgreSQL: {text}; try again, or select a --site"
    return f"PostgreSQL: {text}"
