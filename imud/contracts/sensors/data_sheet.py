"""Contract: what a vendor's manual states about the noise, the resolution and the filters of a driver's devices."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

SensorName = Literal["gyro", "accel"]
Figure = Annotated[float, Meta(gt=0)] | None
"""A positive figure, None where none is stated."""


class SensorFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Figures of one sensor, SI; (rad/s) stands for the unit of the rate, m/s² for an accelerometer."""

    random_walk: Figure = None
    """Angle or velocity random walk N, (rad/s)/√Hz."""
    noise_density: Figure = None
    """Root of the one-sided spectral density, (rad/s)/√Hz: √2 N of white noise."""
    bias_instability: Figure = None
    """The least Allan deviation over 0.664, rad/s."""
    rate_random_walk: Figure = None
    """K, (rad/s)/√s."""
    temperature_slope: Figure = None
    """Change of the bias with temperature, either sign, (rad/s)/K."""


class ModelFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Figures of one model."""

    gyro: SensorFigures = SensorFigures()
    accel: SensorFigures = SensorFigures()
    source: str = ""
    """Document and section."""


def _no_filter(_settings: Mapping[str, str], _sensor: SensorName) -> str:
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """What is known of the sensors of a driver's devices from the vendor's documents."""

    document: str = ""
    """Title and version of the manual, and what it says of noise, in one sentence; empty for a driver without one."""
    models: Mapping[str, ModelFigures] = field(default_factory=dict)
    """Figures by the begin of the product's name; empty where the manual has none for any model."""
    gyro_step_rad_s: float | None = None
    """Value of one count of the angular rate on the wire; None for floats, or where the message decides."""
    accel_step_m_s2: float | None = None
    """The same of the acceleration."""
    filter_words: Callable[[Mapping[str, str], SensorName], str] = _no_filter
    """Describes the device's own low-pass filter of a sensor, from its settings as read back; empty: not known."""

    def figures_of(self, product: str) -> ModelFigures | None:
        """Return the figures of a model by its product name, the longest begin that fits; None for none."""
        fitting = [begin for begin in self.models if product.startswith(begin)]
        return self.models[max(fitting, key=len)] if fitting else None
