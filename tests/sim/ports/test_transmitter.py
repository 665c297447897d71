"""Bursts take their time on the wire, one after the other, and a lost supply cuts the one on its way."""

from imud.sim.ports.transmitter import Transmitter

BYTE_NS = 10_000_000  # 1000 baud: 10 bits of 1 ms


def transmitter() -> Transmitter:
    return Transmitter(1000, 20, free_ns=1000)


def test_wire_time_and_order() -> None:
    wire = transmitter()
    wire.send(0, b"abc")
    wire.send(5, b"de", sample_ns=4, device_ms=1)
    assert wire.next_ns() == 1000 + 3 * BYTE_NS
    assert wire.sent(1000 + 3 * BYTE_NS - 1) == []
    assert [burst.data for burst in wire.sent(1000 + 3 * BYTE_NS)] == [b"abc"]
    assert wire.sent(10**12) == [(1000 + 5 * BYTE_NS, b"de", 4, 1)]
    assert wire.next_ns() is None


def test_an_idle_wire_starts_when_the_burst_is_ready() -> None:
    wire = transmitter()
    assert wire.due_ns(10**9, 2) == 10**9 + 2 * BYTE_NS


def test_buffer_has_an_end() -> None:
    wire = transmitter()
    wire.send(1000, bytes(15))
    assert wire.fits(1000, 5)
    assert not wire.fits(1000, 6)
    assert wire.fits(1000 + BYTE_NS, 6)


def test_power_loss_cuts_the_burst_on_the_wire() -> None:
    wire = transmitter()
    for data in (b"whole", b"broken", b"never"):
        wire.send(1000, data)
    through = wire.stopped(1000 + 5 * BYTE_NS + 2 * BYTE_NS + BYTE_NS // 2)
    assert [burst.data for burst in through] == [b"whole", b"br"]
    assert wire.sent(10**12) == []


def test_power_loss_before_the_first_bit_leaves_nothing() -> None:
    wire = transmitter()
    wire.send(1000, b"never")
    assert wire.stopped(500) == []
