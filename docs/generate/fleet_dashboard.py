"""Dashboard for Grafana and the database of a fleet: `python -m docs.generate.fleet_dashboard` writes the file.

The variable `gateway` selects one gateway. The other rows show all gateways of the selected sites. Panels of a device
read intervals, hours or days, by the length of the time range in Grafana.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from docs.generate.grafana import Dashboard, Json, Panel, Row, source, variable
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import (
    COMPONENTS,
    DROPPED,
    EVENTS,
    GATEWAYS,
    INTERVALS,
    REJECTED,
    Component,
)
from imud.fleet.database.views import DAYS_OF, GATEWAY_STATUS, HOURS_OF, STREAMS, aggregate
from imud.fleet.messages import Stream
from tests.support.files import ROOT

# Grafana 10 renamed the plugin, and still accepts this name
SOURCE: Final = {"type": "postgres", "uid": "${source}"}
SITES: Final = "site IN (${site:sqlstring})"
GATEWAY: Final = "gateway IN (${gateway:sqlstring})"
SILENT_S: Final = round(CollectorSettings().silent_s)
"""Time without a message after which a gateway is silent, s."""
ROWS_MAX: Final = 1000
"""Maximum number of rows of a table."""
TIME: Final = "$__timeGroupAlias(time, $__interval)"
RANGE: Final = "$__timeTo()::timestamptz - $__timeFrom()::timestamptz"
FROM_TO: Final = "$__timeFrom()::timestamptz, $__timeTo()::timestamptz"
TABLES: Final = (
    (INTERVALS.name, "utc_set AND samples > 0", "0 s", "2 days"),
    (f"{HOURS_OF}({FROM_TO})", "true", "2 days", "90 days"),
    (f"{DAYS_OF}({FROM_TO})", "true", "90 days", "1000 years"),
)
"""Tables and functions with the statistics of a device: name, condition, shortest and longest time range."""
UNITS: Final = {"m_s2": "accMS2", "rad_s": "rotrads", "rad": "radian", "t": "si:T", "c": "celsius"}
"""Units of Grafana by the end of the column name."""


@dataclass(frozen=True, slots=True)
class Query:
    """An SQL query."""

    sql: str

    def target(self, kind: str) -> Json:
        """Return the query of a panel of this kind."""
        return {
            "datasource": SOURCE, "rawQuery": True, "rawSql": self.sql, "editorMode": "code",
            "format": "time_series" if kind == "timeseries" else "table",
        }  # fmt: skip


def table(
    title: str, sql: str, *, width: int = 24, height: int = 8, help: str = "", overrides: Sequence[Json] = ()
) -> Panel[Query]:
    return Panel(title, "none", [Query(f"{sql} LIMIT {ROWS_MAX}")], "table", width, height, help, overrides)


def override(column: str, **properties: Any) -> Json:
    """Return properties of one column. `custom_…` are properties of the kind of panel."""
    values = [{"id": name.replace("custom_", "custom."), "value": value} for name, value in properties.items()]
    return {"matcher": {"id": "byName", "options": column}, "properties": values}


LINK: Final = override("gateway", links=[
    {"title": "Show this gateway", "url": "/d/imud-fleet?var-gateway=${__value.raw}&${__url_time_range}"},
])  # fmt: skip


# --- panels of a device -----------------------------------------------------------------------------------------------


def over_time(title: str, field: str, measures: Sequence[str] = ("mean", "min", "max")) -> Panel[Query]:
    """Return the panel of the components of a field: lines of the first measure, and the band from `min` to `max`."""
    parts = [one for one in COMPONENTS if one.field == field]
    names = [_name(one, measure, measures) for one in parts for measure in measures]
    values = [aggregate(one, measure) for one in parts for measure in measures]
    columns = ", ".join(one.column(measure) for one in parts for measure in measures)
    selected = ", ".join(f'{value} AS "{name}"' for value, name in zip(values, names, strict=True))
    rows = " UNION ALL ".join(_rows(columns))
    bands = [one for name in names if name.endswith(" max") for one in _band(name.removesuffix(" max"))]
    query = Query(f"SELECT {TIME}, {selected} FROM ({rows}) AS rows GROUP BY 1 ORDER BY 1")
    return Panel(title, UNITS[parts[0].unit], [query], width=12, height=9, overrides=bands)


def _name(component: Component, measure: str, measures: Sequence[str]) -> str:
    name = component.stem.rpartition("_")[2]
    return name if measure == measures[0] else f"{name} {measure}"


def _rows(columns: str) -> Iterator[str]:
    """Yield a query for each table. PostgreSQL does not read a table if the time range has another length."""
    device = f"{GATEWAY} AND device IN (${{device:sqlstring}}) AND stream = '{Stream.STATISTICS}'"
    for name, condition, shortest, longest in TABLES:
        length = f"{RANGE} > interval '{shortest}' AND {RANGE} <= interval '{longest}'"
        yield (
            f"SELECT time, samples, {columns} FROM {name} "
            f"WHERE {condition} AND {device} AND $__timeFilter(time) AND {length}"
        )


def _band(name: str) -> Iterator[Json]:
    yield override(f"{name} max", custom_fillBelowTo=f"{name} min", custom_fillOpacity=15, custom_lineWidth=0)
    yield override(f"{name} min", custom_lineWidth=0)


# --- rows -------------------------------------------------------------------------------------------------------------

NEWEST: Final = f"WHERE {SITES} AND $__timeFilter(time) ORDER BY time DESC"
FLEET: Final = Row("Fleet", [
    Panel("Gateways", "none", [Query(
        "SELECT count(*) FILTER (WHERE online) AS online, count(*) FILTER (WHERE online IS NOT TRUE) AS offline, "
        f'count(*) FILTER (WHERE silent_s > {SILENT_S}) AS "silent for {SILENT_S // 60} min" '
        f"FROM {GATEWAY_STATUS.name} WHERE {SITES}"
    )], "stat", 8, 4),
    Panel("Samples and events", "none", [Query(
        "SELECT sum(missing) AS missing, sum(dropped) AS dropped, sum(thinned) AS thinned, "
        f'sum(in_spool) AS "in spool" FROM {GATEWAY_STATUS.name} WHERE {SITES}'
    )], "stat", 10, 4, "Sums of the ledgers of all boots."),
    Panel("Rejected messages", "none", [Query(
        f"SELECT count(*) AS messages FROM {REJECTED.name} WHERE $__timeFilter(rejected_at)"
    )], "stat", 6, 4, "All sites."),
    table("State of the gateways", "SELECT site, gateway, online, reason, version, silent_s, missing, dropped, "
          f"thinned, in_spool, utc_set FROM {GATEWAY_STATUS.name} WHERE {SITES} "
          "ORDER BY online NULLS FIRST, silent_s DESC", width=16, height=10,
          overrides=[LINK, override("silent_s", unit="s")]),
    table("Largest backlog", f"SELECT gateway, in_spool FROM {GATEWAY_STATUS.name} WHERE {SITES} AND in_spool > 0 "
          "ORDER BY in_spool DESC", width=5, height=10, overrides=[LINK]),
    table("Versions", f"SELECT version, count(*) AS gateways FROM {GATEWAY_STATUS.name} WHERE {SITES} "
          "GROUP BY version ORDER BY version", width=3, height=10),
    Panel("Dropped samples and events by cause", "none", [Query(
        f'SELECT {TIME}, cause AS metric, sum(last - first + 1) AS dropped FROM {DROPPED.name} '
        f"WHERE {SITES} AND $__timeFilter(time) GROUP BY 1, 2 ORDER BY 1"
    )], width=12),
    Panel("Events by kind", "none", [Query(
        f'SELECT {TIME}, kind AS metric, count(*) AS events FROM {EVENTS.name} '
        f"WHERE {SITES} AND $__timeFilter(time) GROUP BY 1, 2 ORDER BY 1"
    )], width=12),
    table("Events", f"SELECT time, site, gateway, device, kind, message FROM {EVENTS.name} {NEWEST}", width=12),
    table("Dropped ranges", "SELECT time, site, gateway, device, stream, cause, first, last "
          f"FROM {DROPPED.name} {NEWEST}", width=12),
])  # fmt: skip
ONE_GATEWAY: Final = Row("$gateway", [
    table("Ledger", "SELECT device, stream, boot, updated_at, newest, whole, thinned, dropped, missing, duplicates, "
          f"in_spool, balance FROM {STREAMS.name} WHERE {GATEWAY} ORDER BY updated_at DESC"),
])  # fmt: skip
ONE_DEVICE: Final = Row("$gateway: $device", [
    over_time("Acceleration: mean, minimum and maximum", "accel_m_s2"),
    over_time("Acceleration: RMS", "accel_m_s2", ("rms",)),
    over_time("Angular rate: mean, minimum and maximum", "gyro_rad_s"),
    over_time("Attitude: mean, minimum and maximum", "euler_rad"),
    over_time("Magnetic field: mean, minimum and maximum", "mag_t"),
    over_time("Temperature: mean, minimum and maximum", "temperature_c"),
], repeat="device")  # fmt: skip

_DEVICES: Final = f"SELECT DISTINCT unnest(devices) FROM {GATEWAYS.name} WHERE {GATEWAY}"
DASHBOARD: Final = Dashboard(
    title="imud fleet", uid="imud-fleet", file=ROOT / "etc/grafana/imud-fleet.json", source=SOURCE, refresh="1m",
    begin="now-6h",
    variables=(
        source("PostgreSQL", SOURCE["type"]),
        variable("site", SOURCE, f"SELECT DISTINCT site FROM {GATEWAYS.name}", f"SELECT site FROM {GATEWAYS.name}"),
        variable("gateway", SOURCE, f"SELECT gateway FROM {GATEWAYS.name} WHERE {SITES}"),
        variable("device", SOURCE, _DEVICES, _DEVICES),
    ),
    rows=(FLEET, ONE_GATEWAY, ONE_DEVICE),
)  # fmt: skip


if __name__ == "__main__":
    DASHBOARD.write()
