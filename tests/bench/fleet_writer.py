"""Process that simulates devices of several drivers on one pty each, each at its own rate, and counts the frames.

    python -m tests.bench.fleet_writer --seconds S DRIVER:HZ …

The process prints one line with the paths of the slaves, waits for a line on standard input, and sends the frames. Then
it prints JSON: for each device, the number of frames that its pty accepted, and the number of frames that its pty
rejected before the last accepted frame. Later rejected frames cause no gap.

The process sends each frame, also if it is late: device time continues while the process does not run.
"""

import argparse
import binascii
import heapq
import json
import os
import struct
import sys
import time
from collections.abc import Callable
from random import Random
from typing import Final

from imud.drivers.imu61x.uart.codec import encode_ahrs
from imud.model.sample import Vector3
from imud.model.units import RAD_PER_DEG, STANDARD_GRAVITY_M_S2
from imud.sim.ports.pty import sharpen_timers
from tests.bench.writer import open_ptys, template

BEGIN_NS: Final = 10_000_000  # 10 ms until the first frame
SEED: Final = 25  # noise of noisy_values
VALUES: Final = 997  # Number of different values before they repeat. A recording cannot compress this many values well.
# bytes of acceleration and rotation rate in an HI91 frame
ACCEL_AND_GYRO: Final = slice(18, 42)


def noisy_values() -> list[tuple[Vector3, Vector3]]:
    """Return acceleration, m/s², and rotation rate, rad/s, of a device at rest with noise, equal in all runs."""
    random = Random(SEED)
    return [
        (
            (random.gauss(0.1, 0.02), random.gauss(0.2, 0.02), random.gauss(9.8, 0.02)),
            (random.gauss(0.01, 0.001), random.gauss(0.02, 0.001), random.gauss(0.03, 0.001)),
        )
        for _ in range(VALUES)
    ]


def hi91_frames(rate_hz: float) -> Callable[[int], bytes]:
    frame = template()
    head = binascii.crc_hqx(bytes(frame[:4]), 0)
    values = [
        struct.pack("<6f", *(one / STANDARD_GRAVITY_M_S2 for one in accel), *(one / RAD_PER_DEG for one in gyro))
        for accel, gyro in noisy_values()
    ]

    def make(number: int) -> bytes:
        frame[ACCEL_AND_GYRO] = values[number % VALUES]
        struct.pack_into("<I", frame, 14, int(number * 1000 / rate_hz))
        struct.pack_into("<H", frame, 4, binascii.crc_hqx(frame[6:], head))
        return bytes(frame)

    return make


def ahrs_frames(rate_hz: float) -> Callable[[int], bytes]:
    values = noisy_values()

    def make(number: int) -> bytes:
        accel, gyro = values[number % VALUES]
        return encode_ahrs(
            timer_us=int(number * 1e6 / rate_hz), accel_m_s2=accel, gyro_rad_s=gyro,
            euler_rad=(0.1, 0.2, 0.3), temperature_c=30.0,
        )  # fmt: skip

    return make


FRAMES: Final = {"hipnuc-uart": hi91_frames, "imu61x-uart": ahrs_frames}


class Player:
    def __init__(self, name: str, master: int) -> None:
        driver, _, rate = name.partition(":")
        self.taken = self.refused = 0
        self.period_ns = 1e9 / float(rate)
        self._make = FRAMES[driver](float(rate))
        self._master = master
        self._sent = self._refused_since = 0

    def send(self) -> None:
        data = self._make(self._sent)
        self._sent += 1
        try:
            whole = os.write(self._master, data) == len(data)
        except BlockingIOError:
            whole = False
        if whole:
            self.taken += 1
            # rejected frames cause a gap only if a later frame arrives
            self.refused += self._refused_since
        self._refused_since = 0 if whole else self._refused_since + 1


def play(players: list[Player], seconds: float) -> None:
    """Send each frame at its due time. The devices start at different times."""
    start_ns = time.monotonic_ns() + BEGIN_NS
    end_ns = start_ns + int(seconds * 1e9)
    due = [(start_ns + int(p.period_ns * n / len(players)), n) for n, p in enumerate(players)]
    first_ns = [at_ns for at_ns, _ in due]
    counts = [0] * len(players)
    heapq.heapify(due)
    while due[0][0] < end_ns:
        at_ns, number = due[0]
        wait_ns = at_ns - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        players[number].send()
        counts[number] += 1
        # compute the due time from the start: rounding errors do not add up
        heapq.heapreplace(due, (first_ns[number] + int(counts[number] * players[number].period_ns), number))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("devices", nargs="+", metavar="DRIVER:HZ")
    args = parser.parse_args()
    pairs = open_ptys(len(args.devices))
    players = [Player(name, master) for name, (master, _) in zip(args.devices, pairs, strict=True)]
    print(*(os.ttyname(slave) for _, slave in pairs), flush=True)
    sys.stdin.readline()
    sharpen_timers()
    play(players, args.seconds)
    print(json.dumps([(player.taken, player.refused) for player in players]), flush=True)
    sys.stdin.readline()


if __name__ == "__main__":
    main()
