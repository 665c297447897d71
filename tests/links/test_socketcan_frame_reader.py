"""The receiver of CAN frames, on a socket of another family with the same system call, time stamps and drop counter."""

import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from imud.formats.can import RAW_FRAME, CanFrame, pack_frame
from imud.links.socketcan import BATCH_FRAMES, BusState, FrameReader
from tests.support.daemon_process import LIMIT_S

HOUR_NS = 3600 * 10**9
QUARTER_NS = 10**9 // 4
OFFSET_NS = 1_700_000_000 * 10**9
ERROR_FRAME = RAW_FRAME.pack(0x2000_0004, 8, bytes([0, 1, 0, 0, 0, 0, 0, 0]))


def real_ns() -> int:
    """Return the time of a clock that is OFFSET_NS behind the clock of the kernel's time stamps."""
    return time.time_ns() - OFFSET_NS


class Wire:
    """A reader on a loopback UDP socket. Datagrams replace the frames.

    The clocks of the reader stop during a read. Two readings are thus equal, and each time stamp is exact.
    """

    def __init__(self) -> None:
        self.receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.receiver.bind(("127.0.0.1", 0))
        self.receiver.setblocking(False)
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.connect(self.receiver.getsockname())
        self.state = BusState("can0")
        self.wall_ahead_ns = 0
        self.now_ns = real_ns()
        self.reader = FrameReader(
            self.receiver, self.state, lambda: self.now_ns, lambda: self.now_ns + OFFSET_NS + self.wall_ahead_ns
        )
        self._wait_for_stamps()

    def send(self, *can_ids: int) -> tuple[int, int]:
        """Send frames. Return the time before and after sending."""
        before_ns = real_ns()
        for can_id in can_ids:
            self.sender.send(pack_frame(can_id, False, bytes([can_id & 0xFF])))
        return before_ns, real_ns()

    def read(self) -> list[CanFrame]:
        assert select.select([self.receiver], [], [], LIMIT_S)[0]
        self.now_ns = real_ns()
        return self.reader.read()

    def ids(self) -> list[tuple[int, bool]]:
        """Read. Return the identifiers, and whether frames were lost before each."""
        return [(frame.can_id, frame.after_loss) for frame in self.read()]

    def close(self) -> None:
        self.receiver.close()
        self.sender.close()

    def _wait_for_stamps(self) -> None:
        """Wait until the kernel time-stamps datagrams, some ms after the first socket has requested time stamps."""
        end_s, is_stamped = time.monotonic() + LIMIT_S, False
        while not is_stamped:
            assert time.monotonic() < end_s, "no kernel stamps"
            _, sent_ns = self.send(0)
            time.sleep(0.002)
            is_stamped = any(frame.t_rx_ns < sent_ns for frame in self.read())


@pytest.fixture
def wire() -> Iterator[Wire]:
    with closing(Wire()) as made:
        yield made


def test_frames_come_with_the_time_of_their_arrival(wire: Wire) -> None:
    assert wire.reader.read() == []
    before_ns, after_ns = wire.send(1, 2, 0x7FF)
    frames = wire.read()
    assert [f[:3] for f in frames] == [(1, False, b"\x01"), (2, False, b"\x02"), (0x7FF, False, b"\xff")]
    assert not any(f.after_loss for f in frames)
    times = [f.t_rx_ns for f in frames]
    assert before_ns <= times[0] < times[1] < times[2] <= after_ns
    wire.sender.send(pack_frame(0x1234, True, b""))
    wire.sender.send(pack_frame(0x1FFFFFFF, True, bytes(8)))
    assert [f[:3] for f in wire.read()] == [(0x1234, True, b""), (0x1FFFFFFF, True, bytes(8))]
    wire.receiver.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        wire.reader.read()


def test_a_read_is_bounded_and_the_rest_stays(wire: Wire) -> None:
    wire.send(*range(BATCH_FRAMES + 5))
    first, second = wire.read(), wire.read()
    assert [f.can_id for f in first + second] == list(range(BATCH_FRAMES + 5))
    assert (len(first), len(second)) == (BATCH_FRAMES, 5)
    assert second[0].t_rx_ns >= first[-1].t_rx_ns


def test_drops_are_counted_and_marked_where_they_were(wire: Wire) -> None:
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    wire.send(*range(100))
    taken = wire.ids()
    assert len(taken) < 100
    assert not any(after_loss for _, after_loss in taken)
    wire.send(200, 201)
    assert wire.ids() == [(200, True), (201, False)]
    assert len(taken) + wire.reader.dropped == 100
    wire.send(202)
    assert wire.ids() == [(202, False)]


