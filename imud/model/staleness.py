"""Decision whether a value is still current. All outputs use this function."""

from typing import Final

from imud.model.units import NS_PER_S

STALE_PERIODS: Final = 3  # number of periods without a sample after which a value is stale
STALE_LEAST_NS: Final = NS_PER_S  # minimum time without a sample after which a value is stale, ns


def is_stale(last_sample_ns: int, now_ns: int, period_ns: int) -> bool:
    """Return whether a value of the newest sample is no longer current. `period_ns` is the time between two samples; 0:
    unknown."""
    return now_ns - last_sample_ns > max(STALE_PERIODS * period_ns, STALE_LEAST_NS)
