"""Recording daemons that are killed at random moments: the written data is complete and can be replayed.

`python -m tests.bench.recorder_kills` kills more daemons.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

import pytest

from tests.bench.recorder_kills import capture, look_at, run_and_kill

AT_ONCE = 3
EARLY, LATE = 2, 3  # number of daemons killed after the first block, which has no samples, and after written samples
WITH_SAMPLES_BYTES = 40_000  # size that exceeds the start of a file, bytes
LATEST_S = 1.2  # maximum time until the next block, s


@pytest.mark.live
def test_all_blocks_of_killed_daemons_are_complete_and_replay(tmp_path: Path) -> None:
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
