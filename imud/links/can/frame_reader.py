"""Reader of CAN frames from a raw socket in batches, with the kernel's time stamps and drop count.

Plan: one `recvmmsg` per wake-up takes all that is there, up to BATCH_FRAMES, into buffers made once; nothing is
allocated but the frames. Python's own `recvmsg` costs two system calls per frame (it asks for the interface's name each
time) and one more, with an exception, to find the queue empty.

Kernel stamps are CLOCK_REALTIME. They are carried over to CLOCK_MONOTONIC with the offset of the two at the read. A
stamp that is then not between the last time the queue was seen empty and now is of before a step of the wall clock:
it is carried over with the offset of that last time. One that neither offset brings there is of a time between two
steps: its frame is dated by the read, because a frame may have waited, but cannot have come before it was sent.
Nothing moves a stamp out of these bounds. Both clocks are slewed together: their difference is the same at arrival
and read. The kernel begins to stamp some ms after the first socket of the machine asks for it; until then it fills in
the time of the read.
"""

import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final

from imud.formats.can import (
    DATA_BYTES_MAX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    RAW_FRAME,
    REMOTE_FLAG,
    CanFrame,
)
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

BATCH_FRAMES: Final = 64
"""Frames per read: 8 ms of a full bus at 1 Mbit/s. What is left is read at the next turn of the loop."""
SO_TIMESTAMPNS_NEW: Final = 64
"""Ask for arrival stamps, and the type they come under: two 64-bit integers, s and ns (Linux 5.1, asm-generic)."""
SO_RXQ_OVFL: Final = 40
"""Ask for the count of frames dropped because the receive buffer was full, and its type: u32."""
STEADY_NS: Final = 20 * NS_PER_US
"""Two clocks read further apart than this were interrupted: read again, and use the closest of STEADY_TRIES."""
STEADY_TRIES: Final = 3
_COUNT_MASK: Final = 0xFFFF_FFFF
_NO_DATA_FLAGS: Final = ERROR_FLAG | REMOTE_FLAG

_WORD_BYTES: Final = struct.calcsize("P")
_CONTROL_BYTES: Final = 64
_STAMP: Final = f"{_WORD_BYTES + 4}xiqq"  # length, level, type, s, ns
_DROPS: Final = f"{_WORD_BYTES + 4}xiI"  # length, level, type, count
_CONTROL: Final = struct.Struct(f"={_STAMP}{_DROPS}{_CONTROL_BYTES - struct.calcsize(f'={_STAMP}{_DROPS}')}x")
"""Two control messages as the kernel writes them, without their lengths and levels."""

_Rows = Iterable[tuple[tuple[Any, ...], tuple[Any, ...]]]
"""Frames and their control messages, as unpacked."""
OnErrorFrame = Callable[[int, bytes], bool]
"""Called with class bits and data of an error frame; returns whether frames are missing since."""


libc: Final = ctypes.CDLL(None, use_errno=True)
_receive: Final = ctypes.PyDLL(None, use_errno=True).recvmmsg
"""For calls that never block: other threads need not be let in meanwhile."""


class MessageHeader(ctypes.Structure):
    """`struct msghdr` (recvmsg(2))."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_bytes", ctypes.c_uint32),
        ("vector", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class MessageBuffers(ctypes.Structure):
    """`struct mmsghdr` (recvmmsg(2), sendmmsg(2))."""

    _fields_ = (("header", MessageHeader), ("received_bytes", ctypes.c_uint))


class Vector(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("bytes", ctypes.c_size_t))


_MESSAGE_BYTES: Final = ctypes.sizeof(MessageBuffers)
_CONTROL_SIZE_WORD: Final = MessageHeader.control_bytes.offset // _WORD_BYTES
"""Place of `control_bytes` in a header: of all that `recvmmsg` writes there, it reads this again."""
_new_frame: Final[Callable[[tuple[int, bool, bytes, int, bool]], CanFrame]] = partial(tuple.__new__, CanFrame)
"""`CanFrame` at a third of the cost of its own constructor."""


STEP_NS: Final = 100 * NS_PER_US
"""A smaller change of the offset may be the error of its two readings."""
BACKLOG_NS: Final = 5 * NS_PER_MS
"""A frame is stamped so long at most before it is in the queue of the socket: the kernel's own queue is before it."""


