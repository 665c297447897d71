"""Stale values: three periods, at least one second."""

import pytest

from imud.model.staleness import is_stale
from imud.model.units import NS_PER_S


@pytest.mark.parametrize(
    ("age_ns", "period_ns", "stale"),
    [
        (NS_PER_S, 0, False), (NS_PER_S + 1, 0, True), (NS_PER_S, NS_PER_S // 100, False),
        (NS_PER_S + 1, NS_PER_S // 100, True), (3 * NS_PER_S, NS_PER_S, False), (3 * NS_PER_S + 1, NS_PER_S, True),
    ],
)  # fmt: skip
def test_values_after_three_periods(age_ns: int, period_ns: int, stale: bool) -> None:
    assert is_stale(7, 7 + age_ns, period_ns) == stale
