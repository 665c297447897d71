"""Hostile users of a directory of rings: they can neither stop nor mislead the daemon."""

import errno
import logging
import os
import resource
import signal
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic_ns
from typing import Final

import pytest

from imud.cli import main
from imud.client.ring import Ring
from imud.formats.ring import HEADER_BYTES, STATE_CLOSED, STATE_LIVE, RingHeader, decode_header, encode_header
from imud.formats.slot import SLOT_BYTES
from imud.model.errors import ServerError
from imud.publishers import shm as directory
from imud.publishers.shm import RingDirectory, directory_problem, open_directory
from tests.support.daemon_process import running_daemon, wait_until, write_config
from tests.support.pty_port import NOBODY_UID, unprivileged
from tests.support.rings import DEVICE, SLOTS, START_NS, Board, make_sample
from tests.support.surroundings import DAEMON_UID, HOSTILE_UID, needs_root, python_as

RING_BYTES: Final = HEADER_BYTES + SLOTS * SLOT_BYTES
FORGED: Final = encode_header(
    RingHeader(5, 1, STATE_LIVE, DEVICE, 0, SLOTS, newest_seq=1 << 60, first_seq=1 << 59, heartbeat_ns=1 << 62)
)  # fmt: skip


@pytest.fixture(name="shared")
def _shared() -> Iterator[Path]:
    """Return a directory with the rights of /dev/shm: every user can create files, only owners can remove them."""
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-test-") as name:
        os.chmod(name, 0o1777)
        yield Path(name)


HOSTILE: Final[dict[str, Callable[[Path], object]]] = {
    "FIFO": os.mkfifo, "symbolic link to a file": lambda path: path.symlink_to("/etc/passwd"),
    "symbolic link to nothing": lambda path: path.symlink_to("/nowhere/at/all"),
    "directory": lambda path: path.mkdir(), "directory with content": lambda path: (path / "file").mkdir(parents=True),
    "device node": lambda path: os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(5, 0)),  # /dev/tty
    "forged ring": lambda path: path.write_bytes(FORGED + bytes(SLOTS * SLOT_BYTES)),
    "forged header": lambda path: path.write_bytes(FORGED),
    "empty file": lambda path: path.touch(),
    "huge file": lambda path: subprocess.run(["truncate", "-s", "1T", path], check=True),
}  # fmt: skip


def plant(path: Path, kind: str) -> None:
    HOSTILE[kind](path)
    os.chown(path, HOSTILE_UID, HOSTILE_UID, follow_symlinks=False)


@needs_root
@pytest.mark.parametrize("kind", [kind for kind in HOSTILE if kind != "directory with content"])
def test_other_files_with_the_name_are_replaced(shared: Path, kind: str) -> None:
    """As root, the daemon can replace files of other users."""
    plant(shared / f"imud.{DEVICE}", kind)
    board = Board(shared)
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        board.publish([1])
        assert ring.read() == ([make_sample(1)], 0)
    board.publisher.close()
    assert not list(shared.iterdir())


@needs_root
@pytest.mark.parametrize("kind", HOSTILE)
def test_names_of_unfinished_rings(shared: Path, kind: str) -> None:
    """The daemon removes temporary files of a dead daemon.

    It neither opens nor needs the names of other users' files.
    """
    plant(shared / f".imud.{DEVICE}.new", kind)
    (shared / ".imud.mine.new").touch()
    board = Board(shared)
    assert sorted(file.name for file in shared.iterdir()) == [f".imud.{DEVICE}.new", f"imud.{DEVICE}"]
    board.publisher.close()


DAEMON: Final = """
import sys
from pathlib import Path
from tests.support.rings import DEVICE, Board
board = Board(Path(sys.argv[1]))
board.publisher.add_device("other", 4)
for line in sys.stdin:
    command, number = line.split()
    if command == "publish":
        board.publish([int(number)])
    board.tick(int(number) if command == "tick" else 100_000_000)
    print("done", flush=True)
board.publisher.close()
"""


def ask(process: subprocess.Popen[str], command: str) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(command + "\n")
    process.stdin.flush()
    assert process.stdout.readline() == "done\n", process.stderr and process.stderr.read()