class FrameReader:
    """The receiving side of a socket whose messages are `struct can_frame`. The caller keeps and closes the socket."""

    def __init__(
        self,
        receiver: socket.socket,
        on_error: OnErrorFrame,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Enable time stamps and the drop count on the socket."""
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS_NEW, 1)
        receiver.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self.dropped = 0
        """Frames that the kernel dropped because they were not read in time."""
        self._on_error = on_error
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._frames = bytearray(RAW_FRAME.size * BATCH_FRAMES)
        self._control = bytearray(_CONTROL_BYTES * BATCH_FRAMES)
        self._vectors = (Vector * BATCH_FRAMES)()
        self._headers = bytearray(_MESSAGE_BYTES * BATCH_FRAMES)
        self._messages = (MessageBuffers * BATCH_FRAMES).from_buffer(self._headers)
        self._assign_buffers()
        self._fresh_headers = bytes(self._headers)
        self._header_words = memoryview(self._headers).cast("L")  # as size_t on Linux
        self._receive = partial(
            _receive, receiver.fileno(), self._messages, BATCH_FRAMES, int(socket.MSG_DONTWAIT), None
        )
        self._empty_ns = now_ns()
        self._newest_ns = self._empty_ns
        self._empty_offset_ns = self._clocks()[0]
        """CLOCK_REALTIME less CLOCK_MONOTONIC when frames were read and none was left."""
        self._lost = False

    def read(self) -> list[CanFrame]:
        """Data frames that are there, at most BATCH_FRAMES, oldest first. Raises OSError as the kernel names it."""
        begun_ns = self._now_ns()
        count: int = self._receive()
        if count < 0:
            return self._failed(ctypes.get_errno(), begun_ns)
        offset_ns, now_ns = self._clocks()
        if count == 1:  # as on a quiet bus: not worth two iterators
            only = RAW_FRAME.unpack_from(self._frames), _CONTROL.unpack_from(self._control)
            frames = self._decoded((only,), offset_ns, now_ns)
            self._header_words[_CONTROL_SIZE_WORD] = _CONTROL_BYTES
        else:
            frames = self._decoded(self._rows(count), offset_ns, now_ns)
            header_bytes = count * _MESSAGE_BYTES
            self._headers[:header_bytes] = self._fresh_headers[:header_bytes]
        if count < BATCH_FRAMES:
            self._empty_ns, self._empty_offset_ns = begun_ns, offset_ns
        return frames

    def _rows(self, count: int) -> _Rows:
        raw = memoryview(self._frames)[: count * RAW_FRAME.size]
        control = memoryview(self._control)[: count * _CONTROL_BYTES]
        return zip(RAW_FRAME.iter_unpack(raw), _CONTROL.iter_unpack(control), strict=True)

    def _decoded(self, rows: _Rows, offset_ns: int, now_ns: int) -> list[CanFrame]:
        frames: list[CanFrame] = []
        newest_ns, empty_ns, dropped, lost = self._newest_ns, self._empty_ns, self.dropped & _COUNT_MASK, self._lost
        if newest_ns < empty_ns:  # noqa: PLR1730 - a call of max() costs 60 ns on the sample path
            newest_ns = empty_ns
        stepped_ns = offset_ns - self._empty_offset_ns
        if -STEP_NS < stepped_ns < STEP_NS:
            stepped_ns = 0
        for (can_id, size, data), (kind, seconds, ns, drop_kind, drops) in rows:
            if drop_kind == SO_RXQ_OVFL and drops != dropped:
                self.dropped += (drops - dropped) & _COUNT_MASK
                dropped, lost = drops, True
            if can_id & _NO_DATA_FLAGS:
                if can_id & ERROR_FLAG:
                    lost |= self._on_error(can_id ^ ERROR_FLAG, data)
                continue
            t_ns = seconds * NS_PER_S + ns - offset_ns if kind == SO_TIMESTAMPNS_NEW else now_ns
            if stepped_ns and not newest_ns < t_ns <= now_ns and newest_ns < t_ns + stepped_ns <= now_ns:
                t_ns += stepped_ns
            if t_ns > newest_ns:
                newest_ns = t_ns
            elif t_ns < newest_ns - BACKLOG_NS:
                newest_ns = now_ns
            if newest_ns > now_ns:  # noqa: PLR1730
                newest_ns = now_ns
            whole = data if size == DATA_BYTES_MAX else data[:size]
            frames.append(_new_frame((can_id & EXTENDED_ID_MAX, can_id >= EXTENDED_FLAG, whole, newest_ns, lost)))
            lost = False
        self._newest_ns, self._lost = newest_ns, lost
        return frames

    def _clocks(self) -> tuple[int, int]:
        """CLOCK_REALTIME less CLOCK_MONOTONIC, and CLOCK_MONOTONIC."""
        before_ns, wall_ns, now_ns = self._now_ns(), self._wall_ns(), self._now_ns()
        best_ns, offset_ns, tries = now_ns - before_ns, wall_ns - (before_ns + now_ns) // 2, 1
        while best_ns > STEADY_NS and tries < STEADY_TRIES:
            before_ns, wall_ns, now_ns = self._now_ns(), self._wall_ns(), self._now_ns()
            tries += 1
            if now_ns - before_ns < best_ns:
                best_ns, offset_ns = now_ns - before_ns, wall_ns - (before_ns + now_ns) // 2
        return offset_ns, now_ns

    def _failed(self, number: int, begun_ns: int) -> list[CanFrame]:
        if number in (errno.EAGAIN, errno.EINTR):
            self._empty_ns = begun_ns
            return []
        raise OSError(number, os.strerror(number))

    def _assign_buffers(self) -> None:
        """Give each message one frame's bytes and its share of the control buffer."""
        frames = ctypes.addressof(ctypes.c_char.from_buffer(self._frames))
        control = ctypes.addressof(ctypes.c_char.from_buffer(self._control))
        vector = ctypes.addressof(self._vectors)
        for i, message in enumerate(self._messages):
            self._vectors[i].base = frames + i * RAW_FRAME.size
            self._vectors[i].bytes = RAW_FRAME.size
            header = message.header
            header.vector, header.vector_count = vector + i * ctypes.sizeof(Vector), 1
            header.control, header.control_bytes = control + i * _CONTROL_BYTES, _CONTROL_BYTES
