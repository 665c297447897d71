"""Statistics of intervals of samples: mean, minimum, maximum and root mean square.

    samples ─▶ per quantity and component: count, sum, sum of squares, minimum, maximum ─▶ Interval

Angles: imud unwraps the angles of an interval at ±π from its first sample, and wraps the mean to -π … π. Otherwise the
mean of a heading near south would be north. Quaternions: q and -q are the same attitude. imud uses the sign that is
nearer to the first quaternion, and normalizes the mean. Values that are not finite are ignored.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Final

from imud.fleet.messages import Interval, Measures
from imud.model.sample import Sample, Sync

# a mean of positions would be wrong at a longitude of ±180°
VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "incli_rad", "velocity_enu_m_s")
SCALARS: Final = ("temperature_c", "pressure_pa", "heave_m")
ANGLES: Final = frozenset(("euler_rad", "incli_rad"))
MEASURES: Final = ("mean", "min", "max", "rms")
_ORDER: Final = {sync: place for place, sync in enumerate(Sync)}
_TURN: Final = 2 * math.pi


class _Quantity:
    """Sums of one quantity of an interval."""

    __slots__ = ("_count", "_high", "_low", "_reference", "_squares", "_sums")

    def __init__(self, components: int) -> None:
        self._count = 0
        self._sums, self._squares = [0.0] * components, [0.0] * components
        self._low, self._high = [math.inf] * components, [-math.inf] * components
        self._reference: Sequence[float] | None = None

    def add(self, name: str, values: list[Sequence[float]]) -> None:
        """Add values. Ignore values with a component that is not finite."""
        columns = list(zip(*values, strict=True))
        # one sum detects NaN and infinity; it is cheaper than a test of each value
        if not math.isfinite(sum(map(sum, columns))):
            values = [value for value in values if all(map(math.isfinite, value))]
            columns = list(zip(*values, strict=True))
        if not values:
            return
        self._reference = self._reference or values[0]
        if name in ANGLES:
            columns = [_continued(column, near) for column, near in zip(columns, self._reference, strict=True)]
            self._reference = [column[-1] for column in columns]
        elif name == "quat_wxyz":
            columns = list(zip(*[_same_side(value, self._reference) for value in values], strict=True))
        self._count += len(values)
        for at, column in enumerate(columns):
            self._sums[at] += math.fsum(column)
            self._squares[at] += math.fsum([value * value for value in column])
            self._low[at] = min(self._low[at], *column)
            self._high[at] = max(self._high[at], *column)

    def measures(self, name: str, wanted: Sequence[str]) -> Measures | None:
        """Return the requested statistics; None if there was no value."""
        count = self._count
        if not count:
            return None
        mean = [total / count for total in self._sums]
        if name in ANGLES:
            mean = [math.remainder(value, _TURN) for value in mean]
        elif name == "quat_wxyz":
            length = math.hypot(*mean)
            mean = [value / length for value in mean] if length else mean
        found = {
            "mean": tuple(mean),
            "min": tuple(self._low),
            "max": tuple(self._high),
            "rms": tuple(math.sqrt(total / count) for total in self._squares),
        }
        return Measures(**{measure: found[measure] for measure in wanted})


class IntervalMaker:
    """Present interval. Synchronization: one thread."""

    def __init__(self, wanted: Sequence[str] = MEASURES) -> None:
        """`wanted` are names of MEASURES."""
        self._wanted = wanted
        self._begin()

    def _begin(self) -> None:
        self._quantities: dict[str, _Quantity] = {}
        self._first: Sample | None = None
        self._last: Sample | None = None
        self._count = 0
        self._t_err_ns = 0
        self._sync = Sync.UTC
        self._status: int | None = None

    @property
    def is_empty(self) -> bool:
        """Return whether the interval has no sample."""
        return self._first is None

    def add(self, samples: Sequence[Sample]) -> None:
        """Add samples in their order."""
        if not samples:
            return
        self._first = self._first or samples[0]
        self._last = samples[-1]
        self._count += len(samples)
        self._t_err_ns = max(self._t_err_ns, *[one.t_err_ns for one in samples])
        self._sync = min(self._sync, *{one.sync for one in samples}, key=_ORDER.__getitem__)
        for one in samples:
            if one.status is not None:
                self._status = (self._status or 0) | one.status
        for name in VECTORS:
            self._add(name, [value for one in samples if (value := getattr(one, name)) is not None])
        for name in SCALARS:
            self._add(name, [(value,) for one in samples if (value := getattr(one, name)) is not None])

    def take(self) -> Interval | None:
        """Return the interval and start the next; None without samples."""
        first, last = self._first, self._last
        if first is None or last is None:
            return None
        values = {}
        for name, quantity in self._quantities.items():
            measures = quantity.measures(name, self._wanted)
            if measures is not None:
                values[name] = measures
        made = Interval(
            first.seq, last.seq, self._count, first.t_ns, last.t_ns, first.utc_ns, last.utc_ns, self._t_err_ns,
            self._sync, values, self._status,
        )  # fmt: skip
        self._begin()
        return made

    def _add(self, name: str, values: list[Sequence[float]]) -> None:
        if values:
            if name not in self._quantities:
                self._quantities[name] = _Quantity(len(values[0]))
            self._quantities[name].add(name, values)


def by_interval(samples: Sequence[Sample], period_ns: int) -> Iterator[tuple[int, list[Sample]]]:
    """Yield the number and the samples of each interval of CLOCK_MONOTONIC."""
    for number, group in groupby(samples, lambda one: one.t_ns // period_ns):
        yield number, list(group)


def summed_up(samples: Sequence[Sample]) -> Interval | None:
    """Return the statistics of samples that the spool replaces; None without samples."""
    maker = IntervalMaker()
    maker.add(samples)
    return maker.take()


def _continued(column: Sequence[float], near: float) -> tuple[float, ...]:
    """Return angles unwrapped at ±π, starting near `near`."""
    made = []
    for value in column:
        near += math.remainder(value - near, _TURN)
        made.append(near)
    return tuple(made)


def _same_side(value: Sequence[float], reference: Sequence[float]) -> Sequence[float]:
    """Return the quaternion with the sign that is nearer to the reference."""
    if sum(a * b for a, b in zip(value, reference, strict=True)) >= 0:
        return value
    return [-part for part in value]
