"""Lines of the collector: each record once, with its source."""

import io
import json
import math

import msgspec

from imud.fleet.accounts import BootClocks
from imud.fleet.collector import JsonLines, lines_of
from imud.fleet.messages import FleetMessage, Stream
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

HEAD = {"site": "mill", "gateway": "gw", "boot": "1", "device": "bow", "stream": "samples"}


def test_the_line_of_a_sample_contains_its_values() -> None:
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, samples_message(3, 3)))
    assert json.loads(line) == HEAD | {
        "kind": "sample", "seq": 3, "t_ns": 3_000_000, "t_err_ns": 500, "sync": "edge", "t_rx_ns": 3_000_010,
        "utc_ns": 1_790_000_000_003_000_000, "accel_m_s2": [0.375, 0.0, 9.75], "temperature_c": 21.5,
    }  # fmt: skip
    message = samples_message(1, 1)
    sample = msgspec.structs.replace(message.samples[0], accel_m_s2=(math.nan, 0.0, math.inf))
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, msgspec.structs.replace(message, samples=[sample])))
    assert json.loads(line)["accel_m_s2"] == [None, 0.0, None]


def test_lines_of_dropped_records_intervals_and_events_have_kinds() -> None:
    out = io.TextIOWrapper(io.BytesIO())
    batches = [
        FleetBatch("mill", Stream.SAMPLES, dropped_message(1, 4)),
        FleetBatch("mill", Stream.SAMPLES, intervals_message(1, 2)),
        FleetBatch("mill", Stream.EVENTS, event_message(1, 5)),
    ]
    JsonLines(out).write(batches, {}, {})
    dropped, found, up = map(json.loads, out.buffer.getvalue().splitlines())
    assert dropped == HEAD | {
        "kind": "dropped", "first": 1, "last": 4, "cause": "space", "utc_ns": UTC_NS + 4_000_000,
    }  # fmt: skip
    assert (found["kind"], found["values"]["accel_m_s2"]["mean"]) == ("interval", [1.0, 2.0, 3.0])
    assert (up["stream"], up["kind"], up["event"], up["message"]) == ("events", "event", "up", "it is up")


def test_lines_report_an_unset_clock_and_a_later_line_contains_its_offset() -> None:
    messages = [
        samples_message(1, 1, utc_ns=0), intervals_message(2, 3, utc_ns=0), event_message(4, 4_000_000, utc_ns=0),
        dropped_message(5, 6),
    ]  # fmt: skip
    out, clocks = io.StringIO(), BootClocks()

    def write(message: FleetMessage) -> None:
        offset = clocks.take(message)
        JsonLines(out).write([FleetBatch("mill", Stream.SAMPLES, message, offset)], {}, clocks.take_fresh())

    for one in messages:
        write(not_set(one))
    write(synchronised(samples_message(7, 7), t_ns=7_000_000, error_ns=900))
    write(not_set(samples_message(8, 8, utc_ns=0)))
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [line.get("utc") for line in lines] == ["not set"] * 4 + [None] * 3
    assert [line["kind"] for line in lines] == ["sample", "interval", "event", "dropped", "sample", "clock", "sample"]
    assert lines[5] == {
        "kind": "clock", "gateway": "gw", "boot": "1", "t_ns": 7_000_000, "utc_offset_ns": UTC_NS, "utc_err_ns": 900,
    }  # fmt: skip
    assert lines[0]["t_ns"] + lines[5]["utc_offset_ns"] == UTC_NS + 1_000_000
    assert (lines[4]["utc_ns"], lines[4]["utc_err_ns"]) == (UTC_NS + 7_000_000, 900)
    assert (lines[6]["utc_ns"], lines[6]["utc_err_ns"]) == (UTC_NS + 8_000_000, 900 + 1_000_000 // 2000)
