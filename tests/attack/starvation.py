"""Starve a process: stop it by signals, and leave it little of the processor. Linux."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from random import Random
from time import monotonic, sleep
from typing import Final

STOPS_S: Final = (0.05, 0.2, 0.7, 2.0)
"""Shorter and longer than a terminal's buffer lasts at 1 kHz (50 ms), and than a message may be late (500 ms)."""
BETWEEN_S: Final = (0.02, 0.3, 1.0)
HOG: Final = "while True: pass"


def attack(pid: int, seconds: float, seed: int = 1) -> int:
    random, end, stops = Random(seed), monotonic() + seconds, 0
    hogs = [_hog(cpu) for cpu in os.sched_getaffinity(pid)]
    try:
        while (left := end - monotonic()) > 0:
            os.kill(pid, signal.SIGSTOP)
            stops += 1
            try:
                sleep(min(random.choice(STOPS_S), left))
            finally:
                os.kill(pid, signal.SIGCONT)
            sleep(random.choice(BETWEEN_S))
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    return stops


def _hog(cpu: int) -> subprocess.Popen[bytes]:
    hog = subprocess.Popen([sys.executable, "-S", "-c", HOG], stdin=subprocess.DEVNULL)
    os.sched_setaffinity(hog.pid, {cpu})
    return hog
