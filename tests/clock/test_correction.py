"""A counter that the device corrects while its samples go on: time takes no notice, edges stay where they belong."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from imud.clock.correction import corrected
from imud.clock.envelope import Envelope
from imud.clock.unwrap import DeviceTime
from imud.contracts.timing import UtcReference
from imud.sim.ports.arrival import BARE_UART, USB_16MS, ArrivalModel, ArrivalProfile, Crystal
from imud.units import NS_PER_MS, NS_PER_S
from tests.bench.clock import BAUD_OF_RATE
from tests.bench.line_model import LineFaults, heard, measured_ns
from tests.bench.line_runs import (
    REFERENCE,
    UTC_OFFSET_NS,
    Told,
    after,
    begun_ns,
    measurement,
    share_honest,
    sout_clock,
    steepest,
)  # fmt: skip
from tests.support.streams import BEGIN_NS, feed, make_clock, rises, steady

UNIX = 1 << 32
SECONDS = 14
SEED = 1
SET_AT_S = 12
SETTLED_S = 10.5
SLEW = 550e-6
JITTER_STEP_NS = 60_000
"""Stamps of edges are late by an exponential law of 4 µs."""


def run(
    profile: ArrivalProfile,
    rate_hz: int,
    set_ms: float,
    *,
    edges: bool,
    reference: UtcReference | None = None,
    faults: LineFaults | None = None,
) -> tuple[list[Told], Callable[[], int]]:
    """A device on UTC whose counter is set by so much; also how often that was taken for a restart."""
    model = ArrivalModel(profile, rate_hz, SEED, Crystal(0.0), BAUD_OF_RATE[rate_hz])
    clock, told = sout_clock(model), []
    clock.reference = reference
    first_ns = 0
    for read in heard(model.run(rate_hz * SECONDS), SEED, faults or LineFaults()):
        if edges:
            clock.edges(read.edges)
        for a, number in zip(read.arrivals, read.numbers, strict=True):
            truth_ns = measured_ns(a)
            first_ns = first_ns or truth_ns
            age_ns = truth_ns - first_ns
            moved_ns = set_ms * NS_PER_MS * (age_ns >= SET_AT_S * NS_PER_S)
            ticks = (truth_ns + UTC_OFFSET_NS + NS_PER_MS // 3 + int(moved_ns)) // NS_PER_MS % UNIX
            told.append(Told(clock.sample(measurement(a, ticks), a.t_rx_ns, 0), truth_ns, number, begun_ns(model, a)))
    return told, lambda: clock.status().resets


def largest_step_ns(told: list[Told]) -> int:
    return max(abs(b.off_ns - a.off_ns) for a, b in pairwise(told))


@pytest.mark.parametrize("reference", [None, REFERENCE], ids=["unknown", "utc"])
@pytest.mark.parametrize("edges", [False, True], ids=["bare", "edges"])
@pytest.mark.parametrize("rate_hz", [100, 1000])
@pytest.mark.parametrize("set_ms", [-0.9, 0.9, -30.0, 30.0])
def test_a_correction_is_no_step(set_ms: float, rate_hz: int, edges: bool, reference: UtcReference | None) -> None:
    told, resets = run(BARE_UART, rate_hz, set_ms, edges=edges, reference=reference)
    settled = after(told, SETTLED_S)
    assert resets() == 0
    assert all(abs(t.off_ns) <= 2 * t.sample.t_err_ns for t in settled)
    assert rises(t.sample for t in told)
    if edges:
        assert largest_step_ns(settled) < JITTER_STEP_NS
        assert all(t.sample.edge_seq == t.number for t in settled)
        assert max(t.sample.t_err_ns for t in settled) < JITTER_STEP_NS
    else:
        assert steepest(settled) < 2 * SLEW


@pytest.mark.parametrize("edges", [False, True], ids=["bare", "edges"])
@pytest.mark.parametrize("rate_hz", [100, 1000])
@pytest.mark.parametrize("set_ms", [-0.9, 0.9, -30.0, 30.0])
def test_a_correction_behind_a_slow_adapter_with_losses_is_covered(set_ms: float, rate_hz: int, edges: bool) -> None:
    faults = LineFaults(pulse_loss=0.02, frame_loss=0.02)
    told, resets = run(USB_16MS, rate_hz, set_ms, edges=edges, reference=REFERENCE, faults=faults)
    settled = after(told, SETTLED_S)
    assert resets() == 0
    assert share_honest(settled) > 0.99
    assert all(abs(t.off_ns) <= 3 * t.sample.t_err_ns for t in settled)
    assert rises(t.sample for t in told)
    wrong = sum(t.sample.edge_seq not in (None, t.number) for t in settled)
    assert wrong <= 16 * rate_hz // 1000  # no more than the adapter holds in one read, until the next shows it


def stamps(*steps: int) -> tuple[DeviceTime, list[int]]:
    """Device time over steps in ms after 100 of 10 ms, relative to the last of those."""
    time = DeviceTime(NS_PER_MS, UNIX)
    time.begin(0)
    ticks, found = 0, []
    for i, step in enumerate([10] * 100 + list(steps)):
        ticks += step
        time.advance(ticks)
        if i >= 99:
            found.append(time.even_ns)
    return time, [x - found[0] for x in found[1:]]


def test_two_ticks_less_within_a_minute_are_no_step() -> None:
    """The correction takes what room the tick leaves, and the next natural one finds none."""
    time, found = stamps(9, *[10] * 70, 9, 10)
    assert max(abs(b - a - 10 * NS_PER_MS) for a, b in pairwise([0, *found])) < 0.05 * NS_PER_MS
    assert time.doubt_ns > NS_PER_MS // 3


def test_samples_that_are_uneven_are_followed() -> None:
    """Stamps that change all the time are the device's: its samples are where they say, within a tick."""
    time, found = stamps(*[11, 11, 11, 9, 9, 9] * 10)
    assert abs(found[-1] - 600 * NS_PER_MS) <= 2 * NS_PER_MS
    assert not time.uneven


