"""The receiving side of CAN on a socket of another family: the same system call, stamps and drop count."""

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from imud.formats.can import RAW_FRAME, pack_frame
from imud.links.can.frame_reader import BATCH_FRAMES, FrameReader

HOUR_NS = 3600 * 10**9
QUARTER_NS = 10**9 // 4
LIMIT_S = 5.0
APART_S = 0.005
"""Between frames, much more than the error of one reading of both clocks."""
CLOCKS_NS = 1_000_000


class Wire:
    """A reader on a UDP socket of the loop device, whose datagrams are frames."""

    def __init__(self) -> None:
        self.receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.receiver.bind(("127.0.0.1", 0))
        self.receiver.setblocking(False)
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.connect(self.receiver.getsockname())
        self.errors: list[tuple[int, bytes]] = []
        self.error_means_loss = False
        self.wall_ahead_ns = 0
        self.reader = FrameReader(self.receiver, self._on_error, time.monotonic_ns, self._wall_ns)
        self._wait_for_stamps()

    def send(self, *can_ids: int) -> None:
        for can_id in can_ids:
            self.sender.send(pack_frame(can_id, False, bytes([can_id & 0xFF])))

    def close(self) -> None:
        self.receiver.close()
        self.sender.close()

    def _on_error(self, classes: int, data: bytes) -> bool:
        self.errors.append((classes, data))
        return self.error_means_loss

    def _wall_ns(self) -> int:
        return time.time_ns() + self.wall_ahead_ns

    def _wait_for_stamps(self) -> None:
        """The kernel begins to stamp some ms after the first socket asked for it."""
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            self.send(0)
            begun_ns = time.monotonic_ns()
            time.sleep(0.002)
            if any(frame.t_rx_ns < begun_ns for frame in self.reader.read()):
                return
        pytest.fail("no kernel stamps")


@pytest.fixture
def wire() -> Iterator[Wire]:
    with closing(Wire()) as made:
        yield made


def test_frames_come_with_the_time_of_their_arrival(wire: Wire) -> None:
    assert wire.reader.read() == []
    before_ns = time.monotonic_ns()
    wire.send(1, 2, 0x7FF)
    after_ns = time.monotonic_ns()
    time.sleep(0.01)
    frames = wire.reader.read()
    assert [(f.can_id, f.extended, f.data, f.after_loss) for f in frames] == [
        (1, False, b"\x01", False),
        (2, False, b"\x02", False),
        (0x7FF, False, b"\xff", False),
    ]
    assert all(before_ns - 200_000 <= f.t_rx_ns <= after_ns + 200_000 for f in frames)
    assert [f.t_rx_ns for f in frames] == sorted(f.t_rx_ns for f in frames)


def test_extended_identifiers_and_lengths(wire: Wire) -> None:
    wire.sender.send(pack_frame(0x1234, True, b""))
    wire.sender.send(pack_frame(0x1FFFFFFF, True, bytes(8)))
    assert [f[:3] for f in wire.reader.read()] == [(0x1234, True, b""), (0x1FFFFFFF, True, bytes(8))]


def test_a_read_is_bounded_and_the_rest_stays(wire: Wire) -> None:
    wire.send(*range(BATCH_FRAMES + 5))
    first, second = wire.reader.read(), wire.reader.read()
    assert [f.can_id for f in first + second] == list(range(BATCH_FRAMES + 5))
    assert (len(first), len(second)) == (BATCH_FRAMES, 5)
    assert second[0].t_rx_ns >= first[-1].t_rx_ns


def test_drops_are_counted_and_marked_where_they_were(wire: Wire) -> None:
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    wire.send(*range(100))
    taken = wire.reader.read()
    assert len(taken) < 100
    assert not any(frame.after_loss for frame in taken)
    wire.send(200, 201)
    marked = wire.reader.read()
    assert [frame.after_loss for frame in marked] == [True, False]
    assert len(taken) + wire.reader.dropped == 100
    wire.send(202)
    assert not wire.reader.read()[0].after_loss


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, 0])
def test_a_wall_clock_set_between_arrival_and_read_moves_no_stamp(wire: Wire, step_ns: int) -> None:
    wire.reader.read()
    sent_ns = []
    for can_id in range(1, 4):
        time.sleep(APART_S)
        sent_ns.append(time.monotonic_ns())
        wire.send(can_id)
    wire.wall_ahead_ns += step_ns
    frames = wire.reader.read()
    for frame, from_ns, to_ns in zip(frames, sent_ns, [*sent_ns[1:], time.monotonic_ns()], strict=True):
        assert from_ns - CLOCKS_NS <= frame.t_rx_ns <= min(to_ns, from_ns + APART_S * 1e9) + CLOCKS_NS


