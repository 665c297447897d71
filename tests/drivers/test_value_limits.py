"""The rule on high bytes and the rule on numbers accept the same 32-bit floats."""

import struct
from math import inf, nan, nextafter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.drivers import value_limits


def high_byte(value: float) -> bytes:
    return struct.pack("<f", value)[3:]


@given(st.floats(width=32))
def test_both_rules_agree(value: float) -> None:
    assert value_limits.values_possible(high_byte(value)) == value_limits.is_possible([0.0, value])
    assert value_limits.temperatures_possible(high_byte(value)) == (
        value_limits.possible_temperature_c(value) is not None
    )


@pytest.mark.parametrize("value", [131072.0, 3e38, inf, nan])
def test_the_smallest_impossible_value_is_131072(value: float) -> None:
    assert not value_limits.is_possible([value])
    assert value_limits.scaled((0.0, value, 0.0), 2.0) is None
    assert not value_limits.values_possible(high_byte(-value) + high_byte(0.0))


def test_limits_of_values_and_temperatures() -> None:
    assert value_limits.scaled((0.0, 131071.5, -131071.5), 2.0) == (0.0, 262143.0, -262143.0)
    for impossible in (-128.0, 512.0):
        assert value_limits.possible_temperature_c(impossible) is None
        inside = nextafter(impossible, 0.0)
        assert value_limits.possible_temperature_c(inside) == inside
