"""Quantities of a noise analysis, with the units of data sheets.

Value in the unit = SI value × factor. Gyroscopes: 1 rad/√s = 180/π · 60 deg/√h. Accelerometers:
1 m/s/√s = 1 (m/s²)/√Hz = 60 m/s/√h = 10⁶/g µg/√Hz, with g = 9.80665 m/s².
"""

import re
from collections.abc import Mapping
from typing import Final, NamedTuple

from imud.contracts.driver import SensorName
from imud.model.units import RAD_PER_DEG, STANDARD_GRAVITY_M_S2

S_PER_H: Final = 3600.0
ROOT_S_PER_ROOT_H: Final = 60.0
DEG_PER_RAD: Final = 1 / RAD_PER_DEG
MG_PER_M_S2: Final = 1e3 / STANDARD_GRAVITY_M_S2
UG_PER_M_S2: Final = 1e6 / STANDARD_GRAVITY_M_S2


class ShownUnit(NamedTuple):
    """Unit of the reports."""

    name: str
    factor: float  # value in the unit per SI value


class Quantity(NamedTuple):
    """Quantity of a sensor's noise."""

    key: str  # Name in JSON. For a coefficient, also its name in NoiseTerms.
    title: str
    symbol: str
    si: str  # SI unit
    units: tuple[ShownUnit, ...]  # units of the reports, the most usual unit first


GYRO: Final = (
    Quantity(
        "random_walk", "angle random walk", "N", "rad/√s",
        (ShownUnit("deg/√h", DEG_PER_RAD * ROOT_S_PER_ROOT_H),),
    ),
    Quantity(
        "noise_density", "noise density", "√S", "rad/s/√Hz", (ShownUnit("deg/s/√Hz", DEG_PER_RAD),),
    ),
    Quantity("bias_instability", "bias instability", "B", "rad/s", (ShownUnit("deg/h", DEG_PER_RAD * S_PER_H),)),
    Quantity(
        "least_deviation", "least σ / 0.664", "", "rad/s", (ShownUnit("deg/h", DEG_PER_RAD * S_PER_H),),
    ),
    Quantity(
        "rate_random_walk", "rate random walk", "K", "rad/s/√s",
        (ShownUnit("deg/h/√h", DEG_PER_RAD * S_PER_H * ROOT_S_PER_ROOT_H),),
    ),
    Quantity("rate_ramp", "rate ramp", "R", "rad/s²", (ShownUnit("deg/h/h", DEG_PER_RAD * S_PER_H**2),)),
    Quantity("quantisation", "quantisation", "Q", "rad", (ShownUnit("deg", DEG_PER_RAD),)),
    Quantity("temperature_slope", "drift with temp.", "", "rad/s/K", (ShownUnit("deg/h/K", DEG_PER_RAD * S_PER_H),)),
    Quantity("mean", "mean (bias)", "", "rad/s", (ShownUnit("deg/s", DEG_PER_RAD),)),
    Quantity("spread", "std. deviation", "", "rad/s", (ShownUnit("deg/s", DEG_PER_RAD),)),
)  # fmt: skip
ACCEL: Final = (
    Quantity(
        "random_walk", "velocity random walk", "N", "m/s/√s",
        (ShownUnit("m/s/√h", ROOT_S_PER_ROOT_H), ShownUnit("µg/√Hz", UG_PER_M_S2)),
    ),
    Quantity("noise_density", "noise density", "√S", "m/s²/√Hz", (ShownUnit("µg/√Hz", UG_PER_M_S2),)),
    Quantity("bias_instability", "bias instability", "B", "m/s²", (ShownUnit("mg", MG_PER_M_S2),)),
    Quantity("least_deviation", "least σ / 0.664", "", "m/s²", (ShownUnit("mg", MG_PER_M_S2),)),
    Quantity(
        "rate_random_walk", "acceleration r.w.", "K", "m/s²/√s", (ShownUnit("mg/√h", MG_PER_M_S2 * ROOT_S_PER_ROOT_H),),
    ),
    Quantity("rate_ramp", "acceleration ramp", "R", "m/s³", (ShownUnit("mg/h", MG_PER_M_S2 * S_PER_H),)),
    Quantity("quantisation", "quantisation", "Q", "m/s", (ShownUnit("mm/s", 1e3),)),
    Quantity("temperature_slope", "drift with temp.", "", "m/s²/K", (ShownUnit("µg/K", UG_PER_M_S2),)),
    Quantity("mean", "mean", "", "m/s²", (ShownUnit("m/s²", 1.0),)),
    Quantity("spread", "std. deviation", "", "m/s²", (ShownUnit("mg", MG_PER_M_S2),)),
)  # fmt: skip
QUANTITIES: Final[Mapping[SensorName, tuple[Quantity, ...]]] = {"gyro": GYRO, "accel": ACCEL}

# Units of the Allan deviation in plots
DEVIATION: Final[Mapping[SensorName, ShownUnit]] = {
    "gyro": ShownUnit("deg/h", DEG_PER_RAD * S_PER_H),
    "accel": ShownUnit("mg", MG_PER_M_S2),
}
DENSITY: Final[Mapping[SensorName, ShownUnit]] = {
    "gyro": ShownUnit("deg/s/√Hz", DEG_PER_RAD),
    "accel": ShownUnit("µg/√Hz", UG_PER_M_S2),
}
TITLES: Final[Mapping[SensorName, str]] = {"gyro": "gyroscope", "accel": "accelerometer"}
SI: Final[Mapping[SensorName, str]] = {"gyro": "rad/s", "accel": "m/s²"}


def figure_text(value: float) -> str:
    """Format a value with three digits, without an exponent if possible."""
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = f"{value:.3g}"
        return f"{value:.0f}" if "e" in digits else digits
    return short_exponent(f"{value:.2e}")


def short_exponent(text: str) -> str:
    """Shorten the exponent of a number, for example 1.61e+06 to 1.61e6."""
    return re.sub(r"e([+-])0*(?=\d)", lambda sign: "e" + sign[1].strip("+"), text)
