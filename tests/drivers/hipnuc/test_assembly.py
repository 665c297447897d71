"""Assembly of samples from frames without a counter. The data of the test frames identify the burst."""

from collections.abc import Callable, Iterable, Mapping
from random import Random
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.drivers.hipnuc.assembly import Assembly
from imud.model.ledger import Ledger

MS = 1_000_000
PERIOD_NS = 5 * MS
FRAME_NS = 240_000
LEARNING = 6
"""Number of bursts until the fast kinds are known, with the first incomplete burst."""
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

    def feed(self, frames: Iterable[Frame]) -> list[int]:
        """Return the bursts that became samples. Check that no sample is mixed and that the ledger balances."""
        before = len(self.made)
        for frame in frames:
            self.ledger.frames_good += 1
            made = self.assembly.add_frame(frame.kind, frame.data, frame.t_ns)
            assert self.ledger.closes(), self.ledger.snapshot()
            assert min(self.ledger.values()) >= 0
            if made is not None:
                bursts = {int.from_bytes(data[:4], "little") for _, data in made}
                assert len(bursts) == 1, "mixed"
                assert all(data[4] == kind for kind, data in made)
                self.made.append((bursts.pop(), tuple(kind for kind, _ in made)))
        return [burst for burst, _ in self.made[before:]]

    def kinds_of(self, burst: int) -> tuple[int, ...]:
        return dict(self.made)[burst]


def learnt(kinds: Mapping[int, int], bursts: int = 40) -> AssemblyBench:
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
def test_every_burst_becomes_one_sample_once_learnt(kinds: dict[int, int], begin: int) -> None:
    rig = AssemblyBench()
    frames = stream(kinds, range(200))[begin:]
    made = rig.feed(frames)
    assert made[0] <= LEARNING + 2
    assert made == list(range(made[0], 200))
    late = 3 * max(kinds.values()) + LEARNING
    assert all(names == whole(kinds, burst) for burst, names in rig.made if burst >= late)
    assert rig.ledger.lost_gap_device == 0
    assert rig.assembly.period_ns == pytest.approx(PERIOD_NS, rel=1e-3)


def test_samples_are_complete_after_silence_and_after_a_reset() -> None:
    rig = learnt(MIXED)
    for burst in range(40, 61):
        *head, last = stream(MIXED, [burst])
        assert rig.feed(head) == []
        assert rig.ledger.frames_pending == len(head)
        assert rig.feed([last]) == [burst]
        assert rig.ledger.frames_pending == 0

    rig = learnt(MIXED)
    made = rig.feed(without(stream(MIXED, range(40, 400)), lambda f: 61 <= f.burst < 270))
    assert made == [*range(40, 61), *range(270, 400)]
    assert rig.ledger.lost_gap_device == 0

    rig = learnt(EQUAL)
    first, second = stream(EQUAL, [40]), stream(EQUAL, [41])
    rig.feed(first[:2])
    rig.assembly.reset()
    assert rig.ledger.frames_pending == 0
    assert rig.ledger.closes()
    assert rig.feed(first[2:] + second) == [41]
    assert rig.ledger.lost_gap_device == 1
    assert rig.ledger.closes()


@pytest.mark.parametrize("kind", EQUAL)
def test_a_lost_frame_costs_its_sample(kind: int) -> None:
    rig = learnt(EQUAL)
    made = rig.feed(without(stream(EQUAL, range(40, 60)), lambda f: f.burst == 50 and f.kind == kind))
    assert made == [burst for burst in range(40, 60) if burst != 50]
    assert rig.ledger.lost_gap_device == 1


@pytest.mark.parametrize("kind", [3, 6])
def test_a_lost_frame_of_a_slower_kind_costs_its_value_only(kind: int) -> None:
    rig = learnt(MIXED)
    made = rig.feed(without(stream(MIXED, range(40, 90)), lambda f: f.burst == 60 and f.kind == kind))
    assert made == list(range(40, 90))
    assert rig.kinds_of(60) == tuple(other for other in whole(MIXED, 60) if other != kind)
    assert all(names == whole(MIXED, burst) for burst, names in rig.made if burst >= 40 and burst != 60)
    assert rig.ledger.lost_gap_device == 0


@pytest.mark.parametrize("cut", [1, 2])
@pytest.mark.parametrize("bursts", [1, 3])
def test_the_end_of_one_burst_and_the_beginning_of_another_are_not_joined(cut: int, bursts: int) -> None:
    rig = learnt(EQUAL)
    last = 50 + bursts

    def is_lost(frame: Frame) -> bool:
        order = 10 * frame.burst + frame.kind
        return 500 + cut < order <= 10 * last + cut

    made = rig.feed(without(stream(EQUAL, range(40, 70)), is_lost))
    assert made == [*range(40, 50), *range(last + 1, 70)]
    assert rig.ledger.lost_gap_device == 1 + bursts


