import errno
import mmap
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import Mock

import pytest

from imud.client.ring import Ring, default_directory
from imud.formats.ring import HEADER_BYTES, LEDGER_BLOCK_OFFSET, OFFSETS, encode_ledger_block
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES
from imud.model.errors import LinkMissing, ServerError
from imud.publishers.socket.client import Waker
from tests.support.rings import DEVICE, SLOTS, START_NS, TORN, WHOLE, Board, make_sample, place_sample, slot_at
from tests.support.surroundings import DAEMON_UID, HOSTILE_UID, needs_root


@pytest.fixture(name="ring")
def _ring(board: Board) -> Iterator[Ring]:
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        yield ring


def numbers(ring: Ring) -> tuple[list[int], int]:
    samples, missed = ring.read()
    for sample in samples:
        assert sample == make_sample(sample.seq)
    return [sample.seq for sample in samples], missed


def test_opens_by_name(board: Board) -> None:
    board.publish([1])
    with Ring(DEVICE, directory=str(board.path.parent)) as ring:
        assert (ring.path, ring.epoch, ring.newest_seq) == (board.path, 77, 1)
        assert (ring.header.device, ring.header.pid, ring.header.slot_count) == (DEVICE, os.getpid(), SLOTS)


def test_no_such_ring_and_no_permission(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ServerError, match=r"imud.imu9: no such ring; there are rings for: imu0"):
        Ring("imu9", directory=str(tmp_path))
    for number in range(40):
        (tmp_path / f"imud.x{number:02}").touch()
    with pytest.raises(ServerError, match=r"there are rings for: imu0, x00, (x\d\d, ){29}x30$"):
        Ring("imu9", directory=str(tmp_path))
    (tmp_path / "none").mkdir()
    with pytest.raises(ServerError, match="is imud running"):
        Ring("imu9", directory=str(tmp_path / "none"))
    (tmp_path / "imud.x").write_bytes(b"hello")
    with pytest.raises(ServerError, match="is not a ring of imud"):
        Ring("x", directory=str(tmp_path))
    with pytest.raises(ServerError, match=r"not a ring file: expected a regular file \(-\), got another kind \(d\)"):
        Ring(tmp_path)
    os.truncate(board.path, HEADER_BYTES + SLOTS * SLOT_BYTES - 1)
    with pytest.raises(ServerError, match="expected 24576 bytes, got 24575"):
        Ring(board.path)
    refuse = Mock(side_effect=PermissionError(13, "Permission denied"))
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(ServerError, match="add this user to the group"):
        Ring(board.path)


