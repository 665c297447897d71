"""Synthetic noise of an inertial sensor with known coefficients. The values are exact means over a sampling period.

White noise and random walk use the joint distribution of the integral over a period and the value at its end. Flicker
noise uses fractional differences of order 1/2 (Hosking 1981, Kasdin 1995); its spectrum is B²/(2π f) far below the
rate. Quantisation is the difference of white noise of the angle.
"""

import numpy as np
from numpy.random import Generator
from scipy.signal import oaconvolve

from imud.analysis.series import FloatArray, IntArray


def white(random: Generator, count: int, rate_hz: float, n: float) -> FloatArray:
    """Angle random walk N, unit/√Hz."""
    return np.asarray(n * np.sqrt(rate_hz) * random.standard_normal(count))


def random_walk(random: Generator, count: int, rate_hz: float, k: float) -> FloatArray:
    """Rate random walk K, unit/√s: the mean of each period of a Wiener process."""
    period_s = 1 / rate_hz
    steps = np.sqrt(period_s) * random.standard_normal(count)
    begin = np.concatenate(([0.0], np.cumsum(steps)[:-1]))
    inside = steps / 2 + np.sqrt(period_s / 12) * random.standard_normal(count)
    return np.asarray(k * (begin + inside))


def flicker(random: Generator, count: int, b: float) -> FloatArray:
    """Bias instability B, unit; independent of the rate. The first half of the filter output is discarded."""
    order = np.arange(1, 2 * count)
    response = np.concatenate(([1.0], np.cumprod((order - 0.5) / order)))
    return np.asarray(b * oaconvolve(random.standard_normal(2 * count), response)[count : 2 * count])


def quantisation(random: Generator, count: int, rate_hz: float, q: float) -> FloatArray:
    """Quantisation Q, unit · s: differences of angles with a rounding error of Q (one sigma)."""
    return q * rate_hz * np.diff(random.standard_normal(count + 1))


def ramp(count: int, rate_hz: float, r: float) -> FloatArray:
    return np.asarray(r * (np.arange(count) + 0.5) / rate_hz, dtype=np.float64)


def three(one: FloatArray) -> FloatArray:
    return np.repeat(one[:, None], 3, axis=1)


def stamps_ns(count: int, rate_hz: float, begin_ns: int = 1_000_000_000) -> IntArray:
    return np.asarray(begin_ns + np.rint(np.arange(count) * (1e9 / rate_hz)), dtype=np.int64)