def test_frames_of_before_and_after_a_step_of_the_wall_clock_keep_their_order_and_bounds(wire: Wire) -> None:
    wire.reader.read()
    wire.wall_ahead_ns += HOUR_NS
    begin_ns = time.monotonic_ns()
    wire.send(1)
    (first,) = wire.reader.read()
    wire.wall_ahead_ns += HOUR_NS
    wire.send(2)
    (second,) = wire.reader.read()
    assert begin_ns - CLOCKS_NS <= first.t_rx_ns < second.t_rx_ns <= time.monotonic_ns()


@pytest.mark.parametrize("step_ns", [QUARTER_NS, -QUARTER_NS])
def test_a_frame_of_a_time_between_two_steps_of_the_wall_clock_is_not_dated_before_it_came(
    wire: Wire, step_ns: int
) -> None:
    """The wall clock is set and set back between two reads, as a host under SIGSTOP sees it."""
    wire.wall_ahead_ns += step_ns  # of both reads; the kernel stamps by the clock without it
    wire.send(1)
    wire.reader.read()
    time.sleep(APART_S)
    sent_ns = time.monotonic_ns()
    wire.send(2, 3)
    for frame in wire.reader.read():
        assert sent_ns - CLOCKS_NS <= frame.t_rx_ns <= time.monotonic_ns()


def test_error_frames_go_their_own_way(wire: Wire) -> None:
    wire.sender.send(RAW_FRAME.pack(0x2000_0004, 8, bytes([0, 1, 0, 0, 0, 0, 0, 0])))
    wire.sender.send(RAW_FRAME.pack(0x4000_0123, 0, b""))  # a remote frame
    wire.error_means_loss = True
    wire.send(5, 6)
    frames = wire.reader.read()
    assert [(f.can_id, f.after_loss) for f in frames] == [(5, True), (6, False)]
    assert wire.errors == [(4, bytes([0, 1, 0, 0, 0, 0, 0, 0]))]


def test_errors_of_the_socket_are_raised(wire: Wire) -> None:
    wire.receiver.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        wire.reader.read()


def test_layout_of_the_kernels_frame() -> None:
    assert pack_frame(0x65, False, b"\1\2") == struct.pack("=I", 0x65) + b"\2\0\0\0\1\2" + bytes(6)
    assert pack_frame(0x65, True, b"")[:4] == struct.pack("=I", 0x8000_0065)
    with pytest.raises(ValueError, match="no CAN frame"):
        pack_frame(0x800, False, b"")


def test_a_loss_that_is_read_alone_marks_the_first_frame_of_the_next_read(wire: Wire) -> None:
    wire.error_means_loss = True
    wire.sender.send(RAW_FRAME.pack(0x2000_0004, 8, bytes([0, 1, 0, 0, 0, 0, 0, 0])))
    assert wire.reader.read() == []
    wire.send(5)
    assert [frame.after_loss for frame in wire.reader.read()] == [True]
    wire.send(6)
    assert [frame.after_loss for frame in wire.reader.read()] == [False]


def test_a_drop_is_seen_after_reads_of_single_frames(wire: Wire) -> None:
    """A read without drops needs less room for control messages; the next has all of it again."""
    wire.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
    wire.send(1)
    assert len(wire.reader.read()) == 1
    wire.sender.send(pack_frame(2, False, b"") + bytes(4000))  # fills the buffer alone, and is cut to a frame
    wire.send(3)
    assert [(frame.can_id, frame.after_loss) for frame in wire.reader.read()] == [(2, False)]
    wire.send(4)
    assert [(frame.can_id, frame.after_loss) for frame in wire.reader.read()] == [(4, True)]
    assert wire.reader.dropped == 1


def test_a_frame_is_no_older_than_the_read_that_emptied_the_queue(wire: Wire) -> None:
    wire.send(1)
    time.sleep(0.01)
    begun_ns = time.monotonic_ns()
    wire.reader.read()
    wire.send(2)
    wire.wall_ahead_ns += HOUR_NS
    (frame,) = wire.reader.read()
    assert begun_ns <= frame.t_rx_ns <= time.monotonic_ns()


def test_clocks_that_are_always_read_apart_give_the_closest_of_some_readings(wire: Wire) -> None:
    """The thread is away between the two clocks each time: for 30 µs, then for 20 ms."""
    away_ns, calls = [0, 0, 30_000, 0, 20_000_000, 0, 20_000_000], iter(range(7))
    gone_ns = 0

    def now_ns() -> int:
        nonlocal gone_ns
        gone_ns += away_ns[next(calls)] if begun else 0
        return time.monotonic_ns() + gone_ns

    begun = False
    reader = FrameReader(wire.receiver, lambda _classes, _data: False, now_ns, lambda: time.time_ns() + gone_ns)
    sent_ns = time.monotonic_ns()
    wire.send(1)
    begun = True
    (frame,) = reader.read()
    assert frame.t_rx_ns - sent_ns < 9_000_000
