"""Thinning of samples to a rate: which of them are sent, and the mean of the angular rates of all between.

samples ─▶ Pace.is_due ─▶ the first one at or after each due instant, never resampled
    └────▶ MeanRate ────▶ what vibration leaves of the angular rate over the same time
"""

import math
from collections.abc import Sequence

from imud.sample import Sample, Vector3
from imud.units import NS_PER_S


class Pace:
    """Thins the samples of one device to `rate_hz`: the first one at or after each due instant, never resampled.

    Due instants are start + k / rate_hz in the time of the samples, k counted, so that rounding never adds up.
    """

    __slots__ = ("_period_ns", "_start_ns", "due_ns")

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._start_ns: int | None = None
        self.due_ns = 0
        """A sample measured before this instant is not one to send."""

    def is_due(self, t_ns: int) -> bool:
        """Whether the sample measured at `t_ns` is one to send; if so, the next due instant is a later one."""
        start_ns = self._start_ns
        if start_ns is None:
            start_ns = self._start_ns = t_ns
        elif t_ns < self.due_ns:
            return False
        period_ns = self._period_ns
        passed = math.floor((t_ns - start_ns) / period_ns)
        due_ns = start_ns + math.ceil((passed + 1) * period_ns)
        self.due_ns = due_ns if due_ns > t_ns else t_ns + 1  # a period below one ns, or a sum that rounds down
        return True


class MeanRate:
    """Mean of the angular rates of the samples since it was taken last, sensor or body axes as published."""

    __slots__ = ("_count", "_x", "_y", "_z")

    def __init__(self) -> None:
        self._x = self._y = self._z = 0.0
        self._count = 0

    def add(self, samples: Sequence[Sample]) -> None:
        """Add samples; those without angular rates are left out."""
        for sample in samples:
            gyro = sample.gyro_rad_s
            if gyro is not None:
                self._x += gyro[0]
                self._y += gyro[1]
                self._z += gyro[2]
                self._count += 1

    def take(self) -> Vector3 | None:
        """Return the mean and begin anew; None without samples."""
        count = self._count
        if not count:
            return None
        mean = (self._x / count, self._y / count, self._z / count)
        self._x = self._y = self._z = 0.0
        self._count = 0
        return mean
