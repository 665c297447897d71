"""Time after which a value without a new sample is not a current value. All outputs use this decision."""

from typing import Final

from imud.model.units import NS_PER_S

STALE_PERIODS: Final = 3  # number of periods without a new sample after which a value is stale
STALE_MIN_NS: Final = NS_PER_S  # minimum age of a stale value, ns: a fast device may pause for some periods


def stale_after_ns(period_ns: int) -> int:
    """Return the maximum age of a current value, ns. `period_ns` is the time between two values."""
    return max(STALE_PERIODS * period_ns, STALE_MIN_NS)


def is_stale(last_sample_ns: int, now_ns: int, period_ns: int) -> bool:
    """Return whether the value of the sample that arrived at `last_sample_ns` is no longer a current value."""
    return now_ns - last_sample_ns > stale_after_ns(period_ns)
