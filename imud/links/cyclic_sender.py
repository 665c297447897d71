"""Cyclic CAN frames: sent by the broadcast manager of the kernel, or by the event loop if the kernel has no such
manager.

The broadcast manager (CAN_BCM, linux/can/bcm.h) uses a high-resolution timer and does not depend on this process. It
starts the timer again for each frame, so that a period is longer by the latency of the interrupt: microseconds on
hardware, 0.25 ms of 10 ms in the emulated lab. The timer of the event loop has absolute deadlines, so that its error
does not accumulate. A busy process delays it. The event loop skips missed periods.
"""

import asyncio
import errno
import socket
import struct
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Final, Protocol

from imud.formats.can import EXTENDED_FLAG, CyclicFrame, pack_frame
from imud.model.errors import LinkError
from imud.model.units import NS_PER_S, NS_PER_US

TX_SETUP: Final = 1  # operation: send a frame cyclically
SETTIMER: Final = 0x0001  # flag: the message contains valid intervals
STARTTIMER: Final = 0x0002  # flag: start now and send one frame immediately
# Errors of a kernel without CAN_BCM.
NO_MANAGER: Final = frozenset({errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT, errno.EAFNOSUPPORT})

# `struct bcm_msg_head`: operation, flags, count, s and us of the first and second interval, identifier, frames.
_HEAD: Final = struct.Struct("@3I4l2I")
_PAD: Final = bytes(-_HEAD.size % 8)  # padding: the frames after the head are aligned to eight bytes


class CyclicLink(Protocol):
    """Link that sends cyclic frames from the event loop."""

    def write(self, data: bytes, /) -> None:
        """Send frames (`struct can_frame`). Raises LinkError."""
        ...

    def sender_failed(self, error: LinkError, /) -> None:
        """Process the failure of a cyclic frame, which ended the sender."""
        ...


class Sender(Protocol):
    """Sender of cyclic frames until it is closed."""

    def close(self) -> None:
        """Stop. A second call does nothing."""
        ...


def setup(frame: CyclicFrame) -> bytes:
    """Return the TX_SETUP message for a frame. The kernel sends the frame until the socket closes."""
    seconds, rest_ns = divmod(frame.every_ns, NS_PER_S)
    can_id = frame.can_id | EXTENDED_FLAG * frame.extended
    head = _HEAD.pack(TX_SETUP, SETTIMER | STARTTIMER, 0, 0, 0, seconds, rest_ns // NS_PER_US, can_id, 1)
    return head + _PAD + pack_frame(frame.can_id, frame.extended, frame.data)


class KernelSender:
    """Cyclic frames of the broadcast manager on one interface."""

    def __init__(self, interface: str, frames: Sequence[CyclicFrame]) -> None:
        """Start sending. Raises OSError, one of NO_MANAGER when the kernel has no broadcast manager."""
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, socket.CAN_BCM)
        try:
            self._socket.connect((interface,))
            for frame in frames:
                self._socket.send(setup(frame))
        except OSError:
            self._socket.close()
            raise

    def close(self) -> None:
        self._socket.close()


class LoopSender:
    """Cyclic frames of the event loop, sent with the `write` of a link. Synchronization: the loop's thread only."""

    def __init__(
        self,
        link: CyclicLink,
        frames: Sequence[CyclicFrame],
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        """Start sending. After a failed `write`, stop and call `link.sender_failed`. Raises LinkError."""
        self._link = link
        self._now_ns = now_ns
        self._timers: dict[int, asyncio.TimerHandle] = {}
        begin_ns = now_ns()
        try:
            for number, frame in enumerate(frames):
                link.write(pack_frame(frame.can_id, frame.extended, frame.data))
                self._wait(number, frame, begin_ns + frame.every_ns)
        except LinkError:
            self.close()  # stop the timers of the earlier frames
            raise

    def close(self) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()

    def _wait(self, number: int, frame: CyclicFrame, due_ns: int) -> None:
        delay_s = max(0, due_ns - self._now_ns()) / NS_PER_S
        self._timers[number] = asyncio.get_running_loop().call_later(delay_s, self._send, number, frame, due_ns)

    def _send(self, number: int, frame: CyclicFrame, due_ns: int) -> None:
        now_ns = self._now_ns()
        if now_ns < due_ns:  # the loop's timer can fire slightly early in CLOCK_MONOTONIC
            self._wait(number, frame, due_ns)
            return
        try:
            self._link.write(pack_frame(frame.can_id, frame.extended, frame.data))
        except LinkError as error:
            self.close()
            self._link.sender_failed(error)
            return
        self._wait(number, frame, due_ns + ((now_ns - due_ns) // frame.every_ns + 1) * frame.every_ns)
