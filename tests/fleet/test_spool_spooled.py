"""Rows of the spool: undamaged, repaired and deleted rows, for all types of SQLite."""

import msgspec
import pytest

from imud.fleet.messages import DropCause, MessageKind, Stream, decode_message
from imud.fleet.spool import SpoolRow, is_position, repaired_row, row_of, undamaged_row
from tests.fleet.test_spool import batch

FOREIGN = (None, 1.5, "text", b"\xff", -1, 1 << 63)  # values that SQLite can return in any column


def test_a_row_survives_storing() -> None:
    assert undamaged_row(tuple(batch(1))) == batch(1)
    assert undamaged_row(tuple(batch(7, 1, whole=False))) == batch(7, 1, whole=False)


@pytest.mark.parametrize("column", SpoolRow._fields[1:])
def test_a_column_of_another_type_is_detected_or_harmless(column: str) -> None:
    """Any number is a valid time. No sent message contains `items`."""
    for value in FOREIGN:
        row = undamaged_row(tuple(value if name == column else one for name, one in batch(1)._asdict().items()))
        assert row is None or column in ("stored_utc_ns", "items"), value


@pytest.mark.parametrize("column", ["kind", "payload"])
def test_a_row_with_known_numbers_becomes_a_dropped_message(column: str) -> None:
    row = repaired_row([17 if name == column else one for name, one in batch(101)._asdict().items()])
    assert row is not None
    note = decode_message(row.payload)
    assert (note.kind, note.cause, note.first, note.last, note.count) == (
        MessageKind.DROPPED, DropCause.DAMAGED, 101, 200, 100,
    )  # fmt: skip
    assert (note.gateway, note.boot, note.device) == ("gw", "1", "bow")
    assert undamaged_row(tuple(row)) == row


@pytest.mark.parametrize("change", [{"last": 900}, {"items": 3}, {"topic": "imud/x"}, {"boot": ""}, {"first": 0}])
def test_a_row_with_inconsistent_numbers_does_not_become_a_dropped_message(change: dict[str, object]) -> None:
    """A `dropped` message with wrong numbers would make other messages duplicates."""
    assert repaired_row([change.get(name, one) for name, one in batch(101)._asdict().items()]) is None


def test_the_numbers_of_the_payload_are_checked() -> None:
    message = decode_message(batch(1).payload)
    for name, value in (("first", 2), ("last", 99), ("boot", "2"), ("device", "stern"), ("gateway", "other")):
        other = msgspec.structs.replace(message, kind=MessageKind.EVENTS, samples=[], **{name: value})
        row = row_of(batch(1).topic, Stream.SAMPLES, message, msgspec.json.encode(other), 0)
        assert undamaged_row(tuple(row)) is None, name


def test_positions() -> None:
    assert is_position(("1", "bow", "samples", 1, 9))
    assert is_position(("1", "", "events", 9, 9))
    for values in (
        ("1", "bow", "samples", 0, 9), ("1", "bow", "samples", 9, 1), ("1", "bow", "other", 1, 9),
        ("\ufffd", "bow", "samples", 1, 9), ("1", "bow", "samples", 1, "9"), ("1", None, "samples", 1, 9),
        ("1", "bow", "samples", 1, 1 << 62),
    ):  # fmt: skip
        assert not is_position(values), values