def test_a_drop_is_seen_after_reads_of_single_frames(wire: Wire) -> None:
    """A read without drops needs less space for control messages. The next read has the full space again."""
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
    wire.send(1)
    assert wire.ids() == [(1, False)]
    # fills the buffer, and the reader truncates it to a frame
    wire.sender.send(pack_frame(2, False, b"") + bytes(4000))
    wire.send(3)
    assert wire.ids() == [(2, False)]
    wire.send(4)
    assert wire.ids() == [(4, True)]
    assert wire.reader.dropped == 1


def test_error_frames_go_their_own_way_and_can_mean_a_loss(wire: Wire) -> None:
    wire.sender.send(ERROR_FRAME)
    wire.sender.send(RAW_FRAME.pack(0x4000_0123, 0, b""))  # a remote frame
    wire.send(5, 6)
    assert wire.ids() == [(5, True), (6, False)]
    assert (wire.state.overflows, wire.state.news) == (1, [])
    wire.sender.send(ERROR_FRAME)
    assert wire.ids() == []
    wire.send(7)
    assert wire.ids() == [(7, True)], "a loss that is read alone marks the next frame"
    wire.send(8)
    assert wire.ids() == [(8, False)]


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, 0])
def test_a_wall_clock_set_between_arrival_and_read_moves_no_stamp(wire: Wire, step_ns: int) -> None:
    wire.reader.read()
    spans = [wire.send(can_id) for can_id in range(1, 4)]
    wire.wall_ahead_ns += step_ns
    for frame, (before_ns, after_ns) in zip(wire.read(), spans, strict=True):
        assert before_ns <= frame.t_rx_ns <= after_ns


def test_frames_of_before_and_after_a_step_of_the_wall_clock_keep_their_order_and_bounds(wire: Wire) -> None:
    wire.wall_ahead_ns += HOUR_NS
    before_ns, after_ns = wire.send(1)
    (first,) = wire.read()
    assert before_ns <= first.t_rx_ns <= after_ns
    wire.wall_ahead_ns += HOUR_NS
    wire.send(2)
    (second,) = wire.read()
    assert first.t_rx_ns < second.t_rx_ns <= wire.now_ns


@pytest.mark.parametrize("step_ns", [QUARTER_NS, -QUARTER_NS])
def test_a_frame_of_a_time_between_two_steps_of_the_wall_clock_is_not_dated_before_it_came(
    wire: Wire, step_ns: int
) -> None:
    """The wall clock is set and set back between two reads, like on a host under SIGSTOP."""
    wire.wall_ahead_ns += step_ns  # the offset of both reads; the kernel's time stamps do not contain it
    wire.send(1)
    wire.read()
    sent_ns, _ = wire.send(2, 3)
    for frame in wire.read():
        assert sent_ns <= frame.t_rx_ns <= wire.now_ns


def test_a_frame_is_no_older_than_the_read_that_emptied_the_queue(wire: Wire) -> None:
    wire.send(1)
    begun_ns = real_ns()
    wire.read()
    wire.send(2)
    wire.wall_ahead_ns += HOUR_NS
    (frame,) = wire.read()
    assert begun_ns <= frame.t_rx_ns <= wire.now_ns


def test_clocks_that_are_always_read_apart_give_the_closest_of_some_readings(wire: Wire) -> None:
    """Each time, the thread stops between the readings of both clocks: first for 30 us, then for 20 ms."""
    away_ns, calls = [0, 0, 30_000, 0, 20_000_000, 0, 20_000_000], iter(range(7))
    gone_ns, base_ns, begun = 0, real_ns(), False

    def now_ns() -> int:
        nonlocal gone_ns
        gone_ns += away_ns[next(calls)] if begun else 0
        return base_ns + gone_ns

    reader = FrameReader(wire.receiver, BusState("can0"), now_ns, lambda: base_ns + gone_ns + OFFSET_NS)
    before_ns, after_ns = wire.send(1)
    base_ns, begun = after_ns, True
    (frame,) = reader.read()
    assert before_ns - 15_000 <= frame.t_rx_ns <= after_ns + 15_000


def test_layout_of_the_kernels_frame() -> None:
    assert pack_frame(0x65, False, b"\1\2") == struct.pack("=I", 0x65) + b"\2\0\0\0\1\2" + bytes(6)
    assert pack_frame(0x65, True, b"")[:4] == struct.pack("=I", 0x8000_0065)
