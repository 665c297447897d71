"""Turns of a device during a calibration of its magnetometer: directions, angles, and the centre of the field.

sphere   3D: the field vectors end on a sphere about the uncorrected offset
circle   2D: the field vectors of a level vehicle end on a circle about the vertical axis
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from math import dist, hypot, pi, sqrt
from typing import Final

from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S, T_PER_UT

_ORDERS: Final = tuple(permutations(range(3)))  # possible orders of the axes by absolute value
CELLS: Final = 8 * len(_ORDERS)  # number of cells of the sphere: 48
POINTS_MAX: Final = 1024
"""Maximum number of points for the coverage. A slow calibration of five minutes has about 700."""
POINT_DISTANCE_T: Final = 5e-6  # minimum distance of two points, T: an eighth of a cell in Earth's field
FIT_POINTS_MIN: Final = 12  # minimum number of points for a fit
STEP_MAX_NS: Final = NS_PER_S  # maximum time between two samples in the integral of the angular rate, ns
TURNS_WANTED_RAD: Final = 2 * pi  # minimum angle about each axis, rad (manual B, section 8.1.1)
COVERAGE_WANTED: Final = 0.6
"""Minimum share of cells. A hand reaches 40 of 48 cells. With fewer than 29 cells the fit depends on noise."""
FIELD_MIN_T: Final = 22e-6  # minimum of Earth's field at the surface, T (IGRF)
FIELD_MAX_T: Final = 67e-6  # maximum of Earth's field at the surface, T (IGRF)
RESIDUAL_MAX: Final = 0.05
"""Maximum RMS distance from the sphere, as a share of its radius. 5 % change the heading by about 3°."""
OFFSET_MAX_T: Final = 3e-6
"""Maximum offset of the field after a calibration, T. A calibrated device has 1 to 2 µT. 3 µT change the heading by up
to 9° in a horizontal field of 20 µT."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere fitted to the ends of field vectors."""

    centre_t: Vector3
    radius_t: float
    residual: float  # RMS distance of the points from the sphere, as a share of the radius


class Turning:
    """Samples of a device that a user turns.

    The fit uses sums over all samples. The coverage uses at most POINTS_MAX points with a distance of at least
    POINT_DISTANCE_T. Thus memory and computing time have a limit.
    """

    def __init__(self, *, is_planar: bool = False) -> None:
        """`is_planar`: the device stays level and turns about one axis only."""
        self.is_planar = is_planar
        self._points: list[Vector3] = []
        self._fit = _SphereFit()
        self._turned = [0.0, 0.0, 0.0]
        self._turned_before: Vector3 = (0.0, 0.0, 0.0)  # angles at the last `restart_field`
        self._axis: Vector3 = (0.0, 0.0, 0.0)  # mean axis of the turns; the direction of a turn does not matter
        self._t_ns: int | None = None

    def add(self, sample: Sample) -> None:
        if sample.mag_t is not None:
            self._add_field(sample.mag_t)
        before, self._t_ns = self._t_ns, sample.t_ns
        if before is None or sample.gyro_rad_s is None or sample.t_ns - before > STEP_MAX_NS:
            return
        step_s = (sample.t_ns - before) / NS_PER_S
        for axis, rate in enumerate(sample.gyro_rad_s):
            self._turned[axis] += abs(rate) * step_s
        sign = -1.0 if _dot(self._axis, sample.gyro_rad_s) < 0.0 else 1.0
        angles = (sign * rate * step_s for rate in sample.gyro_rad_s)
        x, y, z = (mean + angle for mean, angle in zip(self._axis, angles, strict=True))
        self._axis = (x, y, z)

    def _add_field(self, field_t: Vector3) -> None:
        self._fit.add(field_t)
        if len(self._points) < POINTS_MAX and (not self._points or dist(self._points[-1], field_t) >= POINT_DISTANCE_T):
            self._points.append(field_t)

    def restart_field(self) -> None:
        """Remove the field samples: the device now corrects the field in another way."""
        self._turned_before = self.turned_rad
        self._points.clear()
        self._fit = _SphereFit()

    @property
    def turned_rad(self) -> Vector3:
        """Angle about each axis of the sensor, rad, summed over both directions."""
        x, y, z = self._turned
        return (x, y, z)

    @property
    def share(self) -> float:
        """Share of the wanted turns and, unless `is_planar`, of the wanted directions, 0 … 1.

        With `is_planar`, the turns since the last `restart_field` count: a circle has few directions and no sphere.
        """
        if self.is_planar:
            angles = (angle - start for angle, start in zip(self._turned, self._turned_before, strict=True))
            return min(1.0, max(angles) / TURNS_WANTED_RAD)
        return min(1.0, coverage(self.cells(self.fit())) / COVERAGE_WANTED, min(self._turned) / TURNS_WANTED_RAD)

    @property
    def has_field(self) -> bool:
        """Whether a sample contained a magnetic field."""
        return bool(self._points)

    def cells(self, sphere: Sphere | None) -> int:
        """Return the covered cells as a bit mask, seen from the centre of the sphere."""
        a, b, c = sphere.centre_t if sphere is not None else (0.0, 0.0, 0.0)
        mask = 0
        for x, y, z in self._points:
            mask |= 1 << cell_of((x - a, y - b, z - c))
        return mask

    def fit(self) -> Sphere | None:
        """Return the fitted sphere; None if there are too few points or if they lie in a plane."""
        return self._fit.sphere()

    def offset(self, bias_t: Vector3 | None) -> Vector3 | None:
        """Return the offset of the field that the bias of the device does not explain, T.

        A device sends the field with or without its bias (no manual states it). Thus the offset is the centre of the
        field, or the difference of the centre and the bias if this difference is shorter. `bias_t`: None if the device
        does not report its bias. With `is_planar`, only the part in the plane of the turns counts. None if the samples
        do not show the centre.
        """
        if self.is_planar:
            axis = _unit(self._axis)
            centre_t = self._fit.circle_centre(axis)
        else:
            axis = None
            sphere = self.fit()
            centre_t = sphere.centre_t if sphere is not None else None
        if centre_t is None or bias_t is None:
            return centre_t
        x, y, z = (centre - bias for centre, bias in zip(centre_t, bias_t, strict=True))
        if axis is not None:
            height = _dot((x, y, z), axis)
            x, y, z = (value - height * part for value, part in zip((x, y, z), axis, strict=True))
        return min(centre_t, (x, y, z), key=lambda vector: hypot(*vector))


