"""Age after which a value is stale."""

import pytest

from imud.model.staleness import is_stale, stale_after_ns
from imud.model.units import NS_PER_MS, NS_PER_S


@pytest.mark.parametrize(
    ("period_ns", "limit_ns"),
    [(0, NS_PER_S), (10 * NS_PER_MS, NS_PER_S), (NS_PER_S // 3, NS_PER_S), (NS_PER_S, 3 * NS_PER_S)],
)
def test_three_periods_but_at_least_one_second(period_ns: int, limit_ns: int) -> None:
    start_ns = 1000 * NS_PER_S
    assert stale_after_ns(period_ns) == limit_ns
    assert not is_stale(start_ns, start_ns + limit_ns, period_ns)
    assert is_stale(start_ns, start_ns + limit_ns + 1, period_ns)
