"""Process that simulates N HiPNUC devices on N ptys at a fixed rate, with as little CPU time as Python allows.

The process prints one line with the paths of the slaves, waits for a line on standard input, writes the frames, and
prints the number of frames that the ptys rejected. The pressure of frame i is FIRST_PA + i. The file `--times` is an
array of i64 with the time of each write, ns. A reader thus knows the true time of each sample, and the measured process
has no extra work. The file `--refused` is one i64, the number of frames so far that a pty did not accept completely.
With `--udp PORT`, the process sends attitude sentences of NMEA 0183 to this port, for gpsd.
"""

import argparse
import binascii
import mmap
import os
import pty
import socket
import struct
import sys
import time
import tty
from collections.abc import Callable
from functools import reduce
from operator import xor

from imud.drivers.hipnuc.uart.codec import encode_hi91

LATE_LIMIT_NS = 50_000_000
"""Maximum delay of the writer, ns. With a larger delay, the writer has lost its deadlines and shifts all later ones."""

MakeFrame = Callable[[int], bytes | bytearray]

FIRST_PA = 2000  # Pressure of frame 0, Pa. imud ignores a pressure below 1000 Pa or above 120 kPa.


def open_ptys(count: int) -> list[tuple[int, int]]:
    pairs = []
    for _ in range(count):
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        pairs.append((master, slave))
    return pairs


def template() -> bytearray:
    """Return an HI91 frame with pressure at offset 10, device time at 14 and CRC at 4."""
    frame = encode_hi91(
        system_time_ms=0, accel_m_s2=(0.1, 0.2, 9.8), gyro_rad_s=(0.01, 0.02, 0.03), mag_t=(2e-5, 1e-6, -4e-5),
        euler_rad=(0.1, 0.2, 0.3), quat_wxyz=(1.0, 0.0, 0.0, 0.0), temperature_c=30.0, pressure_pa=0.0,
    )  # fmt: skip
    return bytearray(frame)


def hi91_frames(rate_hz: float) -> MakeFrame:
    frame = template()
    crc, pack = binascii.crc_hqx, struct.pack_into
    head = crc(bytes(frame[:4]), 0)

    def make(i: int) -> bytearray:
        pack("<f", frame, 10, float(FIRST_PA + i))
        pack("<I", frame, 14, int(i * 1000 / rate_hz))
        pack("<H", frame, 4, crc(frame[6:], head))
        return frame

    return make


def sentence(i: int) -> bytes:
    """Return an $OHPR sentence: heading, pitch, roll, temperature, depth, magnetic field, acceleration, rotation."""
    angle = i % 3600 / 10
    body = f"OHPR,{angle:.1f},-2.5,1.3,30.1,0.0,48.2,20.1,-3.4,-43.6,9.81,0.12,-0.05,9.79,0.0,0.1,0.2,0.3,0.0"
    check = reduce(xor, body.encode())
    return f"${body}*{check:02X}\r\n".encode()


def play(
    masters: list[int], rate_hz: float, frames: int, phases: int, times: mmap.mmap, make: MakeFrame,
    count: mmap.mmap | None = None, apart: int = 0,
) -> int:  # fmt: skip
    """Write `frames` frames to every master, in `phases` groups over each period. Return the number of rejected frames.

    A pty rejects a frame if it accepts only a part of it. `count` contains the number of rejected frames so far. Each
    master skips `apart` more first frames than the previous master.
    """
    pack = struct.pack_into
    period_ns = int(1e9 / rate_hz)
    begins = [(master, apart * place) for place, master in enumerate(masters)]
    groups = [begins[i::phases] for i in range(phases)]
    refused = 0
    start_ns = time.monotonic_ns() + 10_000_000
    for i in range(frames):
        frame = make(i)
        for phase, group in enumerate(groups):
            due_ns = start_ns + i * period_ns + phase * period_ns // phases
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns / 1e9)
            elif wait_ns < -LATE_LIMIT_NS:
                start_ns -= wait_ns
            if phase == 0:
                pack("<q", times, 8 * i, time.monotonic_ns())
            for master, first in group:
                if i >= first and not _takes(master, frame):
                    refused += 1
                    if count:
                        pack("<q", count, 0, refused)
    return refused


def _takes(master: int, frame: bytes | bytearray) -> bool:
    try:
        return os.write(master, frame) == len(frame)
    except BlockingIOError:
        return False


def mapped(path: str, size_bytes: int) -> mmap.mmap:
    with open(path, "r+b") as file:
        return mmap.mmap(file.fileno(), size_bytes)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--phases", type=int, default=1)
    parser.add_argument(
        "--apart", type=int, default=0, metavar="FRAMES", help="frames between the starts of two devices"
    )
    parser.add_argument("--times", required=True)
    parser.add_argument("--refused", metavar="FILE")
    parser.add_argument("--udp", type=int, metavar="PORT")
    args = parser.parse_args()
    times, count = mapped(args.times, 8 * args.frames), mapped(args.refused, 8) if args.refused else None
    if args.udp:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", args.udp))
            print(flush=True)
            sys.stdin.readline()
            print(play([sock.fileno()], args.rate, args.frames, 1, times, sentence), flush=True)
            sys.stdin.readline()
        return
    pairs = open_ptys(args.devices)
    print(*(os.ttyname(slave) for _, slave in pairs), flush=True)
    sys.stdin.readline()
    masters, make = [master for master, _ in pairs], hi91_frames(args.rate)
    print(play(masters, args.rate, args.frames, args.phases, times, make, count, args.apart), flush=True)
    sys.stdin.readline()


if __name__ == "__main__":
    main()
