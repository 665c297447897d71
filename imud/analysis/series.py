"""Even runs of samples from their time stamps: the true rate, which samples are missing, and where a run ends.

A sensor samples evenly by its own crystal; stamps scatter about that grid by their error. The grid is fitted to the
stamps, so the rate is the sensor's as the host's clock sees it, and every sample has a place on it. Places without a
sample are missing ones: short gaps are filled by interpolation and counted, longer ones end the run. Nothing is
shortened: the samples after a gap keep their time.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from imud.model.errors import BadArgument
from imud.model.units import NS_PER_S

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SAMPLES_LEAST: Final = 64
"""Fewer say nothing about rate or noise."""
FILL_MOST: Final = 4
"""Missing samples in a row that are filled; more end a run. A longer line between two points changes the noise."""
SCATTER_MOST: Final = 0.2
"""Scatter of the stamps, in periods, up to which a missing sample is located: at half a period it is a guess."""
STEP_FOR_PERIOD: Final = 4
"""The first guess of the period is from stamps so far apart: device time in whole ms makes single steps uneven."""
REFINEMENTS: Final = 4
PAUSE_S: Final = 1.0
"""With stamps that scatter too much to locate a missing sample, silence of so long still ends a run."""


@dataclass(frozen=True, slots=True)
class Readings:
    """Samples of one device as they came, oldest first."""

    t_ns: IntArray
    """(n,) CLOCK_MONOTONIC of the measurement, rising."""
    gyro_rad_s: FloatArray | None
    """(n, 3); NaN where a sample had none; None where no sample had."""
    accel_m_s2: FloatArray | None
    """(n, 3), specific force."""
    temperature_c: FloatArray | None
    """(n,), NaN where a sample had none."""

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.t_ns[-1] - self.t_ns[0]) / NS_PER_S if len(self.t_ns) else 0.0


@dataclass(frozen=True, slots=True)
class Grid:
    """Places of samples on an even grid of time."""

    rate_hz: float
    """Rate of the sensor by the stamps."""
    place: IntArray
    """(n,) number of the period of each sample, the first 0, rising."""
    scatter_s: float
    """Standard deviation of the stamps about the grid."""
    located: bool
    """Whether the stamps are good enough to see a single missing sample."""
    runs: tuple[tuple[int, int], ...]
    """First and last + 1 of the samples of each run without a gap of more than FILL_MOST."""
    missing: int
    """Places without a sample."""
    filled: int
    """Of these, those in short gaps, which are filled."""

    @property
    def duration_s(self) -> float:
        """From the first place to the end of the last."""
        return float(self.place[-1] + 1) / self.rate_hz

    def words(self) -> str:
        """Describe what was done about missing samples, in one sentence."""
        scatter = f"stamps scatter by {self.scatter_s * 1e6:.0f} µs about an even grid of {self.rate_hz:.4f} Hz"
        if not self.located:
            return (
                f"{scatter}, too much to see single missing samples, which are therefore not made up for; silences of "
                f"{PAUSE_S:g} s and more end a run: {len(self.runs)} runs"
            )
        if not self.missing:
            return f"{scatter}; no sample is missing"
        share = 100 * self.missing / int(self.place[-1] + 1)
        return (
            f"{scatter}; {self.missing} samples are missing ({share:.2f} %): {self.filled} in gaps of at most "
            f"{FILL_MOST} are interpolated, longer gaps part the series into {len(self.runs)} "
            f"run{'s' if len(self.runs) > 1 else ''}"
        )


def grid_of(t_ns: IntArray) -> Grid:
    """Fit an even grid to stamps, (n,) rising, ns. Raises BadArgument for too few, or such that do not rise."""
    if len(t_ns) < SAMPLES_LEAST:
        raise BadArgument(f"expected at least {SAMPLES_LEAST} samples with values, got {len(t_ns)}")
    t_s = (t_ns - t_ns[0]) / NS_PER_S
    steps_s = np.diff(t_s)
    if steps_s.min() <= 0:
        at = int(np.argmax(steps_s <= 0)) + 1
        raise BadArgument(f"expected time stamps that rise, sample {at} has not: is it a file of two devices?")
    period_s = _guess(t_s)
    steps = np.ones(len(steps_s), dtype=np.int64)
    for _ in range(REFINEMENTS):
        steps = np.maximum(np.rint(steps_s / period_s).astype(np.int64), 1)
        period_s = _slope(np.concatenate(([0], np.cumsum(steps))), t_s, steps)
    scatter_s = _scatter(steps_s - steps * period_s)
    located = scatter_s <= SCATTER_MOST * period_s
    if not located:
        steps = np.where(steps_s > PAUSE_S, np.maximum(np.rint(steps_s / period_s), 1), 1).astype(np.int64)
    place = np.concatenate(([0], np.cumsum(steps))).astype(np.int64)
    period_s = _slope(place, t_s, steps)
    most = FILL_MOST + 1
    long = np.flatnonzero(steps > most) + 1
    bounds = [0, *long.tolist(), len(t_s)]
    short = steps[(steps > 1) & (steps <= most)]
    return Grid(
        1 / period_s, place, scatter_s, located, tuple(pairwise(bounds)),
        int((steps - 1).sum()), int((short - 1).sum()),
    )  # fmt: skip


def _guess(t_s: FloatArray) -> float:
    """Period from the median over some steps."""
    return float(np.median(t_s[STEP_FOR_PERIOD:] - t_s[:-STEP_FOR_PERIOD])) / STEP_FOR_PERIOD


def _slope(place: IntArray, t_s: FloatArray, steps: IntArray) -> float:
    """Least-squares period from places and times, of the parts between gaps: a pause need not be whole periods."""
    part = np.concatenate(([0], np.cumsum(steps > FILL_MOST + 1)))
    count = np.bincount(part)
    x = place - (np.bincount(part, place) / count)[part]
    y = t_s - (np.bincount(part, t_s) / count)[part]
    return float((x @ y) / (x @ x))


def _scatter(residual_s: FloatArray) -> float:
    """Standard deviation of one stamp, from those of differences of two, without outliers."""
    middle = np.median(residual_s)
    return float(1.4826 * np.median(np.abs(residual_s - middle)) / np.sqrt(2))


def even_runs(grid: Grid, values: FloatArray, *, smooth: bool = False) -> list[FloatArray]:
    """Values (n, …) of the grid's samples as even runs, each (m, …) at `grid.rate_hz`, short gaps filled.

    By straight lines, which add no power, for noise; with `smooth` by a cubic spline, for vibration.
    """
    found = []
    for first, end in grid.runs:
        place, part = grid.place[first:end], values[first:end]
        every = np.arange(place[0], place[-1] + 1)
        if len(every) == len(place):
            found.append(np.asarray(part, dtype=np.float64))
        elif smooth and len(place) >= SAMPLES_LEAST:
            found.append(_filled_smooth(place, part, every))
        else:
            columns = part.reshape(len(part), -1).T
            lines = [np.interp(every, place, column) for column in columns]
            found.append(np.stack(lines, axis=1).reshape(len(every), *part.shape[1:]))
    return found


def _filled_smooth(place: IntArray, part: FloatArray, every: IntArray) -> FloatArray:
    filled: FloatArray = np.empty((len(every), *part.shape[1:]))
    filled[place - place[0]] = part
    absent: Any = np.setdiff1d(every, place, assume_unique=True)
    filled[absent - place[0]] = CubicSpline(place, part, axis=0)(absent)
    return filled


def with_values(t_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Leave out the samples that have no finite value: t_ns (k,), values (k, …)."""
    good = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    return t_ns[good], values[good]
