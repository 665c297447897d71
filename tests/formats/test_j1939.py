"""29-bit identifiers of the manual and of the standard, split and joined."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats.can import EXTENDED_ID_MAX
from imud.formats.j1939 import GLOBAL, J1939Id, all_of, filter_of, join, sender_of, split

KNOWN = [
    (0x0CFF3408, J1939Id(3, 0xFF34, 0x08)), (0x0CEF0855, J1939Id(3, 0xEF00, 0x55, 0x08)),
    (0x0CEF5508, J1939Id(3, 0xEF00, 0x08, 0x55)), (0x09F11223, J1939Id(2, 127250, 0x23)),
    (0x0DF119FE, J1939Id(3, 127257, 0xFE)), (0x0DEF0855, J1939Id(3, 0x1EF00, 0x55, 0x08)),
    (0x18EAFF00, J1939Id(6, 0xEA00, 0x00, GLOBAL)),  # a request to all
    (0x1CEFFF01, J1939Id(7, 0xEF00, 0x01, 0xFF)),
    (0x02F00400, J1939Id(0, 0x2F004, 0x00)),  # EDP set: J1939's upper half
]  # fmt: skip


@given(st.integers(0, EXTENDED_ID_MAX))
def test_round_trip_of_every_identifier(can_id: int) -> None:
    assert join(split(can_id)) == can_id


def test_known_and_invalid_identifiers_and_filters() -> None:
    for can_id, parts in KNOWN:
        assert (split(can_id), join(parts)) == (parts, can_id)
    for parts in (
        J1939Id(8, 0xFF34, 8), J1939Id(3, 0x40000, 8), J1939Id(3, 0xFF34, 256), J1939Id(3, 0xEF00, 8, 256),
        J1939Id(3, 0xEF01, 8, 5),  # a destination in the number
        J1939Id(3, 0xFF34, 8, 5),  # a destination in a broadcast
        J1939Id(-1, 0xFF34, 8),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="J1939"):
            join(parts)
    one = filter_of(0xFF34, 8)
    assert all(one.matches(priority << 26 | 0xFF3408, True) for priority in range(8))
    assert not one.matches(0x0CFF3409, True)
    assert not one.matches(0x0CFF3508, True)
    assert not one.matches(0x0DFF3408, True)  # another data page
    assert not one.matches(0x0CFF3408 & 0x7FF, False)
    any_source = filter_of(127250, None)
    assert any_source.matches(0x09F11200, True)
    assert any_source.matches(0x1DF112FD, True)
    assert all_of(8).matches(0x1DF11208, True)
    assert not all_of(8).matches(0x1DF11209, True)
    assert all_of(None).matches(0x1DF11209, True)
    assert not any_source.matches(0x09F11300, True)
    reply = filter_of(0xEF00, 8, 0x55)
    assert reply.matches(0x18EF5508, True)
    assert not reply.matches(0x18EF0855, True)
    pgns = (0xFF34,)
    assert [sender_of(can_id, True, bytes(8), pgns) for can_id in (0x0CFF3400, 0x1CFF34FD)] == [0, 253]
    assert sender_of(0x0CFF34FE, True, bytes(8), pgns) is None  # a node without an address
    others = ((0x0CFF3708, True, 8), (0x0CFF3408, False, 8), (0x0CFF3408, True, 7))
    assert [sender_of(can_id, extended, bytes(size), pgns) for can_id, extended, size in others] == [None] * 3
