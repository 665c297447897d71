"""Coverage, turns and the fitted sphere for points with known results."""

from itertools import permutations, product
from math import pi

import pytest

from imud.device.calibration import CELLS, Turning, cell_of, coverage
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.physics import tumble

POINTS_MAX = 1024

CENTRE: Vector3 = (14e-6, -2e-6, -9e-6)


def sample(t_ns: int, mag: Vector3 | None = None, gyro: Vector3 | None = None) -> Sample:
    return Sample("bow", 1, t_ns, 0, Sync.ARRIVAL, t_ns, t_ns, mag_t=mag, gyro_rad_s=gyro)


def of(points: list[Vector3]) -> Turning:
    """Return the result for these field vectors, 0.1 s apart."""
    turning = Turning()
    for number, point in enumerate(points):
        turning.add(sample(number * 100 * NS_PER_MS, point))
    return turning


def test_each_cell_has_one_direction_of_each_order_and_sign() -> None:
    directions = [
        tuple(sign * value for sign, value in zip(signs, values, strict=True))
        for signs in product((1, -1), repeat=3)
        for values in permutations((1.0, 2.0, 3.0))
    ]
    cells = {cell_of((x, y, z)) for x, y, z in directions}
    assert cells == set(range(CELLS))
    assert cell_of((3.0, 2.0, 1.0)) == 0
    assert coverage(0b1011) == 3 / 48


def test_sphere_of_six_points_and_its_residual() -> None:
    """Points on the axes at 45 µT about the centre, then the same with a radius of 40 µT along X."""
    a, b, c = CENTRE

    def axes(x: float) -> list[Vector3]:
        r = 45e-6
        return [(a + x, b, c), (a - x, b, c), (a, b + r, c), (a, b - r, c), (a, b, c + r), (a, b, c - r)] * 2

    sphere = of(axes(45e-6)).fit()
    assert sphere is not None
    assert sphere.centre_t == pytest.approx(CENTRE)
    assert sphere.radius_t == pytest.approx(45e-6)
    assert sphere.residual < 1e-9
    flattened = of(axes(40e-6)).fit()
    assert flattened is not None
    # mean of |m - c|² = (40² + 2·45²)/3 = 1883.3 = r², residuals -283.3, 141.7, 141.7: 200.3 / (2 r²) = 0.0532
    assert flattened.radius_t == pytest.approx(43.4e-6, abs=1e-8)
    assert flattened.residual == pytest.approx(0.0532, abs=1e-4)


@pytest.mark.parametrize(
    "points",
    [
        [],
        [(1e-6, 0.0, 0.0)] * 50,
        [(4e-5 * x, 4e-5 * y, 0.0) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1), (0.6, 0.8), (-0.6, 0.8))] * 4,
        [(0.0, 0.0, 0.0)] * 50,
    ],
    ids=["none", "one point", "a plane", "zeros"],
)
def test_no_sphere(points: list[Vector3]) -> None:
    assert of(points).fit() is None


def test_coverage_is_seen_from_the_centre() -> None:
    """A field of 45 µT with a bias of 60 µT covers half of the directions, seen from the origin."""
    truth = [tumble().at(second / 10).mag_t for second in range(1000)]
    turning = of([(x + 60e-6, y, z) for x, y, z in truth])
    sphere = turning.fit()
    assert sphere is not None
    assert sphere.centre_t == pytest.approx((60e-6, 0.0, 0.0), abs=1e-9)
    assert coverage(turning.cells(sphere)) > 0.9
    assert coverage(turning.cells(None)) < 0.6
    turning.restart_field()
    assert not turning.has_field


def test_turns_and_bounded_memory() -> None:
    turning = Turning()
    for number in range(11):
        turning.add(sample(number * 100 * NS_PER_MS, None, (pi, -pi / 2, 0.0)))
    assert turning.turned_rad == pytest.approx((pi, pi / 2, 0.0))
    turning.add(sample(5 * NS_PER_S, None, (pi, pi, pi)))  # a gap of 4 s is not part of the angle
    assert turning.turned_rad == pytest.approx((pi, pi / 2, 0.0))
    assert not turning.has_field
    # two alternating directions use all points, and a third direction arrives too late
    turning = of([(4e-5, 2e-5, 1e-5), (-4e-5, -2e-5, -1e-5)] * (POINTS_MAX // 2))
    turning.add(sample(10**12, (1e-5, 2e-5, 4e-5)))
    assert turning.cells(None).bit_count() == 2
    near = of([(4e-5, 2e-5, 1e-5 + number * 1e-9) for number in range(POINTS_MAX)])
    near.add(sample(10**12, (1e-5, 2e-5, 4e-5)))
    assert near.cells(None).bit_count() == 2  # equal points use one place
