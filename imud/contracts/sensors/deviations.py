"""Contract: what is known of the noise of one sample of a device, for messages with covariances."""

from typing import Annotated

import msgspec
from msgspec import Meta

from imud.contracts.settings import Settings

Sigma = Annotated[float, Meta(gt=0)] | None


class Deviations(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One-sigma noise of one sample, the same for every axis, in SI units; None where it is not known."""

    accel_m_s2: Sigma = None
    """Standard deviation of one sample of the specific force, m/s²; null where it is not known."""
    gyro_rad_s: Sigma = None
    """The same of the angular rate, rad/s."""
    mag_t: Sigma = None
    """The same of the magnetic field, T."""
    attitude_rad: Sigma = None
    """The same of the attitude, about each axis of the body, rad."""
    temperature_c: Sigma = None
    """The same of the temperature, K."""
    pressure_pa: Sigma = None
    """The same of the pressure, Pa."""

    def updated(self, other: "Deviations") -> "Deviations":
        """Return these, with those of `other` that are known in their place."""
        known = {name: sigma for name in self.__struct_fields__ if (sigma := getattr(other, name)) is not None}
        return msgspec.structs.replace(self, **known)