@needs_root
@pytest.mark.parametrize("kind", ["FIFO", "directory with content", "forged ring"])
def test_a_file_that_cannot_be_replaced_affects_one_ring_only(shared: Path, kind: str) -> None:
    """Without this permission, the daemon creates the ring when the name is free."""
    path = shared / f"imud.{DEVICE}"
    plant(path, kind)
    with python_as(DAEMON_UID, DAEMON, str(shared)) as daemon:
        ask(daemon, "publish 7")
        assert (path.lstat().st_uid, (shared / "imud.other").stat().st_uid) == (HOSTILE_UID, DAEMON_UID)
        path.rename(shared.parent / f"{shared.name}-away")
        ask(daemon, "tick 1000000000")
        ask(daemon, "publish 8")
        header = decode_header(path.read_bytes()[:HEADER_BYTES], "ring")
        assert (header.newest_seq, header.first_seq, path.stat().st_uid) == (8, 8, DAEMON_UID)
        _, errors = daemon.communicate()
    away = shared.parent / f"{shared.name}-away"
    subprocess.run(["rm", "-rf", away], check=True)
    assert daemon.returncode == 0, errors
    assert errors.count("no ring for imu0") == 1
    assert not list(shared.iterdir())


@needs_root
@pytest.mark.live
@pytest.mark.parametrize("kind", ["FIFO", "directory with content"])
def test_daemon_starts_reloads_and_stops(tmp_path: Path, shared: Path, kind: str) -> None:
    """Start, reload and SIGTERM of a daemon process. `running_daemon` waits for its end."""
    nothing = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    another = {**nothing, "uart": {"port": str(tmp_path / "nothing"), "baud": 115200}}
    for name in ("bow", "stern"):
        plant(shared / f"imud.{name}", kind)
    with running_daemon(tmp_path, {"bow": nothing}, shm={"directory": str(shared)}) as daemon:
        daemon.wait_for("bow", "missing")
        write_config(tmp_path, {"bow": nothing, "stern": another}, shm={"directory": str(shared)})
        daemon.signal(signal.SIGHUP)
        wait_until(lambda: "stern" in daemon.statuses(), "the second device")
        daemon.wait_for("stern", "missing")


# ---- the directory -------------------------------------------------------------------------------------------------


@needs_root
@pytest.mark.parametrize(
    ("uid", "mode", "message"),
    [
        (HOSTILE_UID, 0o755, f"belongs to user {HOSTILE_UID}, who can replace the rings: expected root as its owner"),
        (HOSTILE_UID, 0o1777, f"belongs to user {HOSTILE_UID}, who can replace the rings"),
        (0, 0o777, "has mode 0777: other users can replace the rings; chmod go-w"),
        (0, 0o775, "has mode 0775: other users can replace"),
    ],
)
def test_directory_that_other_users_can_change_is_rejected(shared: Path, uid: int, mode: int, message: str) -> None:
    shared.chmod(mode)
    os.chown(shared, uid, uid)
    with pytest.raises(ServerError, match=message):
        RingDirectory(str(shared))


@pytest.mark.parametrize(
    ("make", "why"), [(lambda path: path.symlink_to("real"), "a symbolic link"), (os.mkfifo, "Not a directory")]
)
def test_paths_that_are_not_a_directory_are_rejected(tmp_path: Path, make: Callable[[Path], object], why: str) -> None:
    (tmp_path / "real").mkdir()
    make(tmp_path / "shm")
    with pytest.raises(ServerError, match=rf"expected a directory for shared memory \({why}\)"):
        RingDirectory(str(tmp_path / "shm"))


def test_directory_of_the_user_replaces_a_missing_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    system, own = tmp_path / "none" / "imud" / "shm", tmp_path / "run"
    own.mkdir()
    monkeypatch.setattr(directory, "DIRECTORY", str(system))
    monkeypatch.setattr("imud.formats.ring.DIRECTORY", str(system))
    umask = os.umask(0o077)
    try:
        found = open_directory(str(system), {"XDG_RUNTIME_DIR": str(own)})
    finally:
        os.umask(umask)
    assert found.path == str(own / "imud" / "shm")
    assert stat.S_IMODE(Path(found.path).stat().st_mode) == 0o755
    assert caplog.messages == [
        f"shm: {system}: expected a directory for shared memory (No such file or directory); "
        f"create it, or set shm.directory; using {found.path}"
    ]
    found.close()
    with pytest.raises(ServerError, match="expected a directory"):
        open_directory(str(system), {})
    system.parent.parent.mkdir()
    found = open_directory(str(system), {"XDG_RUNTIME_DIR": str(own)})
    assert found.path == str(system)
    found.close()


