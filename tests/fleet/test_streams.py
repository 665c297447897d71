"""Messages of samples and events: numbers without gaps, intervals on their grid, messages about lost samples."""

import msgspec
import pytest

from imud.fleet.accounts import FleetLedger, StreamCounts, StreamPosition
from imud.fleet.messages import DropCause, FleetMessage, MessageKind, Stream, decode_message
from imud.fleet.settings import DeviceSending, Whole
from imud.fleet.spool import SpoolRow
from imud.fleet.streams import DeviceStreams, Gateway, notes_of
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S

SAMPLES_MAX, SLOTS_MAX, LATE_NS = 200, 500, 1 * NS_PER_S

GATEWAY = Gateway("site", "gw", "0000000000000001")


def samples(first: int, last: int, period_ns: int = NS_PER_MS) -> list[Sample]:
    return [
        Sample("bow", seq, seq * period_ns, 0, Sync.EDGE, seq * period_ns, seq, temperature_c=float(seq))
        for seq in range(first, last + 1)
    ]


def streams(**settings: object) -> DeviceStreams:
    return DeviceStreams(GATEWAY, "bow", 0, msgspec.convert(settings, DeviceSending))


def messages(rows: list[SpoolRow]) -> list[FleetMessage]:
    return [decode_message(row.payload) for row in rows]


def ranges(rows: list[SpoolRow], stream: Stream) -> list[tuple[str, int, int]]:
    return [(row.kind, row.first, row.last) for row in rows if row.stream == stream]


def test_complete_samples_are_sent_in_batches_of_batch_s() -> None:
    one = streams(rate_hz=None, whole="json", batch_s=0.1)
    made = one.add(samples(1, 250))
    assert ranges(made, Stream.SAMPLES) == [("samples", 1, 99), ("samples", 100, 199)]
    assert made[0].topic == "imud/site/gw/bow/samples"
    assert messages(made)[0].samples == samples(1, 99)
    assert ranges(one.flush(), Stream.SAMPLES) == [("samples", 200, 250)]
    one = streams()
    made = [row for n in range(3) for row in one.event(Event(n, "bow", EventKind.UP, "up"), 77)]
    assert ranges(made, Stream.EVENTS) == [("events", n, n) for n in (1, 2, 3)]
    assert ranges(one.missed_events(2, 77), Stream.EVENTS) == [("dropped", 4, 5)]
    assert ranges(streams().missed_events(2, 77), Stream.EVENTS) == [("dropped", 1, 2)]
    assert streams(events=False).event(Event(0, "bow", EventKind.UP, "up"), 77) == []
    assert streams(events=False).missed_events(2, 77) == []


@pytest.mark.parametrize(("whole", "most"), [(Whole.JSON, SAMPLES_MAX), (Whole.SLOTS, SLOTS_MAX)])
def test_the_number_of_samples_in_a_message_is_limited(whole: Whole, most: int) -> None:
    one = streams(rate_hz=None, whole=whole.value, batch_s=60)
    made = one.add(samples(1, 3 * most)) + one.flush()
    assert [row.items for row in made] == [most] * 3


def test_intervals_start_on_the_grid() -> None:
    one = streams(rate_hz=10, values=["mean"], batch_s=0.2)
    made = one.add(samples(1, 1000))
    assert ranges(made, Stream.STATISTICS) == [
        ("intervals", 1, 199), ("intervals", 200, 399), ("intervals", 400, 599), ("intervals", 600, 799),
        ("intervals", 800, 999),
    ]  # fmt: skip
    first, second = messages(made)[0].intervals
    assert (first.first, first.last, first.count) == (1, 99, 99)
    assert (second.first, second.last, second.values["temperature_c"].mean) == (100, 199, (149.5,))


def test_due_messages_are_sent_without_new_samples() -> None:
    one = streams(rate_hz=1, whole="slots", batch_s=1)
    assert (one.add(samples(1000, 1010)), one.take_due(NS_PER_S * 2)) == ([], [])
    assert one.take_due(NS_PER_S * 2 + LATE_NS - 1) == []
    made = one.take_due(NS_PER_S * 2 + LATE_NS)
    assert [(row.stream, row.first, row.last) for row in made] == [
        ("samples", 1000, 1010), ("statistics", 1000, 1010),
    ]  # fmt: skip


def test_both_streams_contain_a_message_about_dropped_samples() -> None:
    one = streams(rate_hz=1, whole="slots")
    made = one.add(samples(1, 50)) + one.add([*samples(61, 70), *samples(72, 80)]) + one.flush()
    for stream in (Stream.SAMPLES, Stream.STATISTICS):
        ledger = FleetLedger(from_begin=True)
        for row in made:
            if row.stream == stream:
                ledger.take(decode_message(row.payload), stream)
        (counts,) = ledger.counts.values()
        assert counts == StreamCounts(1, 80, whole=69, dropped={"queue": 11})
    assert one.gaps == 11


def test_a_later_run_in_the_same_boot_continues_the_numbers() -> None:
    one = streams(rate_hz=None, whole="json")
    one.resume("samples", StreamPosition(GATEWAY.boot, "bow", "samples", 1, 100))
    one.resume("events", StreamPosition(GATEWAY.boot, "bow", "events", 1, 7))
    made = one.add(samples(151, 160)) + one.flush()
    assert ranges(made, Stream.SAMPLES) == [("dropped", 101, 150), ("samples", 151, 160)]
    assert messages(made)[0].cause is DropCause.OFF
    assert (messages(made)[1].begin, one.gaps) == (1, 0)
    assert one.event(Event(0, "bow", EventKind.UP, "up"), 77)[0].first == 8
    one = streams(rate_hz=100, whole="json")
    one.resume("samples", StreamPosition(GATEWAY.boot, "bow", "samples", 1, 100))
    one.resume("statistics", StreamPosition(GATEWAY.boot, "bow", "statistics", 1, 160))
    made = one.add(samples(161, 170)) + one.flush()
    assert ranges(made, Stream.SAMPLES) == [("samples", 161, 170)]


def test_dropped_messages_keep_the_numbers() -> None:
    one = streams(rate_hz=10, whole="json")
    made = one.add(samples(1, 1500)) + one.event(Event(0, "bow", EventKind.UP, "up"), 77)
    notes = notes_of(made, DropCause.DISK, "gw")
    assert {row.stream for row in notes} == set(Stream)
    for note, message in zip(notes, messages(notes), strict=True):
        rows = [row for row in made if row.stream == note.stream]
        assert (message.kind, message.cause) == (MessageKind.DROPPED, DropCause.DISK)
        assert (message.first, message.last) == (rows[0].first, rows[-1].last)
        assert message.count == sum(row.items for row in rows)
    assert notes_of(notes_of(made, DropCause.DISK, "gw"), DropCause.DISK, "gw") == notes
