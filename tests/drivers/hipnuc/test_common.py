"""Values as counts of a signed field, valid air pressures, and the load of a bus."""

from math import inf, nan

import pytest

from imud.drivers.hipnuc.bus_load import CyclicMessage, refuse_overload
from imud.drivers.hipnuc.common import counts_of, pressure_of, temperature_beside
from imud.model.errors import BadArgument


@pytest.mark.parametrize(
    ("value", "bits", "counts"),
    [
        (0.4, 16, 0), (-1.6, 16, -2), (32767.4, 16, 32767), (1e9, 16, 32767), (-32768.0, 16, -32768),
        (-inf, 16, -32768), (inf, 32, 2**31 - 1), (-(2.0**40), 32, -(2**31)),
    ],
)  # fmt: skip
def test_nearest_count_in_the_range(value: float, bits: int, counts: int) -> None:
    assert counts_of(value, bits) == counts


def test_nan_has_no_count() -> None:
    with pytest.raises(ValueError, match="NaN"):
        counts_of(nan, 16)


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


def test_bits_of_a_message_and_the_limit_of_the_bus() -> None:
    assert CyclicMessage(6, False, 10).bits_per_s == 9500  # 47 + 8 · 6 = 95 bits, 100 times
    assert CyclicMessage(8, True, 5).bits_per_s == 26_200  # 67 + 64 = 131 bits, 200 times
    assert CyclicMessage(8, True, 0).bits_per_s == 0
    messages = {"A": CyclicMessage(8, True, 5), "B": CyclicMessage(8, True, 0)}
    refuse_overload(messages, 0, 26_200)
    refuse_overload(messages, 1e9, 0)
    with pytest.raises(BadArgument, match=r"got 105 % of it: A every 5 ms 105 %; other devices 0 %"):
        refuse_overload(messages, 0, 25_000)
    with pytest.raises(BadArgument, match=r"got 100 % of it: A every 5 ms 26.2 %; other devices 73.8 %"):
        refuse_overload(messages, 73_801, 100_000)
