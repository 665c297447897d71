"""Units of data sheets compared with values by hand, and the format of numbers."""

from itertools import chain
from math import pi

import pytest

from imud.analysis.quantities import ACCEL, DENSITY, DEVIATION, GYRO, QUANTITIES, figure_text

SI = {"deg": pi / 180, "h": 3600.0, "√h": 60.0, "mm": 1e-3, "mg": 9.80665e-3, "µg": 9.80665e-6}
"""Values of the units in SI units; 1 for other units. g is the standard acceleration of gravity, 9.80665 m/s²."""


def test_units_and_digits() -> None:
    units = list(chain.from_iterable(one.units for one in (*GYRO, *ACCEL)))
    for unit in (*units, *DENSITY.values(), *DEVIATION.values()):
        first, *others = unit.name.split("/")
        si_value = SI.get(first, 1.0)
        for other in others:
            si_value /= SI.get(other, 1.0)
        assert si_value * unit.factor == pytest.approx(1.0, rel=1e-9), unit
    assert next(one for one in GYRO if one.key == "rate_ramp").units[0].factor * 1.3467047e-9 == pytest.approx(1.0)
    gyro, accel = ([one.key for one in QUANTITIES[name]] for name in QUANTITIES)
    assert gyro == accel
    values = (0.0, 0.34321, 12345.6, 1e-5, -9.81, 2e7)
    assert [figure_text(value) for value in values] == ["0", "0.343", "12346", "1.00e-5", "-9.81", "2.00e7"]