@pytest.mark.parametrize("kinds", [EQUAL, MIXED, LEADING])
@pytest.mark.parametrize("lost", [1, 2, 100])
def test_bursts_that_are_lost_whole_are_counted(kinds: dict[int, int], lost: int) -> None:
    rig = learnt(kinds)
    made = rig.feed(without(stream(kinds, range(40, 300)), lambda f: 61 <= f.burst < 61 + lost))
    assert made == [*range(40, 61), *range(61 + lost, 300)]
    assert rig.ledger.lost_gap_device == lost
    assert all(names == whole(kinds, burst) for burst, names in rig.made if burst >= 61 + lost + 4)


@pytest.mark.parametrize("kinds", [EQUAL, MIXED, LEADING])
@pytest.mark.parametrize("stall_ns", [4 * MS, 7_300_000, 60 * MS, 1500 * MS])
def test_a_stall_between_two_bursts_costs_nothing(kinds: dict[int, int], stall_ns: int) -> None:
    """All frames of the stall arrive together at its end."""
    rig = learnt(kinds)
    begin_ns = 10**9 + 60 * PERIOD_NS - MS
    frames = [
        frame._replace(t_ns=begin_ns + stall_ns) if begin_ns < frame.t_ns < begin_ns + stall_ns else frame
        for frame in stream(kinds, range(40, 500))
    ]
    made = rig.feed(frames)
    if kinds is EQUAL:
        assert made == list(range(40, 500))
        assert rig.ledger.lost_gap_device == 0
    held_up = {frame.burst for frame in frames if frame.t_ns == begin_ns + stall_ns}
    whole_bursts = {b for b in held_up if all(f.t_ns == begin_ns + stall_ns for f in frames if f.burst == b)}
    assert whole_bursts <= set(made)
    assert set(range(40, 60)) <= set(made)


@pytest.mark.parametrize("kinds", [EQUAL, MIXED])
def test_repeated_frames_cost_no_sample(kinds: dict[int, int]) -> None:
    rig, random = learnt(kinds), Random(3)
    frames = [frame for frame in stream(kinds, range(40, 140)) for _ in range(random.choice((1, 1, 2)))]
    assert rig.feed(frames) == list(range(40, 140))
    assert rig.ledger.lost_gap_device == 0


def test_kinds_that_are_switched_off_or_stay_out() -> None:
    """Also kinds that are not selected, and a kind of 50 ms next to a period of 20 ms, between bursts."""
    rig = learnt(EQUAL)
    made = rig.feed(stream({1: 1, 3: 1}, range(40, 80)))
    assert made == list(range(50, 80))
    assert rig.ledger.lost_gap_device == 10
    rig = learnt(EQUAL)
    made = rig.feed(stream({2: 1, 3: 1}, range(40, 80)))
    assert made == list(range(made[0], 80))
    assert made[0] <= 60
    rig = learnt(MIXED)
    off, on = stream({1: 1, 2: 1, 3: 2}, range(40, 300)), stream(MIXED, range(300, 400))
    assert rig.feed(off) == list(range(40, 300))
    *head, last = stream({1: 1, 2: 1, 3: 2}, [300])  # the assembly no longer waits for kind 6
    assert rig.feed([*head, last]) == [300]
    assert rig.feed(on[4:]) == list(range(301, 400))
    assert rig.kinds_of(380) == (1, 2, 3, 6)

    rig = AssemblyBench({1, 3})
    made = rig.feed(stream(MIXED, range(60)))
    assert made == list(range(made[0], 60))
    assert all(names == tuple(k for k in whole(MIXED, b) if k in (1, 3)) for b, names in rig.made if b > 12)
    frames = sorted(
        [*stream({1: 1, 2: 1}, range(200), 20 * MS), *stream({6: 1}, range(80), 50 * MS)], key=lambda frame: frame.t_ns
    )
    rig = AssemblyBench()
    rig.feed(frames)
    assert all(names == (1, 2) for _, names in rig.made)
    assert len(rig.made) >= 190


@pytest.mark.parametrize("new", [{4: 1}, {4: 2}, {6: 10}])
def test_a_kind_that_is_switched_on_joins(new: dict[int, int]) -> None:
    rig = learnt(EQUAL)
    kinds = {**EQUAL, **new}
    assert rig.feed(stream(kinds, range(40, 120))) == list(range(40, 120))
    every = next(iter(new.values()))
    joined = 40 + (7 if every == 1 else 3 * every)
    assert all(names == whole(kinds, burst) for burst, names in rig.made if burst >= joined)


