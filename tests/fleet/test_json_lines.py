"""Lines of the collector: every record once, with where it is from."""

import io
import json
import math

import msgspec

from imud.event import Event, EventKind
from imud.fleet import FleetBatch
from imud.fleet.json_lines import JsonLines, lines_of
from imud.formats.fleet.messages import Interval, Measures, MessageKind
from imud.formats.fleet.topics import Stream
from imud.sample import Sync
from tests.fleet.fleet_gateway import dropped_message, samples_message

HEAD = {"site": "mill", "gateway": "gw", "boot": "1", "device": "bow", "stream": "samples"}


def test_a_sample_has_what_it_has() -> None:
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, samples_message(3, 3)))
    assert json.loads(line) == HEAD | {
        "kind": "sample", "seq": 3, "t_ns": 3_000_000, "t_err_ns": 500, "sync": "edge", "t_rx_ns": 3_000_010,
        "utc_ns": 1_790_000_000_003_000_000, "accel_m_s2": [0.375, 0.0, 9.75], "temperature_c": 21.5,
    }  # fmt: skip


def test_what_json_has_not_is_null() -> None:
    message = samples_message(1, 1)
    sample = msgspec.structs.replace(message.samples[0], accel_m_s2=(math.nan, 0.0, math.inf))
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, msgspec.structs.replace(message, samples=[sample])))
    assert json.loads(line)["accel_m_s2"] == [None, 0.0, None]


def test_dropped_intervals_and_events_have_their_kinds() -> None:
    interval = Interval(1, 2, 2, 0, 0, 0, 0, 0, Sync.EDGE, {"accel_m_s2": Measures(mean=(1.0, 2.0, 3.0))})
    thinned = msgspec.structs.replace(
        samples_message(1, 2), kind=MessageKind.INTERVALS, samples=[], intervals=[interval]
    )
    event = msgspec.structs.replace(
        samples_message(1, 1), kind=MessageKind.EVENTS, samples=[], events=[Event(5, "bow", EventKind.UP, "it is up")]
    )
    out = io.StringIO()
    batches = [
        FleetBatch("mill", Stream.SAMPLES, dropped_message(1, 4)),
        FleetBatch("mill", Stream.SAMPLES, thinned),
        FleetBatch("mill", Stream.EVENTS, event),
    ]
    JsonLines(out).write(batches, {})
    dropped, found, up = map(json.loads, out.getvalue().splitlines())
    assert dropped == HEAD | {"kind": "dropped", "first": 1, "last": 4, "cause": "space"}
    assert (found["kind"], found["values"]["accel_m_s2"]["mean"]) == ("interval", [1.0, 2.0, 3.0])
    assert (up["stream"], up["kind"], up["message"]) == ("events", "event", "it is up")


def test_an_event_keeps_its_own_kind() -> None:
    event = msgspec.structs.replace(
        samples_message(1, 1), kind=MessageKind.EVENTS, samples=[], events=[Event(5, "bow", EventKind.UP, "it is up")]
    )
    (line,) = lines_of(FleetBatch("mill", Stream.EVENTS, event))
    assert json.loads(line)["event"] == "up"
