"""The wire of a UART: bursts take their time, and ends at different rates hear what follows from the bits."""

from random import Random

import pytest

from imud.devices.hipnuc.uart.driver import DRIVER
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.sim.ports.uart_wire import Transmitter, heard

BYTE_NS = 10_000_000  # 1000 baud: 10 bits of 1 ms
DATA = bytes(range(256)) * 2
RATES = DRIVER.baud_rates


@pytest.mark.parametrize("baud", RATES)
def test_equal_rates_hear_all(baud: int) -> None:
    assert heard(DATA, baud, baud) == DATA
    assert heard(DATA, baud, round(baud * 1.02)) == DATA


def test_sampling_of_bits_is_right_where_rates_are_nearly_equal() -> None:
    assert heard(DATA, 104_000, 100_000) == DATA  # past the shortcut: 4 % is still within half a bit at bit 10
    assert heard(DATA, 100_000, 104_000) == DATA
    assert heard(DATA, 115_200, 100_000) != DATA


@pytest.mark.parametrize(
    ("data", "sent", "listening", "expected"),
    [
        (b"\xff", 100, 200, b"\xfe"),  # start bit of two half bits: 0, then ones
        (b"\x00", 100, 200, b"\x00"),  # nine zeros are eighteen: a break, then the line waits for idle
        (b"\x55", 100, 200, b"\x66\xe6"),  # every bit twice; no stop bit at 9, idle at 10, next start at 12
        (b"\xff", 400, 100, b""),  # the start bit is shorter than half a bit: a glitch
    ],
)
def test_garbage_by_hand(data: bytes, sent: int, listening: int, expected: bytes) -> None:
    assert heard(data, sent, listening) == expected


@pytest.mark.parametrize("sent", RATES)
@pytest.mark.parametrize("listening", RATES)
def test_no_frame_survives_a_wrong_rate(sent: int, listening: int) -> None:
    random, ledger = Random(f"{sent} {listening}"), Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    events = [
        event
        for _ in range(10)
        for event in codec.feed(heard(DRIVER.example_frame(random), sent, listening))
        if isinstance(event, Measurement)
    ]
    assert bool(events) == (sent == listening)


def test_a_port_without_a_rate_hears_nothing() -> None:
    assert heard(DATA, 115_200, 0) == b""
    assert heard(DATA, 0, 115_200) == b""
    assert heard(b"", 9600, 115_200) == b""


def test_slow_listener_gets_less_fast_listener_more() -> None:
    assert len(heard(DATA, 921_600, 9600)) < len(DATA) / 20
    assert len(heard(DATA, 9600, 115_200)) > len(DATA)


# --- transmitter -----------------------------------------------------------------------------------------------------


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
