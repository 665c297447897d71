"""The wire of a UART: duration of bursts, and bytes at ends with different rates."""

from random import Random

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.ports.uart_wire import Transmitter, heard

BYTE_NS = 10_000_000  # 1000 baud: 10 bits of 1 ms
DATA = bytes(range(256)) * 2
RATES = DRIVER.baud_rates


def test_what_ends_at_equal_near_and_other_rates_hear() -> None:
    for baud in RATES:
        assert heard(DATA, baud, baud) == heard(DATA, baud, round(baud * 1.02)) == DATA
    assert heard(DATA, 104_000, 100_000) == DATA  # a difference of 4 % is within half a bit at bit 10
    assert heard(DATA, 100_000, 104_000) == DATA
    assert heard(DATA, 115_200, 100_000) != DATA
    assert heard(DATA, 115_200, 0) == b""
    assert heard(DATA, 0, 115_200) == b""
    assert heard(b"", 9600, 115_200) == b""
    assert len(heard(DATA, 921_600, 9600)) < len(DATA) / 20
    assert len(heard(DATA, 9600, 115_200)) > len(DATA)


@pytest.mark.parametrize(
    ("data", "sent", "listening", "expected"),
    [
        (b"\xff", 100, 200, b"\xfe"),  # two half bits: a start bit, then ones
        (b"\x00", 100, 200, b"\x00"),  # nine zeros become eighteen: a break, then the UART waits for idle
        (b"\x55", 100, 200, b"\x66\xe6"),  # every bit twice; stop bit wrong at 9, idle at 10, next start at 12
        (b"\xff", 400, 100, b""),  # the start bit is shorter than half a bit: a glitch
    ],
)
def test_garbage_by_hand(data: bytes, sent: int, listening: int, expected: bytes) -> None:
    assert heard(data, sent, listening) == expected


@pytest.mark.parametrize("sent", [9600, 115_200, 921_600])
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


def transmitter() -> Transmitter:
    return Transmitter(1000, 20, free_ns=1000)


def test_wire_time_buffer_and_power_loss() -> None:
    wire = transmitter()
    wire.send(0, b"abc")
    wire.send(5, b"de", sample_ns=4, device_ms=1)
    assert wire.next_ns() == 1000 + 3 * BYTE_NS
    assert wire.sent(1000 + 3 * BYTE_NS - 1) == []
    assert [burst.data for burst in wire.sent(1000 + 3 * BYTE_NS)] == [b"abc"]
    assert wire.sent(10**12) == [(1000 + 5 * BYTE_NS, b"de", 4, 1)]
    assert wire.next_ns() is None

    wire = transmitter()
    assert wire.due_ns(10**9, 2) == 10**9 + 2 * BYTE_NS

    wire = transmitter()
    wire.send(1000, bytes(15))
    assert wire.fits(1000, 5)
    assert not wire.fits(1000, 6)
    assert wire.fits(1000 + BYTE_NS, 6)

    wire = transmitter()
    for data in (b"whole", b"broken", b"never"):
        wire.send(1000, data)
    through = wire.stopped(1000 + 5 * BYTE_NS + 2 * BYTE_NS + BYTE_NS // 2)
    assert [burst.data for burst in through] == [b"whole", b"br"]
    assert wire.sent(10**12) == []

    wire = transmitter()
    wire.send(1000, b"never")
    assert wire.stopped(500) == []
