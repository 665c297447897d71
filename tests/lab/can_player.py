"""Plays simulated modules from memory: python -m tests.lab.can_player INTERFACE RATE SECONDS NAME:NODE …

The guest's one emulated CPU cannot simulate nine modules while a daemon serves them. So all frames are made first, in
virtual time; then each burst is one system call. Prints `ready`, begins at the first line on stdin and prints the zero
of the motion (CLOCK_MONOTONIC, ns), ends when the frames or stdin end, and prints how many frames were refused.
"""

import ctypes
import gc
import select
import socket
import sys
import time

from imud.kit.can import RAW_FRAME, pack_frame
from imud.links.mmsg import Message, Vector, libc
from imud.sim import CAN_SIMULATORS
from imud.sim.can_modules import CanModules
from imud.sim.pty import sharpen_timers
from imud.sim.simulator import SimulatorOptions

BURST_NS = 2_000_000
"""Frames that leave within this time of each other leave together."""
AHEAD_NS = 300_000_000
FRAMES_MAX = 256


def bursts(names: list[str], rate_hz: float, seconds: float) -> list[tuple[int, bytes]]:
    """Offset from the zero of the motion and frames of every burst."""
    modules = []
    for name in names:
        driver, _, node = name.partition(":")
        options = SimulatorOptions(rate_hz=rate_hz, node=int(node), boot_ms=0, noise="none", skew_ppm=0.0, at_once=True)
        modules.append(CAN_SIMULATORS[driver].make(options, 0))
    together, found, end_ns = CanModules(modules), list[tuple[int, bytes]](), round(seconds * 1e9)
    while (due_ns := together.next_ns()) is not None and due_ns < end_ns:
        due_ns += BURST_NS
        frames = [pack_frame(frame.can_id, frame.extended, frame.data) for frame in together.advance(due_ns)]
        assert len(frames) <= FRAMES_MAX
        found.append((due_ns, b"".join(frames)))
    return found


class Sender:
    """Sends a burst from buffers made once."""

    def __init__(self, interface: str) -> None:
        self.refused = 0
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # hears nothing
        self._socket.bind((interface,))
        self._frames = ctypes.create_string_buffer(FRAMES_MAX * RAW_FRAME.size)
        self._vectors, self._messages = (Vector * FRAMES_MAX)(), (Message * FRAMES_MAX)()
        for number, (vector, message) in enumerate(zip(self._vectors, self._messages, strict=True)):
            vector.base, vector.bytes = ctypes.addressof(self._frames) + number * RAW_FRAME.size, RAW_FRAME.size
            message.header.vector, message.header.vector_count = ctypes.addressof(vector), 1

    def send(self, data: bytes) -> None:
        """All frames of a burst."""
        count = len(data) // RAW_FRAME.size
        ctypes.memmove(self._frames, data, len(data))
        sent = libc.sendmmsg(self._socket.fileno(), self._messages, count, 0)
        self.refused += count - max(sent, 0)


def main(interface: str, rate: str, seconds: str, *names: str) -> int:
    """Run."""
    played = bursts(list(names), float(rate), float(seconds))
    sender = Sender(interface)
    gc.freeze()
    gc.disable()
    sharpen_timers()
    print("ready", flush=True)
    sys.stdin.readline()
    epoch_ns = time.monotonic_ns() + AHEAD_NS
    print(epoch_ns, flush=True)
    for offset_ns, data in played:
        wait_ns = epoch_ns + offset_ns - time.monotonic_ns()
        if select.select([sys.stdin], [], [], max(wait_ns, 0) / 1e9)[0]:
            break
        sender.send(data)
    print(sender.refused, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
