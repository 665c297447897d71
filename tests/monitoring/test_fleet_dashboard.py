"""The dashboard of a fleet: a real PostgreSQL with rows of three gateways answers every query as Grafana sends it.

Grafana itself does not run in this test.
"""

import re
from collections.abc import Iterator, Sequence
from datetime import timedelta
from decimal import Decimal
from typing import Any, Final

import pytest

from docs.generate.fleet_dashboard import DASHBOARD, ONE_DEVICE, Query
from docs.generate.grafana import Panel
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import COMPONENTS, DROPPED, EVENTS, GATEWAYS, INTERVALS, LEDGER, REJECTED
from imud.fleet.database.upkeep import Upkeep
from imud.fleet.statistics import MEASURES
from tests.fleet.database.fleet_rows import START, insert
from tests.fleet.postgres_server import NO_POSTGRES, running_server

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]

UNITS: Final = {"m_s2": "accMS2", "rad_s": "rotrads", "rad": "radian", "t": "si:T", "c": "celsius"}
DAY: Final = START.replace(hour=0)
HOURS: Final = 3
PERIOD_S: Final = 60
BEFORE_S: Final = -86_400
"""Time of rows before the time range of all queries, s."""
SITES: Final = {"gw-1": "mill", "gw-2": "mill", "gw-3": "o'neill"}
PANELS: Final = [panel for row in DASHBOARD.rows for panel in row.panels]


@pytest.fixture(scope="module")
def cursor() -> Iterator[Any]:
    import psycopg

    with running_server() as server, psycopg.connect(server.url) as connection:
        made = connection.cursor()
        Upkeep(CollectorSettings()).prepare(made)
        fill(made)
        yield made


def fill(cursor: Any) -> None:
    """Insert three hours of a fleet. Device `bow` of gw-1 rolls by 0.1 rad, the other devices are level."""
    for gateway, site in SITES.items():
        names: dict[str, Any] = {"gateway": gateway, "site": site}
        insert(cursor, GATEWAYS, online=gateway != "gw-2", reason="", devices=["bow", "mast"], **names)
        insert(cursor, REJECTED, rejected_at=START)
        for device in ("bow", "mast"):
            insert(cursor, LEDGER, device=device, newest=90, whole=80, missing=10, sent=100, **names)
            for at_s in (BEFORE_S, 60):
                insert(cursor, EVENTS, at_s, device=device, **names)
                insert(cursor, DROPPED, at_s, device=device, first=5, last=9, **names)
            roll = 0.1 if (gateway, device) == ("gw-1", "bow") else 0.0
            for at_s in (BEFORE_S, *range(30, HOURS * 3600, PERIOD_S)):
                values: dict[str, Any] = {
                    one.column(measure): roll + {"min": -1.0, "max": 1.0}.get(measure, 0.0) - at_s * 1e-6
                    for one in COMPONENTS for measure in MEASURES
                }  # fmt: skip
                insert(cursor, INTERVALS, at_s, device=device, **values, **names)


def filled_in(sql: str, length: timedelta, interval_s: int, **values: Sequence[str]) -> str:
    """Return a query as Grafana sends it: https://grafana.com/docs/grafana/latest/datasources/postgres/."""
    begin, end = (time.isoformat().replace("+00:00", "Z") for time in (DAY, DAY + length))
    sql = sql.replace("$__interval", f"{interval_s}s")
    for pattern, replacement in (
        (r"\$__timeGroupAlias\((\w+), ?(\d+)s\)", r'floor(extract(epoch from \1)/\2)*\2 AS "time"'),
        (r"\$__timeFilter\((\w+)\)", rf"\1 BETWEEN '{begin}' AND '{end}'"),
        (r"\$__timeFrom\(\)", f"'{begin}'"),
        (r"\$__timeTo\(\)", f"'{end}'"),
    ):
        sql = re.sub(pattern, replacement, sql)
    for name, chosen in values.items():
        quoted = ",".join("'" + one.replace("'", "''") + "'" for one in chosen)
        sql = sql.replace(f"${{{name}:sqlstring}}", quoted)
    assert "$" not in sql
    return sql


