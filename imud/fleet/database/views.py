"""Views of the fleet database: ledger of each stream, state of each gateway, statistics of hours and days.

    imud_ledger ──▶ imud_streams ──┐
    imud_gateways ─────────────────┴──▶ imud_gateway_status
    imud_intervals ──▶ imud_intervals_1h ──▶ imud_intervals_1d

With TimescaleDB, the last two are continuous aggregates: TimescaleDB stores finished hours and days, and computes newer
rows when a program reads them. Otherwise, PostgreSQL computes all rows when a program reads them. It does not use a
condition for the time of an hour to select partitions. Therefore, the functions `imud_hours` and `imud_days` return the
same rows for a time range.

Any client of the broker can write values into the tables. No value makes a view fail: sums have a maximum, and means
ignore values with a product outside the range of double precision.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from imud.fleet.database.tables import (
    COMPONENTS,
    GATEWAYS,
    INTERVALS,
    LEDGER,
    MEANINGS,
    Column,
    Component,
    FleetTable,
    comments,
)
from imud.fleet.statistics import ANGLES, MEASURES

_BIGINT_MOST: Final = (1 << 63) - 1


class ViewColumn(NamedTuple):
    """Column of a view with the SQL expression of its value."""

    column: Column
    expression: str


class FleetView(NamedTuple):
    """View with its comment, columns, and source: the clauses of the query from FROM on."""

    name: str
    comment: str
    values: tuple[ViewColumn, ...]
    source: str
    is_aggregate: bool = False  # True for a continuous aggregate of TimescaleDB
    function: str = ""  # name of the function that returns the rows of a time range; empty without a function
    range_source: str = ""  # source of the query of this function

    @property
    def columns(self) -> tuple[Column, ...]:
        return tuple(one.column for one in self.values)

    def statements(self) -> Iterator[str]:
        """Yield the statements that create the view with its comments."""
        selected = ", ".join(f"{one.expression} AS {one.column.name}" for one in self.values)
        query = f"AS SELECT {selected} {self.source}"
        if self.is_aggregate:
            options = "timescaledb.continuous, timescaledb.materialized_only = false"
            yield f"CREATE MATERIALIZED VIEW {self.name} WITH ({options}) {query} WITH NO DATA"
        else:
            yield f"CREATE VIEW {self.name} {query}"
        yield from comments("VIEW", self.name, self.comment, self.columns)
        if self.function:
            names = "*" if self.is_aggregate else selected
            # PostgreSQL includes a stable SQL function in the query, and then reads only the partitions of the range
            yield (
                f"CREATE FUNCTION {self.function}(since timestamptz, until timestamptz) RETURNS SETOF {self.name} "
                f"LANGUAGE sql STABLE PARALLEL SAFE AS $$ SELECT {names} {self.range_source} $$"
            )
            comment = f"rows of {self.name} that overlap the time range since <= time < until"
            yield f"COMMENT ON FUNCTION {self.function} IS '{comment}'"


def _kept(table: FleetTable, *names: str, source: str = "", comment: str = "") -> Iterator[ViewColumn]:
    """Yield columns of a table, also as columns of the view. `comment` follows the comment of the table."""
    for one in table.columns:
        if one.name in names:
            column = Column(one.name, one.type.removesuffix(" NOT NULL"), one.comment + comment)
            yield ViewColumn(column, source + one.name)


def _sum(expression: str) -> str:
    """Return the sum of integers, 0 without rows. The sum of two numbers of a false message can exceed bigint."""
    return f"least(coalesce(sum({expression}), 0), {_BIGINT_MOST})::bigint"


# --- ledger and gateways ----------------------------------------------------------------------------------------------

_IN_SPOOL: Final = Column(
    "in_spool", "bigint", "numbers in the spool or on the way, by the newest state of the gateway"
)
STREAMS: Final = FleetView(
    "imud_streams",
    "ledger of each stream, with the numbers that did not arrive yet",
    (
        *_kept(LEDGER, *(name for name in LEDGER.names if name != "gaps")),
        ViewColumn(_IN_SPOOL, "greatest(sent - newest, 0)"),
        ViewColumn(
            Column("balance", "bigint", "difference of both sides of the ledger; 0 if the ledger balances"),
            "newest - begin + 1 - whole - thinned - dropped - missing",
        ),
    ),
    f"FROM {LEDGER.name}",
)
_COUNTERS: Final = ("missing", "dropped", "thinned", "duplicates")
_NO_STATE: Final = "; NULL before the first state"
GATEWAY_STATUS: Final = FleetView(
    "imud_gateway_status",
    "newest state of each gateway, and sums of the ledgers of its streams in all boots",
    (
        *_kept(GATEWAYS, "site", "gateway"),
        *_kept(GATEWAYS, "online", "reason", "version", "devices", comment=_NO_STATE),
        ViewColumn(
            Column("silent_s", "double precision", "time since the newest message of a stream, or since the state, s"),
            "extract(epoch FROM now() - coalesce(ledger.updated_at, state.stored_at))::double precision",
        ),
        *(
            ViewColumn(one.column, f"coalesce(ledger.{one.column.name}, 0)")
            for one in (*_kept(LEDGER, *_COUNTERS), ViewColumn(_IN_SPOOL, ""))
        ),
        *_kept(GATEWAYS, "utc_set"),
    ),
    f"FROM {GATEWAYS.name} AS state FULL JOIN (SELECT site, gateway, max(updated_at) AS updated_at, "
    f"{', '.join(f'{_sum(name)} AS {name}' for name in (*_COUNTERS, _IN_SPOOL.name))} "
    f"FROM {STREAMS.name} GROUP BY site, gateway) AS ledger USING (site, gateway)",
)

# --- hours and days ---------------------------------------------------------------------------------------------------

# Quaternions q and -q are the same attitude. The components of two intervals can have different signs. Their mean,
# minimum, maximum and RMS would then be wrong.
AGGREGATED: Final = tuple(one for one in COMPONENTS if one.field != "quat_wxyz")


def aggregate(component: Component, measure: str) -> str:
    """Return the SQL expression of a statistic over several rows of imud_intervals, or of its views."""
    name = component.column(measure)
    if measure in ("min", "max"):
        return f"{measure}({name})"
    # a row of any client: the square of the value, or the product with the number of samples, must be representable
    rows = f"FILTER (WHERE {name} = 0 OR abs({name}) BETWEEN 1e-100 AND 1e100)"
    if measure == "mean" and component.field in ANGLES:
        return f"atan2(sum(samples * sin({name})) {rows}, sum(samples * cos({name})) {rows})"
    if measure == "mean":
        return f"sum(samples * {name}) {rows} / sum(samples) {rows}"
    return f"sqrt(sum(samples * {name} * {name}) {rows} / sum(samples) {rows})"


def _meaning(component: Component, measure: str) -> str:
    text = f"{MEANINGS[measure]} of: {component.comment}"
    if component.field not in ANGLES:
        return text
    return f"{text}; " + {
        "mean": "direction of the sum of unit vectors, -π to π",
        "rms": "of the unwrapped angles of each interval",
    }.get(measure, "of the unwrapped angles of each interval, can be outside -π to π")


def _intervals(
    name: str, width: str, source: str, function: str, range_source: str, *, with_timescale: bool
) -> FleetView:
    """Return the view with statistics in steps of `width`. `source`: table or view, and the conditions. `range_source`:
    the same for the function, with `{low}` and `{high}`, the first time of the range and the first time after it."""

    def bucket_of(time: str) -> str:
        # both functions align the times to UTC
        if with_timescale:
            return f"time_bucket(interval '{width}', {time})"
        return f"date_bin(interval '{width}', {time}, timestamptz '2000-01-01 00:00+00')"

    bucket = bucket_of("time")
    low = bucket_of("since")
    high = bucket_of("until - interval '1 microsecond'") + f" + interval '{width}'"
    keys = tuple(_kept(INTERVALS, "site", "gateway", "device", "stream"))
    group = f"GROUP BY {bucket}, {', '.join(one.expression for one in keys)}"
    return FleetView(
        name,
        f"statistics of each device in {width}, weighted by the samples of the intervals; only rows with a known time",
        (
            ViewColumn(Column("time", "timestamptz", f"UTC time of the start, a multiple of {width}"), bucket),
            *keys,
            ViewColumn(Column("samples", "bigint", "number of samples"), _sum("samples")),
            *(
                ViewColumn(
                    Column(one.column(measure), "double precision", _meaning(one, measure)), aggregate(one, measure)
                )
                for one in AGGREGATED
                for measure in MEASURES
            ),
        ),
        f"FROM {source} {group}",
        with_timescale,
        function,
        f"FROM {name} WHERE time >= {low} AND time < {high}"
        if with_timescale
        else f"FROM {range_source.format(low=low, high=high)} {group}",
    )


HOURS: Final = "imud_intervals_1h"
DAYS: Final = "imud_intervals_1d"
HOURS_OF: Final = "imud_hours"
DAYS_OF: Final = "imud_days"


def views(*, with_timescale: bool) -> tuple[FleetView, ...]:
    """Return all views, each after the views that it reads."""
    known, in_range = f"{INTERVALS.name} WHERE utc_set AND samples > 0", "time >= {low} AND time < {high}"
    return (
        STREAMS,
        GATEWAY_STATUS,
        _intervals(HOURS, "1 hour", known, HOURS_OF, f"{known} AND {in_range}", with_timescale=with_timescale),
        # a late interval changes a complete day: 24 rows per device instead of 86,400 intervals at 1 Hz
        _intervals(DAYS, "1 day", HOURS, DAYS_OF, HOURS_OF + "({low}, {high})", with_timescale=with_timescale),
    )


def statements(with_timescale: bool) -> Iterator[str]:
    """Yield the statements that create all views. With `with_timescale`, imud_intervals is a hypertable and the license
    of TimescaleDB allows continuous aggregates."""
    for view in views(with_timescale=with_timescale):
        yield from view.statements()


# A refresh of an hour without intervals removes the hour. TimescaleDB refreshes hours between start_offset and
# end_offset, at least two of them.
_REFRESHED_DAYS_LEAST: Final = 3 / 24


def refresh_policies(intervals_days: float | None) -> Iterator[str]:
    """Yield the statements that let TimescaleDB store new hours and days. Rows that arrive late appear after the next
    refresh, after at most one hour or one day. `intervals_days`: age at which imud removes intervals; None: never."""
    yield from _refresh_policy(HOURS, "1 hour", intervals_days)
    yield from _refresh_policy(DAYS, "1 day", None)  # its hours stay


def _refresh_policy(name: str, width: str, days: float | None) -> Iterator[str]:
    yield f"SELECT remove_continuous_aggregate_policy('{name}', if_exists => true)"
    if days is None or days >= _REFRESHED_DAYS_LEAST:
        start = "NULL" if days is None else f"interval '{round(days * 86_400)} s'"
        yield (
            f"SELECT add_continuous_aggregate_policy('{name}', start_offset => {start}, "
            f"end_offset => interval '{width}', schedule_interval => interval '{width}')"
        )
