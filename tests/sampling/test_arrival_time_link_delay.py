"""Bounds of the delay of a link."""

from imud.model.units import NS_PER_MS
from imud.sampling.arrival_time import FIRST_SPREAD_NS, ArrivalSpread, LinkDelay


def test_a_timer_hides_no_more_than_the_pause() -> None:
    delay = LinkDelay(byte_ns=10_850, hold_ns=16 * NS_PER_MS)
    assert delay.held_ns(0.0, 82) == 16 * NS_PER_MS
    assert delay.held_ns(1e6, 82) == 1e6 - 82 * 10_850
    assert delay.held_ns(1e9, 82) == 16 * NS_PER_MS
    assert delay.held_ns(1e5, 82) == 0.0


def test_a_uart_has_a_receive_timeout() -> None:
    assert LinkDelay(86_805, 0).floor_ns - LinkDelay(0, 0).floor_ns == 4 * 86_805


def test_spread_of_even_and_uneven_arrivals() -> None:
    even, uneven = ArrivalSpread(), ArrivalSpread()
    assert even.sigma_ns == FIRST_SPREAD_NS
    for i in range(1, 500):
        even.add_arrival(i * 10 * NS_PER_MS)
        uneven.add_arrival(i * 10 * NS_PER_MS + (i % 2) * 4 * NS_PER_MS)
    assert even.sigma_ns < 10_000
    assert abs(even.period_ns - 10 * NS_PER_MS) < 1000
    assert 2 * NS_PER_MS < uneven.sigma_ns < 12 * NS_PER_MS
