"""What a simulated HiPNUC module is made of and where it is."""

from dataclasses import dataclass, field
from typing import Final

from imud.sample import Vector3
from imud.sim.hipnuc.uart.utc import Epoch
from imud.sim.physics.motion import Motion, swing
from imud.sim.physics.noise import Noise

MARK_SPREAD_NS: Final = 15_000
"""Assumed: the manual (section 1.2.1) gives the mean only."""


@dataclass(frozen=True, slots=True)
class HipnucHardware:
    """One module. Frozen: settings that commands change are `ModuleSettings`."""

    product: str = "HI14R3"
    build: str = "Oct 15 2024"
    uuid: str = "043995698D6E1708"
    firmware: int = 156
    bootloader: int = 109
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    boot_ms: int = 500
    processing_ns: int = 125_000
    """From the instant of measurement, or from the edge on SIN, to the first bit on the wire."""
    mark_spread_ns: int = MARK_SPREAD_NS
    """How much it takes longer or shorter at most after an edge on SIN."""
    mark_seed: int = 1
    utc_epoch: Epoch = "unix"
    """What UTC in ms counts from."""
    uptime_ms: int = 0
    """Device time at the first power-on, to begin near the end of a counter's range."""
    mag_bias_t: Vector3 = (0.0, 0.0, 0.0)
    """Result of its magnetic calibration; zero: never calibrated."""
