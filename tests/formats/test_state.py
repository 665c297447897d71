"""Tables of the state of an object: types, ranges, numbers of fields, and attributes that no table names."""

from collections import deque
from contextlib import suppress
from enum import Enum
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats.state import (
    STATE_BYTES_MAX,
    CodecState,
    Data,
    Each,
    Extreme,
    Field,
    Flag,
    Integer,
    Items,
    Map,
    Maybe,
    New,
    OneOf,
    Present,
    Real,
    Row,
    SameAs,
    StateError,
    StateTable,
    Values,
    ValueType,
    decode_state,
    encode_state,
    member_of,
)


class Holder:
    def __init__(self, value: object, other: object = None) -> None:
        self.value = value
        self.other = other


class Place(NamedTuple):
    t_ns: int
    number: int


class Color(Enum):
    RED = "red"
    BLUE = "blue"


def through(kind: ValueType, value: object, new: object = None) -> Any:
    """Save a value of a type, and load it into an object with the value `new`."""
    table = StateTable((Field(1, "value", kind),), {"other": "not state"})
    saved = decode_state(1, encode_state(1, table.save(Holder(value))))
    return table.load(saved, Holder(new)).value


BYTE = Integer(0, 0xFF)


@pytest.mark.parametrize(
    ("kind", "value", "new"),
    [
        (Flag(), True, False), (BYTE, 255, 0), (Real(-1, 1), -0.5, 0.0), (Real(-9, 9), 7, 0.0), (Data(3), b"abc", b""),
        (Real(0, 9, 1.0), 0.0, 0.0), (Extreme(-1, 1), float("inf"), float("inf")), (Extreme(-1, 1), 0.5, float("inf")),
        (member_of(Color), Color.BLUE, Color.RED), (Maybe(BYTE), None, 3), (Maybe(BYTE), 3, None),
        (Present(BYTE), None, None), (Present(BYTE), 4, 5), (Items(BYTE, 2), [1, 2], []), (Items(BYTE, 2), [1, 2], ()),
        (Each(BYTE), [1, 2], [3, 4]), (Values(BYTE, 3), {3, 1}, set()), (Map(BYTE, Data(2), 2), {2: b"a", 1: b"b"}, {}),
        (Row(BYTE, Flag()), (1, True), None), (Row(BYTE, BYTE, make=Place), Place(1, 2), None),
    ],
)  # fmt: skip
def test_values_are_restored(kind: ValueType, value: object, new: object) -> None:
    found = through(kind, value, new)
    assert found == value
    assert type(found) is type(value)


def test_containers_of_the_new_object_are_kept() -> None:
    new = deque([9], maxlen=2)
    assert through(Items(BYTE, 2), deque([1, 2]), new) is new
    assert (list(new), new.maxlen) == ([1, 2], 2)
    counts = {9: 9}
    assert through(Map(BYTE, BYTE, 2), {1: 2}, counts) is counts
    assert counts == {1: 2}


