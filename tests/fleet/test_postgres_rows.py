"""Rows of the collector: values in the order of the columns, and UTC times."""

import json

import msgspec

from imud.fleet.accounts import BootOffset
from imud.fleet.messages import DropCause, FleetMessage, Stream
from imud.fleet.postgres import RECORDS, SAMPLES, SCHEMA, FleetTable, Row, record_rows, sample_rows
from imud.fleet.reader import FleetBatch
from tests.fleet.fleet_gateway import (
    UTC_NS,
    dropped_message,
    event_message,
    intervals_message,
    not_set,
    samples_message,
    synchronised,
)

KNOWN = BootOffset(0, UTC_NS, 40)


def named(table: FleetTable, row: Row) -> dict[str, object]:
    return dict(zip(table.names, row, strict=True))


def record(message: FleetMessage, offset: BootOffset | None = None) -> dict[str, object]:
    (row,) = record_rows(FleetBatch("mill", Stream.STATISTICS, message, offset))
    return named(RECORDS, row)


def test_a_sample_row_contains_its_values_by_column_name() -> None:
    (row,) = sample_rows(FleetBatch("mill", Stream.SAMPLES, synchronised(samples_message(3, 3), error_ns=40)))
    found = {name: value for name, value in named(SAMPLES, row).items() if value is not None}
    # 1,790,000,000 s after 1970: `date -u -d @1790000000`
    assert found == {
        "time": "2026-09-21T14:13:20.003000+00:00", "site": "mill", "gateway": "gw", "boot": "1", "device": "bow",
        "utc_ns": UTC_NS + 3_000_000, "utc_set": True, "utc_err_ns": 40, "seq": 3, "t_ns": 3_000_000, "t_err_ns": 500,
        "sync": "edge", "t_rx_ns": 3_000_010, "accel_m_s2": [0.375, 0.0, 9.75], "temperature_c": 21.5,
    }  # fmt: skip


def test_a_record_without_a_clock_uses_the_offset_of_its_boot() -> None:
    for message, t_ns in (
        (intervals_message(2, 4, utc_ns=0), 2_000_000), (event_message(5, 5_000_000, utc_ns=0), 5_000_000),
        (msgspec.structs.replace(dropped_message(6, 7), utc_ns=7_000_000), 7_000_000),
    ):  # fmt: skip
        waiting, known = record(not_set(message)), record(not_set(message), KNOWN)
        assert (waiting["utc_ns"], waiting["utc_set"], waiting["utc_err_ns"]) == (t_ns, False, None)
        assert (known["utc_ns"], known["utc_set"], known["t_ns"]) == (UTC_NS + t_ns, True, t_ns)
        assert known["utc_err_ns"] == 40 + t_ns // 2000
    content = json.loads(str(record(not_set(intervals_message(2, 4, utc_ns=0)), KNOWN)["content"]))
    assert (content["begin_utc_ns"], content["end_utc_ns"]) == (UTC_NS + 2_000_000, UTC_NS + 4_000_000)


def test_a_time_before_1970_and_dropped_records_of_an_earlier_version() -> None:
    found = record(msgspec.structs.replace(dropped_message(6, 7), cause=DropCause.AGE, utc_ns=-1))
    assert (found["time"], found["utc_ns"], found["t_ns"], found["utc_set"]) == (
        "1969-12-31T23:59:59.999999+00:00", -1, None, False,
    )  # fmt: skip
    assert found["content"] == '{"cause":"age"}'
    assert all(one.strip().startswith("CREATE TABLE IF NOT EXISTS imud_") for one in SCHEMA.values())