@needs_root
def test_a_user_without_a_directory_is_told_before_the_start(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`imud check` reports that `imud run` of this user cannot create rings, and creates nothing."""
    shared.chmod(0o755)
    system, own, file = shared / "imud" / "shm", shared / "run", shared / "bow.yaml"
    own.mkdir()
    os.chown(own, NOBODY_UID, NOBODY_UID)
    for name in ("imud.publishers.shm.DIRECTORY", "imud.formats.ring.DIRECTORY"):
        monkeypatch.setattr(name, str(system))
    problem = f"cannot create shared memory in {system}; set shm.directory, or XDG_RUNTIME_DIR"
    with unprivileged():
        for environment, expected in (({}, problem), ({"XDG_RUNTIME_DIR": str(own)}, "")):
            assert directory_problem(str(system), environment).endswith(expected)
            assert bool(directory_problem(str(system), environment)) == bool(expected)
        assert (directory_problem(str(own), {}), directory_problem(str(own / "none"), {})) == ("", "")
        assert "create its parent, or set" in directory_problem(str(own / "none" / "shm"), {})
    assert directory_problem(str(system), {}) == ""  # root
    with unprivileged(), pytest.raises(ServerError, match="; or set XDG_RUNTIME_DIR"):
        open_directory(str(system), {})
    file.write_text(f"shm: {{directory: {own}/none/shm}}\ndevices: {{}}\n")
    assert main(["check", str(file)]) == 0
    assert (
        f"{file}: note: shm: user root cannot create shared memory in {own}/none/shm; create its parent, or set "
        "shm.directory; ignore this note if another user runs the daemon"
    ) in capsys.readouterr().out.splitlines()
    assert sorted(shared.rglob("*")) == [file, own]


def test_reader_searches_all_directories_of_the_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "imud" / "shm"
    own.mkdir(parents=True)
    (tmp_path / "system").mkdir()
    monkeypatch.setattr("imud.formats.ring.DIRECTORY", str(tmp_path / "system"))
    monkeypatch.delenv("IMUD_SHM", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(ServerError, match=f"{tmp_path}/system/imud.imu0: no such ring"):
        Ring(DEVICE)
    boards = []
    for folder in (own, tmp_path / "system"):  # the directory of the system is first if both exist
        boards.append(Board(folder))
        with Ring(DEVICE) as ring:
            assert ring.path.parent == folder
    for board in boards:
        board.publisher.close()


# ---- changes of a ring in use --------------------------------------------------------------------------------------


def test_removed_ring_is_created_again(board: Board, caplog: pytest.LogCaptureFixture) -> None:
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        board.publish([1, 2])
        board.path.unlink()
        board.publish([3])
        assert ring.read() == ([make_sample(seq) for seq in (1, 2, 3)], 0)  # writer and reader still map the file
        board.publish([4])
        board.tick()
        board.publish([5, 6])
        assert ring.read() == ([make_sample(4)], 0)  # the reader reads the old ring to its end
        assert ring.read() == ([make_sample(5), make_sample(6)], 0)
        assert (ring.epoch, ring.missed) == (77, 0)
    assert f"the ring file of {DEVICE} was missing or truncated; created it again" in caplog.text
    assert board.word("first_seq") == 5
    with Ring(board.path, now_ns=lambda: board.now_ns) as slow:
        board.publish([7, 8])
        board.path.unlink()
        board.tick()
        board.publish(range(9, 9 + 2 * SLOTS))
        assert slow.read() == ([make_sample(7), make_sample(8)], 0)
        samples, missed = slow.read()
        assert [sample.seq for sample in samples] == list(range(9 + SLOTS, 9 + 2 * SLOTS))
        assert missed == SLOTS


@pytest.mark.parametrize("size_bytes", [0, 1, HEADER_BYTES, HEADER_BYTES + SLOT_BYTES])
@pytest.mark.parametrize("first", ["publish", "tick", "read", "close"])
def test_truncated_ring_is_created_again(tmp_path: Path, size_bytes: int, first: str) -> None:
    board = Board(tmp_path)
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        board.publish([1, 2])
        assert ring.latest() == make_sample(2)
        os.truncate(board.path, size_bytes)
        if first == "close":
            board.publisher.close()
            assert ring.read() == ([], 0)
            return
        if first == "read":
            assert (ring.read(), ring.latest(), ring.ledger(), ring.newest_seq) == (([], 0), None, None, 0)
            assert not ring.alive(board.now_ns)
        if first == "publish":
            board.publish([3])
        board.tick()
        board.publish([4])
        assert ring.read() == ([make_sample(4)], 3)
        assert ring.alive(board.now_ns)
    assert board.path.stat().st_size == RING_BYTES
    board.publisher.close()


def test_a_ring_truncated_completely_and_by_a_byte_and_replaced(board: Board) -> None:
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        board.publish([1, 2])
        os.truncate(board.path, 0)
        board.tick()
        assert ring.read() == ([], 2)
        board.publish([3])
        assert ring.read() == ([make_sample(3)], 0)
        board.publish([4])
        os.truncate(board.path, RING_BYTES - 1)
        board.publish([5])
        board.tick()
        board.publish([6])
        assert ring.read() == ([make_sample(4)], 0)
        assert ring.read() == ([make_sample(6)], 1)
        other = board.path.with_name("other")
        other.write_bytes(FORGED + bytes(SLOTS * SLOT_BYTES))
        other.rename(board.path)  # another file replaces the ring
        board.publish([7])
        assert ring.read() == ([make_sample(7)], 0)
        board.tick()
        board.publish([8])
        assert ring.read() == ([make_sample(8)], 0)
    # imud restores the size for a reader that does not check the file, and marks the file as closed
    with board.path.open("rb") as file:
        os.truncate(board.path, 0)
        board.publish([9])
        raw = file.read()
    assert (len(raw), raw[44], any(raw[HEADER_BYTES:])) == (RING_BYTES, STATE_CLOSED, False)


def test_directory_removed_and_created_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "parent" / "shm"
    folder.mkdir(parents=True)
    board = Board(folder)
    caplog.clear()
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        board.path.unlink()
        folder.rmdir()
        folder.parent.rmdir()
        for seq in range(1, 16):
            board.publish([seq])
            board.tick()
        assert ring.read() == ([make_sample(seq) for seq in range(1, 16)], 0)
        assert len([record for record in caplog.records if record.levelno == logging.ERROR]) == 2  # one per problem
        folder.mkdir(parents=True)
        board.tick()
        board.publish([16])
        assert ring.read() == ([make_sample(16)], 0)
    board.publisher.close()
    assert not list(folder.iterdir())


# a fixture of tests/conftest.py checks the descriptors
def test_descriptors_are_closed_and_none_is_left(board: Board, caplog: pytest.LogCaptureFixture) -> None:
    with Ring(board.path, now_ns=lambda: board.now_ns) as ring:
        for _ in range(20):
            os.truncate(board.path, 5)
            board.tick()
            board.path.unlink()
            board.tick()
            ring.read()
    board.path.unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
        board.tick()
        board.publish([1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert os.strerror(errno.EMFILE) in caplog.text
    board.tick()
    assert board.path.exists()


@needs_root
def test_full_tmpfs(tmp_path: Path) -> None:
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k,mode=1777", "x", tmp_path], check=False).returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        (tmp_path / "filler").write_bytes(bytes(250_000))
        board = Board(tmp_path)
        board.publish([1])
        board.tick()
        assert not board.path.exists()
        (tmp_path / "filler").unlink()
        board.tick()
        left = os.statvfs(tmp_path).f_bfree * 4096
        (tmp_path / "filler").write_bytes(bytes(left))
        assert os.statvfs(tmp_path).f_bfree == 0
        board.publish(range(2, 2 + 2 * SLOTS))
        os.truncate(board.path, 0)
        board.publish([200])
        board.tick()
        assert board.path.stat().st_size == RING_BYTES
        board.publisher.close()
    finally:
        subprocess.run(["umount", "-l", tmp_path], check=True)


def test_a_reader_of_a_fifo_and_of_a_forged_ring_and_names_of_rings_in_a_message(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "imud.x")
    (tmp_path / "imud.y").symlink_to("imud.x")
    with pytest.raises(ServerError, match=r"expected a regular file \(-\), got another kind \(p\)"):
        Ring(tmp_path / "imud.x")
    with pytest.raises(ServerError, match="cannot read"):
        Ring(tmp_path / "imud.y")
    (tmp_path / "imud.z").write_bytes(FORGED + bytes(SLOTS * SLOT_BYTES))
    with Ring(tmp_path / "imud.z") as ring:
        assert not ring.alive(monotonic_ns())
        assert not ring.alive(START_NS)
        assert ring.latest() is None
        assert ring.read() == ([], 0)
    for name in ("bow", "\x1b[31m", "a\nb", "c" * 100, *(f"n{i}" for i in range(100))):
        (tmp_path / f"imud.{name}").touch()
    with pytest.raises(ServerError) as caught:
        Ring("none", directory=str(tmp_path))
    message = str(caught.value)
    assert message.isprintable()
    assert "bow, n0, n1, n10," in message
    assert len(message) < 500


def test_the_search_for_temporary_files_is_limited(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(directory, "LEFTOVERS_MAX", 3)
    for number in range(10):
        (shared / f".imud.{number}.new").touch()
    RingDirectory(str(shared)).close()
    assert len(list(shared.iterdir())) == 7
