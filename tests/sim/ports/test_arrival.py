"""The arrival model: limits of its profiles, and its truth."""

from dataclasses import replace
from itertools import pairwise

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports import arrival


def arrivals(
    profile: arrival.ArrivalProfile, rate_hz: float = 100, count: int = 2000, seed: int = 1
) -> list[arrival.Arrival]:
    """Return arrivals at 921600 baud."""
    return list(arrival.ArrivalModel(profile, rate_hz, seed).run(count))


def one_way(a: arrival.Arrival) -> int:
    """Return the arrival time minus wire time and true time, ns."""
    return a.t_rx_ns - (a.size_bytes + a.trailing_bytes) * 10_850 - a.t_ns


@pytest.mark.parametrize("profile", arrival.PROFILES, ids=lambda p: p.name)
@pytest.mark.parametrize("rate_hz", [1, 1000])
def test_nothing_arrives_before_it_was_sent(profile: arrival.ArrivalProfile, rate_hz: float) -> None:
    got = arrivals(profile, rate_hz)
    assert len(got) == 2000
    assert min(one_way(a) for a in got) >= -10_850  # trailing bytes are whole bytes, the true value is not
    assert all(a.t_rx_ns <= b.t_rx_ns and a.t_ns < b.t_ns for a, b in pairwise(got))


@pytest.mark.parametrize("profile", arrival.PROFILES, ids=lambda p: p.name)
def test_the_same_seed_gives_the_same(profile: arrival.ArrivalProfile) -> None:
    assert arrivals(profile, count=200) == arrivals(profile, count=200)
    assert arrivals(profile, count=200) != arrivals(profile, count=200, seed=2)


@pytest.mark.parametrize(
    ("profile", "late_ns", "trailing_bytes"),
    [
        *zip(
            arrival.PROFILES,
            (889_700, 999_911, 1_430_841, 9_142_774, 2_918_942, 2_405_092),
            (0, 82, 4, 359_578, 44_994, 52_455),
            strict=True,
        )
    ],
)
def test_the_mean_delay_of_a_profile(profile: arrival.ArrivalProfile, late_ns: int, trailing_bytes: int) -> None:
    found = list(arrival.ArrivalModel(profile, 400, 3, arrival.Crystal(20.0, 0.1), 921_600).run(1500))
    assert sum(a.t_rx_ns - a.t_ns for a in found) / len(found) == pytest.approx(late_ns, abs=2)
    assert sum(a.trailing_bytes for a in found) == trailing_bytes


def test_wires_timers_and_packets() -> None:
    """At 115200 baud 82 bytes take 7.1 ms, so that at 200 Hz each frame waits for the previous frames."""
    assert {one_way(a) // 2 for a in arrivals(arrival.PERFECT)} <= {-1, 0}

    got = arrivals(arrival.USB_16MS, 1000)
    reads = {a.t_rx_ns for a in got}
    assert 115 <= len(reads) <= 130
    assert max(a.trailing_bytes for a in got) > 82 * 12
    waits = [a.t_rx_ns - a.t_ns for a in got]
    assert 13 * NS_PER_MS < max(waits) < 30 * NS_PER_MS

    for a, b in pairwise(arrivals(arrival.USB_16MS, 1000)):
        if a.t_rx_ns == b.t_rx_ns:
            assert a.trailing_bytes - b.trailing_bytes == 82
        else:
            assert a.trailing_bytes < 82

    assert len({a.t_rx_ns for a in arrivals(arrival.USB_16MS_PACKET, 1000)}) > 1900

    got = list(arrival.ArrivalModel(arrival.PERFECT, 200, 1, baud=115_200).run(400))
    assert got[-1].t_rx_ns - got[-1].t_ns > NS_PER_S // 2


@pytest.mark.parametrize(
    ("profile", "newest_ms"),
    [(replace(arrival.USB_16MS, timer_ppm=0), 37), (arrival.USB_16MS_PACKET, 5)],
    ids=lambda p: str(p)[:40],
)
def test_a_late_read_has_what_further_rounds_of_the_timer_brought(
    profile: arrival.ArrivalProfile, newest_ms: int
) -> None:
    """The adapter delivers at 5 ms, and the read is at 45 ms. A packet adapter starts its timer only with data."""
    newest_ns = arrival.ArrivalModel(profile, 1000, 1)._newest_hand_over(5 * NS_PER_MS, 45 * NS_PER_MS)
    assert newest_ns == newest_ms * NS_PER_MS


@pytest.mark.parametrize(("skew_ppm", "drift"), [(0.0, 0.0), (50_000.0, 0.0), (-50_000.0, 0.0), (0.0, 0.1)])
def test_the_crystal_runs_as_told(skew_ppm: float, drift: float) -> None:
    got = list(arrival.ArrivalModel(arrival.PERFECT, 10, 1, arrival.Crystal(skew_ppm, drift, 5.0)).run(2500))
    ratio = (got[-1].dev_ns - got[0].dev_ns) / (got[-1].t_ns - got[0].t_ns)
    assert ratio == pytest.approx(1 + skew_ppm * 1e-6, abs=5e-6 if drift else 1e-9)
    rates = [(b.dev_ns - a.dev_ns) / (b.t_ns - a.t_ns) for a, b in pairwise(got)]
    assert max(rates) - min(rates) == pytest.approx(10e-6 if drift else 0, abs=1e-6)
