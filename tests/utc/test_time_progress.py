"""Times of sentences that advance like CLOCK_MONOTONIC, leap, drift, or change once."""

from random import Random

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.utc.time_progress import CONFIRM_NS, LEAP_NS, TimeProgress

START_NS = 500 * NS_PER_S
OFFSET_NS = 1_795_000_000 * NS_PER_S


def test_delays_and_drift_are_accepted() -> None:
    progress, random = TimeProgress(), Random(1)
    for second in range(20_000):
        delay_ns = random.randrange(400 * NS_PER_MS)
        drift_ns = second * 100_000  # 100 ppm: 2 s at the end
        assert progress.is_steady(OFFSET_NS + drift_ns - delay_ns, START_NS + second * NS_PER_S)


def test_leaps_of_one_second_or_more_are_rejected() -> None:
    for leap_s in (-86_400, -1, 1, 2, 500):
        progress = TimeProgress()
        assert progress.is_steady(OFFSET_NS, START_NS)
        assert not progress.is_steady(OFFSET_NS + leap_s * NS_PER_S, START_NS + NS_PER_S)
        assert progress.is_steady(OFFSET_NS + 100 * NS_PER_MS, START_NS + 2 * NS_PER_S)


def test_small_steps_do_not_move_the_accepted_time() -> None:
    """A hostile server advances its time by 1.4 s in each second."""
    progress = TimeProgress()
    accepted = [
        offset_ns
        for second in range(1000)
        if progress.is_steady(offset_ns := OFFSET_NS + second * 400 * NS_PER_MS, START_NS + second * NS_PER_S)
    ]
    assert max(accepted) - OFFSET_NS <= LEAP_NS + NS_PER_S


def test_new_time_is_accepted_after_ten_seconds() -> None:
    progress = TimeProgress()
    progress.is_steady(OFFSET_NS, START_NS)
    new_ns = OFFSET_NS - 3 * NS_PER_S  # the receiver has got its leap seconds
    start_ns = START_NS + NS_PER_S
    assert not any(progress.is_steady(new_ns, start_ns + t_ns) for t_ns in range(0, CONFIRM_NS, NS_PER_S))
    assert progress.is_steady(new_ns, start_ns + CONFIRM_NS)
    assert not progress.is_steady(OFFSET_NS, start_ns + CONFIRM_NS)


def test_sentences_of_the_accepted_time_restart_the_confirmation() -> None:
    """Two receivers contradict each other: imud stays with the first."""
    progress = TimeProgress()
    progress.is_steady(OFFSET_NS, START_NS)
    for second in range(1, 100):
        t_ns = START_NS + second * NS_PER_S
        assert not progress.is_steady(OFFSET_NS + 7 * NS_PER_S, t_ns)
        assert progress.is_steady(OFFSET_NS, t_ns)
