"""Fit below the arrivals, and the feasible lines of a latency timer, compared with a brute-force search."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from math import ceil
from random import Random

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.arrival_fit import ArrivalFit, extend_lower_hull, feasible_lines, lower_hull


def at(fit: ArrivalFit, device_ns: int) -> float:
    return fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)


def add(fit: ArrivalFit, device_ns: int, arrival_ns: int) -> bool:
    """Add an arrival without bytes after it. Return whether the fit changed."""
    return fit.add_arrival(device_ns, arrival_ns, 0, arrival_ns - at(fit, device_ns))


def fitted(slope: float, delay_mean_ns: float, seconds: int, seed: int = 1) -> tuple[ArrivalFit, int]:
    """Return a fit below 100 points per second of a line through the origin, and its error at the newest point."""
    random = Random(seed)
    fit, device_ns = ArrivalFit(0, 0), 0
    for i in range(1, 100 * seconds):
        device_ns = i * 10 * NS_PER_MS
        add(fit, device_ns, int(slope * device_ns + random.expovariate(1 / delay_mean_ns)))
    return fit, int(at(fit, device_ns) - slope * device_ns)


@pytest.mark.parametrize("slope", [1.0, 1 / 0.95, 1 / 1.05, 1.00005])
def test_the_fit_follows_the_frames_without_delay(slope: float) -> None:
    fit, off_ns = fitted(slope, 1_000_000, 100)
    assert abs(off_ns) < 20_000  # the mean delay is 1 ms
    assert fit.slope == pytest.approx(slope, abs=1e-6)
    assert fit.error_ns < 20_000


def test_the_window_is_bounded_and_the_fit_is_over_the_bins_that_are_left() -> None:
    fit, off_ns = fitted(1.0, 1_000_000, 1)
    assert abs(off_ns) < 1_000_000
    assert fit.slope_error > 1e-5
    # Each change opens a bin: the number of bins in a window is limited.
    fit, _ = fitted(1.0, 1_000_000, 200)
    assert 30 * NS_PER_S < fit.span_ns < (64 + 2) * NS_PER_S
    later = range(200 * NS_PER_S, 200 * NS_PER_S + fit.span_ns, 10 * NS_PER_MS)
    assert sum(add(fit, device_ns, device_ns + 1_000_000) for device_ns in later) <= 64
    # One arrival that is too early affects the fit for at most one window.
    fit, device_ns = ArrivalFit(0, -5_000_000), 0
    for i in range(1, 100 * 100):
        device_ns = i * 10 * NS_PER_MS
        add(fit, device_ns, device_ns)
    assert abs(at(fit, device_ns) - device_ns) < 10
    # The hull has no corner of a dropped or merged bin.
    random = Random(3)
    fit, points = ArrivalFit(0, 0), [(0, 0)]
    for i in range(1, 4000):
        device_ns = i * 50 * NS_PER_MS
        arrival_ns = int(1.00002 * device_ns + 1e-16 * -(device_ns**2) + random.expovariate(1e-5))
        points.append((device_ns, arrival_ns))
        if add(fit, device_ns, arrival_ns):
            kept = [(x, y) for x, y in points if x >= device_ns - fit.span_ns]
            assert min(y - at(fit, x) for x, y in kept) > -10_000  # lowest point above an earlier fit


@pytest.mark.parametrize("seed", range(4))
def test_no_point_is_under_the_hull_however_it_was_made(seed: int) -> None:
    """Corners are points, the slopes between them rise, and an extended hull equals the hull of all points."""
    random = Random(seed)
    points = [(float(x), random.gauss(0, 100)) for x in sorted(random.sample(range(10_000), 80))]
    hull = lower_hull(points)
    slopes = [(yb - ya) / (xb - xa) for (xa, ya), (xb, yb) in pairwise(hull)]
    assert slopes == sorted(slopes)
    assert {hull[0], hull[-1]} == {points[0], points[-1]}
    assert set(hull) <= set(points)
    for (xa, ya), (xb, yb) in pairwise(hull):
        assert all(y >= ya + (yb - ya) / (xb - xa) * (x - xa) - 1e-9 for x, y in points if xa <= x <= xb)
    at_once: list[tuple[float, float]] = []
    for begin in range(0, 80, 7):
        extend_lower_hull(at_once, points[begin : begin + 7])
    assert at_once == hull


def behind_timer(seconds: int, stalls_ns: Iterable[tuple[int, int]], hold_ns: int, pause_ns: int) -> ArrivalFit:
    """A fit of frames every 10 ms behind a timer of `hold_ns`. The stalls contain no frames."""
    random, fit, stalls = Random(3), ArrivalFit(0, 0, hold_ns), tuple(stalls_ns)
    fit.set_pause(pause_ns, hold_ns // (10 * NS_PER_MS) + 2)
    for i in range(1, 100 * seconds):
        sent_ns = i * 10 * NS_PER_MS
        handed_ns = sent_ns + hold_ns - (sent_ns + 7_000_000 + i * 40) % hold_ns
        handed_ns = next((until for since, until in stalls if since <= handed_ns < until), handed_ns)
        device_ns, arrival_ns = sent_ns, handed_ns + int(random.expovariate(1 / 30_000))
        trailing_ns = max(arrival_ns - sent_ns - pause_ns, 0)  # time on the wire except for the pause
        fit.add_arrival(device_ns, arrival_ns - trailing_ns, trailing_ns, arrival_ns - trailing_ns - at(fit, device_ns))
    return fit


def test_messages_between_stalls_bound_what_a_timer_hides() -> None:
    """A third of all frames is late. The others show the same bounds as on an idle host."""
    hold_ns, pause_ns = 16 * NS_PER_MS, 3 * NS_PER_MS
    stalls = [(at_ms * NS_PER_MS, (at_ms + 120) * NS_PER_MS) for at_ms in range(0, 70_000, 350)]
    fit = behind_timer(70, stalls, hold_ns, pause_ns)
    assert fit.hidden_ns < 2 * pause_ns
    device_ns = 70 * NS_PER_S
    assert abs(at(fit, device_ns) - fit.shift_ns - device_ns) < 2 * pause_ns


@pytest.mark.parametrize(("seconds", "ppm"), [(20, 20), (20, 100), (60, 0), (60, -20)])
def test_the_slope_error_covers_the_part_that_a_slow_beat_hides(seconds: int, ppm: float) -> None:
    """Frames every 16 ms behind a timer of 16 ms: the wait changes by some µs per second, and the spread is small."""
    period_ns = 16 * NS_PER_MS
    timer_ns = period_ns * (1 + ppm * 1e-6)
    fit = ArrivalFit(0, 0, period_ns)
    fit.set_pause(15 * NS_PER_MS, 2)
    for number in range(1, seconds * NS_PER_S // period_ns):
        sent_ns = number * period_ns
        handed_ns = int(ceil((sent_ns + 3 * NS_PER_MS) / timer_ns) * timer_ns) - 3 * NS_PER_MS
        add(fit, sent_ns, handed_ns)
    assert abs(fit.slope - 1) <= fit.slope_error <= period_ns / (seconds * NS_PER_S)
    assert abs(at(fit, sent_ns) - fit.shift_ns - sent_ns) <= fit.hidden_ns / 2 <= period_ns / 2


@pytest.mark.parametrize(("hold_ms", "span_ms"), [(0, 100), (1, 100), (16, 320)])
def test_a_fit_is_known_after_8_points_and_100_ms_or_20_periods_of_the_timer(hold_ms: int, span_ms: int) -> None:
    for last_ms, known in ((span_ms - 1, False), (span_ms, True)):
        fit = ArrivalFit(0, 0, hold_ms * NS_PER_MS)
        for number in range(1, 7):
            add(fit, number * NS_PER_MS, number * NS_PER_MS)
        assert not fit.is_known(0)
        add(fit, last_ms * NS_PER_MS, last_ms * NS_PER_MS)
        assert fit.count == 8
        assert fit.is_known(100 * NS_PER_MS) == known
    assert fit.is_known(span_ms * NS_PER_MS)
    assert not fit.is_known(span_ms * NS_PER_MS + 1)


@pytest.mark.parametrize(("reported_ms", "true_ms"), [(1, 16), (1, 4), (4, 16), (1, 20)])
def test_a_timer_that_is_longer_than_reported_is_measured(reported_ms: int, true_ms: int) -> None:
    random, fit = Random(1), ArrivalFit(0, 0, reported_ms * NS_PER_MS)
    for number in range(1, 2000):
        sent_ns = number * 10 * NS_PER_MS
        add(fit, sent_ns, sent_ns + int(random.uniform(0, 0.9 * true_ms * NS_PER_MS)))
    assert fit.measured_hold_ns == min(true_ms, 16) * NS_PER_MS
    fit = ArrivalFit(0, 0, reported_ms * NS_PER_MS)
    for number in range(1, 2000):
        sent_ns = number * 10 * NS_PER_MS
        add(fit, sent_ns, sent_ns + int(random.uniform(0, 0.9 * reported_ms * NS_PER_MS)))
    assert fit.measured_hold_ns == 0


def followed(fit: ArrivalFit, seconds: int, slope: float, delays_ns: Callable[[float], float]) -> ArrivalFit:
    """Add a frame every 20 ms. `delays_ns` is the delay of a frame by its time, s."""
    for number in range(1, 50 * seconds):
        sent_ns = number * 20 * NS_PER_MS
        add(fit, sent_ns, int(slope * sent_ns + delays_ns(number / 50)))
    return fit


def noise(mean_ns: float) -> Callable[[float], float]:
    random = Random(2)
    return lambda _t_s: random.expovariate(1 / mean_ns)


def held(random: Random) -> Callable[[float], float]:
    """Return waits in a timer of 16 ms. In each second half of a second, the host adds 5 ms."""
    return lambda t_s: 5e6 * (int(t_s * 2) % 2) + random.random() * 14.4e6


FITS: dict[str, Callable[[], ArrivalFit]] = {
    "three points": lambda: followed(ArrivalFit(0, 0), 1, 1.0001, lambda t_s: 1000 * (t_s > 0.03)),
    "too slow": lambda: followed(ArrivalFit(0, 0), 20, 1 / 1.08, noise(1e5)),
    "too fast": lambda: followed(ArrivalFit(0, 0), 20, 1 / 0.92, noise(1e5)),
    "known slope": lambda: followed(ArrivalFit(0, 0, 0, 1.0, 1e-6), 20, 1.0001, noise(1e5)),
    "clock stopped": lambda: followed(ArrivalFit(0, 0), 150, 1.0, lambda t_s: 3e8 * (t_s > 130)),
    "short timer": lambda: followed(ArrivalFit(0, 0, NS_PER_MS), 20, 1.00002, noise(4e5)),
    "timer and late host": lambda: followed(ArrivalFit(0, 0, 16 * NS_PER_MS), 20, 1.00002, held(Random(5))),
    "timer and stopped clock": lambda: followed(ArrivalFit(0, 0, 16 * NS_PER_MS), 20, 1.0, lambda t_s: 3e7 * (t_s > 5)),
    "timer and stalls": lambda: behind_timer(
        40, [(at_ms * NS_PER_MS, (at_ms + 90) * NS_PER_MS) for at_ms in range(0, 40_000, 350)], 16 * NS_PER_MS,
        3 * NS_PER_MS,
    ),
}  # fmt: skip
FIGURES: dict[str, tuple[float, ...]] = {
    "three points": (99000, 101041.667, 2460.81633, 112.9, 556.84659, 0, 0, 0),
    "too slow": (-1.46944004e+09, -65420560.7, 3246481.56, 15849292.4, 97217435, 0, 0, 0),
    "too fast": (1.49333333e+09, 75268817.2, 45952455.9, 227914261, 134486262, 205813684, 0, 0),
    "known slope": (472985.6, 23840, 5960, 1495045.86, 894474.868, 1347572.4, 0, 0),
    "clock stopped": (300000000, 15000000, 3160705.36, 49749609.4, 324154052, 3.81469727e-06, 0, 0),
    "short timer": (329241.914, 16594.8545, 17052.7379, 5180.79118, 106344.792, 0, 617066.586, 222003.103),
    "timer and late host": (417593.346, 21048.0517, 261989.757, 540287.147, 3723227.27, 0, 6942595.18, 2522798.8),
    "timer and stopped clock": (3e7, 2016129.03, 461436.207, 2251237.41, 14699696.6, 0, 6e6, 3e6),
    "timer and stalls": (409842.83, 10328.7004, 46476.1538, 96461.7138, 619397.552, 0, 3205560.35, 1155153.68),
}  # fmt: skip


@pytest.mark.parametrize("name", FITS)
def test_the_figures_of_a_fit_change_only_on_purpose(name: str) -> None:
    """Value, slope and its error in 1e-9, errors and hidden part in ns."""
    fit = FITS[name]()
    got = (
        at(fit, fit.fitted_ns) - fit.fitted_ns, (fit.slope - 1) * 1e9, fit.slope_error * 1e9, fit.error_ns,
        fit.residual_ns, fit.recent_ns, fit.hidden_ns, fit.shift_ns,
    )  # fmt: skip
    assert got == pytest.approx(FIGURES[name], rel=1e-6, abs=1)


def test_bounds_hold_for_every_line_that_fits() -> None:
    found = feasible_lines([(0.0, 10.0), (10.0, 10.0)], [(0.0, 0.0), (10.0, 0.0)], 10.0)
    assert found is not None
    assert (found.lowest_ns, found.highest_ns) == (0.0, 10.0)
    assert (found.slope_lowest, found.slope_highest) == (-1.0, 1.0)
    assert feasible_lines([(0.0, 0.0), (10.0, 0.0)], [(5.0, 1.0)], 10.0) is None
    assert feasible_lines([(5.0, 0.0)], [(5.0, 1.0)], 10.0) is None
    random = Random(5)
    ceiling = [(float(x), random.uniform(5, 15)) for x in range(0, 100, 9)]
    floor = [(float(x), random.uniform(-15, -5)) for x in range(3, 100, 9)]
    found = feasible_lines(ceiling, floor, 100.0)
    assert found is not None
    seen = []
    for _ in range(5000):
        slope, at_end = random.uniform(-0.4, 0.4), random.uniform(-40, 40)
        is_below = all(at_end + slope * (x - 100) <= y for x, y in ceiling)
        if is_below and all(at_end + slope * (x - 100) >= y for x, y in floor):
            seen.append(at_end)
            assert found.slope_lowest <= slope <= found.slope_highest
            assert found.lowest_ns <= at_end <= found.highest_ns
    assert len(seen) > 25
    assert max(seen) > found.highest_ns - 2
    assert min(seen) < found.lowest_ns + 2