def test_messages_that_pause_are_no_correction() -> None:
    """The device rested for 13 ms once, and its message came when it should."""
    clock = make_clock()
    points = steady(0, 0, 1000) + steady(9_993 + 10, 10_003, 500)
    samples = feed(clock, points)
    assert (
        max(
            abs(s.t_ns - BEGIN_NS - int(ms * NS_PER_MS) - NS_PER_MS)
            for s, (_, ms) in zip(samples[500:], points[500:], strict=True)
        )
        < NS_PER_MS
    )


@pytest.mark.parametrize("set_ms", [-2_000, 2_000])
def test_a_counter_that_moves_far_began_anew(set_ms: int) -> None:
    clock = make_clock()
    feed(clock, steady(100_000, 0, 1000) + steady(110_000 + set_ms, 10_000, 500))
    assert clock.status().resets == 1


def test_samples_that_were_never_missing_are_not_told_missing() -> None:
    clock = make_clock()
    feed(clock, steady(0, 0, 1000))
    feed(clock, [(10_030, 10_000)])
    assert clock.missed == 0


def test_until_an_arrival_confirms_it_the_correction_is_doubted() -> None:
    """A period more may have passed; device time as stamped goes back with the counter."""
    clock = make_clock()
    (last,) = feed(clock, steady(100_000, 0, 1000))[-1:]
    first, second = feed(clock, [(109_970, 10_000), (109_980, 10_010)])
    assert last.t_dev_ns is not None
    assert first.t_dev_ns == last.t_dev_ns - 20 * NS_PER_MS
    assert first.t_err_ns > 10 * NS_PER_MS
    assert second.t_err_ns < NS_PER_MS
    assert abs(first.t_ns - last.t_ns - 10 * NS_PER_MS) < NS_PER_MS // 100


@pytest.mark.parametrize(("seconds", "seen"), [(4, False), (6, True)])
def test_a_young_line_takes_nothing_for_a_correction(seconds: int, seen: bool) -> None:
    time, _ = stamps(7)
    x_before = time.even_ns - 7 * NS_PER_MS
    begin = x_before - seconds * NS_PER_S
    envelope = Envelope(begin, begin)
    for x in range(begin, x_before + 1, 10 * NS_PER_MS):
        envelope.add(x, x, 0, 0.0)
    assert corrected(time, envelope, x_before, x_before + 10 * NS_PER_MS) is seen
