"""Values as whole counts of a signed field."""

from math import isnan


def counts_of(value: float, bits: int) -> int:
    """The nearest count, for a value beyond the field's range its first or last one. Raises ValueError for NaN."""
    if isnan(value):
        raise ValueError("NaN has no count")
    most = 1 << bits - 1
    return round(max(-most, min(most - 1, value)))