class Answer:
    """Rows of one query."""

    def __init__(self, cursor: Any, query: Query, length: timedelta, **values: Sequence[str]) -> None:
        chosen = {"site": ["mill", "o'neill"], "gateway": ["gw-1"], "device": ["bow"]} | values
        cursor.execute(filled_in(query.sql, length, 10, **chosen).encode())
        self.columns = [one.name for one in cursor.description]
        self.rows = cursor.fetchall()

    def column(self, name: str) -> list[Any]:
        return [row[self.columns.index(name)] for row in self.rows]


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.title)
def test_every_query_has_rows_that_the_panel_can_show(cursor: Any, panel: Panel[Query]) -> None:
    (query,) = panel.queries
    for length in (timedelta(days=1), timedelta(days=7), timedelta(days=365)):
        answer = Answer(cursor, query, length)
        assert answer.rows
        if panel.kind == "table":
            continue
        series = answer.columns
        if panel.kind == "timeseries":
            assert answer.columns[0] == "time"
            assert answer.column("time") == sorted(answer.column("time"))
            series = answer.columns[1:]
        assert series
        for name in series:
            kinds = (str,) if name == "metric" else (int, float, Decimal)
            assert all(isinstance(value, kinds) for value in answer.column(name)), name


@pytest.mark.parametrize("panel", ONE_DEVICE.panels, ids=lambda panel: panel.title)
def test_panels_of_a_device_read_intervals_hours_or_days(cursor: Any, panel: Panel[Query]) -> None:
    (query,) = panel.queries
    first = START + timedelta(seconds=30)
    columns = {one.column(measure): one.unit for one in COMPONENTS for measure in MEASURES}
    assert {UNITS[columns[name]] for name in re.findall(r"\w+", query.sql) if name in columns} == {panel.unit}
    for days, begin, period_s, count in (
        (1, first, PERIOD_S, 180), (2, first, PERIOD_S, 180), (3, START, 3600, 3), (91, DAY, 86_400, 1),
    ):  # fmt: skip
        times = [float(one) for one in Answer(cursor, query, timedelta(days=days)).column("time")]
        assert times == [begin.timestamp() + number * period_s for number in range(count)]
    names = {override["matcher"]["options"] for override in panel.overrides}
    names |= {one["value"] for override in panel.overrides for one in override["properties"] if one["value"]} - {15}
    answer = Answer(cursor, query, timedelta(days=7))
    assert names <= {*answer.columns}
    for name in answer.columns[1:]:
        if f"{name} max" in answer.columns:
            for value, low, high in zip(*map(answer.column, (name, f"{name} min", f"{name} max")), strict=True):
                assert low < value < high


def test_variables_select_rows(cursor: Any) -> None:
    panels = {panel.title: panel.queries[0] for panel in PANELS}
    day = timedelta(days=1)
    answer = Answer(cursor, panels["State of the gateways"], day, site=["mill"])
    assert answer.column("gateway") == ["gw-2", "gw-1"]  # offline first
    assert Answer(cursor, panels["Gateways"], day).rows == [(2, 1, 3)]
    assert Answer(cursor, panels["Gateways"], day, site=["o'neill"]).rows == [(1, 0, 1)]
    assert Answer(cursor, panels["Samples and events"], day).rows == [(60, 0, 0, 60)]
    assert Answer(cursor, panels["Dropped samples and events by cause"], day, site=["mill"]).rows[0][1:] == (
        "space",
        20,
    )
    assert (
        len(Answer(cursor, panels["Events"], day).rows) == len(Answer(cursor, panels["Dropped ranges"], day).rows) == 6
    )
    roll = panels["Attitude: mean, minimum and maximum"]
    for gateway, device, expected in (("gw-1", "bow", 0.1), ("gw-1", "mast", 0.0), ("gw-2", "bow", 0.0)):
        answer = Answer(cursor, roll, day, gateway=[gateway], device=[device])
        assert answer.column("roll") == pytest.approx([expected] * (HOURS * 3600 // PERIOD_S), abs=0.02)


def test_variables_have_values(cursor: Any) -> None:
    values: dict[str, list[str]] = {}
    for variable in DASHBOARD.variables:
        for query in filter(None, (variable["query"] if "definition" in variable else "", variable.get("allValue"))):
            cursor.execute(filled_in(query, timedelta(1), 1, **values).encode())
            values[variable["name"]] = sorted({value for (value,) in cursor})
    assert values == {"site": ["mill", "o'neill"], "gateway": ["gw-1", "gw-2", "gw-3"], "device": ["bow", "mast"]}
    every = DASHBOARD.variables[1]["allValue"]
    (query,) = PANELS[0].queries
    cursor.execute(filled_in(query.sql.replace("${site:sqlstring}", every), timedelta(1), 1).encode())
    assert cursor.fetchall() == [(2, 1, 3)]
