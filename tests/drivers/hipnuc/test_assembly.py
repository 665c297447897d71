"""Assembly of samples from frames without a counter. The data of the test frames identify the burst.
Loss and delay by the times of bursts. The period is 5 ms; times are in ms."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from random import Random
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.drivers.hipnuc.assembly import Assembly, Cadence, Learned, SidSeries, learned_from
from imud.model.ledger import Ledger

MS = 1_000_000
PERIOD_NS = 5 * MS
FRAME_NS = 240_000
EQUAL = {1: 1, 2: 1, 3: 1}
MIXED = {1: 1, 2: 1, 3: 2, 6: 10}
"""200, 200, 100 and 20 Hz, as multiples of the burst period."""
LEADING = {7: 4, 1: 1, 2: 1}
"""Order in which a slow kind is first."""


class Frame(NamedTuple):
    kind: int
    data: bytes
    t_ns: int
    burst: int
    sid: int | None = None


def stream(kinds: Mapping[int, int], bursts: Iterable[int], period_ns: int = PERIOD_NS) -> list[Frame]:
    """Yield the frames of some bursts at their times. The data are the number of the burst and the kind."""
    frames = []
    for burst in bursts:
        due = [kind for kind, every in kinds.items() if burst % every == 0]
        for place, kind in enumerate(due):
            data = burst.to_bytes(4, "little") + bytes([kind])
            frames.append(Frame(kind, data, 10**9 + burst * period_ns + place * FRAME_NS, burst))
    return frames


class AssemblyBench:
    def __init__(self, kinds: Iterable[int] | None = None) -> None:
        self.ledger = Ledger()
        self.assembly = Assembly(self.ledger, None if kinds is None else set(kinds))
        self.made: list[tuple[int, tuple[int, ...]]] = []
        """Burst and kinds of each sample."""
        self.times_ns: list[int] = []
        self.ages_ns: list[int] = []
        """Time from each value to its sample, ns."""

    def feed(self, frames: Iterable[Frame], *, bursts: bool = True) -> list[int]:
        """Return the bursts that became samples. Check that each frame is part of one sample or ignored, and the
        ledger. `bursts`: check also that no sample is mixed.
        """
        before, arrivals = len(self.made), dict[bytes, int]()
        for frame in frames:
            arrivals[frame.data] = frame.t_ns
            self.ledger.frames_good += 1
            for made in self.assembly.add_frame(*frame[:3], frame.sid):
                numbers = {int.from_bytes(data[:4], "little") for _, data in made.frames}
                assert not bursts or len(numbers) == 1, "mixed"
                assert all(data[4] == kind for kind, data in made.frames)
                self.made.append((numbers.pop(), tuple(kind for kind, _ in made.frames)))
                self.times_ns.append(made.t_first_ns)
                self.ages_ns += [abs(made.t_first_ns - arrivals.get(data, made.t_first_ns)) for _, data in made.frames]
            assert self.ledger.closes(), self.ledger.snapshot()
            assert min(self.ledger.values()) >= 0
        assert self.times_ns == sorted(self.times_ns)
        return [burst for burst, _ in self.made[before:]]

    def kinds_of(self, burst: int) -> tuple[int, ...]:
        return dict(self.made)[burst]


def learnt(kinds: Mapping[int, int], bursts: int = 60) -> AssemblyBench:
    rig = AssemblyBench()
    rig.feed(stream(kinds, range(bursts)))
    assert rig.ledger.lost_gap_device == 0
    return rig


def without(frames: list[Frame], lost: Callable[[Frame], bool]) -> list[Frame]:
    return [frame for frame in frames if not lost(frame)]


def whole(kinds: Mapping[int, int], burst: int) -> tuple[int, ...]:
    return tuple(kind for kind, every in kinds.items() if burst % every == 0)


@pytest.mark.parametrize("kinds", [EQUAL, MIXED, LEADING, {4: 1}, {1: 3, 2: 1, 4: 3, 6: 7}])
@pytest.mark.parametrize("begin", [0, 2])
def test_every_burst_becomes_one_sample(kinds: dict[int, int], begin: int) -> None:
    """Also the first bursts: imud ignores no frame while it learns."""
    rig = AssemblyBench()
    made = rig.feed(stream(kinds, range(200))[begin:])
    late = 4 * max(kinds.values())
    assert set(made) >= set(range(2, 199))
    assert [one for one in rig.made if late <= one[0] < 199] == [(b, whole(kinds, b)) for b in range(late, 199)]
    assert rig.ledger.lost_gap_device == rig.ledger.frames_ignored == 0
    assert rig.assembly.period_ns == pytest.approx(PERIOD_NS, rel=1e-3)
    if kinds in (EQUAL, MIXED):
        assert rig.times_ns[-20:] == [10**9 + burst * PERIOD_NS for burst in made[-20:]]


FREE = {
    "an autopilot at 40, 10 and 1 Hz": {1: 25.0, 2: 100.0, 3: 1000.0},
    "40, 10 and 1 Hz, elsewhere in the period": {1: (25.0, 24.0), 2: (100.0, 13.0), 3: (1000.0, 26.0)},
    "timers that slide": {1: 100.0, 2: (100.3, 0.6), 3: (100.7, 1.2)},
    "the faster kind slides": {1: (100.3, 3.0), 2: 100.0}, "half the rate, sliding": {1: 10.0, 2: (20.05, 0.4)},
    "no common multiple": {1: 20.0, 2: 50.0, 3: (33.0, 5.0)},
    "the slow kind is first": {1: (1000.0, 0.0), 2: (50.0, 20.0)}, "opposite phases": {1: 100.0, 2: (100.0, 50.0)},
    "one kind": {1: 1000.0},
}  # fmt: skip
SIDS: dict[str, Callable[[int, int, int], int | None]] = {
    "no SID": lambda kind, number, message: None,
    "always 0": lambda kind, number, message: 0,
    "a counter of each kind": lambda kind, number, message: (number + 50 * kind) % 251,
    "counters that start together": lambda kind, number, message: number % 253,
    "one counter of all messages": lambda kind, number, message: message % 256,
    "steps of four": lambda kind, number, message: 4 * number % 252,
}


def free_frames(kinds: Mapping[int, object], jitter: float, random: Random, until_ms: int = 0) -> list[Frame]:
    """Return the frames of kinds with timers of their own: period, or (period, phase), in ms."""
    timers = {kind: one if isinstance(one, tuple) else (float(str(one)), 0.0) for kind, one in kinds.items()}
    fastest = min(period for period, _ in timers.values())
    until_ms = until_ms or int(max(400 * fastest, *(8 * period for period, _ in timers.values()), 0))
    frames = []
    for kind, (period, phase) in timers.items():
        for number in range(int((until_ms - phase) / period)):
            t_ms = phase + number * period + jitter * fastest * random.random()
            data = number.to_bytes(4, "little") + bytes([kind])
            frames.append(Frame(kind, data, 10**9 + round(t_ms * MS), number))
    return sorted(frames, key=lambda frame: frame.t_ns)


@pytest.mark.parametrize("sid", SIDS.values(), ids=SIDS)
@pytest.mark.parametrize("jitter", [0.0, 0.1, 0.4])
@pytest.mark.parametrize("kinds", FREE.values(), ids=FREE)
def test_kinds_with_own_timers_lose_nothing(
    kinds: dict[int, object], jitter: float, sid: Callable[[int, int, int], int | None]
) -> None:
    """The SID and the period prove no loss. Each value has about the time of its sample."""
    frames = free_frames(kinds, jitter, Random(1))
    frames = [f._replace(sid=sid(f.kind, f.burst, place)) for place, f in enumerate(frames)]
    rig = AssemblyBench()
    rig.feed(frames, bursts=False)
    rest = [len(made.frames) for made in rig.assembly.flush()]
    counts = Counter(kind for _, kinds_of in rig.made for kind in kinds_of)
    assert sum(counts.values()) + sum(rest) == len(frames)
    assert rig.ledger.frames_ignored == rig.ledger.lost() == rig.ledger.lost_unknown == rig.ledger.frames_lost == 0
    fastest = max(Counter(f.kind for f in frames).values())
    assert fastest - 1 <= len(rig.made) <= 1.2 * fastest + 8
    # two kinds with nearly the same period slide by up to one period
    assert max(rig.ages_ns) <= (1.05 + jitter) * rig.assembly.period_ns
    assert rig.assembly.problem == ""


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_period_of_the_fastest_kind_proves_its_losses(jitter: float) -> None:
    kinds = {1: 25.0, 2: (100.0, 7.0), 3: (1000.0, 16.0)}
    frames = free_frames(kinds, jitter, Random(2))
    lost = {(1, 100), (1, 200), (1, 201), (1, 202), (2, 30), (3, 4), (1, 300)}
    rig = AssemblyBench()
    rig.feed((f for f in frames if (f.kind, f.burst) not in lost), bursts=False)
    assert rig.ledger.lost_gap_device == 5


def test_samples_are_complete_after_silence_after_a_reset_and_with_equal_values_after_a_stall() -> None:
    rig = learnt(MIXED)
    for burst in range(60, 81):
        *head, last = stream(MIXED, [burst])
        assert (rig.feed(head), rig.ledger.frames_pending) == ([], len(head))
        assert (rig.feed([last]), rig.ledger.frames_pending) == ([burst], 0)

    rig = learnt(MIXED)
    made = rig.feed(without(stream(MIXED, range(60, 400)), lambda f: 81 <= f.burst < 290))
    assert made == [*range(60, 81), *range(290, 400)]
    assert (rig.ledger.lost_gap_device, rig.ledger.lost_unknown) == (0, 1)

    rig = learnt(EQUAL)
    first, second = stream(EQUAL, [60]), stream(EQUAL, [61])
    rig.feed(first[:2])
    rig.assembly.reset()
    assert (rig.ledger.frames_pending, rig.feed(first[2:] + second)) == (0, [60, 61])
    rig = learnt({1: 1})
    late = [frame._replace(data=bytes([0, 0, 0, 0, 1])) for frame in stream({1: 1}, range(60, 70))]
    rig.feed(frame._replace(t_ns=late[-1].t_ns) for frame in late)
    assert (rig.ledger.frames_ignored, len(rig.made)) == (0, 70)


@pytest.mark.parametrize("kind", EQUAL)
def test_a_lost_frame_costs_its_value_only(kind: int) -> None:
    rig = learnt(EQUAL)
    made = rig.feed(without(stream(EQUAL, range(60, 80)), lambda f: f.burst == 70 and f.kind == kind))
    assert made == list(range(60, 80))
    assert rig.kinds_of(70) == tuple(other for other in EQUAL if other != kind)
    assert (rig.ledger.lost_gap_device, rig.ledger.frames_lost) == (0, 1)
    rig = learnt(MIXED, 120)
    made = rig.feed(without(stream(MIXED, range(120, 170)), lambda f: f.burst == 130 and f.kind == 6))
    assert (rig.ledger.lost_gap_device, rig.ledger.frames_lost) == (0, 1)
    assert rig.made[-50:] == [(b, (1, 2, 3) if b == 130 else whole(MIXED, b)) for b in range(120, 170)]
    assert made == list(range(120, 170))


@pytest.mark.parametrize("cut", [1, 2])
@pytest.mark.parametrize("bursts", [1, 3])
def test_the_end_of_one_burst_and_the_beginning_of_another_are_not_joined(cut: int, bursts: int) -> None:
    rig = learnt(EQUAL)
    last = 70 + bursts

    def is_lost(frame: Frame) -> bool:
        return 700 + cut < 10 * frame.burst + frame.kind <= 10 * last + cut

    made = rig.feed(without(stream(EQUAL, range(60, 90)), is_lost))
    assert (made, rig.ledger.lost_gap_device) == ([*range(60, 71), *range(last, 90)], bursts - 1)


@pytest.mark.parametrize("kinds", [EQUAL, MIXED, LEADING])
@pytest.mark.parametrize("lost", [1, 2, 100])
def test_bursts_that_are_lost_whole_are_counted(kinds: dict[int, int], lost: int) -> None:
    rig = learnt(kinds)
    made = rig.feed(without(stream(kinds, range(60, 300)), lambda f: 81 <= f.burst < 81 + lost))
    assert (made, rig.ledger.lost_gap_device) == ([*range(60, 81), *range(81 + lost, 300)], lost)
    assert rig.ledger.frames_lost == sum(len(whole(kinds, burst)) for burst in range(81, 81 + lost))
    assert all(names == whole(kinds, burst) for burst, names in rig.made if burst >= 81 + lost + 4)


@pytest.mark.parametrize("kinds", [EQUAL, MIXED, LEADING])
@pytest.mark.parametrize("stall_ns", [4 * MS, 7_300_000, 60 * MS, 1500 * MS])
def test_a_stall_between_two_bursts_costs_nothing(kinds: dict[int, int], stall_ns: int) -> None:
    """All frames of the stall arrive together at its end."""
    rig = learnt(kinds)
    begin_ns = 10**9 + 80 * PERIOD_NS - MS
    frames = [
        frame._replace(t_ns=begin_ns + stall_ns) if begin_ns < frame.t_ns < begin_ns + stall_ns else frame
        for frame in stream(kinds, range(60, 500))
    ]
    made = rig.feed(frames, bursts=kinds is EQUAL)
    assert len(set(made)) >= 439
    assert rig.ledger.lost() == rig.ledger.lost_unknown == rig.ledger.frames_ignored == 0
    if kinds is EQUAL:
        assert made == list(range(60, 500))


@pytest.mark.parametrize("kinds", [EQUAL, MIXED])
def test_repeated_frames_cost_no_sample(kinds: dict[int, int]) -> None:
    rig, random = learnt(kinds), Random(3)
    frames = [frame for frame in stream(kinds, range(60, 160)) for _ in range(random.choice((1, 1, 2)))]
    assert (rig.feed(frames), rig.ledger.lost_gap_device) == (list(range(60, 160)), 0)
    assert rig.ledger.frames_ignored == len(frames) - len(set(frames))


def test_kinds_that_are_switched_off_or_stay_out() -> None:
    """Also kinds that are not selected, and the anchor."""
    rig = learnt(EQUAL)
    assert rig.feed(stream({1: 1, 3: 1}, range(60, 100))) == list(range(60, 99 + (rig.ledger.frames_pending == 0)))
    *head, last = stream({1: 1, 3: 1}, [100])
    assert 100 not in rig.feed(head)
    assert 100 in rig.feed([last])  # imud no longer waits for kind 2
    assert rig.ledger.lost_gap_device == 0
    rig = learnt(EQUAL)
    assert rig.feed(stream({2: 1, 3: 1}, range(60, 120))) == list(range(60, 120))
    rig = learnt(MIXED)
    off, on = stream({1: 1, 2: 1, 3: 2}, range(60, 300)), stream(MIXED, range(300, 400))
    assert (rig.feed(off), set(rig.feed(on))) == (list(range(60, 300)), set(range(300, 400)))
    assert rig.kinds_of(380) == (1, 2, 3, 6)
    rig = AssemblyBench({1, 3})
    made = rig.feed(stream(MIXED, range(60)))
    assert made == list(range(60))
    assert all(names == tuple(k for k in whole(MIXED, b) if k in (1, 3)) for b, names in rig.made if b > 12)


def test_a_kind_that_is_switched_on_joins_and_a_new_rate_is_not_a_loss() -> None:
    for new in ({4: 1}, {4: 2}, {6: 10}):
        rig = learnt(EQUAL)
        kinds = {**EQUAL, **new}
        made = rig.feed(stream(kinds, range(60, 140)))
        assert set(made) == set(range(60, 140))
        joined = 60 + 7 * next(iter(new.values()))
        assert all(names == whole(kinds, burst) for burst, names in rig.made if burst >= joined)
    for period_ns in (PERIOD_NS // 2, 2 * PERIOD_NS, 4 * PERIOD_NS):
        rig = learnt(EQUAL)
        begin_ns = 10**9 + 60 * PERIOD_NS
        frames = [
            frame._replace(t_ns=frame.t_ns - 10**9 + begin_ns - 60 * period_ns)
            for frame in stream(EQUAL, range(60, 110), period_ns)
        ]
        assert (rig.feed(frames), rig.ledger.lost_gap_device) == (list(range(60, 110)), 0)
        assert rig.assembly.period_ns == pytest.approx(period_ns, rel=0.05)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (EQUAL, {1: 1, 2: 2, 3: 2}), (EQUAL, {1: 2, 2: 1, 3: 1}), (MIXED, {1: 1, 2: 1, 3: 1, 6: 10}),
        (MIXED, {1: 1, 2: 1, 3: 4, 6: 5}),
    ],
)  # fmt: skip
def test_another_rate_of_some_is_learnt(before: dict[int, int], after: dict[int, int]) -> None:
    rig = learnt(before)
    rig.feed(stream(after, range(60, 300)))
    settled = [made for made in rig.made if made[0] >= 160]
    assert settled == [(burst, whole(after, burst)) for burst in range(160, 300)]


@given(seed=st.integers(0, 2**32), kinds=st.sampled_from([EQUAL, MIXED, LEADING, {1: 1, 6: 20}, {1: 1, 2: 2, 3: 4}]))
def test_frames_reach_one_sample_each_under_any_loss(seed: int, kinds: dict[int, int]) -> None:
    """Losses of single frames and of runs, at any time. imud counts at most the bursts that were lost whole."""
    random = Random(seed)
    rig = AssemblyBench()
    rate = random.choice((0.0, 0.02, 0.2))
    frames: list[Frame] = []
    run = 0
    for frame in stream(kinds, range(300)):
        run = random.randrange(1, 3 * len(kinds)) if random.random() < rate / 4 else max(0, run - 1)
        if run or random.random() < rate:
            continue
        frames.append(frame._replace(t_ns=frame.t_ns + random.randrange(FRAME_NS // 2)))
    rig.feed(frames, bursts=False)
    rig.assembly.flush()
    assert rig.ledger.frames_in_samples == len(frames)
    lost = 300 - len({frame.burst for frame in frames})
    assert rig.ledger.lost() <= 1.25 * lost + 3 * (rate > 0)


@given(seed=st.integers(0, 2**32))
def test_any_frames_at_any_time_keep_the_ledger_closed(seed: int) -> None:
    random = Random(seed)
    ledger = Ledger()
    assembly = Assembly(ledger)
    t_ns = 0
    for _ in range(600):
        t_ns += random.choice((-1, 0, 1000, FRAME_NS, PERIOD_NS, 10**9))
        ledger.frames_good += 1
        sid = random.choice((None, 0, 1, 2, 250))
        assembly.add_frame(random.choice((1, 2, 2, 3, 6)), random.choice((b"a", b"b")), t_ns, sid)
        if random.random() < 0.01:
            assembly.reset()
        assert ledger.closes()
        assert 0 <= ledger.frames_pending <= 4


def test_the_step_and_the_modulus_of_a_series_of_sids() -> None:
    series = SidSeries()
    known = [(series.add(sid, is_next=False), series.is_known) for sid in range(0, 20, 2)]
    assert known == [(None, False)] * 9 + [(None, True)]  # eight equal differences
    assert ([series.add(sid, is_next=False) for sid in (20, 26, 27)], series.is_known) == ([0, 2, None], False)
    series = SidSeries()
    assert [series.add(sid, is_next=True) for sid in range(253)] == [None] * 10 + [0] * 243
    assert [series.add(sid, is_next=True) for sid in (0, 1, 3, 252, 2, None, 3)] == [None, 0, 1, 248, 2, None, None]


@pytest.mark.parametrize("modulus", [251, 253, 256])
def test_equal_sids_decide_in_place_of_the_time(modulus: int) -> None:
    """Some bursts arrive together without some frames. The SIDs also count a lost burst."""
    frames = [f._replace(sid=f.burst % modulus) for f in stream(EQUAL, range(700))]
    lost = {(70, 3), (71, 1), (71, 2), (620, 1), (620, 2), (620, 3)}
    late_ns = 10**9 + 75 * PERIOD_NS - MS
    rig = AssemblyBench()
    rig.feed(
        f._replace(t_ns=max(f.t_ns, late_ns) if 60 <= f.burst < 75 else f.t_ns)
        for f in frames
        if (f.burst, f.kind) not in lost
    )
    assert rig.kinds_of(70) == (1, 2)
    assert rig.kinds_of(71) == (3,)
    assert rig.ledger.lost() == 1
    assert rig.ledger.frames_ignored == 0


def test_sids_without_a_loss_and_sids_that_no_longer_agree() -> None:
    """A pause of the sender is not a loss. After it, kind 2 has another SID."""
    frames = [
        f._replace(sid=(f.burst + 3 * (f.kind == 2 and f.burst >= 100)) % 253, t_ns=f.t_ns + (f.burst >= 100) * 33 * MS)
        for f in stream(EQUAL, range(200))
    ]
    rig = AssemblyBench()
    rig.feed(frames)
    assert rig.ledger.lost() == 0
    assert rig.ledger.lost_unknown == 0
    assert all(rig.kinds_of(burst) == (1, 2, 3) for burst in range(120, 199))


def lost(*times_ms: float, period_ms: int = 5) -> int:
    cadence = Cadence(period_ms * MS, 0)
    steady = [times_ms[-1] + period_ms * n for n in range(1, 5)]
    return sum(cadence.begin(round(t * MS))[0] for t in (*times_ms, *steady))


@pytest.mark.parametrize(
    ("times_ms", "expected"),
    [
        ((5, 10), 0),
        ((9.4, 13.2, 15), 0),  # the second burst is delayed less, but still late
        ((12, 12.1, 15), 0), ((38, 38.1, 38.2, 38.3, 38.4, 38.5, 38.6, 40), 0), ((5, 11.2, 15, 19, 25), 0), ((10,), 1),
        ((11.25,), 1), ((11.3,), 0), ((8.76,), 1), ((8.7,), 0),  # a quarter of a period is another phase
        ((5, 20), 2), ((10, 20), 2), ((20, 20.1, 25), 2), ((1000,), 199), ((1004,), 0),
        ((10, 30, 40, 60, 70, 90, 100, 120), 16),
    ],
)  # fmt: skip
def test_a_remaining_delay_is_a_loss(times_ms: tuple[float, ...], expected: int) -> None:
    assert lost(*times_ms) == expected


@pytest.mark.parametrize(("jitter_ns", "bursts"), [(400_000, 3), (500_000, 16)])
def test_an_unsteady_device_needs_more_bursts_for_a_loss(jitter_ns: int, bursts: int) -> None:
    cadence, numbers = Cadence(5 * MS, 0), (*range(1, 21), *range(22, 60))
    found = [cadence.begin(5 * MS * n + n % 2 * jitter_ns)[0] for n in numbers]
    assert (sum(found), numbers[found.index(1)]) == (1, 21 + bursts)


@pytest.mark.parametrize(
    ("times_ms", "others_ms", "expected"),
    [
        (range(0, 80, 10), (), None), (range(0, 90, 10), (), Learned(0, 10 * MS)),
        # a distance from 1.5 to 4.5 medians is a gap, which does not count in the mean
        ((*range(0, 80, 10), 84.9), (), Learned(0, 10_612_500)), ((*range(0, 80, 10), 85.1), (), Learned(0, 10 * MS)),
        ((*range(0, 80, 10), 114.9), (), Learned(0, 10 * MS)), ((*range(0, 80, 10), 115.1), (), Learned(0, 14_387_500)),
        # kind 1 arrives after the longest pause: it is the anchor if its mean period is at most 10 % longer
        (range(0, 90, 10), (9, 19, 29, 39, 52.6), Learned(1, 10_900_000)),
        (range(0, 90, 10), (9, 19, 29, 39, 53.4), Learned(0, 10 * MS)),
    ],
)  # fmt: skip
def test_anchor_and_period_after_eight_periods(
    times_ms: Iterable[float], others_ms: Iterable[float], expected: Learned | None
) -> None:
    frames = [(kind, round(t * MS)) for kind, times in enumerate((times_ms, others_ms)) for t in times]
    assert learned_from(sorted(frames, key=lambda frame: frame[1])) == expected


def test_the_period_follows_slowly_jumps_when_all_agree_and_a_silence_has_four_periods() -> None:
    cadence = Cadence(5 * MS, 0)
    for n in range(1, 200):
        cadence.begin(n * 5_100_000)
    assert cadence.period_ns == pytest.approx(5_100_000, abs=100)
    begin_ns = 199 * 5_100_000
    for n in range(1, 9):
        assert cadence.begin(begin_ns + n * 20 * MS) == (0, False)
    assert cadence.period_ns == 20 * MS
    assert [lost(gap_ms, period_ms=500) for gap_ms in (2000, 2001)] == [3, 0]
