"""Whether a device rests, and the means of its samples at rest. Samples in, judgement out; no clock.

A device rests when its angular rate and its acceleration stay within a small band about their means, the mean rate is
not above the bias of an uncalibrated gyroscope, and the mean acceleration has the length of gravity.
"""

from collections import deque
from collections.abc import Iterable
from math import atan2, cos, hypot, sin
from typing import Final

from imud.contracts.control.calibration import RestMeans
from imud.sample import Pair, Sample, Vector3
from imud.units import RAD_PER_DEG

WINDOW_SAMPLES: Final = 20
"""At ten looks per second, two seconds."""
RATE_BAND_RAD_S: Final = 1.0 * RAD_PER_DEG
"""About the mean: ten times the noise of these sensors; a hand that holds the device moves it more."""
RATE_MEAN_RAD_S: Final = 5.0 * RAD_PER_DEG
"""The bias of an uncalibrated gyroscope is below; a slow steady turn is above."""
ACCEL_BAND_M_S2: Final = 0.5
STANDARD_GRAVITY_M_S2: Final = 9.80665
GRAVITY_TOLERANCE: Final = 0.05
"""Of the mean's length: scale errors and local gravity are below one percent."""


class RestWindow:
    """The newest samples of a device. Memory is bounded by WINDOW_SAMPLES."""

    def __init__(self) -> None:
        self._accel: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._gyro: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._euler: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._incli: deque[Pair] = deque(maxlen=WINDOW_SAMPLES)
        self.samples = 0
        """Samples seen since the last `clear`."""

    def add(self, sample: Sample) -> None:
        """Add a sample."""
        self.samples += 1
        if sample.accel_m_s2 is not None:
            self._accel.append(sample.accel_m_s2)
        if sample.gyro_rad_s is not None:
            self._gyro.append(sample.gyro_rad_s)
        if sample.euler_rad is not None:
            self._euler.append(sample.euler_rad)
        if sample.incli_rad is not None:
            self._incli.append(sample.incli_rad)

    def clear(self) -> None:
        """Forget all samples."""
        self._accel.clear()
        self._gyro.clear()
        self._euler.clear()
        self._incli.clear()
        self.samples = 0

    @property
    def full(self) -> bool:
        """Whether there are enough samples to judge."""
        return self.samples >= WINDOW_SAMPLES

    def motion(self) -> str:
        """What moves, one clause with its figure and limit; empty at rest. Judges what samples there are."""
        if self._gyro:
            mean = _mean(self._gyro)
            if (band := _band(self._gyro, mean)) > RATE_BAND_RAD_S:
                return _said("the angular rate changes by", band / RAD_PER_DEG, RATE_BAND_RAD_S / RAD_PER_DEG, "°/s")
            if (rate := hypot(*mean)) > RATE_MEAN_RAD_S:
                return _said("it turns at", rate / RAD_PER_DEG, RATE_MEAN_RAD_S / RAD_PER_DEG, "°/s")
        if self._accel:
            mean = _mean(self._accel)
            if (band := _band(self._accel, mean)) > ACCEL_BAND_M_S2:
                return _said("the acceleration changes by", band, ACCEL_BAND_M_S2, "m/s²")
            excess = abs(hypot(*mean) - STANDARD_GRAVITY_M_S2)
            if excess > GRAVITY_TOLERANCE * STANDARD_GRAVITY_M_S2:
                limit = GRAVITY_TOLERANCE * STANDARD_GRAVITY_M_S2
                return _said("the acceleration differs from gravity by", excess, limit, "m/s²")
        return ""

    def means(self) -> RestMeans:
        """Means of the samples; angles as circular means."""
        roll_pitch_yaw, incli = _circular_mean(self._euler), _circular_mean(self._incli)
        return RestMeans(
            _mean(self._accel) if self._accel else None,
            _mean(self._gyro) if self._gyro else None,
            (roll_pitch_yaw[0], roll_pitch_yaw[1], roll_pitch_yaw[2]) if roll_pitch_yaw else None,
            (incli[0], incli[1]) if incli else None,
        )


def _said(words: str, value: float, limit: float, unit: str) -> str:
    return f"{words} {value:.3g} {unit} (at most {limit:.3g} {unit} at rest)"


def _mean(vectors: deque[Vector3]) -> Vector3:
    count = len(vectors)
    x, y, z = map(sum, zip(*vectors, strict=True))
    return (x / count, y / count, z / count)


def _band(vectors: deque[Vector3], mean: Vector3) -> float:
    """Length of the largest deviation from the mean."""
    a, b, c = mean
    return max(hypot(x - a, y - b, z - c) for x, y, z in vectors)


def _circular_mean(angles: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
    """Means of several angles; empty for none."""
    axes = zip(*angles, strict=True)
    return tuple(atan2(sum(sin(one) for one in axis), sum(cos(one) for one in axis)) for axis in axes)
