"""Deviations of a device from a report of its noise, as `imud noise --json` writes it."""

from math import hypot, sqrt
from pathlib import Path
from typing import Final

import msgspec

from imud.contracts.sensors.deviations import Deviations
from imud.errors import ImudError, reason_of
from imud.files import read_regular

FILE_BYTES_MAX: Final = 64 << 20
"""A report has every point of its curves: some MB."""


class _Spread(msgspec.Struct):
    """Standard deviation of the samples of one axis, SI."""

    value: float


class _Axis(msgspec.Struct):
    spread: _Spread


class _Sensor(msgspec.Struct):
    axes: dict[str, _Axis]


class _Measurement(msgspec.Struct):
    device: str


class _Report(msgspec.Struct):
    """The members of the report that are used."""

    measurement: _Measurement
    sensors: dict[str, _Sensor]


def read_noise(path: Path) -> tuple[str, Deviations]:
    """Return the device of a report, and the deviations of its sensors: the quadratic mean of the three axes'.

    The standard deviation of samples at rest has in it what drifted during the measurement. Raises ImudError.
    """
    try:
        report = msgspec.json.decode(read_regular(path, FILE_BYTES_MAX), type=_Report)
    except (OSError, ValueError) as error:
        raise ImudError(f"{path}: expected a report of `imud noise --json`: {reason_of(error)}") from error
    return report.measurement.device, Deviations(
        accel_m_s2=_sigma(report.sensors.get("accel")), gyro_rad_s=_sigma(report.sensors.get("gyro"))
    )


def _sigma(sensor: _Sensor | None) -> float | None:
    """None for a sensor that was not measured, or whose values never changed."""
    if sensor is None or not sensor.axes:
        return None
    spreads = [axis.spread.value for axis in sensor.axes.values()]
    return hypot(*spreads) / sqrt(len(spreads)) or None
