"""How far the turning of a magnetometer has come: directions covered, turns about each axis, field, residual of a fit.

Turned through all directions, the end of the field vector m describes a sphere about the bias of the sensor. Its centre
c and radius r follow by linear least squares from |m|² = 2 c·m + (r² - |c|²). The directions of m - c are counted in 48
cells of equal area: the eight octants, each divided into six by the order of |x|, |y|, |z|.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from math import dist, pi, sqrt
from typing import Final

from imud.sample import Sample, Vector3
from imud.units import NS_PER_S

_ORDERS: Final = tuple(permutations(range(3)))
"""Axes by falling absolute value."""
CELLS: Final = 8 * len(_ORDERS)
POINTS_MAX: Final = 1024
"""Points for the coverage; later ones are not kept. A slow turning of five minutes has some 700."""
POINT_DISTANCE_T: Final = 5e-6
"""An eighth of a cell in Earth's field."""
FIT_POINTS_MIN: Final = 12
T_PER_UT: Final = 1e-6
STEP_MAX_NS: Final = NS_PER_S
"""A longer pause between two samples is not integrated."""
TURNS_WANTED_RAD: Final = 2 * pi
"""Manual B, section 8.1.1: each axis at least once through 360°."""
COVERAGE_WANTED: Final = 0.6
"""Share of the cells: a hand reaches more than 40 of 48; with fewer than 29 the fit depends on noise."""
FIELD_MIN_T: Final = 22e-6
FIELD_MAX_T: Final = 67e-6
"""Earth's field at the surface, 22 to 67 µT (IGRF)."""
RESIDUAL_MAX: Final = 0.05
"""RMS distance from the sphere over its radius: 5 % of the horizontal field turn the heading by about 3°."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere fitted to the ends of field vectors."""

    centre_t: Vector3
    radius_t: float
    residual: float
    """RMS distance of the points from it, as a share of the radius."""


class Turning:
    """Samples of a device that is being turned.

    The fit uses sums over all samples. For the coverage POINTS_MAX points are kept, none nearer to the one before than
    POINT_DISTANCE_T. So memory, and the time of one question, are bounded.
    """

    def __init__(self) -> None:
        self._points: list[Vector3] = []
        self._fit = _SphereFit()
        self._turned = [0.0, 0.0, 0.0]
        self._t_ns: int | None = None

    def add(self, sample: Sample) -> None:
        """Add a sample."""
        if sample.mag_t is not None:
            self._add_field(sample.mag_t)
        before, self._t_ns = self._t_ns, sample.t_ns
        if before is None or sample.gyro_rad_s is None or sample.t_ns - before > STEP_MAX_NS:
            return
        step_s = (sample.t_ns - before) / NS_PER_S
        for axis, rate in enumerate(sample.gyro_rad_s):
            self._turned[axis] += abs(rate) * step_s

    def _add_field(self, field_t: Vector3) -> None:
        self._fit.add(field_t)
        if len(self._points) < POINTS_MAX and (not self._points or dist(self._points[-1], field_t) >= POINT_DISTANCE_T):
            self._points.append(field_t)

    def restart_field(self) -> None:
        """Forget the field so far: the device corrects it in another way from now on."""
        self._points.clear()
        self._fit = _SphereFit()

    @property
    def turned_rad(self) -> Vector3:
        """Angle turned about each axis of the sensor, whatever the direction."""
        x, y, z = self._turned
        return (x, y, z)

    @property
    def has_field(self) -> bool:
        """Whether any sample had a magnetic field."""
        return bool(self._points)

    def cells(self, sphere: Sphere | None) -> int:
        """The covered cells as a bit mask, seen from the centre of the sphere."""
        a, b, c = sphere.centre_t if sphere is not None else (0.0, 0.0, 0.0)
        mask = 0
        for x, y, z in self._points:
            mask |= 1 << cell_of((x - a, y - b, z - c))
        return mask

    def fit(self) -> Sphere | None:
        """Fit the sphere; None while the points are too few or lie in a plane."""
        return self._fit.sphere()


class _SphereFit:
    """Linear least squares for the sphere, from sums; in µT, so that they are well scaled."""

    def __init__(self) -> None:
        self._count = 0
        self._sums = [[0.0] * 5 for _ in range(5)]
        """Products of (2x, 2y, 2z, 1, |m|²) with each other: normal equations, their right side, its square."""

    def add(self, field_t: Vector3) -> None:
        """Add a point."""
        x, y, z = (value / T_PER_UT for value in field_t)
        row = (2 * x, 2 * y, 2 * z, 1.0, x * x + y * y + z * z)
        self._count += 1
        for sums, left in zip(self._sums, row, strict=True):
            for column, right in enumerate(row):
                sums[column] += left * right

    def sphere(self) -> Sphere | None:
        """The sphere; None while the points are too few or lie in a plane."""
        if self._count < FIT_POINTS_MIN:
            return None
        solved = _solve([list(row) for row in self._sums[:4]])
        if solved is None:
            return None
        a, b, c, d = solved
        squared = d + a * a + b * b + c * c
        if squared <= 0:
            return None
        right_side = [row[4] for row in self._sums]
        # A point at distance e from the sphere misses its equation by about 2 r e.
        missed = right_side[4] - sum(value * right for value, right in zip(solved, right_side[:4], strict=True))
        residual = sqrt(max(missed, 0.0) / self._count) / (2 * squared)
        return Sphere((a * T_PER_UT, b * T_PER_UT, c * T_PER_UT), sqrt(squared) * T_PER_UT, residual)


def cell_of(direction: Vector3) -> int:
    """The cell, 0 … 47, in which a direction lies: octant by signs, then the order of the absolute values."""
    octant = sum((value < 0) << axis for axis, value in enumerate(direction))
    order = tuple(sorted(range(3), key=lambda axis: -abs(direction[axis])))
    return octant * len(_ORDERS) + _ORDERS.index(order)


def coverage(mask: int) -> float:
    """Share of the cells that are in the mask."""
    return mask.bit_count() / CELLS


def _solve(matrix: Sequence[list[float]]) -> list[float] | None:
    """Solve four linear equations with their right sides in the fifth column; None for a singular system.

    Gaussian elimination with partial pivoting; `matrix` is changed.
    """
    scale = max(abs(value) for row in matrix for value in row[:4])
    for i in range(4):
        pivot = max(range(i, 4), key=lambda row: abs(matrix[row][i]))
        if abs(matrix[pivot][i]) <= 1e-9 * scale:
            return None
        rows = list(matrix)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        matrix = rows
        for row in matrix[i + 1 :]:
            factor = row[i] / matrix[i][i]
            for j in range(i, 5):
                row[j] -= factor * matrix[i][j]
    found = [0.0] * 4
    for i in reversed(range(4)):
        known = sum(matrix[i][j] * found[j] for j in range(i + 1, 4))
        found[i] = (matrix[i][4] - known) / matrix[i][i]
    return found
