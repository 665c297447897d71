import json
import os
import shutil
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import Final, Self

import pytest

from imud.contracts.publisher import Batch
from imud.formats import ring as shm_layout
from imud.formats import slot
from imud.formats.slot import PRESENT_BITS, SEQ_INVALID, SLOT_BYTES, SLOT_FIELDS, SYNC_CODES
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Sample
from imud.publishers.socket.client import Waker
from tests.support.rings import DEVICE, SLOTS, START_NS, TORN, WHOLE, Board, make_sample, place_sample, slot_at
from tests.support.surroundings import DAEMON_UID, HOSTILE_UID, needs_root

INCLUDE = Path(__file__).parents[2] / "imud" / "include"
READER = Path(__file__).with_name("reader.c")
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-O2", f"-I{INCLUDE}")
LANGUAGES: Final = {
    "c99": ("cc", "-std=c99", "-x", "c"), "gnu17": ("cc", "-std=gnu17", "-x", "c"),
    "c++11": ("c++", "-std=c++11", "-x", "c++"), "c++17": ("c++", "-std=c++17", "-x", "c++"),
}  # fmt: skip
STRESS_SAMPLES, STRESS_NS = 10_000, 200_000_000  # the stress test ends at the first of both limits

Build = Callable[[Path, str], Path]


