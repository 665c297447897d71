"""Rows in a real PostgreSQL: each value of a message in its own column."""

from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import pytest

from imud.fleet.accounts import BootOffset
from imud.fleet.database.rows import TurnRows, columns_of
from imud.fleet.database.tables import COMPONENTS, TABLES, Component, FleetTable
from imud.fleet.messages import DropCause, FleetMessage, Interval, Measures, Stream
from imud.fleet.reader import FleetBatch
from imud.fleet.statistics import MEASURES, SCALARS, VECTORS
from imud.model.event import Event, EventKind
from imud.model.sample import SAMPLE_FIELDS, Position, Sample, Sync
from tests.fleet.database.deliveries import write
from tests.fleet.fleet_gateway import (
    UTC_NS,
    dropped_message,
    event_message,
    intervals_message,
    not_set,
    samples_message,
    synchronised,
)
from tests.fleet.postgres_server import query

SIZES = {name: sum(one.field == name for one in COMPONENTS) for name in (*VECTORS, *SCALARS)}
NAMES = {
    "accel_m_s2": ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2"),
    "gyro_rad_s": ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"),
    "mag_t": ("mag_x_t", "mag_y_t", "mag_z_t"),
    "quat_wxyz": ("quat_w", "quat_x", "quat_y", "quat_z"),
    "euler_rad": ("roll_rad", "pitch_rad", "yaw_rad"),
    "incli_rad": ("incli_x_rad", "incli_y_rad"),
    "velocity_enu_m_s": ("velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s"),
    "temperature_c": ("temperature_c",), "pressure_pa": ("pressure_pa",), "heave_m": ("heave_m",),
}  # fmt: skip


def rows(url: str, table: str) -> list[dict[str, Any]]:
    """Return the rows of a table without columns that are NULL."""
    found = query(url, f"SELECT to_jsonb({table}) FROM {table} ORDER BY utc_ns")
    given = [{name: value for name, value in row.items() if value is not None} for (row,) in found]
    return [row | {"time": datetime.fromisoformat(row["time"])} for row in given]


def time(utc_ns: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)


HEAD = {"site": "mill", "gateway": "gw", "boot": "1", "device": "bow"}


def clock(t_ns: int) -> dict[str, object]:
    return {"time": time(UTC_NS + t_ns), "utc_ns": UTC_NS + t_ns, "utc_set": True, "utc_err_ns": 1000}


@pytest.mark.live
def test_each_value_of_a_sample_has_its_column(database: str) -> None:
    values: dict[str, Any] = {
        name: tuple(-1.5 * at - number for at in range(SIZES[name])) if name in VECTORS else 0.1 + number
        for number, name in enumerate(SIZES, 1)
    }
    position = Position(0.5, -0.25, 101.5, 4, 12)
    numbers = {"t_dev_ns": 7, "status": 1 << 40, "pps_age_ms": 8, "edge_seq": 9, "gnss_utc_ns": 10}
    (bare,) = samples_message(1, 1).samples
    bare = msgspec.structs.replace(bare, accel_m_s2=None, temperature_c=None)
    others = {"seq": 2, "t_ns": 2_000_000, "t_rx_ns": 2_000_010, "utc_ns": UTC_NS + 2_000_000, "sync": Sync.UTC}
    full = msgspec.structs.replace(bare, position=position, **others, **numbers, **values)
    assert all(getattr(full, name) is not None for name in SAMPLE_FIELDS)
    message = msgspec.structs.replace(synchronised(samples_message(1, 2)), samples=[bare, full])
    # the message of another device has other columns
    write(database, message, synchronised(samples_message(3, 3, device="aft")))
    first, second, third = rows(database, "imud_samples")
    base = {"seq": 1, "t_ns": 1_000_000, "t_err_ns": 500, "sync": "edge", "t_rx_ns": 1_000_010}
    assert first == HEAD | clock(1_000_000) | base
    expected = {
        column: value
        for name, columns in NAMES.items()
        for column, value in zip(columns, values[name] if name in VECTORS else (values[name],), strict=True)
    }
    assert second == HEAD | clock(2_000_000) | base | numbers | expected | {
        "seq": 2, "t_ns": 2_000_000, "t_rx_ns": 2_000_010, "sync": "utc", "latitude_rad": 0.5, "longitude_rad": -0.25,
        "height_m": 101.5, "position_quality": 4, "satellites": 12,
    }  # fmt: skip
    assert (third["device"], third["accel_x_m_s2"], third["temperature_c"]) == ("aft", 0.375, 21.5)


def wide_interval() -> Interval:
    """Return an interval with all values. Each value is different."""
    (one,) = intervals_message(4, 5).intervals
    values = {
        name: Measures(*(tuple(100.0 * number + 10 * at + axis for axis in range(size)) for at in range(len(MEASURES))))
        for number, (name, size) in enumerate(SIZES.items())
    }
    return msgspec.structs.replace(one, values=values, status=5)


