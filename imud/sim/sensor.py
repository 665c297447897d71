"""Sensor of a simulated device: the motion that it measures, its noise and its crystal; made from the options."""

from dataclasses import dataclass, field
from typing import TypedDict

from imud.sim.physics.motion import MOTIONS, Motion, Truth, swing
from imud.sim.physics.noise import Noise
from imud.sim.simulator import SimulatorOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorHardware:
    """Hardware of every simulated sensor, whatever its link."""

    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    """Rate error of the crystal against the host's clock, 1e-6."""
    boot_ms: int = 500
    """Silence after power-on and reboot."""
    processing_ns: int = 125_000
    """From the instant of measurement to the first bit on the wire."""

    def reading(self, t_s: float) -> Truth:
        """Measured values `t_s` seconds after the zero of the motion."""
        truth = self.motion.at(t_s)
        return self.noise.add(truth, t_s) if self.noise else truth


class SensorFields(TypedDict):
    """Fields of `SensorHardware` by name."""

    motion: Motion
    noise: Noise | None
    skew_ppm: float
    boot_ms: int
    processing_ns: int


def sensor_of(options: SimulatorOptions) -> SensorFields:
    """The sensor from the common options. Raises ValueError for an unknown motion."""
    return {
        "motion": motion_of(options),
        "noise": noise_of(options),
        "skew_ppm": options.skew_ppm,
        "boot_ms": options.boot_ms,
        "processing_ns": options.processing_ns,
    }


def motion_of(options: SimulatorOptions) -> Motion:
    """The motion by its name. Raises ValueError for an unknown one."""
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    return MOTIONS[options.motion](options.gravity_m_s2)


def noise_of(options: SimulatorOptions, number: int = 0) -> Noise | None:
    """The noise of the device with this number, None for a perfect one."""
    return Noise(options.seed + number) if options.noise == "real" else None
