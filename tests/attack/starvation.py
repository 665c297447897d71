"""Starve a process: stop it with signals, and limit its CPU time. Linux only."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from random import Random
from time import monotonic, sleep
from typing import Final

STOPS_S: Final = (0.05, 0.2, 0.7, 2.0)
"""Durations of the stops, s: shorter and longer than the buffer of a terminal lasts at 1 kHz (50 ms) and than the
maximum delay of a frame (500 ms)."""
BETWEEN_S: Final = (0.02, 0.3, 1.0)  # time between two stops, s
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
