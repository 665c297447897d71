"""Daemons that record and are killed at random moments, as processes: what they had written is whole, and replays as it
ran. `python -m tests.bench.recorder_kills` kills many more."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

import pytest

from tests.bench.recorder_kills import capture, look_at, run_and_kill

AT_ONCE = 3
EARLY, LATE = 2, 3
"""So many are killed from the first block on, which has no samples, and so many when samples were written."""
WITH_SAMPLES_BYTES = 40_000
"""More than what a file begins with."""
LATEST_S = 1.2
"""The next block comes within a second."""


@pytest.mark.live
def test_of_daemons_that_are_killed_every_block_is_whole_and_replays_as_it_ran(tmp_path: Path) -> None:
    random = Random(4)
    kills = [(random.uniform(0, LATEST_S), 1 if n < EARLY else WITH_SAMPLES_BYTES) for n in range(EARLY + LATE)]
    capture(tmp_path / "capture")

    def killed(number: int) -> int:
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "capture").hardlink_to(tmp_path / "capture")
        return look_at(*run_and_kill(folder, *kills[number]))[0]

    with ThreadPoolExecutor(AT_ONCE) as pool:
        samples = list(pool.map(killed, range(len(kills))))
    print(samples)
    assert all(samples[EARLY:])
