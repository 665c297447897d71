"""Cost of a window of frames: the number of examined periods does not depend on the times of the frames."""

from bisect import bisect_left
from collections.abc import Sequence
from random import Random
from typing import Any

import pytest

from imud.drivers.hipnuc import same_address
from imud.drivers.hipnuc.same_address import EXTRAS, WINDOW, SameAddress, series_of

MS = 1_000_000
# Maximum number of examined periods of a window: 21 first steps, each with at most 82 periods, for three series. 2300
# random windows have at most 3444. Without the limit, they have up to 31,000.
PERIODS_MAX = 3 * 21 * 82


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the examined periods."""
    found = [0]

    def counted(times_ns: Sequence[int], due_ns: int) -> int:
        found[0] += 1
        assert found[0] <= PERIODS_MAX, "too many periods"
        return bisect_left(times_ns, due_ns)

    monkeypatch.setattr(same_address, "bisect_left", counted)
    return found


def pauses(random: Random) -> list[int]:
    """Return the times of a device that pauses once in a window."""
    step_ns, before = random.choice([1, 2, 10]) * MS, random.randrange(1, WINDOW)
    times_ns = [number * step_ns for number in range(before)]
    begin_ns = times_ns[-1] + random.choice([10, 1000, 10**5, 10**9]) * step_ns
    return times_ns + [begin_ns + number * step_ns for number in range(WINDOW - before)]


def scattered(random: Random) -> list[int]:
    return sorted(int(10 ** random.uniform(0, 18)) for _ in range(WINDOW))


@pytest.mark.parametrize("make", [pauses, scattered])
@pytest.mark.parametrize("seed", range(40))
def test_a_window_has_a_maximum_cost(counts: list[int], make: Any, seed: int) -> None:
    """Before the limit, a pause of 1000 periods cost 31,000 examined periods: 0.05 s for 64 frames."""
    devices = SameAddress()
    for t_ns in make(Random(seed)):
        devices.add_frame(1, t_ns, None)
    assert counts[0] <= PERIODS_MAX


@pytest.mark.parametrize("seed", range(20))
def test_falling_times_have_a_maximum_cost(counts: list[int], seed: int) -> None:
    """A forged recording can contain any times. The extra frames of several windows are then not in order."""
    random = Random(seed)
    devices = SameAddress()
    for window in range(10):
        counts[0] = 0
        offset_ns = random.choice([0, 1 << 60, -(1 << 60), 1 << 50])
        for number in range(WINDOW):
            devices.add_frame(1, offset_ns + (window * WINDOW + number) * 10 * MS + 3 * MS * (number % 5 == 0), None)
    far = [number * 10 for number in range(EXTRAS)] + [1 << 60]
    counts[0] = 0
    series_of(sorted(far + [0] * 8))