@pytest.mark.live
def test_each_value_of_an_interval_has_its_column(database: str) -> None:
    wide, narrow = wide_interval(), intervals_message(6, 9).intervals[0]
    message = synchronised(msgspec.structs.replace(intervals_message(4, 9), intervals=[narrow, wide]))
    write(database, message)
    found, other = rows(database, "imud_intervals")
    for name, columns in NAMES.items():
        unit = {"quat_wxyz": "", "velocity_enu_m_s": "_m_s"}.get(name, name[name.index("_") :])
        for measure in MEASURES:
            for at, column in enumerate(columns):
                place = f"{column.removesuffix(unit)}_{measure}{unit}"
                assert found.pop(place) == getattr(wide.values[name], measure)[at]
    base = {"stream": "statistics", "samples": 2, "t_err_ns": 500, "sync": "edge"}
    assert found == HEAD | clock(4_000_000) | base | {
        "first": 4, "last": 5, "t_ns": 4_000_000, "end_t_ns": 5_000_000, "end_utc_ns": UTC_NS + 5_000_000, "status": 5,
    }  # fmt: skip
    assert other == HEAD | clock(6_000_000) | base | {
        "first": 6, "last": 9, "samples": 4, "t_ns": 6_000_000, "end_t_ns": 9_000_000,
        "end_utc_ns": UTC_NS + 9_000_000, "accel_x_mean_m_s2": 1.0, "accel_y_mean_m_s2": 2.0, "accel_z_mean_m_s2": 3.0,
    }  # fmt: skip


@pytest.mark.live
def test_events_and_dropped_ranges_have_columns(database: str) -> None:
    details: dict[str, str | int | float | bool | None] = {"seq": 7, "text": "ü", "on": None}
    events = [Event(1_000_000, "bow", EventKind.MARK, "é\n", details), Event(6_000_000, "bow", EventKind.UP, "")]
    message = synchronised(msgspec.structs.replace(event_message(3, 6_000_000), events=events, last=4))
    unknown = msgspec.structs.replace(dropped_message(8, 9), cause=None)
    write(database, message, dropped_message(1, 7), unknown)
    first, second = rows(database, "imud_events")
    mark = {"number": 3, "t_ns": 1_000_000, "kind": "mark", "message": "é\n", "details": details}
    assert first == HEAD | clock(1_000_000) | mark
    up = {"number": 4, "t_ns": 6_000_000, "kind": "up", "message": ""}
    assert second == HEAD | clock(6_000_000) | up
    dropped, other = rows(database, "imud_dropped")
    at = {"time": time(UTC_NS + 7_000_000), "utc_ns": UTC_NS + 7_000_000, "utc_set": True}
    assert dropped == HEAD | at | {"stream": "samples", "first": 1, "last": 7, "cause": "space"}
    assert (other["first"], other["cause"]) == (8, "unknown")


KNOWN = BootOffset(0, UTC_NS, 40)


def record(message: FleetMessage, offset: BootOffset | None = None) -> dict[str, object]:
    """Return the only row of a message."""
    turn = TurnRows()
    turn.add(FleetBatch("mill", Stream.STATISTICS, message, offset), columns_of(message.intervals))
    (own,) = [one for one in turn.tables if one.count]
    (row,) = own.rows(own.names)
    return dict(zip(own.names, row, strict=True))


def test_a_record_without_a_clock_uses_the_offset_of_its_boot() -> None:
    for message, t_ns in (
        (samples_message(1, 1, utc_ns=0), 1_000_000), (intervals_message(2, 4, utc_ns=0), 2_000_000),
        (event_message(5, 5_000_000, utc_ns=0), 5_000_000),
        (msgspec.structs.replace(dropped_message(6, 7), utc_ns=7_000_000), 7_000_000),
    ):  # fmt: skip
        waiting, known = record(not_set(message)), record(not_set(message), KNOWN)
        assert (waiting["utc_ns"], waiting["utc_set"], waiting["utc_err_ns"]) == (t_ns, False, None)
        assert (known["utc_ns"], known["utc_set"], known["t_ns"]) == (UTC_NS + t_ns, True, t_ns)
        assert known["utc_err_ns"] == 40 + t_ns // 2000
    found = record(not_set(intervals_message(2, 4, utc_ns=0)), KNOWN)
    assert found["end_utc_ns"] == UTC_NS + 4_000_000
    found = record(msgspec.structs.replace(dropped_message(6, 7), cause=DropCause.AGE, utc_ns=-1))
    # one ns before 1970, µs since 2000
    assert (found["time"], found["utc_ns"], found["utc_set"]) == (-946_684_800_000_001, -1, False)
    assert (found["t_ns"], found["cause"]) == (None, "age")


@pytest.mark.parametrize(
    ("name", "measures", "problem"),
    [
        ("light", Measures(mean=(1.0,)), r"expected values of accel_m_s2, .*, got 'light'; is the imud of the gateway"),
        ("light", Measures(), "got 'light'"),
        ("mag_t", Measures(mean=(1.0, 2.0, 3.0), rms=(1.0, 2.0)), "expected 3 components of mag_t, got 2"),
    ],
)
def test_values_without_a_column_are_reported(name: str, measures: Measures, problem: str) -> None:
    (one,) = intervals_message(4, 5).intervals
    columns_of([one, wide_interval()])
    bad = msgspec.structs.replace(one, values=one.values | {name: measures})
    with pytest.raises(ValueError, match=problem):
        columns_of([wide_interval(), bad])


def test_tables_describe_each_component_of_samples_and_intervals() -> None:
    """Columns have unique names and comments. The type of a component in the message gives its number of columns."""
    for table in TABLES:
        assert len(set(table.names)) == len(table.names)
        assert all(one.comment for one in table.columns), table.name
        assert set(table.primary) <= set(table.names)
    assert {name: tuple(one.column() for one in COMPONENTS if one.field == name) for name in SIZES} == NAMES
    schema = msgspec.json.schema(Sample)["$defs"]["Sample"]["properties"]
    assert {name: schema[name]["anyOf"][0].get("maxItems", 1) for name in SIZES} == SIZES
    one = FleetTable("imud_x", "it's", (TABLES[0].columns[0],), ())
    assert "COMMENT ON TABLE imud_x IS 'it''s'" in list(one.statements())
    assert Component("heave_m", None, "heave", "m", "").column("min") == "heave_min_m"
