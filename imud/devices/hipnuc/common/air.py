"""Table: values of an air pressure field that are a pressure, for all protocols of HiPNUC modules.

Modules without a barometer fill the field all the same: with 0, with 999 as the placeholder of the vendor's programs
(999 counts are 9.99 Pa on J1939), or, in HI91 of older firmware, with whatever stood in the buffer. A frame in the
vendor's older manual has -4.2e-25 Pa. Below 1 kPa or above 120 kPa there is no pressure: the earth's air has 33 kPa on
the highest and 108 kPa at the deepest place where a vehicle goes.
"""

from typing import Final

PRESSURE_MIN_PA: Final = 1_000.0
PRESSURE_MAX_PA: Final = 120_000.0
PLACEHOLDERS: Final = (0.0, 999.0)
"""Values that firmware without a barometer writes on purpose."""


def pressure_of(value_pa: float) -> float | None:
    """Return a pressure in Pa, or None where the field holds none; NaN and infinity are none."""
    return value_pa if PRESSURE_MIN_PA <= value_pa <= PRESSURE_MAX_PA else None


def temperature_beside(temperature_c: float, pressure_pa: float) -> float | None:
    """Return the temperature in °C that HI91 carries next to a pressure field, or None where both were never written.

    It is the inertial sensor's, so it stands without a barometer too; but where the pressure is no value that any
    firmware writes, the bytes around it are what stood in the buffer.
    """
    is_written = pressure_pa in PLACEHOLDERS or pressure_of(pressure_pa) is not None
    return temperature_c if is_written else None
