"""Values as whole counts of a signed field."""

from math import inf, nan

import pytest

from imud.devices.hipnuc.common.raw_units import counts_of


@pytest.mark.parametrize(
    ("value", "bits", "counts"),
    [
        (0.4, 16, 0),
        (-1.6, 16, -2),
        (32767.4, 16, 32767),
        (1e9, 16, 32767),
        (-32768.0, 16, -32768),
        (-inf, 16, -32768),
        (inf, 32, 2**31 - 1),
        (-(2.0**40), 32, -(2**31)),
    ],
)
def test_nearest_count_in_the_range(value: float, bits: int, counts: int) -> None:
    assert counts_of(value, bits) == counts


def test_no_number_has_no_count() -> None:
    with pytest.raises(ValueError, match="NaN"):
        counts_of(nan, 16)