@pytest.mark.parametrize("period_ns", [PERIOD_NS // 2, 2 * PERIOD_NS, 4 * PERIOD_NS])
def test_a_new_rate_is_not_a_loss(period_ns: int) -> None:
    rig = learnt(EQUAL)
    begin_ns = 10**9 + 40 * PERIOD_NS
    frames = [
        frame._replace(t_ns=frame.t_ns - 10**9 + begin_ns - 40 * period_ns)
        for frame in stream(EQUAL, range(40, 90), period_ns)
    ]
    assert rig.feed(frames) == list(range(40, 90))
    assert rig.ledger.lost_gap_device == 0
    assert rig.assembly.period_ns == pytest.approx(period_ns, rel=0.05)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (EQUAL, {1: 1, 2: 2, 3: 2}),
        (EQUAL, {1: 2, 2: 1, 3: 1}),
        (MIXED, {1: 1, 2: 1, 3: 1, 6: 10}),
        (MIXED, {1: 1, 2: 1, 3: 4, 6: 5}),
    ],
)
def test_another_rate_of_some_is_learnt(before: dict[int, int], after: dict[int, int]) -> None:
    rig = learnt(before)
    rig.feed(stream(after, range(40, 300)))
    settled = [made for made in rig.made if made[0] >= 150]
    assert settled == [(burst, whole(after, burst)) for burst in range(150, 300)]


def test_order_alone_and_learning_under_loss() -> None:
    """Without times: 1 and 3 of a burst, then 2 and 3 of the next burst. 2 is before the held 3 in the order."""
    rig = AssemblyBench()
    rig.feed(frame._replace(t_ns=0) for frame in stream(EQUAL, range(30)))
    frames = without(stream(EQUAL, range(30, 40)), lambda f: (f.burst, f.kind) in ((32, 2), (33, 1)))
    assert rig.feed(frame._replace(t_ns=0) for frame in frames) == [30, 31, *range(34, 40)]
    rig = AssemblyBench()
    made = rig.feed(frame._replace(t_ns=0) for frame in stream(EQUAL, range(30)))
    assert made == list(range(5, 30))

    rig = AssemblyBench()
    frames = without(stream(EQUAL, range(30)), lambda f: f.burst in (2, 4) and f.kind == 2)
    made = rig.feed(frames)
    assert made == list(range(made[0], 30))
    assert made[0] <= 12
    assert all(names == (1, 2, 3) for burst, names in rig.made if burst > made[0] + 7)
    rig = AssemblyBench()
    lost = {(7, 1), (9, 1), (10, 1), (14, 1), (19, 1)}
    rig.feed(frame for frame in stream({1: 1, 2: 2}, range(1, 80)) if (frame.burst, frame.kind) not in lost)
    assert [made for made in rig.made if made[0] >= 25] == [
        (burst, whole({1: 1, 2: 2}, burst)) for burst in range(25, 80)
    ]


@given(seed=st.integers(0, 2**32), kinds=st.sampled_from([EQUAL, MIXED, LEADING, {1: 1, 6: 20}, {1: 1, 2: 2, 3: 4}]))
def test_periods_are_never_mixed(seed: int, kinds: dict[int, int]) -> None:
    """Any loss, of single frames and of runs, at any time, also during learning. Each sample is from one burst
    (`feed`).
    """
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
    made = rig.feed(frames)
    assert made == sorted(set(made))
    heard = {b for b in range(300) if {f.kind for f in frames if f.burst == b} == set(whole(kinds, b))}
    assert len(heard & set(made)) >= 0.5 * len(heard) - 20
    if rate == 0.0:
        assert rig.ledger.lost_gap_device == 0


@given(seed=st.integers(0, 2**32))
def test_any_frames_at_any_time_keep_the_ledger_closed(seed: int) -> None:
    random = Random(seed)
    ledger = Ledger()
    assembly = Assembly(ledger)
    t_ns = 0
    for _ in range(600):
        t_ns += random.choice((0, 1000, FRAME_NS, PERIOD_NS, 10**9))
        ledger.frames_good += 1
        assembly.add_frame(random.choice((1, 2, 2, 3, 6)), random.choice((b"a", b"b")), t_ns)
        if random.random() < 0.01:
            assembly.reset()
        assert ledger.closes()
        assert 0 <= ledger.frames_pending <= 4
