"""Thinning of samples to a rate: selected samples, and the mean of the angular rates between them.

samples ─▶ Pace.is_due ─▶ the sample nearest to each due time, never resampled; RateThinner: several rates
   └────▶ MeanRate ────▶ mean angular rate over the same time
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S

# Number of periods without a sample after which the sample period is unknown. One or two lost samples have no effect.
PAUSE_PERIODS: Final = 4
NOTHING: Final[Mapping[float, tuple[int, ...]]] = {}  # result of `choose` for most batches


class Pace:
    """Selection of samples at `rate_hz`: the sample nearest to each due time, never resampled.

    The due times are start + k / rate_hz in the time of the samples. k is an integer counter, so rounding errors do not
    accumulate. Taking the nearest sample keeps all samples of a device with exactly this rate, although some are early.
    Taking the first sample after each due time would lose up to a quarter of them. The due times restart at a sample
    that is late by more than one sample period: after a pause, or with a device slower than the rate.
    """

    __slots__ = ("_count", "_period_ns", "_start_ns", "due_ns")

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._start_ns: int | None = None
        self._count = 0
        self.due_ns = 0  # earliest time stamp of the next selected sample

    def is_due(self, t_ns: int, step_ns: int) -> bool:
        """Return whether the sample at `t_ns` is selected. If so, advance the due time. `step_ns` is the time since the
        previous sample; 0 for the first sample."""
        if t_ns < self.due_ns:
            return False
        period_ns, start_ns = self._period_ns, self._start_ns
        late_ns = 0 if start_ns is None else t_ns - start_ns - math.ceil(self._count * period_ns)
        half_ns = min(step_ns, period_ns) / 2
        if start_ns is None or step_ns > PAUSE_PERIODS * period_ns:
            start_ns, half_ns, self._count = t_ns, 0.0, 0  # the sample period is unknown
        elif late_ns > 2 * half_ns:
            start_ns, self._count = t_ns - math.ceil(half_ns), 0
        self._start_ns = start_ns
        self._count += 1
        due_ns = start_ns + math.ceil(self._count * period_ns - half_ns)
        self.due_ns = due_ns if due_ns > t_ns else t_ns + 1  # a period below one ns, or a sum that was rounded down
        return True


class RateThinner:
    """Paces of one device, one per rate. All readers with the same rate receive the same samples."""

    __slots__ = ("_newest_ns", "_paces", "_users")

    def __init__(self) -> None:
        self._paces: dict[float, Pace] = {}
        self._users: dict[float, int] = {}
        self._newest_ns = 0

    def __bool__(self) -> bool:
        """Return whether there is any rate."""
        return bool(self._paces)

    def add(self, rate_hz: float) -> None:
        """Add a reader with this rate."""
        self._users[rate_hz] = self._users.get(rate_hz, 0) + 1
        self._paces.setdefault(rate_hz, Pace(rate_hz))

    def discard(self, rate_hz: float) -> None:
        """Remove a reader with this rate. The last reader removes the rate."""
        self._users[rate_hz] -= 1
        if not self._users[rate_hz]:
            del self._users[rate_hz], self._paces[rate_hz]

    def choose(self, times_ns: Sequence[int]) -> Mapping[float, tuple[int, ...]]:
        """Return the indices of the selected samples by rate. Call it once with the time stamp of each sample."""
        paces = self._paces
        if not paces:
            return NOTHING
        before_ns, newest_ns = self._newest_ns, times_ns[-1]
        self._newest_ns = newest_ns
        due = [(rate_hz, pace) for rate_hz, pace in paces.items() if newest_ns >= pace.due_ns]
        if not due:
            return NOTHING
        steps_ns = [t_ns - last_ns for t_ns, last_ns in zip(times_ns, (before_ns, *times_ns), strict=False)]
        found = {}
        for rate_hz, pace in due:
            is_due = pace.is_due
            chosen = tuple([index for index, t_ns in enumerate(times_ns) if is_due(t_ns, steps_ns[index])])
            if chosen:
                found[rate_hz] = chosen
        return found


class MeanRate:
    """Mean angular rate of the samples since the last `take`, in the published axes."""

    __slots__ = ("_count", "_x", "_y", "_z")

    def __init__(self) -> None:
        self._x = self._y = self._z = 0.0
        self._count = 0

    def add(self, samples: Sequence[Sample]) -> None:
        """Add samples. Ignore samples without angular rates."""
        for sample in samples:
            gyro = sample.gyro_rad_s
            if gyro is not None:
                self._x += gyro[0]
                self._y += gyro[1]
                self._z += gyro[2]
                self._count += 1

    def take(self) -> Vector3 | None:
        """Return the mean and start again; None without samples."""
        count = self._count
        if not count:
            return None
        mean = (self._x / count, self._y / count, self._z / count)
        self._x = self._y = self._z = 0.0
        self._count = 0
        return mean
