"""Which values are an air pressure."""

from math import inf, nan

import pytest

from imud.devices.hipnuc.common.air import pressure_of, temperature_beside


@pytest.mark.parametrize("value_pa", [1_000.0, 33_000.0, 101_325.0, 120_000.0])
def test_a_pressure(value_pa: float) -> None:
    assert pressure_of(value_pa) == value_pa
    assert temperature_beside(21, value_pa) == 21


@pytest.mark.parametrize(
    ("value_pa", "temperature_c"),
    [(0.0, 21), (999.0, 21), (9.99, None), (999.9, None), (120_000.1, None), (-4.2e-25, None), (nan, None),
     (inf, None), (-101_325.0, None)],
)  # fmt: skip
def test_no_pressure(value_pa: float, temperature_c: float | None) -> None:
    assert pressure_of(value_pa) is None
    assert temperature_beside(21, value_pa) == temperature_c
