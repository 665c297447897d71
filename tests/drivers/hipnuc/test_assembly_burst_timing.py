"""Loss and delay by the times of bursts. The period is 5 ms; times are in ms."""

import pytest

from imud.drivers.hipnuc.assembly import Cadence

MS = 1_000_000


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
        ((5, 20), 2), ((10, 20), 2), ((20, 20.1, 25), 2), ((1000,), 199), ((1004,), 0),
        ((10, 30, 40, 60, 70, 90, 100, 120), 16),
    ],
)  # fmt: skip
def test_a_remaining_delay_is_a_loss(times_ms: tuple[float, ...], expected: int) -> None:
    assert lost(*times_ms) == expected


def test_a_silence_has_more_than_four_periods() -> None:
    assert [lost(gap_ms, period_ms=500) for gap_ms in (2000, 2001)] == [3, 0]


def test_the_period_follows_slowly_and_jumps_when_all_agree() -> None:
    cadence = Cadence(5 * MS, 0)
    for n in range(1, 200):
        cadence.begin(n * 5_100_000)
    assert cadence.period_ns == pytest.approx(5_100_000, abs=100)
    begin_ns = 199 * 5_100_000
    for n in range(1, 9):
        assert cadence.begin(begin_ns + n * 20 * MS) == (0, False)
    assert cadence.period_ns == 20 * MS