def test_directory_of_the_environment(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMUD_SHM", str(tmp_path))
    with Ring(DEVICE) as ring:
        assert ring.path == board.path
    with pytest.raises(ServerError, match=r"/nowhere/imud\.imu0: no such ring"):
        Ring(DEVICE, directory="/nowhere")  # the argument has priority over IMUD_SHM
    monkeypatch.setenv("IMUD_SHM", "")
    assert default_directory() == "/run/imud/shm"
    monkeypatch.delenv("IMUD_SHM")
    assert default_directory() == "/run/imud/shm"
    first, second = tmp_path / "first", tmp_path / "second"
    monkeypatch.setattr("imud.client.ring.default_directories", lambda _: [str(first), str(second)])
    for folder, expected in ((first, first), (second, second), (first, first)):  # the first folder has priority
        folder.mkdir(exist_ok=True)
        (folder / board.path.name).touch()
        assert default_directory(DEVICE) == str(expected)
        assert (default_directory(), default_directory("other")) == (str(first), str(first))
        if expected == first:
            (folder / board.path.name).unlink()
    (first / board.path.name).touch()
    assert default_directory(DEVICE) == str(first)


def test_errors_of_the_system_are_named(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(ServerError, match=r"cannot read .*loop: Too many levels of symbolic links"):
        Ring(tmp_path / "loop")
    fail = Mock(side_effect=OSError(errno.ENOMEM, "Cannot allocate memory"))
    monkeypatch.setattr(mmap, "mmap", fail)
    with pytest.raises(ServerError, match="Cannot allocate memory"):
        Ring(board.path)


@needs_root
def test_owner(board: Board) -> None:
    for mode in (0o1777, 0o755):
        board.path.parent.chmod(mode)
        os.chown(board.path, HOSTILE_UID, -1)
        with pytest.raises(ServerError, match=f"belongs to user {HOSTILE_UID}: expected root"):
            Ring(board.path)
        with pytest.raises(ServerError, match="expected root or user"):
            Ring(board.path, owner_uid=DAEMON_UID)
        Ring(board.path, owner_uid=HOSTILE_UID).close()
        os.chown(board.path.parent, DAEMON_UID, -1)
        os.chown(board.path, DAEMON_UID, -1)
        Ring(board.path).close()
        os.chown(board.path, 0, -1)
        Ring(board.path, owner_uid=HOSTILE_UID).close()
        os.chown(board.path.parent, 0, -1)
    # the reader refuses a file of another user at the path of a removed ring, and opens the next file of the daemon
    board.publish([1])
    os.chown(board.path, DAEMON_UID, -1)
    with Ring(board.path, from_oldest=True, owner_uid=DAEMON_UID, now_ns=lambda: board.now_ns) as ring:
        assert numbers(ring) == ([1], 0)
        board.die()
        os.chown(board.path, HOSTILE_UID, -1)
        with pytest.raises(ServerError, match="expected root or user"):
            ring.reopen()
        os.chown(board.path, DAEMON_UID, -1)
        assert ring.reopen()


@pytest.mark.usefixtures("ring")
def test_reader_cannot_write(board: Board) -> None:
    maps = Path("/proc/self/maps").read_text().splitlines()
    assert sorted(line.split()[1] for line in maps if line.endswith(str(board.path))) == ["r--s", "rw-s"]


def test_a_position_is_read_and_protected_by_the_crc(board: Board, ring: Ring) -> None:
    board.publish_samples([place_sample(1), make_sample(2), place_sample(3)])
    assert ring.read().samples == [place_sample(1), make_sample(2), place_sample(3)]
    board.poke(slot_at(3) + 290, b"\x55")
    assert ring.latest() is None


def test_read_returns_the_samples_after_opening(board: Board, ring: Ring) -> None:
    assert ring.latest() is None
    board.publish(range(1, 6))
    assert ring.latest() == make_sample(5)
    assert numbers(ring) == ([*range(1, 6)], 0)
    assert ring.latest() == make_sample(5)
    with Ring(board.path, now_ns=lambda: board.now_ns) as later:
        assert numbers(later) == ([], 0)
        board.publish([6])
        assert numbers(later) == ([6], 0)
        assert numbers(later) == ([], 0)


@pytest.mark.parametrize(("count", "expected"), [(0, []), (3, [1, 2, 3]), (SLOTS + 2, [*range(3, SLOTS + 3)])])
def test_read_can_begin_with_the_oldest_sample_in_the_ring(board: Board, count: int, expected: list[int]) -> None:
    board.publish(range(1, count + 1))
    with Ring(board.path, from_oldest=True, now_ns=lambda: board.now_ns) as ring:
        assert numbers(ring) == (expected, 0)
        board.publish([count + 1])
        assert numbers(ring) == ([count + 1], 0)


@pytest.mark.parametrize("count", [1, SLOTS - 1, SLOTS, SLOTS + 1, 3 * SLOTS + 5])
def test_a_slow_reader_gets_the_exact_number_of_missed_samples(board: Board, ring: Ring, count: int) -> None:
    board.publish(range(1, count + 1))
    first = max(1, count - SLOTS + 1)
    assert numbers(ring) == (list(range(first, count + 1)), first - 1)
    assert ring.missed == first - 1


@pytest.mark.parametrize("seed", range(3))
def test_every_sample_is_read_or_missed(board: Board, ring: Ring, seed: int) -> None:
    random, last, seen, missed = Random(seed), 0, 0, 0
    for _ in range(30):
        count = random.choice((0, 1, 5, SLOTS - 1, SLOTS, SLOTS + 1, 2 * SLOTS))
        board.publish(range(last + 1, last + 1 + count))
        last += count
        if random.random() < 0.6:
            got, lost = numbers(ring)
            assert got == list(range(seen + missed + lost + 1, last + 1))
            seen, missed = seen + len(got), missed + lost
            assert seen + missed == last
    assert ring.missed == missed


@pytest.mark.parametrize("name", TORN)
def test_an_incomplete_slot_is_refused_until_it_is_complete_or_overwritten(board: Board, ring: Ring, name: str) -> None:
    board.publish([1, 2])
    board.poke(slot_at(2), TORN[name])
    assert ring.latest() is None
    assert numbers(ring) == ([1], 0)
    assert numbers(ring) == ([], 0)  # it may still arrive: another core may see the store late
    board.poke(slot_at(2), WHOLE)
    assert numbers(ring) == ([2], 0)
    board.publish([3])
    board.poke(slot_at(3), TORN[name])
    assert numbers(ring) == ([], 0)
    board.publish([4])
    assert numbers(ring) == ([4], 1)
    assert numbers(ring) == ([], 0)


class MeanwhileMap(mmap.mmap):
    """Runs a function between the read of a slot's sequence number and its copy, or just after the copy."""

    before: Callable[[], None] | None = None
    after: Callable[[], None] | None = None

    def __getitem__(self, at: Any) -> Any:
        before, self.before = self.before, None
        if before is not None:
            before()
        raw = super().__getitem__(at)
        after, self.after = self.after, None
        if after is not None:
            after()
        return raw


@contextmanager
def mapped(board: Board) -> Iterator[tuple[Ring, MeanwhileMap]]:
    made: list[MeanwhileMap] = []

    def make(*arguments: Any, **options: Any) -> MeanwhileMap:
        made.append(MeanwhileMap(*arguments, **options))
        return made[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mmap, "mmap", make)
        ring = Ring(board.path, now_ns=lambda: board.now_ns)
    with ring:
        yield ring, made[0]


@pytest.mark.parametrize("moment", ["before", "after"])
def test_overwritten_while_reading(board: Board, moment: str) -> None:
    with mapped(board) as (ring, memory):
        board.publish(range(1, SLOTS + 1))
        setattr(memory, moment, lambda: board.publish([SLOTS + 1]))
        assert numbers(ring) == (list(range(2, SLOTS + 2)), 1)


def test_writer_begins_the_slot_while_it_is_copied(board: Board) -> None:
    with mapped(board) as (ring, memory):
        board.publish(range(1, SLOTS + 1))
        memory.after = lambda: board.poke(slot_at(1), struct.pack("<Q", SEQ_INVALID))
        assert numbers(ring) == ([], 0)
        board.publish([SLOTS + 1])
        assert numbers(ring) == (list(range(2, SLOTS + 2)), 1)


def test_latest_overtaken_while_copying(board: Board) -> None:
    with mapped(board) as (ring, memory):
        board.publish([1])
        memory.before = lambda: board.publish(range(2, SLOTS + 2))
        assert ring.latest() == make_sample(SLOTS + 1)


def test_sequence_numbers_with_a_gap_and_after_a_restart(board: Board, ring: Ring) -> None:
    board.publish([1, 2, 3])
    board.publish([5000, 5001])
    assert numbers(ring) == ([5000, 5001], 4999)
    board.publish([1, 2])
    assert numbers(ring) == ([1, 2], 0)
    # the reader sees the new `first` before the new `newest`
    board.poke(OFFSETS["first_seq"], struct.pack("<Q", 5000))
    board.publish([3])
    assert numbers(ring) == ([3], 0)
    board.publish([5000])
    assert numbers(ring) == ([5000], 4996)


def test_restart_after_a_clean_end(board: Board, ring: Ring, tmp_path: Path) -> None:
    board.publish([1, 2, 3])
    board.publisher.close()
    assert not ring.alive(board.now_ns)
    assert numbers(ring) == ([1, 2, 3], 0)  # the reader reads the old ring to its end
    assert numbers(ring) == ([], 0)
    assert ring.epoch == 77
    successor = Board(tmp_path, epoch=78)
    successor.publish([1, 2])
    assert numbers(ring) == ([1, 2], 0)
    assert ring.epoch == 78
    assert ring.alive(successor.now_ns)
    successor.publisher.close()


def test_restart_after_a_daemon_that_died(board: Board, ring: Ring, tmp_path: Path) -> None:
    board.publish([1, 2])
    assert numbers(ring) == ([1, 2], 0)
    board.die()
    successor = Board(tmp_path, epoch=78)
    successor.publish(range(1, SLOTS + 4))
    board.now_ns = START_NS + 999_999_999
    assert numbers(ring) == ([], 0)  # the old heartbeat is still valid
    board.now_ns += 1
    assert ring.latest() == make_sample(SLOTS + 3)
    assert numbers(ring) == (list(range(4, SLOTS + 4)), 3)
    assert ring.epoch == 78
    successor.publisher.close()


def test_torn_slot_does_not_hold_a_reader_at_a_dead_daemon(board: Board, ring: Ring, tmp_path: Path) -> None:
    board.publish([1, 2])
    board.poke(slot_at(1), bytes(8))
    board.publisher.close()
    successor = Board(tmp_path, epoch=78)
    successor.publish([1])
    assert numbers(ring) == ([1], 0)
    assert ring.epoch == 78
    successor.publisher.close()


def test_successor_of_another_layout(board: Board, ring: Ring) -> None:
    board.publisher.close()
    board.path.write_bytes(b"imudshm\0" + bytes(HEADER_BYTES))
    with pytest.raises(ServerError, match="the same version"):
        ring.read()


def test_heartbeat_ledger_and_reopen(board: Board, ring: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not ring.reopen()  # the file did not change
    assert ring.alive(START_NS + 999_999_999)
    assert not ring.alive(START_NS + 1_000_000_000)
    assert ring.ledger() is None
    board.ledger.bytes_in = board.ledger.bytes_skipped = 12345678901
    board.tick(900_000_000)
    assert ring.alive(START_NS + 1_800_000_000)
    block = ring.ledger()
    assert block is not None
    assert (block.update, block.driver, block.ledger) == (1, "hipnuc-uart", board.ledger.snapshot())
    board.publisher.close()
    assert not ring.reopen()
    opened = os.open

    def remove_and_open(path: Path, flags: int) -> int:
        path.unlink()
        return opened(path, flags)

    board.path.touch()
    monkeypatch.setattr(os, "open", remove_and_open)
    assert not ring.reopen()  # removed between the check of the file and its opening


@pytest.mark.parametrize(
    ("at", "data"),
    [
        (0, b"\xff" * 8), (8, b"X"), (40, b"\1"), (0, struct.pack("<Q", 2)), (512, b"\0\0\0\0"),
        (0, encode_ledger_block(SEQ_INVALID, "", [0] * 24)),
    ],
)  # fmt: skip
def test_torn_ledger_is_refused(board: Board, ring: Ring, at: int, data: bytes) -> None:
    board.tick()
    board.poke(LEDGER_BLOCK_OFFSET + at, data)
    assert ring.ledger() is None


def test_ledger_that_changes_while_it_is_copied(board: Board) -> None:
    with mapped(board) as (ring, memory):
        board.tick()

        def change() -> None:
            board.ledger.bytes_in = 5
            board.tick()

        memory.after = change
        block = ring.ledger()
        assert block is not None
        assert (block.update, block.ledger["bytes_in"]) == (2, 5)


def test_wait_also_when_another_was_faster(ring: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    waker = Waker()
    fd = os.dup(waker.client_end)
    try:
        assert not ring.wait(fd, 0)
        for _ in range(3):
            assert waker.wake()
        assert ring.wait(fd)
        assert not ring.wait(fd, 0)
        assert waker.wake()
        waker.close()
        assert ring.wait(fd)
        for _ in range(2):  # the descriptor stays readable; the error prevents a busy loop
            with pytest.raises(LinkMissing, match="call notify again"):
                ring.wait(fd)
    finally:
        waker.close()
        os.close(fd)
    waker = Waker()
    assert waker.wake()
    read = os.read

    def late(fd: int, size: int) -> bytes:
        read(fd, size)
        return read(fd, size)

    monkeypatch.setattr(os, "read", late)
    assert ring.wait(waker.client_end, 0)
    waker.close()


def test_close_twice(board: Board) -> None:
    ring = Ring(board.path)
    ring.close()
    ring.close()
    maps = Path("/proc/self/maps").read_text().splitlines()
    assert [line.split()[1] for line in maps if line.endswith(str(board.path))] == ["rw-s"]  # the writer
