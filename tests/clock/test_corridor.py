"""Lines between two chains, against a brute-force search."""

from random import Random

from imud.clock.corridor import corridor


def test_a_level_corridor() -> None:
    found = corridor([(0.0, 10.0), (10.0, 10.0)], [(0.0, 0.0), (10.0, 0.0)], 10.0)
    assert found is not None
    assert (found.lowest_ns, found.highest_ns) == (0.0, 10.0)
    assert (found.slope_lowest, found.slope_highest) == (-1.0, 1.0)


def test_no_line_fits() -> None:
    assert corridor([(0.0, 0.0), (10.0, 0.0)], [(5.0, 1.0)], 10.0) is None
    assert corridor([(5.0, 0.0)], [(5.0, 1.0)], 10.0) is None


def test_bounds_hold_for_every_line_that_fits() -> None:
    random = Random(5)
    ceiling = [(float(x), random.uniform(5, 15)) for x in range(0, 100, 9)]
    floor = [(float(x), random.uniform(-15, -5)) for x in range(3, 100, 9)]
    found = corridor(ceiling, floor, 100.0)
    assert found is not None
    seen = []
    for _ in range(20_000):
        slope, at_end = random.uniform(-0.4, 0.4), random.uniform(-40, 40)
        if all(at_end + slope * (x - 100) <= y for x, y in ceiling) and all(
            at_end + slope * (x - 100) >= y for x, y in floor
        ):
            seen.append(at_end)
            assert found.slope_lowest <= slope <= found.slope_highest
            assert found.lowest_ns <= at_end <= found.highest_ns
    assert len(seen) > 100
    assert max(seen) > found.highest_ns - 2
    assert min(seen) < found.lowest_ns + 2
