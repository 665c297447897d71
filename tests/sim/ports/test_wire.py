"""Two ends of a wire at different rates hear garbage, and what garbage follows from the bits."""

from random import Random

import pytest

from imud.devices.hipnuc.uart.codec import DRIVER
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.sim.ports.wire import heard

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
