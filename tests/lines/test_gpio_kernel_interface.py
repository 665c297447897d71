"""Events of a line in the format of the kernel, packed by hand."""

from imud.contracts.lines import Edge
from imud.lines.gpio import LineEventDecoder


def event(t_ns: int, kind: int, seqno: int) -> bytes:
    """Return a `struct gpio_v2_line_event` of line 5, in a request with another count."""
    words = (kind, 5, 77, seqno)
    return t_ns.to_bytes(8, "little") + b"".join(word.to_bytes(4, "little") for word in words) + bytes(24)


def test_edges_with_jumps_of_the_count_which_are_losses() -> None:
    events = LineEventDecoder()
    data = event(0x0102030405060708, 1, 1) + event(2**63 - 1, 2, 2)
    assert events.decode(data) == [Edge(0x0102030405060708, True, 1), Edge(2**63 - 1, False, 2)]
    assert events.decode(b"") == []
    assert events.lost == 0
    events = LineEventDecoder()
    assert [edge.number for edge in events.decode(event(1, 1, 2) + event(2, 2, 10) + event(3, 1, 11))] == [2, 10, 11]
    assert events.lost == 1 + 7


def test_numbers_go_on_when_the_count_wraps_and_after_a_restart() -> None:
    events = LineEventDecoder()
    events.decode(event(1, 1, 2**32 - 1))
    assert [edge.number for edge in events.decode(event(2, 2, 0) + event(3, 1, 1))] == [2**32, 2**32 + 1]
    assert events.lost == 2**32 - 2
    events = LineEventDecoder()
    events.decode(event(1, 1, 1) + event(2, 2, 2))
    events.restart()
    assert [edge.number for edge in events.decode(event(3, 1, 1))] == [3]
    assert events.lost == 0