@pytest.fixture(scope="module", name="build")
def _build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    folder = tmp_path_factory.mktemp("build")

    def build(source: Path, language: str) -> Path:
        compiler, *options = LANGUAGES[language]
        if shutil.which(compiler) is None:
            pytest.skip(f"cannot compile the C header: cannot find {compiler}")
        program = folder / f"{source.stem}-{language}"
        if not program.exists():
            command = [compiler, *STRICT, *options, str(source), "-o", str(program)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            assert done.stderr == ""
        return program

    return build


class Reader:
    """The compiled reader. Each `ask` sends one command and returns its reply."""

    def __init__(self, program: Path, ring: str | Path, files: tuple[int, ...] = ()) -> None:
        self._process = subprocess.Popen(
            [program, "commands", str(ring)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=files
        )

    @property
    def pid(self) -> int:
        return self._process.pid

    def ask(self, command: str) -> list[str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()
        return self._process.stdout.readline().split()

    def next(self) -> tuple[int, int]:
        """Return the sequence number of the next sample (0: no sample), and the number of missed samples before it."""
        _, _, seq, missed = self.ask("next")
        return int(seq), int(missed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._process.communicate()
        assert kind is not None or self._process.returncode == 0


@pytest.fixture(name="reader")
def _reader(build: Build, board: Board) -> Iterator[Reader]:
    program = build(READER, "c99")
    with Reader(program, board.path) as reader:
        assert reader.ask("latest") == ["latest", "0", "0"]  # the ring is now open
        yield reader


def layout_program() -> tuple[str, list[str]]:
    """Return a C program that prints the layout of the compiler, and the expected output from the Python tables."""
    lines, expected = [], []

    def add(name: str, expression: str, value: int) -> None:
        lines.append(f'    printf("{name} %llu\\n", (unsigned long long)({expression}));')
        expected.append(f"{name} {value}")

    for record, fields in (("slot", SLOT_FIELDS), ("header", shm_layout.HEADER_FIELDS)):
        for field in fields:
            size = struct.calcsize(f"<{field.count}{field.code}")
            add(f"{record}.{field.name}", f"offsetof(imud_{record}, {field.name})", field.offset)
            add(f"{record}.{field.name}.size", f"sizeof(((imud_{record} *)0)->{field.name})", size)
    for place, name in enumerate(LEDGER_FIELDS):
        add(name, f"IMUD_LEDGER_{name.upper()}", place)
    for sync, code in SYNC_CODES.items():
        add(sync, f"IMUD_SYNC_{sync.upper()}", code)
    bits = {name: bit for name, bit in vars(slot).items() if name.startswith("HAS_") and name != "HAS_MORE"}
    assert sorted(bits.values()) == sorted(PRESENT_BITS.values())
    for name, bit in bits.items():
        add(name, f"IMUD_{name}", bit)
    for name in ("HEADER_BYTES", "LEDGER_ROOM", "HEARTBEAT_LIMIT_NS", "STATE_LIVE", "STATE_CLOSED"):
        add(name, f"IMUD_{name}", getattr(shm_layout, name))
    add("slot bytes", "sizeof(imud_slot)", SLOT_BYTES)
    add("header bytes", "sizeof(imud_header)", shm_layout.HEADER_BYTES)
    add("layout", "IMUD_LAYOUT_VERSION", shm_layout.RING_LAYOUT_VERSION)
    add("slot layout", "IMUD_SLOT_LAYOUT_VERSION", slot.SLOT_LAYOUT_VERSION)
    add("no count", "IMUD_NO_COUNT", slot.NO_COUNT)
    add("invalid", "IMUD_SEQ_INVALID", SEQ_INVALID)
    add("magic", "sizeof IMUD_MAGIC", len(shm_layout.MAGIC))
    for name, at in (("update", 0), ("driver", 8), ("values", 40), ("crc32", 512)):
        add(f"ledger.{name}", f"offsetof(imud_ledger, {name})", at)
    return '#include "imud.h"\nint main(void)\n{\n' + "\n".join(lines) + "\n    return 0;\n}\n", expected


def numbers_of(s: Sample) -> list[float]:
    assert s.accel_m_s2 is not None
    assert s.gyro_rad_s is not None
    assert s.temperature_c is not None
    vectors = [part for pair in zip(s.accel_m_s2, s.gyro_rad_s, strict=True) for part in pair]
    present = slot.HAS_ACCEL | slot.HAS_GYRO | slot.HAS_TEMPERATURE
    return [s.seq, s.t_ns, s.t_rx_ns, s.utc_ns, s.t_err_ns, present, 3, 1, *vectors, s.temperature_c]


@pytest.mark.parametrize("language", LANGUAGES)
def test_layout_is_that_of_the_tables(build: Build, board: Board, tmp_path: Path, language: str) -> None:
    source = tmp_path / "layout.c"
    text, expected = layout_program()
    source.write_text(text)
    done = subprocess.run([build(source, language)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == expected
    with Reader(build(READER, language), board.path) as reader:
        assert reader.ask("latest") == ["latest", "0", "0"]
        board.publish([1, 2])
        for seq in (1, 2):
            assert [json.loads(word) for word in reader.ask("sample")] == numbers_of(make_sample(seq))
        assert reader.ask("latest") == ["latest", "1", "2"]
        assert reader.next() == (0, 0)


@pytest.mark.parametrize("count", [1, SLOTS - 1, SLOTS, SLOTS + 1, 3 * SLOTS + 5])
def test_slow_reader_learns_exactly_what_it_missed(board: Board, reader: Reader, count: int) -> None:
    board.publish(range(1, count + 1))
    first = max(1, count - SLOTS + 1)
    assert reader.next() == (first, first - 1)
    for seq in range(first + 1, count + 1):
        assert reader.next() == (seq, 0)
    assert reader.next() == (0, 0)


@pytest.mark.parametrize("name", TORN)
def test_torn_slot_is_refused(board: Board, reader: Reader, name: str) -> None:
    board.publish([1, 2])
    board.poke(slot_at(2), TORN[name])
    assert [reader.next(), reader.next()] == [(1, 0), (0, 0)]
    assert reader.ask("latest") == ["latest", "0", "0"]
    board.poke(slot_at(2), WHOLE)
    assert reader.next() == (2, 0)
    board.publish([3, 4])
    board.poke(slot_at(3), TORN[name])
    assert reader.next() == (0, 0)
    board.publish([5])
    assert [reader.next(), reader.next(), reader.next()] == [(4, 1), (5, 0), (0, 0)]


def test_a_position_is_read_and_protected_by_the_crc(board: Board, reader: Reader) -> None:
    board.publish_samples([place_sample(1), make_sample(2), place_sample(3)])
    assert [reader.next(), reader.next(), reader.next()] == [(1, 0), (2, 0), (3, 0)]
    board.poke(slot_at(3) + 290, b"\x55")
    assert reader.ask("latest") == ["latest", "0", "0"]


def test_number_that_changes_during_the_copy_and_gaps(board: Board, reader: Reader) -> None:
    board.publish([1])
    reader.ask(f"poke {board.path} {slot_at(1) + 7} 255 1")  # high byte of the sequence number
    assert reader.next() == (0, 0)
    board.poke(slot_at(1) + 7, b"\0")
    assert reader.next() == (1, 0)
    board.publish([5000])
    assert reader.next() == (5000, 4999 - 1)
    board.publish([1])
    assert reader.next() == (1, 0)  # the numbers start again
    for now_ns, health in (
        (START_NS + 999_999_999, "0"), (START_NS + 1_000_000_000, "2"), (START_NS - 999_999_999, "0"),
        (START_NS - 1_000_000_000, "2"), (-(1 << 63), "2"),
    ):  # fmt: skip
        assert reader.ask(f"health {now_ns}") == ["health", health]
    board.publisher.close()
    assert reader.ask(f"health {START_NS}") == ["health", "1"]


def test_restarted_daemon(board: Board, reader: Reader, tmp_path: Path) -> None:
    board.publish([1])
    assert reader.ask("reopen") == ["reopen", "0", "77"]
    board.publisher.close()
    assert reader.ask("reopen") == ["reopen", "-1", "77"]
    successor = Board(tmp_path, epoch=78)
    successor.publish(range(1, SLOTS + 3))
    assert reader.next() == (1, 0)  # the old ring is still mapped
    assert reader.ask("reopen") == ["reopen", "1", "78"]
    assert reader.next() == (3, 2)
    successor.publisher.close()


def test_removed_ring(board: Board, reader: Reader) -> None:
    """The same daemon continues its sequence numbers in a new file, so the reader must not count samples as missed."""
    board.publish([1, 2])
    assert reader.next() == (1, 0)
    board.path.unlink()
    board.tick()
    board.publish([3, 4])
    assert reader.ask(f"health {board.now_ns}") == ["health", "1"]
    assert [reader.next(), reader.next()] == [(2, 0), (0, 0)]
    assert reader.ask("reopen") == ["reopen", "1", "77"]
    assert [reader.next(), reader.next(), reader.next()] == [(3, 0), (4, 0), (0, 0)]
    board.path.unlink()
    board.publish([5])
    board.tick()
    board.publish([6])
    assert reader.ask("reopen") == ["reopen", "1", "77"]
    assert reader.next() == (6, 1)


@pytest.mark.parametrize("size_bytes", [0, 1, shm_layout.HEADER_BYTES, shm_layout.HEADER_BYTES + SLOT_BYTES])
def test_cut_ring(board: Board, reader: Reader, size_bytes: int) -> None:
    """`health` reports the cut before the reader touches a missing page."""
    board.publish([1])
    os.truncate(board.path, size_bytes)
    assert reader.ask(f"health {board.now_ns}") == ["health", "1"]
    board.publish([2])
    assert reader.ask(f"health {board.now_ns}") == ["health", "1"]
    assert reader.next() == (0, 0)
    board.tick()
    board.publish([3])
    assert reader.ask("reopen") == ["reopen", "1", "77"]
    assert reader.ask(f"health {board.now_ns}") == ["health", "0"]
    assert [reader.next(), reader.next()] == [(3, 2), (0, 0)]


def test_new_ring_before_its_first_sample_and_descriptors_of_reopened_rings(board: Board, reader: Reader) -> None:
    def count() -> int:
        return len(os.listdir(f"/proc/{reader.pid}/fd"))

    before = count()
    board.publish([1, 2])
    os.truncate(board.path, 0)
    board.tick()
    assert reader.ask("reopen") == ["reopen", "1", "77"]
    assert [reader.next(), reader.next()] == [(0, 2), (0, 0)]
    board.publish([3])
    assert reader.next() == (3, 0)
    for _ in range(10):
        board.path.unlink()
        board.tick()
        assert reader.ask("reopen") == ["reopen", "1", "77"]
    assert count() == before


def run_reader(build: Build, *arguments: str, language: str = "c99", **environment: str) -> str:
    """Return the name of the error when the reader opens a ring, or "open"."""
    done = subprocess.run(
        [build(READER, language), "commands", *arguments], stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=False, env=environment or None, timeout=60,
    )  # fmt: skip
    assert done.returncode in (0, 1)
    return done.stdout.split(" ", 2)[1] if done.returncode else "open"


def test_directories_of_names(build: Build, tmp_path: Path) -> None:
    """If IMUD_SHM is set, it is the only directory. Otherwise the directory of the user is used if the system directory
    has no such ring."""
    own = tmp_path / "imud" / "shm"
    own.mkdir(parents=True)
    device = "no-such-device-of-the-tests"
    opened = partial(run_reader, build, device)

    assert opened(XDG_RUNTIME_DIR=str(tmp_path)) == "-1"
    header = shm_layout.encode_header(shm_layout.RingHeader(1, 2, 1, device, 0, SLOTS))
    (own / f"imud.{device}").write_bytes(header + bytes(SLOTS * SLOT_BYTES))
    assert opened(XDG_RUNTIME_DIR=str(tmp_path)) == "open"
    assert opened(XDG_RUNTIME_DIR=str(tmp_path), IMUD_SHM="") == "open"
    assert opened(IMUD_SHM=str(own)) == "open"
    assert opened(XDG_RUNTIME_DIR=str(tmp_path), IMUD_SHM="/nowhere") == "-1"
    assert opened(XDG_RUNTIME_DIR="relative") == "-1"
    assert opened(XDG_RUNTIME_DIR="/" + "x" * 300) == "-1"
    assert opened(IMUD_SHM="/" + "x" * 300) == "-6"


def test_other_files_and_names_are_refused_without_a_wait(build: Build, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("fifo")
    (tmp_path / "directory").mkdir()
    for name in ("fifo", "link", "directory"):
        assert run_reader(build, str(tmp_path / name)) == "-3", name
    for name, code in (("", "-6"), ("x" * 250, "-6"), ("no-such-device-of-the-tests", "-1")):
        assert run_reader(build, name) == code, name


@needs_root
@pytest.mark.parametrize("language", ["c99", "c++17"])
def test_owner(build: Build, board: Board, language: str) -> None:
    """Like the Python reader, accept a ring of root, of the owner of the directory, or of the given user."""

    def opened(directory_uid: int, file_uid: int, *named_uid: int) -> str:
        os.chown(board.path.parent, directory_uid, -1)
        os.chown(board.path, file_uid, -1)
        return run_reader(build, str(board.path), *map(str, named_uid), language=language)

    assert opened(0, HOSTILE_UID) == "-8"
    assert opened(0, HOSTILE_UID, DAEMON_UID) == "-8"
    assert opened(DAEMON_UID, HOSTILE_UID) == "-8"
    assert opened(0, DAEMON_UID, DAEMON_UID) == "open"
    assert opened(DAEMON_UID, DAEMON_UID) == "open"
    assert opened(DAEMON_UID, 0, HOSTILE_UID) == "open"


@needs_root
def test_owner_of_a_ring_that_is_opened_again(board: Board, reader: Reader) -> None:
    board.die()
    os.chown(board.path, HOSTILE_UID, -1)
    assert reader.ask("reopen") == ["reopen", "-8", "77"]
    os.chown(board.path, 0, -1)
    assert reader.ask("reopen") == ["reopen", "1", "77"]


def test_ledger(board: Board, reader: Reader) -> None:
    assert reader.ask("ledger") == ["ledger", "0"]
    for number, name in enumerate(LEDGER_FIELDS):
        setattr(board.ledger, name, (1 << 40) + number)
    board.tick()
    expected = ["ledger", "1", *(str((1 << 40) + i) for i in range(len(LEDGER_FIELDS))), "hipnuc-uart"]
    assert reader.ask("ledger") == expected
    reader.ask(f"poke {board.path} {shm_layout.LEDGER_BLOCK_OFFSET + 7} 255 1")
    assert reader.ask("ledger") == ["ledger", "0"]  # the ledger changed during the copy
    board.poke(shm_layout.LEDGER_BLOCK_OFFSET + 7, b"\0")
    assert reader.ask("ledger") == expected
    board.poke(shm_layout.LEDGER_BLOCK_OFFSET + 100, b"\1")
    assert reader.ask("ledger") == ["ledger", "0"]
    board.poke(shm_layout.LEDGER_BLOCK_OFFSET, shm_layout.encode_ledger_block(SEQ_INVALID, "", [0] * 24))
    assert reader.ask("ledger") == ["ledger", "0"]


def test_wait(build: Build, board: Board) -> None:
    waker = Waker()
    fd = waker.client_end
    with Reader(build(READER, "c99"), board.path, (fd,)) as reader:
        assert reader.ask(f"wait {fd} 0") == ["wait", "0"]
        assert reader.ask("wait -1 0") == ["wait", "0"]
        assert waker.wake()
        assert waker.wake()
        assert reader.ask(f"wait {fd} 10000") == ["wait", "1"]
        assert reader.ask(f"wait {fd} 0") == ["wait", "0"]
        assert waker.wake()
        waker.close()
        assert reader.ask(f"wait {fd} 10000") == ["wait", "1"]
        assert reader.ask(f"wait {fd} 10000") == ["wait", "-7"]
        assert reader.ask("wait 999 10000") == ["wait", "-5"]


def header_with(name: str, value: int) -> bytes:
    raw = bytearray(shm_layout.encode_header(shm_layout.RingHeader(1, 2, 1, DEVICE, 0, SLOTS)))
    struct.pack_into("<I", raw, shm_layout.OFFSETS[name], value)
    return bytes(raw) + bytes(SLOTS * SLOT_BYTES)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (None, -1), (b"", -3), (bytes(shm_layout.HEADER_BYTES), -3), (header_with("layout_version", 1), -4),
        (header_with("slot_layout_version", 3), -4), (header_with("slot_bytes", 512), -4),
        (header_with("header_bytes", 8192), -4), (header_with("slot_count", 63), -3),
        (header_with("slot_count", 2 * SLOTS), -3), (header_with("ledger_count", 60), -3),
    ],
)  # fmt: skip
def test_what_cannot_be_opened(build: Build, tmp_path: Path, content: bytes | None, code: int) -> None:
    path = tmp_path / "imud.x"
    if content is not None:
        path.write_bytes(content)
    assert run_reader(build, str(path)) == str(code)


@pytest.mark.live
@pytest.mark.parametrize("slots_in_ring", [1, SLOTS])
def test_no_torn_sample_and_none_unaccounted_under_stress(build: Build, tmp_path: Path, slots_in_ring: int) -> None:
    """A ring with one slot is the hardest case: reader and writer always use the same slot."""
    board = Board(tmp_path, slots=slots_in_ring)
    batches = stress_batches()
    command = [str(build(READER, "c99")), "stress", str(board.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        done, end_ns = 0, time.monotonic_ns() + STRESS_NS
        for batch in batches:
            if time.monotonic_ns() >= end_ns:
                break
            board.publisher.publish(batch)
            done += len(batch.samples)
            os.sched_yield()
        board.publisher.close()
        read, missed, torn, missed_total = (int(word) for word in process.stdout.readline().split())
    assert process.returncode == 0
    assert torn == 0
    assert read + missed == done
    assert missed == missed_total
    assert read > 0


def stress_batches() -> list[Batch]:
    """Return encoded batches. Some are small enough for the reader, others overtake it."""
    random, batches, done = Random(2), [], 0
    while done < STRESS_SAMPLES:
        end = min(done + random.choice((1, 1, 1, 5, 20, 100)), STRESS_SAMPLES)
        batch = Batch(DEVICE, 3, [make_sample(seq) for seq in range(done + 1, end + 1)])
        assert batch.packed
        batches.append(batch)
        done = end
    return batches
