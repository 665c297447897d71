import errno
import fcntl
import grp
import logging
import mmap
import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any, Self
from unittest.mock import Mock

import msgspec
import pytest

from imud.client.ring import Ring
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.formats import kernel
from imud.formats import ring as layout
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES, encode_slot
from imud.model.errors import ServerError
from imud.model.ledger import LEDGER_FIELDS
from imud.model.units import NS_PER_S
from imud.publishers import shm as ring
from imud.publishers.shm import ShmOptions, ShmPublisher
from tests.support.files import ROOT
from tests.support.publisher_context import FakeLatencies, publisher_context
from tests.support.rings import DEVICE, SLOTS, START_NS, Board, make_sample, place_sample, slot_at


def make(folder: Path, **settings: Any) -> ShmPublisher:
    context = publisher_context(list, 1, lambda: START_NS)
    return ShmPublisher(ShmOptions(directory=str(folder), slots=SLOTS, **settings), context)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"slots": 1000}, "power of two, got 1000; try 512 or 1024"), ({"slots": 32}, ">= 64"),
        ({"slots": 1 << 21}, "<= 1048576"), ({"mode": 640}, "<= 511"),
        ({"mode": 0o660}, "mode: expected no write permission for group and others, got 0o660"),
        ({"mode": 0o602}, "got 0o602"), ({"directory": "shm"}, "absolute path"), ({"slotz": 64}, "slotz"),
    ],
)  # fmt: skip
def test_invalid_options_are_reported(values: dict[str, object], message: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert(values, ShmOptions)


def test_the_file_of_a_ring_and_its_slots(board: Board) -> None:
    header = layout.decode_header(board.path.read_bytes()[: layout.HEADER_BYTES], "x")
    assert header == layout.RingHeader(77, os.getpid(), layout.STATE_LIVE, DEVICE, 3, SLOTS, 0, 1, START_NS)
    status = board.path.stat()
    assert status.st_size == layout.HEADER_BYTES + SLOTS * SLOT_BYTES
    assert status.st_blocks * 512 >= status.st_size  # st_blocks counts units of 512 bytes: all blocks are allocated
    board.publish([1, 2])
    board.publish([3])
    assert (board.word("newest_seq"), board.word("first_seq")) == (3, 1)
    board.publish(range(4, SLOTS + 3))
    raw = board.path.read_bytes()
    for seq in range(3, SLOTS + 3):
        assert raw[slot_at(seq) :][:SLOT_BYTES] == encode_slot(make_sample(seq), 3)
    assert len(raw) == layout.HEADER_BYTES + SLOTS * SLOT_BYTES
    board.publish([507, 508])  # the gap moves the first number
    assert (board.word("first_seq"), board.word("newest_seq")) == (507, 508)


def test_ring_is_complete_before_it_appears(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[bool, layout.RingHeader, int]] = []
    rename = os.rename
    for name in (f".imud.{DEVICE}.new", ".imud.x", "x.new"):  # the first is a file of a dead daemon
        (tmp_path / name).write_bytes(b"half")

    def spy(source: str, target: str, **directories: int) -> None:
        file = tmp_path / source
        mode = stat.S_IMODE(file.stat().st_mode)
        seen.append(
            ((tmp_path / target).exists(), layout.decode_header(file.read_bytes()[: layout.HEADER_BYTES], "x"), mode)
        )
        rename(source, target, **directories)

    monkeypatch.setattr(os, "rename", spy)
    board = Board(tmp_path)
    [(existed, header, mode)] = seen
    assert (existed, header.device, header.state, mode) == (False, DEVICE, layout.STATE_LIVE, 0o640)
    assert {file.name for file in tmp_path.iterdir()} == {f"imud.{DEVICE}", ".imud.x", "x.new"}
    board.publisher.close()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("found", [kernel.present, kernel.Kernel(None)], ids=["kernel", "python"])
def test_batches_and_single_samples_write_the_same_bytes(
    tmp_path: Path, seed: int, found: kernel.Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = Random(seed)
    for name in ("one", "many"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(kernel, "present", found)
    many = Board(tmp_path / "many")
    monkeypatch.setattr(kernel, "present", kernel.Kernel(None))
    one = Board(tmp_path / "one")
    seq = 0
    for _ in range(40):
        numbers = []
        for _ in range(random.choice((1, 2, 5, 20, SLOTS, SLOTS + 7))):
            seq += 1 if random.random() < 0.97 else random.randint(2, 2 * SLOTS)
            numbers.append(seq)
        samples = [random.choice((make_sample, place_sample))(number) for number in numbers]
        many.publish_samples(samples)
        for sample in samples:
            one.publish_samples([sample])
        driver, counts = random.choice(("", "x" * 31, "é" * 16)), random.choices((0, 7, (1 << 64) - 1), k=2)
        for board in (one, many):
            board.driver, (board.ledger.bytes_in, board.ledger.frames_lost) = driver, counts
            board.tick(random.choice((0, NS_PER_S // 2, NS_PER_S)) if board is one else one.now_ns - many.now_ns)
        written = [board.path.read_bytes() for board in (one, many)]
        assert written[0][layout.OFFSETS["newest_seq"] :] == written[1][layout.OFFSETS["newest_seq"] :]
    one.publisher.close()
    many.publisher.close()


Notes = list[tuple[int, int, object]]


class Spy:
    """Buffer in front of a memoryview that stores position and length of each write, bytes."""

    def __init__(self, target: memoryview, notes: Notes) -> None:
        self.target, self.notes = target, notes

    def cast(self, code: Any) -> "Spy":
        return Spy(self.target.cast(code), self.notes)

    def __setitem__(self, at: Any, value: Any) -> None:
        width, is_run = self.target.itemsize, isinstance(at, slice)
        places, values = (range(*at.indices(len(self.target))), value.tolist()) if is_run else ([at], [value])
        self.notes += [(place * width, width, one) for place, one in zip(places, values, strict=True)]
        self.target[at] = value

    def release(self) -> None:
        self.target.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.target.release()


class SpyMap(mmap.mmap):
    notes: Notes | None = None

    def __setitem__(self, at: Any, value: Any) -> None:
        assert self.notes is not None
        self.notes.append((at.start, at.stop - at.start, bytes(value)))
        super().__setitem__(at, value)


def test_order_of_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: Notes = []
    with monkeypatch.context() as patch:
        patch.setattr(ring, "memoryview", lambda memory: Spy(memoryview(memory), notes), raising=False)
        patch.setattr(SpyMap, "notes", notes)
        patch.setattr(mmap, "mmap", SpyMap)
        patch.setattr(kernel, "present", kernel.Kernel(None))
        board = Board(tmp_path)
    monkeypatch.setattr(SpyMap, "notes", notes)
    board.publish([1])
    slot = encode_slot(make_sample(1), 3)
    assert notes == [
        (slot_at(1), 8, SEQ_INVALID), (slot_at(1) + 8, SLOT_BYTES - 8, slot[8:]), (slot_at(1), 8, 1),
        (layout.OFFSETS["newest_seq"], 8, 1),
    ]  # fmt: skip
    notes.clear()
    board.publish([2, 3])
    slots = [encode_slot(make_sample(seq), 3)[8:] for seq in (2, 3)]
    assert notes == [
        (slot_at(2), 8, SEQ_INVALID), (slot_at(3), 8, SEQ_INVALID),
        (slot_at(2) + 8, 2 * SLOT_BYTES - 8, SEQ_INVALID.to_bytes(8, "little").join(slots)), (slot_at(2), 8, 2),
        (slot_at(3), 8, 3), (layout.OFFSETS["newest_seq"], 8, 3),
    ]  # fmt: skip
    notes.clear()
    board.tick()
    update = layout.OFFSETS["ledger_update"]
    assert notes[0] == (layout.OFFSETS["heartbeat_ns"], 8, board.now_ns)
    assert [note[:2] for note in notes[1:]] == [(update, 8), (update + 8, layout.LEDGER_BLOCK_BYTES - 8), (update, 8)]
    assert [notes[1][2], notes[3][2]] == [SEQ_INVALID, 1]
    board.publisher.close()


def ledger_in(path: Path, count: int = len(LEDGER_FIELDS)) -> layout.LedgerBlock:
    block = layout.decode_ledger_block(
        path.read_bytes()[layout.LEDGER_BLOCK_OFFSET :][: layout.LEDGER_BLOCK_BYTES], count
    )
    assert block is not None
    return block


def test_tick_shows_ledger_driver_and_heartbeat_and_writes_what_changed(board: Board) -> None:
    updates = []
    for bytes_in, driver in ((0, ""), (0, ""), (5, ""), (5, ""), (5, "hipnuc-uart")):
        board.ledger.bytes_in, board.driver = bytes_in, driver
        board.tick(NS_PER_S)
        updates.append(board.word("ledger_update"))
    assert updates == [1, 1, 2, 2, 3]
    for number, name in enumerate(LEDGER_FIELDS):
        setattr(board.ledger, name, 1000 + number)
    board.tick(NS_PER_S // 2)
    assert board.word("ledger_update") == 3  # imud writes the ledger once per second, and the heartbeat in each tick
    assert board.word("heartbeat_ns") == board.now_ns
    board.tick(NS_PER_S // 2)
    block = ledger_in(board.path)
    assert (block.update, block.driver, block.ledger) == (4, "hipnuc-uart", board.ledger.snapshot())
    assert board.word("heartbeat_ns") == board.now_ns


def test_a_tick_reads_ledgers_without_the_complete_state(tmp_path: Path) -> None:
    def whole_state() -> list[DeviceStatus]:
        raise AssertionError("the state of every device was made for its ledger")

    counts = dict.fromkeys(LEDGER_FIELDS, 7)
    context = publisher_context(
        whole_state, 1, lambda: START_NS, ledgers=lambda: [(DEVICE, "imu61x-uart", tuple(counts.values()))]
    )
    publisher = ShmPublisher(ShmOptions(directory=str(tmp_path), slots=SLOTS), context)
    publisher.add_device(DEVICE, 3)
    publisher.tick(START_NS)
    block = ledger_in(tmp_path / f"imud.{DEVICE}")
    assert (block.driver, block.ledger) == ("imu61x-uart", counts)
    publisher.close()


def test_close_marks_the_ring_and_removes_the_file(board: Board) -> None:
    latencies = board.context.latencies
    assert isinstance(latencies, FakeLatencies)
    assert latencies.asked == {"shared memory": (5_000_000, None)}
    with board.path.open("rb") as file:
        board.ledger.bytes_in, board.now_ns = 9, START_NS + 7
        board.publisher.close()
        assert latencies.asked == {}
        raw = file.read()
    header = layout.decode_header(raw[: layout.HEADER_BYTES], "x")
    block = layout.decode_ledger_block(raw[layout.LEDGER_BLOCK_OFFSET :][: layout.LEDGER_BLOCK_BYTES], 1)
    assert (header.state, header.heartbeat_ns) == (layout.STATE_CLOSED, START_NS + 7)
    assert block is not None
    assert block.ledger == {"bytes_in": 9}
    assert not list(board.path.parent.iterdir())
    board.publisher.close()
    board = Board(board.path.parent)
    successor = board.path.with_name("other")
    successor.write_bytes(b"new")
    successor.rename(board.path)
    board.publisher.close()
    assert board.path.read_bytes() == b"new"


def test_events_and_unknown_devices_are_ignored(board: Board) -> None:
    before = board.path.read_bytes()
    assert board.publisher.event is None
    board.publisher.publish(Batch("another", 4, [make_sample(1, "another")]))
    assert board.path.read_bytes() == before
    with pytest.raises(ServerError, match="without '/'"):
        board.publisher.add_device("../imu", 4)
    assert board.path.exists()
    board.publisher.remove_device(DEVICE)
    assert not board.path.exists()
    board.publish([1])  # a batch that arrives late
    board.tick()
    assert not board.path.exists()
    board.publisher.remove_device(DEVICE)
    starting = make(board.path.parent)
    starting.add_device(DEVICE, 3)
    with pytest.raises(ServerError, match="without '/'"):
        starting.add_device("../imu", 4)
    assert not board.path.exists(), "a daemon that does not start leaves no ring"


def other_writer(path: Path, pid: int, *, heartbeat_ns: int = START_NS - 1, state: int = layout.STATE_LIVE) -> None:
    header = layout.RingHeader(5, pid, state, DEVICE, 0, SLOTS, heartbeat_ns=heartbeat_ns)
    path.write_bytes(layout.encode_header(header))


OTHER_DAEMON = """
import sys, time
from pathlib import Path
from tests.support.files import ROOT
from tests.support.rings import Board, slot_at, TORN, WHOLE
board = Board(Path(sys.argv[1]))
print("ready", flush=True)
time.sleep(60)
"""


@contextmanager
def other_daemon(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start another process with a ring in `folder`. Kill it at the end."""
    command = [sys.executable, "-c", OTHER_DAEMON, str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def test_locks_of_other_processes(tmp_path: Path) -> None:
    with other_daemon(tmp_path) as other:
        with pytest.raises(ServerError, match=f"another imud writes this ring, process {other.pid}: stop it first"):
            Board(tmp_path, now_ns=START_NS + 60_000_000_000)  # the age of its heartbeat has no effect
        other.kill()
        other.wait()
        Board(tmp_path).publisher.close()  # the ring can be created immediately
    first = Board(tmp_path)
    first.die()
    with first.path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        Board(tmp_path, epoch=78).publisher.close()
    first.publisher.close()


def test_ring_of_another_daemon_is_not_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    board = Board(tmp_path)
    board.path.unlink()
    with other_daemon(tmp_path) as other:
        inode = board.path.stat().st_ino
        for _ in range(30):
            board.tick()
        assert board.path.stat().st_ino == inode
        board.publish([1])
        assert [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR] == [
            f"shm: no ring for {DEVICE}: {board.path}: another imud writes this ring, process {other.pid}:"
            " stop it first; trying again every second"
        ]
        other.kill()
        other.wait()
        board.tick()
    assert (board.path.stat().st_ino == inode, board.word("newest_seq"), board.word("first_seq")) == (False, 1, 2)
    board.publisher.close()


def dead_pid() -> int:
    with subprocess.Popen([sys.executable, "-S", "-c", ""]) as process:
        process.wait()
        return process.pid


@pytest.mark.parametrize(
    "leave",
    [
        lambda path: other_writer(path, dead_pid()),  # a killed daemon that systemd restarted
        lambda path: other_writer(path, os.getppid()),  # another process has the same number
        lambda path: other_writer(path, 1, heartbeat_ns=1 << 62),
        lambda path: other_writer(path, os.getppid(), state=layout.STATE_CLOSED),
        lambda path: path.write_bytes(b"of another version"),
    ],
)
def test_file_of_an_earlier_daemon_is_replaced(tmp_path: Path, leave: Callable[[Path], object]) -> None:
    path = tmp_path / f"imud.{DEVICE}"
    leave(path)
    with path.open("rb") as old:
        before = old.read()
        board = Board(tmp_path)
        board.publish([1])
        old.seek(0)
        assert (old.read(), board.word("epoch")) == (before, 77)
        board.publisher.close()


def test_ring_in_full_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The daemon runs without the ring, logs it once, and creates the ring when there is room."""
    tries: list[int] = []

    def refuse(*_: object) -> None:
        tries.append(board.now_ns if tries else START_NS)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    descriptors = len(os.listdir("/proc/self/fd"))
    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", refuse)
        board = Board(tmp_path)
        for _ in range(30):
            board.tick(100_000_000)
        board.publish([1, 2, 3])
    assert [(at - START_NS) // 1_000_000 for at in tries] == [0, 100, 1100, 2100]
    assert len(os.listdir("/proc/self/fd")) == descriptors + 1  # the descriptor of the directory
    assert (board.context.outputs.rings, board.context.outputs.without_ring) == ({}, {DEVICE})
    [record] = (record for record in caplog.records if record.levelno == logging.ERROR)
    assert re.search(r"imud.imu0 with 24576 bytes: No space left .* reduce shm.slots", record.getMessage())
    assert not list(tmp_path.iterdir())
    board.tick()
    with Ring(board.path, now_ns=lambda: board.now_ns) as reader:
        board.publish([4])
        assert ([s.seq for s in reader.read().samples], reader.missed) == ([4], 0)
    assert (board.context.outputs.rings, board.context.outputs.without_ring) == ({DEVICE: str(board.path)}, set())
    board.path.unlink()
    descriptors = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(mmap, "mmap", Mock(side_effect=OSError(errno.ENOMEM, "Cannot allocate memory")))
    board.tick()
    assert f"cannot map 24576 bytes of imud.{DEVICE}: Cannot allocate memory" in caplog.text
    assert (board.path.exists(), len(os.listdir("/proc/self/fd"))) == (False, descriptors)
    assert board.context.outputs.without_ring == {DEVICE}
    board.publisher.close()
    assert not board.context.outputs.without_ring


def test_unusable_paths_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    publisher = make(Path("/proc"))
    publisher.add_device(DEVICE, 0)
    assert "check the permissions of /proc" in caplog.text
    publisher.publish(Batch(DEVICE, 0, [make_sample(1)]))
    publisher.close()
    with pytest.raises(ServerError, match="expected a directory for shared memory"):
        make(tmp_path / "none" / "shm").start()
    assert not (tmp_path / "none").exists()
    made = make(tmp_path / "made")
    made.start()
    assert (tmp_path / "made").is_dir()
    made.close()
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    with pytest.raises(ServerError, match="cannot create files in"):
        make(tmp_path).start()


@pytest.mark.parametrize("exists", [False, True])
def test_group_that_does_not_exist_or_cannot_be_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, exists: bool
) -> None:
    group, why = "no-such-group", "does not exist;"
    if exists:
        group = next(one.gr_name for one in grp.getgrall() if one.gr_gid != os.getegid())
        why = f"does not contain user {os.geteuid()}, so imud cannot give it files;"
        monkeypatch.setattr(os, "fchown", Mock(side_effect=PermissionError(errno.EPERM, "Operation not permitted")))
    publisher = make(tmp_path, group=group)
    with caplog.at_level(logging.WARNING):
        publisher.start()
        publisher.add_device("a", 0)
        publisher.add_device("b", 1)
    assert [record.getMessage() for record in caplog.records] == [
        f"shm: group {group} {why} its members cannot read shared memory"
    ]
    assert (tmp_path / "imud.a").stat().st_gid == os.getegid()
    publisher.close()


def test_group_and_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "fchown", lambda _, user, group: given.append((user, group)))
    publisher = make(tmp_path, group=grp.getgrgid(os.getegid()).gr_name, mode=0o604)
    publisher.start()
    publisher.add_device("a", 0)
    assert (given, stat.S_IMODE((tmp_path / "imud.a").stat().st_mode)) == ([(-1, os.getegid())], 0o604)
    publisher.close()


@pytest.mark.parametrize("content", [b"notes of the user\n", bytes(1 << 16), layout.MAGIC[:-1]])
def test_foreign_file_is_kept(tmp_path: Path, content: bytes) -> None:
    """A file of this user that has the name of a ring keeps its content under another name."""
    path = tmp_path / f"imud.{DEVICE}"
    path.write_bytes(content)
    board = Board(tmp_path)
    assert path.read_bytes().startswith(layout.MAGIC)
    path.unlink()
    path.write_bytes(content)
    board.tick(NS_PER_S)
    assert path.read_bytes().startswith(layout.MAGIC)
    board.publisher.close()
    assert [file.read_bytes() for file in tmp_path.glob(".imud.*.foreign")] == [content] * 2
