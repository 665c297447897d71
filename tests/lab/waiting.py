"""Wait for a state of the kernel or of another program that has no event."""

import time
from collections.abc import Callable

LIMIT_S = 20.0
PAUSE_S = 0.01


def wait_until(holds: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
    give_up_s = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < give_up_s, f"{what}: not within {limit_s} s"
        time.sleep(PAUSE_S)
