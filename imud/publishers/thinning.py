"""Thinning of samples to a rate: which of them are sent, and the mean of the angular rates of all between.

samples ─▶ Pace.is_due ─▶ the one nearest to each due instant, never resampled; RateThinner: for several rates
    └────▶ MeanRate ────▶ what vibration leaves of the angular rate over the same time
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S

PAUSE_PERIODS: Final = 4
"""After so many periods without a sample how often samples come is learned anew; a lost one or two change nothing."""


NOTHING: Final[Mapping[float, tuple[int, ...]]] = {}
"""What is chosen of most batches."""


class Pace:
    """Thins the samples of one device to `rate_hz`: the one nearest to each due instant, never resampled.

    Due instants are start + k / rate_hz in the time of the samples, k counted, so that rounding never adds up. Nearest,
    because a device that sends just at the rate has its samples at due instants, some a little early: all are taken,
    where the first one at or after each would be up to a quarter less. They are counted from a sample anew where that
    is late by more than the step between samples: after a pause, and with a device slower than the rate.
    """

    __slots__ = ("_count", "_period_ns", "_start_ns", "due_ns")

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._start_ns: int | None = None
        self._count = 0
        self.due_ns = 0
        """A sample measured before this instant is not one to send."""

    def is_due(self, t_ns: int, step_ns: int) -> bool:
        """Whether the sample measured at `t_ns` is one to send; if so, the next due instant is a later one.

        `step_ns` is the time since the sample before it, sent or not; for the first sample 0.
        """
        if t_ns < self.due_ns:
            return False
        period_ns, start_ns = self._period_ns, self._start_ns
        late_ns = 0 if start_ns is None else t_ns - start_ns - math.ceil(self._count * period_ns)
        half_ns = min(step_ns, period_ns) / 2
        if start_ns is None or step_ns > PAUSE_PERIODS * period_ns:
            start_ns, half_ns, self._count = t_ns, 0.0, 0  # how often samples come is not known, or not any more
        elif late_ns > 2 * half_ns:
            start_ns, self._count = t_ns - math.ceil(half_ns), 0
        self._start_ns = start_ns
        self._count += 1
        due_ns = start_ns + math.ceil(self._count * period_ns - half_ns)
        self.due_ns = due_ns if due_ns > t_ns else t_ns + 1  # a period below one ns, or a sum that rounds down
        return True


class RateThinner:
    """The paces of one device, one for each rate: all who want a rate get the same samples, which are made once."""

    __slots__ = ("_newest_ns", "_paces", "_users")

    def __init__(self) -> None:
        self._paces: dict[float, Pace] = {}
        self._users: dict[float, int] = {}
        self._newest_ns = 0

    def __bool__(self) -> bool:
        """Whether any rate is wanted."""
        return bool(self._paces)

    def add(self, rate_hz: float) -> None:
        """Choose samples for this rate, too; it may be wanted several times."""
        self._users[rate_hz] = self._users.get(rate_hz, 0) + 1
        self._paces.setdefault(rate_hz, Pace(rate_hz))

    def discard(self, rate_hz: float) -> None:
        """Take back one `add`; the rate is forgotten with the last."""
        self._users[rate_hz] -= 1
        if not self._users[rate_hz]:
            del self._users[rate_hz], self._paces[rate_hz]

    def choose(self, samples: Sequence[Sample]) -> Mapping[float, tuple[int, ...]]:
        """Return which samples are to be sent, their indices by rate; to be called with each sample, once."""
        paces = self._paces
        if not paces:
            return NOTHING
        before_ns, newest_ns = self._newest_ns, samples[-1].t_ns
        self._newest_ns = newest_ns
        due = [(rate_hz, pace) for rate_hz, pace in paces.items() if newest_ns >= pace.due_ns]
        if not due:
            return NOTHING
        times_ns = [sample.t_ns for sample in samples]
        steps_ns = [t_ns - last_ns for t_ns, last_ns in zip(times_ns, (before_ns, *times_ns), strict=False)]
        found = {}
        for rate_hz, pace in due:
            is_due = pace.is_due
            chosen = tuple([index for index, t_ns in enumerate(times_ns) if is_due(t_ns, steps_ns[index])])
            if chosen:
                found[rate_hz] = chosen
        return found


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
