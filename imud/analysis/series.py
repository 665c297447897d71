"""Time grid of samples: true rate, lost samples, and runs with a constant period.

A sensor samples with a constant period of its own crystal. The time stamps scatter around this grid because of their
error. imud fits the grid to the time stamps. The rate is therefore the rate of the sensor in host time, and each sample
has a place on the grid. A place without a sample is a lost sample. imud interpolates short gaps and counts them. A
longer gap ends a run. Samples after a gap keep their time.
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

SAMPLES_LEAST: Final = 64  # minimum number of samples for an analysis
# Maximum number of consecutive lost samples that imud interpolates. Longer interpolation changes the noise.
FILL_MOST: Final = 4
# Maximum scatter of the time stamps, in periods, to find single lost samples. With 0.5, the place would be a guess.
SCATTER_MOST: Final = 0.2
# Distance of time stamps for the first estimate, periods. Single steps of device time in whole ms are uneven.
STEP_FOR_PERIOD: Final = 4
REFINEMENTS: Final = 4
PAUSE_S: Final = 1.0  # minimum silence that ends a run if imud cannot find single lost samples, s


@dataclass(frozen=True, slots=True)
class Readings:
    """Samples of one device in the order of arrival."""

    t_ns: IntArray  # time stamps of the measurements (CLOCK_MONOTONIC), increasing, ns, shape (n,)
    # Angular rate, shape (n, 3); NaN if a sample does not contain it, None if no sample contains it
    gyro_rad_s: FloatArray | None
    accel_m_s2: FloatArray | None  # specific force, shape (n, 3); NaN and None as above
    temperature_c: FloatArray | None  # temperature, shape (n,); NaN and None as above
    euler_rad: FloatArray | None = None  # roll, pitch, yaw, shape (n, 3); NaN and None as above

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t_ns[-1] - self.t_ns[0]) / NS_PER_S if len(self.t_ns) else 0.0


@dataclass(frozen=True, slots=True)
class Grid:
    """Places of samples on a time grid with a constant period."""

    rate_hz: float  # rate of the sensor in host time, Hz
    place: IntArray  # index of the period of each sample, increasing from 0, shape (n,)
    scatter_s: float  # standard deviation of the time stamps around the grid, s
    located: bool  # whether the time stamps are good enough to find single lost samples
    # Index of the first sample and of the last sample plus 1, for each run without a gap longer than FILL_MOST
    runs: tuple[tuple[int, int], ...]
    missing: int  # number of places without a sample
    filled: int  # number of interpolated samples in short gaps

    @property
    def duration_s(self) -> float:
        """Time from the first place to the end of the last place, s."""
        return float(self.place[-1] + 1) / self.rate_hz

    def words(self) -> str:
        """Describe the grid and the lost samples."""
        scatter = f"the time stamps scatter by {self.scatter_s * 1e6:.0f} µs around a grid of {self.rate_hz:.4f} Hz"
        if not self.located:
            return (
                f"{scatter}; because of this scatter, imud cannot find and interpolate single lost samples; gaps of "
                f"{PAUSE_S:g} s and more divide the series into {len(self.runs)} runs"
            )
        if not self.missing:
            return f"{scatter}; no sample is lost"
        share = 100 * self.missing / int(self.place[-1] + 1)
        return (
            f"{scatter}; {self.missing} samples are lost ({share:.2f} %): imud interpolates {self.filled} samples in "
            f"gaps of at most {FILL_MOST}; longer gaps divide the series into {len(self.runs)} "
            f"run{'s' if len(self.runs) > 1 else ''}"
        )


def grid_of(t_ns: IntArray) -> Grid:
    """Fit a grid to increasing time stamps, ns, shape (n,). Raises BadArgument for too few or other time stamps."""
    if len(t_ns) < SAMPLES_LEAST:
        raise BadArgument(f"expected at least {SAMPLES_LEAST} samples with values, got {len(t_ns)}")
    t_s = (t_ns - t_ns[0]) / NS_PER_S
    steps_s = np.diff(t_s)
    if steps_s.min() <= 0:
        at = int(np.argmax(steps_s <= 0)) + 1
        raise BadArgument(f"expected increasing time stamps, got a step back at sample {at}; are there two devices?")
    period_s = _guess(t_s)
    steps = np.ones(len(steps_s), dtype=np.int64)
    for _ in range(REFINEMENTS):
        # the number of periods between two samples, at least 1
        steps = np.maximum(np.rint(steps_s / period_s).astype(np.int64), 1)
        period_s = _slope(np.concatenate(([0], np.cumsum(steps))), t_s, steps)
    scatter_s = _scatter(steps_s - steps * period_s)
    located = scatter_s <= SCATTER_MOST * period_s
    if not located:
        pauses = steps_s > PAUSE_S
        # without the rounded distances of scattered time stamps, which make the period too short
        period_s = period_s if pauses.all() else float(np.mean(steps_s[~pauses]))
        steps = np.where(pauses, np.maximum(np.rint(steps_s / period_s), 1), 1).astype(np.int64)
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
    """Return a first estimate of the period from the median of some steps, s."""
    return float(np.median(t_s[STEP_FOR_PERIOD:] - t_s[:-STEP_FOR_PERIOD])) / STEP_FOR_PERIOD


def _slope(place: IntArray, t_s: FloatArray, steps: IntArray) -> float:
    """Return the least-squares period of places and times, s."""
    # separately for each part between gaps: a pause of the device is perhaps not a whole number of periods
    part = np.concatenate(([0], np.cumsum(steps > FILL_MOST + 1)))
    count = np.bincount(part)
    x = place - (np.bincount(part, place) / count)[part]
    y = t_s - (np.bincount(part, t_s) / count)[part]
    return float((x @ y) / (x @ x))


def _scatter(residual_s: FloatArray) -> float:
    """Return the standard deviation of a time stamp, from the differences of two time stamps, without outliers."""
    middle = np.median(residual_s)
    # 1.4826: standard deviation of a normal distribution per median deviation
    return float(1.4826 * np.median(np.abs(residual_s - middle)) / np.sqrt(2))


def even_runs(grid: Grid, values: FloatArray, *, smooth: bool = False) -> list[FloatArray]:
    """Return the values of the runs, each of the shape (m, …), with interpolated short gaps.

    The interpolation is linear for noise, because lines add no power. `smooth` selects a cubic spline for vibration.
    """
    found = []
    for first, end in grid.runs:
        place, part = grid.place[first:end], values[first:end]
        every = np.arange(place[0], place[-1] + 1)
        # no lost sample in this run
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
    """Return the time stamps, shape (k,), and values, shape (k, …), of samples with finite values only."""
    good = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    return t_ns[good], values[good]