class _SphereFit:
    """Linear least-squares fit of a sphere from sums, in µT for numerical accuracy."""

    def __init__(self) -> None:
        self._count = 0
        # products of (2x, 2y, 2z, 1, |m|²): the normal equations with the right side and its square
        self._sums = [[0.0] * 5 for _ in range(5)]

    def add(self, field_t: Vector3) -> None:
        x, y, z = (value / T_PER_UT for value in field_t)
        row = (2 * x, 2 * y, 2 * z, 1.0, x * x + y * y + z * z)
        self._count += 1
        for sums, left in zip(self._sums, row, strict=True):
            for column, right in enumerate(row):
                sums[column] += left * right

    def sphere(self) -> Sphere | None:
        if self._count < FIT_POINTS_MIN:
            return None
        solved = _solve([list(row) for row in self._sums[:4]])
        if solved is None:
            return None
        a, b, c, d = solved
        squared = d + a * a + b * b + c * c  # the mean square distance from the centre: positive
        right_side = [row[4] for row in self._sums]
        # a point at distance e from the sphere has a residual of about 2 r e in its equation
        missed = right_side[4] - sum(value * right for value, right in zip(solved, right_side[:4], strict=True))
        residual = sqrt(max(missed, 0.0) / self._count) / (2 * squared)
        return Sphere((a * T_PER_UT, b * T_PER_UT, c * T_PER_UT), sqrt(squared) * T_PER_UT, residual)

    def circle_centre(self, axis: Vector3) -> Vector3 | None:
        """Return the centre of a circle about `axis`, a vector of length 1, T. Its part along the axis is 0.

        None if there are too few points or if they lie on a line.
        """
        if self._count < FIT_POINTS_MIN:
            return None
        u, v = _plane_of(axis)
        # the equations of the sphere for a centre in the plane of u and v
        rows = ((*u, 0.0, 0.0), (*v, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0, 1.0))
        products = [[_dot(sums, row) for row in rows] for sums in self._sums]
        columns = list(zip(*products, strict=True))
        matrix = [[_dot(column, row) for column in columns] for row in rows[:3]]
        solved = _solve(matrix)
        if solved is None:
            return None
        a, b, _ = solved
        x, y, z = ((a * left + b * right) * T_PER_UT for left, right in zip(u, v, strict=True))
        return (x, y, z)


def _dot(left: Sequence[float], right: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(left, right, strict=True))


def _unit(vector: Vector3) -> Vector3:
    """Return the vector with length 1; Z for a vector of length 0."""
    length = hypot(*vector)
    if not length:
        return (0.0, 0.0, 1.0)
    x, y, z = (value / length for value in vector)
    return (x, y, z)


def _cross(left: Vector3, right: Vector3) -> Vector3:
    a, b, c = left
    x, y, z = right
    return (b * z - c * y, c * x - a * z, a * y - b * x)


def _plane_of(axis: Vector3) -> tuple[Vector3, Vector3]:
    """Return two vectors of length 1 that are perpendicular to `axis` and to each other."""
    smallest = min(range(3), key=lambda index: abs(axis[index]))
    other = (float(smallest == 0), float(smallest == 1), float(smallest == 2))
    u = _unit(_cross(axis, other))
    return u, _cross(axis, u)


def cell_of(direction: Vector3) -> int:
    """Return the cell of a direction, 0 … 47: its octant, then the order of the absolute values."""
    octant = sum((value < 0) << axis for axis, value in enumerate(direction))
    order = tuple(sorted(range(3), key=lambda axis: -abs(direction[axis])))
    return octant * len(_ORDERS) + _ORDERS.index(order)


def coverage(mask: int) -> float:
    """Return the share of the cells in the mask."""
    return mask.bit_count() / CELLS


def _solve(matrix: Sequence[list[float]]) -> list[float] | None:
    """Solve linear equations with the right sides in the last column; None if they are singular.

    Gaussian elimination with partial pivoting. Changes `matrix`.
    """
    count = len(matrix)
    scale = max(abs(value) for row in matrix for value in row[:count])
    for i in range(count):
        pivot = max(range(i, count), key=lambda row: abs(matrix[row][i]))
        if abs(matrix[pivot][i]) <= 1e-9 * scale:
            return None
        rows = list(matrix)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        matrix = rows
        for row in matrix[i + 1 :]:
            factor = row[i] / matrix[i][i]
            for j in range(i, count + 1):
                row[j] -= factor * matrix[i][j]

    solution = [0.0] * count
    for i in reversed(range(count)):
        solved_part = sum(matrix[i][j] * solution[j] for j in range(i + 1, count))
        solution[i] = (matrix[i][count] - solved_part) / matrix[i][i]
    return solution
