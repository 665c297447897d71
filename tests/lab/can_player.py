"""Plays simulated devices from memory: python -m tests.lab.can_player INTERFACE RATE SECONDS NAME:NODE …

The guest has one emulated CPU, which cannot simulate nine devices while a daemon serves them. The player first computes
the frames of LOOP_S in simulated time, with a motion of its own for each device (`Phased`). Then it repeats these
frames. It sends each burst with one system call and continues the INDEX of an IMU61x.

The program prints `ready`. At the first line of standard input, it starts and prints the time of the first sample
(CLOCK_MONOTONIC, ns). It ends after SECONDS or when standard input closes, and prints the number of frames that the
kernel rejected.
"""

import ctypes
import gc
import select
import socket
import struct
import sys
import time
from dataclasses import dataclass, field
from functools import partial

from imud.drivers.imu61x.can import INDEX_MODULUS, SET_FRAMES
from imud.formats.can import RAW_FRAME, pack_frame
from imud.links.socketcan import MessageBuffers, Vector, libc
from imud.sim import CAN_SIMULATORS
from imud.sim.can_module import CanModules
from imud.sim.physics import GRAVITY_M_S2, MOTIONS, Truth
from imud.sim.ports.pty import sharpen_timers
from imud.sim.sensor import SimulatorOptions

BURST_NS = 2_000_000
AHEAD_NS = 300_000_000
FRAMES_MAX = 256  # frames per system call
BEGIN_NS = 1_000_000_000  # time from the first line of standard input to the first sample
LOOP_S = 4.0
"""Duration of the repeated motion, s. The guest needs longer to compute the motion than to play it."""
LOOP_NS = round(LOOP_S * 1e9)
PHASE_S = 7.3
"""Time offset between the motions of two devices, s. Frames of two devices are thus never equal."""
INDEX = struct.Struct("<H")
INDEX_AT = 8 + 6
"""Offset of INDEX in the last frame of a set: the last two data bytes. The data starts at offset 8."""


class Phased:
    def __init__(self, number: int, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        self._motion = MOTIONS["swing"](gravity_m_s2)
        self._phase_s = PHASE_S * number

    def at(self, t_s: float) -> Truth:
        """Return the true attitude `t_s` seconds after the start of the device's motion."""
        return self._motion.at(t_s + self._phase_s)


@dataclass
class Played:
    offset_ns: int
    frames: bytearray
    indices: list[int] = field(default_factory=list)

    def count_on(self, samples: int) -> None:
        for at in self.indices:
            (index,) = INDEX.unpack_from(self.frames, at)
            INDEX.pack_into(self.frames, at, (index + samples) % INDEX_MODULUS)


def loop(names: list[str], rate_hz: float) -> list[Played]:
    modules, closing = [], set()
    for number, name in enumerate(names):
        driver, _, node = name.partition(":")
        motion = f"swing {number}"
        MOTIONS[motion] = partial(Phased, number)
        options = SimulatorOptions(
            rate_hz=rate_hz, node=int(node), boot_ms=0, noise="none", skew_ppm=0.0, at_once=True, motion=motion
        )
        modules.append(CAN_SIMULATORS[driver].make(options, 0))
        if driver == "imu61x-can":
            closing.add(int(node) + SET_FRAMES - 1)
    together, found = CanModules(modules), list[Played]()
    begin_ns = BEGIN_NS - round(0.5e9 / rate_hz)
    while (due_ns := together.next_ns()) is not None and due_ns < begin_ns + LOOP_NS:
        sent = together.advance(due_ns + BURST_NS)
        assert len(sent) <= FRAMES_MAX
        if due_ns >= begin_ns:
            frames = bytearray().join(pack_frame(frame.can_id, frame.extended, frame.data) for frame in sent)
            at = [n * RAW_FRAME.size + INDEX_AT for n, f in enumerate(sent) if f.can_id in closing and not f.extended]
            found.append(Played(due_ns + BURST_NS - BEGIN_NS, frames, at))
    return found


class Sender:
    def __init__(self, interface: str) -> None:
        self.refused = 0
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # this socket only sends
        self._socket.bind((interface,))
        self._frames = bytearray(FRAMES_MAX * RAW_FRAME.size)
        frames = ctypes.addressof(ctypes.c_char.from_buffer(self._frames))
        self._vectors, self._messages = (Vector * FRAMES_MAX)(), (MessageBuffers * FRAMES_MAX)()
        for number, (vector, message) in enumerate(zip(self._vectors, self._messages, strict=True)):
            vector.base, vector.bytes = frames + number * RAW_FRAME.size, RAW_FRAME.size
            message.header.vector, message.header.vector_count = ctypes.addressof(vector), 1

    def send(self, frames: bytearray) -> None:
        count = len(frames) // RAW_FRAME.size
        self._frames[: len(frames)] = frames
        sent = libc.sendmmsg(self._socket.fileno(), self._messages, count, 0)
        self.refused += count - max(sent, 0)


def main(interface: str, rate: str, seconds: str, *names: str) -> int:
    played, samples = loop(list(names), float(rate)), round(float(rate) * LOOP_S)
    sender = Sender(interface)
    gc.freeze()
    gc.disable()
    sharpen_timers()
    print("ready", flush=True)
    sys.stdin.readline()
    begin_ns = time.monotonic_ns() + AHEAD_NS
    end_ns = begin_ns + round(float(seconds) * 1e9)
    print(begin_ns, flush=True)
    ended = False
    while not ended and begin_ns < end_ns:
        for burst in played:
            wait_ns = begin_ns + burst.offset_ns - time.monotonic_ns()
            if ended := bool(select.select([sys.stdin], [], [], max(wait_ns, 0) / 1e9)[0]):
                break
            sender.send(burst.frames)
            burst.count_on(samples)
        begin_ns += LOOP_NS
    print(sender.refused, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
