"""Sensor noise: white noise of each sample plus a bias that wanders slowly, from one seed."""

from dataclasses import dataclass
from math import pi, sin
from random import Random
from statistics import NormalDist
from typing import Final

from imud.sample import Vector3
from imud.sim.physics.motion import Truth

NORMAL_BITS: Final = 12
NORMAL_MASK: Final = (1 << NORMAL_BITS) - 1
NORMAL: Final = tuple(NormalDist().inv_cdf((i + 0.5) / (1 << NORMAL_BITS)) for i in range(1 << NORMAL_BITS))
"""Equally likely values of the normal distribution: picking one takes a fifth of the time of `random.gauss`."""


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """One-sigma white noise per sample and axis, and the largest bias.

    The white noise is what a HiPNUC module showed in one second at rest at 100 Hz: 0.0006 G, 0.036 °/s, 0.2 µT,
    0.2 Pa. The biases are assumed.
    """

    accel_m_s2: float = 0.006
    gyro_rad_s: float = 0.0006
    mag_t: float = 0.2e-6
    accel_bias_m_s2: float = 0.02
    gyro_bias_rad_s: float = 0.0005
    mag_bias_t: float = 0.3e-6
    pressure_pa: float = 0.2
    bias_period_s: float = 300.0
    """Time in which the bias of the first axis repeats; the other axes take a little longer each."""


class Noise:
    """Adds noise to a truth. The same seed and the same calls give the same noise. Attitude stays true: it is the
    module's own filter output, and what it should be is what tests compare with."""

    def __init__(self, seed: int, levels: NoiseLevels | None = None) -> None:
        self._levels = levels = levels or NoiseLevels()
        self._random = random = Random(seed)
        self._waves = [
            (2 * pi / (levels.bias_period_s * (1 + axis / 7)), random.uniform(0, 2 * pi)) for axis in range(9)
        ]

    def bias(self, t_s: float) -> tuple[Vector3, Vector3, Vector3]:
        """Bias of accelerometer (m/s²), gyroscope (rad/s) and magnetometer (T) at a time."""
        a, b, c, d, e, f, g, h, i = (sin(omega * t_s + phase) for omega, phase in self._waves)
        levels = self._levels
        accel, gyro, mag = levels.accel_bias_m_s2, levels.gyro_bias_rad_s, levels.mag_bias_t
        return (accel * a, accel * b, accel * c), (gyro * d, gyro * e, gyro * f), (mag * g, mag * h, mag * i)

    def add(self, truth: Truth, t_s: float) -> Truth:
        """Add noise to `truth`."""
        levels = self._levels
        accel_bias, gyro_bias, mag_bias = self.bias(t_s)
        accel, gyro, mag, euler, quat, temperature_c, pressure_pa = truth
        return Truth(
            self._blur(accel, accel_bias, levels.accel_m_s2),
            self._blur(gyro, gyro_bias, levels.gyro_rad_s),
            self._blur(mag, mag_bias, levels.mag_t),
            euler,
            quat,
            temperature_c,
            pressure_pa + levels.pressure_pa * NORMAL[self._random.getrandbits(NORMAL_BITS)],
        )

    def _blur(self, vector: Vector3, bias: Vector3, sigma: float) -> Vector3:
        bits = self._random.getrandbits(3 * NORMAL_BITS)
        x, y, z = vector
        bias_x, bias_y, bias_z = bias
        return (
            x + bias_x + sigma * NORMAL[bits & NORMAL_MASK],
            y + bias_y + sigma * NORMAL[bits >> NORMAL_BITS & NORMAL_MASK],
            z + bias_z + sigma * NORMAL[bits >> 2 * NORMAL_BITS],
        )
