"""Corrections spread over time."""

import pytest

from imud.clock.slew import SETTLED_AFTER_NS, SLEW, SLEW_SETTLING, Slew
from imud.units import NS_PER_MS, NS_PER_S


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("age_ns", "rate"), [(0, SLEW_SETTLING), (SETTLED_AFTER_NS + 1, SLEW)])
def test_the_rate_is_bounded(sign: int, age_ns: int, rate: float) -> None:
    slew = Slew()
    slew.left_ns = sign * 10.0 * NS_PER_S
    before = slew.left_ns
    after = slew.over(10 * NS_PER_MS, age_ns)
    assert before - after == pytest.approx(sign * rate * 10 * NS_PER_MS)


def test_it_ends_at_nothing() -> None:
    slew = Slew()
    slew.left_ns = -3.0
    assert slew.over(NS_PER_S, SETTLED_AFTER_NS + 1) == 0.0
    assert slew.left_ns == 0.0
