"""The log contains each fault with its kind, each fault has its effect, and the seed decides the faults.
The arrival model: limits of its profiles, and its truth."""

from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports import arrival
from imud.sim.ports.faults import Fault, FaultKind, FaultRates, Faults, rates_from
from imud.sim.sensor import Burst

STEP_NS = 10 * NS_PER_MS


def bursts(count: int) -> list[Burst]:
    random = Random(1)
    return [Burst(n * STEP_NS, DRIVER.example_frame(random), n * STEP_NS - 1, n) for n in range(count)]


def passed(faults: Faults, count: int = 300) -> list[tuple[Burst, Burst | None]]:
    return [(burst, faults.pass_on(burst)) for burst in bursts(count)]


def hit(faults: Faults) -> set[int]:
    return {fault.burst for fault in faults.log}


@pytest.mark.parametrize("kind", FaultKind)
def test_what_was_not_hit_arrives_as_it_was_and_what_was_is_noted(kind: FaultKind) -> None:
    faults = Faults(5, rates_from(f"{kind}=0.1"))
    for number, (before, after) in enumerate(passed(faults)):
        if number in hit(faults):
            assert after != before
        elif kind not in (FaultKind.DELAY, FaultKind.UNPLUG):  # DELAY and UNPLUG also affect later bursts
            assert after == before
    assert set(faults.counts) == {kind}
    assert (1 if kind is FaultKind.UNPLUG else 10) <= faults.counts[kind] <= 60
    assert (faults.counts[kind], faults.bursts) == (len(faults.log), 300)


@pytest.mark.parametrize(
    ("kind", "least", "most"),
    [(FaultKind.CUT, -82, -1), (FaultKind.FLIP, 0, 0), (FaultKind.DROP, -1, -1), (FaultKind.INSERT, 1, 16)],
)
def test_length_tells_the_kind(kind: FaultKind, least: int, most: int) -> None:
    faults = Faults(3, rates_from(f"{kind}=1"))
    for before, after in passed(faults, 100):
        change = len(after.data if after else b"") - len(before.data)
        assert least <= change <= most or (kind is FaultKind.CUT and len(before.data) > 82 and change < 0)


def test_flips_wrong_rates_delays_unplugging_and_invalid_rates() -> None:
    for before, after in passed(Faults(3, FaultRates(flip=1.0)), 50):
        assert after
        assert sum((a ^ b).bit_count() for a, b in zip(before.data, after.data, strict=True)) == 1
    faults = Faults(2, FaultRates(wrong_baud=1.0), baud=115_200)
    assert all(after is None or after.data != before.data for before, after in passed(faults, 100))
    faults = Faults(3, FaultRates(delay=0.5, delay_ns=25 * NS_PER_MS))
    pairs = passed(faults)
    times = [after.due_ns for _, after in pairs if after]
    assert times == sorted(times)
    assert all(after and after.due_ns >= before.due_ns for before, after in pairs)
    assert faults.bursts_hit == 0
    faults = Faults(3, FaultRates(unplug=0.02, unplug_ns=55 * NS_PER_MS))
    pairs, first = passed(faults), faults.log[0].burst
    assert [after for _, after in pairs[first : first + 6]] == [None] * 6
    assert faults.unplugged_until_ns >= first * STEP_NS + 55 * NS_PER_MS
    assert sum(after is None for _, after in pairs) == faults.bursts_hit
    for text in ("flop=0.1", "flip", "flip=often", "flip=1.5", "flip=-1", "flip=nan"):
        with pytest.raises(ValueError, match="fault"):
            rates_from(text)


def test_the_ledger_of_a_codec_tells_the_same() -> None:
    faults, ledger = Faults(11, FaultRates(flip=0.05, cut=0.03, drop=0.03, insert=0.03)), Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    events = [event for _, after in passed(faults, 400) if after for event in codec.feed(after.data)]
    events += codec.flush()
    untouched, measured = 400 - len(hit(faults)), sum(isinstance(event, Measurement) for event in events)
    survivable = faults.counts[FaultKind.INSERT]  # bytes inserted directly before a frame do not damage it
    assert ledger.closes()
    assert untouched <= ledger.frames_in_samples <= untouched + survivable
    assert measured >= untouched
    assert rates_from("flip=0.5,delay=0.1,delay_ns=7") == FaultRates(flip=0.5, delay=0.1, delay_ns=7)
    assert not rates_from("").any()
    assert rates_from("cut=0.1").any()
    empty = Faults(1, FaultRates(cut=1, drop=1))
    assert empty.pass_on(Burst(0, b"x")) is None
    assert (empty.counts, empty.bursts_hit) == ({FaultKind.CUT: 1, FaultKind.DROP: 1}, 1)
    rates = FaultRates(flip=0.1, cut=0.1, delay=0.1)

    def run(seed: int) -> list[Fault]:
        faults = Faults(seed, rates)
        passed(faults)
        return faults.log

    assert run(1) == run(1)
    assert run(1) != run(2)


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