@pytest.mark.parametrize(
    ("kind", "saved", "new"),
    [
        (Flag(), 1, False), (BYTE, 256, 0), (BYTE, -1, 0), (BYTE, True, 0), (BYTE, 1.0, 0), (BYTE, "1", 0),
        (Real(-1, 1), float("nan"), 0.0), (Real(-1, 1), float("inf"), 0.0), (Real(-1, 1), 2, 0.0),
        (Real(-1, 1), True, 0.0), (Real(0, 9, 1.0), 0.5, 0.0), (Extreme(-1, 1), None, 0.0), (Data(3), b"abcd", b""),
        (Data(3, 3), b"ab", b""), (Data(3), "abc", b""), (member_of(Color), 2, None), (member_of(Color), "RED", None),
        (member_of(Color), -1, None), (Present(BYTE), None, 1), (Present(BYTE), 1, None),
        (Items(BYTE, 2), [1, 2, 3], []),
        (Items(BYTE, 2), {}, []), (Items(BYTE, 2), None, []), (Each(BYTE), [1], [1, 2]),
        (Values(BYTE, 1), [1, 2], set()),
        (Map(BYTE, BYTE, 1), [[1, 1], [2, 2]], {}), (Map(BYTE, BYTE, 1), {1: 1}, {}), (Row(BYTE), [1, 2], None),
        (Row(BYTE), 1, None), (SameAs("other"), 0, None), (SameAs("other"), 1, None),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_invalid_values_are_errors(kind: ValueType, saved: object, new: object) -> None:
    with pytest.raises(StateError, match="value: expected"):
        StateTable((Field(1, "value", kind),)).load({1: saved}, Holder(new))


class Inner:
    __slots__ = ("count", "unset")
    STATE = StateTable((Field(7, "count", BYTE),), {"unset": "not state"})

    def __init__(self) -> None:
        self.count = 0


def test_objects_come_from_the_table_or_the_new_object() -> None:
    old, new = Inner(), Inner()
    old.count = 5
    assert through(Inner.STATE, old, new) is new
    assert new.count == 5
    made = through(New(Inner.STATE, lambda _owner: Inner()), old)
    assert (type(made), made.count) == (Inner, 5)
    assert through(CodecState(), old, new) is new
    for kind in (Inner.STATE, CodecState()):
        with pytest.raises(StateError):
            StateTable((Field(1, "value", kind),)).load({1: {7: 5}}, Holder(None))
    for value in (Holder(1), 7, None):
        with pytest.raises(StateError, match="no table of the state of its codec"):
            through(CodecState(), value, value)


def test_an_attribute_can_be_the_object_of_another_attribute() -> None:
    table = StateTable(
        (Field(1, "other", Maybe(New(Inner.STATE, lambda _owner: Inner()))), Field(2, "value", SameAs("other")))
    )
    inner, new = Inner(), Holder(None)
    table.load(table.save(Holder(inner, inner)), new)
    assert new.value is new.other
    assert type(new.value) is Inner
    with pytest.raises(StateError):
        table.save(Holder(Inner(), inner))
    with pytest.raises(StateError):
        StateTable((Field(1, "value", OneOf(1, 2)),), {"other": ""}).save(Holder(3))


def test_attributes_outside_the_table_are_errors_when_saving() -> None:
    """A codec of another package can be a subclass with more attributes."""

    class More(Inner):
        def __init__(self) -> None:
            super().__init__()
            self.more = 1

    with pytest.raises(StateError, match="the table of the state of More does not name the attribute more"):
        More.STATE.save(More())
    with pytest.raises(StateError, match="value: "):
        StateTable((Field(1, "value", Items(BYTE, 2)),), {"other": ""}).save(Holder(7))


def test_only_fields_of_the_table_change() -> None:
    holder = Holder(1, 2)
    table = StateTable((Field(1, "value", BYTE),), {"other": "not state"})
    table.load({1: 5, 2: 6, 99: "unknown"}, holder)
    assert (holder.value, holder.other, set(vars(holder))) == (5, 2, {"value", "other"})
    table.load({}, holder)
    assert holder.value == 5
    for saved in ({"value": 5}, {"__class__": 5}):
        table.load(saved, holder)
        assert (holder.value, type(holder)) == (5, Holder)
    for junk in ([5], None, 5, "value"):
        with pytest.raises(StateError):
            table.load(junk, holder)


def test_sizes_and_revisions() -> None:
    assert decode_state(3, encode_state(3, {1: "a"})) == {1: "a"}
    with pytest.raises(StateError, match="revision 3"):
        decode_state(4, encode_state(3, {}))
    with pytest.raises(StateError, match="expected at most"):
        encode_state(1, {1: bytes(STATE_BYTES_MAX)})
    with pytest.raises(StateError, match="expected at most"):
        decode_state(1, bytes(STATE_BYTES_MAX + 1))
    with pytest.raises(StateError, match="cannot write"):
        encode_state(1, {1: 1 << 70})


@given(st.binary(max_size=60))
def test_any_bytes_raise_state_error(data: bytes) -> None:
    with suppress(StateError):
        assert isinstance(decode_state(1, data), dict)
    assert decode_state(1, msgspec.msgpack.encode([1, {1: data}])) == {1: data}
