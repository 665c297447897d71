"""The cache: whole or absent, made once, and one clear line when it cannot be made."""

import fcntl
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.lab.host import cache
from tests.lab.host.errors import LabError


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("IMUD_LAB_CACHE", str(folder))
    return folder


def ignore(_line: str) -> None:
    """Nobody listens."""


def make_file(folder: Path) -> None:
    """A build that succeeds."""
    (folder / "file").write_text("built", encoding="utf-8")


def fail(folder: Path) -> None:
    """A build that fails after it wrote something."""
    (folder / "build.log").write_text("cc: oh", encoding="utf-8")
    raise LabError("build failed")


def never(_folder: Path) -> None:
    """A build that must not happen."""
    raise AssertionError("built again")


def names(root: Path) -> set[str]:
    """What the cache holds."""
    return {entry.name for entry in root.iterdir()}


def test_key_depends_on_every_part_and_their_borders() -> None:
    keys = {
        cache.key_of(*parts) for parts in ((b"ab", b"c"), (b"a", b"bc"), (b"abc",), (b"ab", b"c", b""), (b"ab", b"d"))
    }
    assert len(keys) == 5
    assert cache.key_of(b"ab", b"c") == cache.key_of(b"ab", b"c")


def test_made_once_then_found(root: Path) -> None:
    first = cache.get("lab-1", make_file, 1, ignore)
    assert (first / "file").read_text(encoding="utf-8") == "built"
    assert cache.get("lab-1", never, 1, ignore) == first
    assert names(root) == {"lock", "lab-1"}


def test_two_builds_at_once_make_one(root: Path) -> None:
    """The second finds the lock taken, says so, and takes the first one's result."""
    inside, told = threading.Event(), threading.Event()
    made, said = [], []

    def slow(folder: Path) -> None:
        inside.set()
        assert told.wait(20)
        made.append(folder)
        make_file(folder)

    def listen(line: str) -> None:
        said.append(line)
        told.set()

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(cache.get, "lab-1", slow, 1, ignore)
        assert inside.wait(20)
        second = pool.submit(cache.get, "lab-1", never, 1, listen)
        assert first.result(20) == second.result(20)
    assert len(made) == 1
    assert said == ["another build is under way; waiting for it"]
    assert names(root) == {"lock", "lab-1"}


def test_lock_that_never_comes_free(root: Path) -> None:
    root.mkdir()
    with open(root / "lock", "w", encoding="ascii") as holder:
        fcntl.flock(holder, fcntl.LOCK_EX)
        with (
            pytest.raises(LabError, match=r"another build has held .*lock for 0 s"),
            cache.locked(root, ignore, wait_s=0.0),
        ):
            pass


def test_failed_build_leaves_its_log_only(root: Path) -> None:
    with pytest.raises(LabError, match=r"build failed \(log: .*failed-build.log\)"):
        cache.get("lab-1", fail, 1, ignore)
    assert names(root) == {"lock", "failed-build.log"}
    assert cache.get("lab-1", make_file, 1, ignore).is_dir()


def test_no_space(root: Path) -> None:
    with pytest.raises(LabError, match=r"no space: .* GB free, the build needs 1000000000.0 GB"):
        cache.get("lab-1", never, 10**18, ignore)
    assert names(root) == {"lock"}


def test_unwritable_place_is_one_line(root: Path) -> None:
    root.parent.joinpath("cache").write_text("a file", encoding="utf-8")
    with pytest.raises(LabError, match=r"cache folder .*: .*exists"):
        cache.get("lab-1", never, 1, ignore)


def test_leftovers_and_old_folders_go_with_the_next_build(root: Path) -> None:
    for name in ("new-killed", "lab-old", "lab-recent"):
        (root / name).mkdir(parents=True)
    long_ago_s = time.time() - cache.MAX_AGE_S - 60
    os.utime(root / "lab-old", (long_ago_s, long_ago_s))
    cache.get("lab-1", make_file, 1, ignore)
    assert names(root) == {"lock", "lab-1", "lab-recent"}


def test_use_keeps_a_folder_young(root: Path) -> None:
    folder = cache.get("lab-1", make_file, 1, ignore)
    os.utime(folder, (0, 0))
    assert cache.find("lab-1") == folder
    assert folder.stat().st_mtime > time.time() - 60
    assert names(root) == {"lock", "lab-1"}


@pytest.mark.parametrize("path", ["/tmp/a b", "/tmp/a:b", "/tmp/a#b"])
def test_path_that_make_cannot_carry(monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.setenv("IMUD_LAB_CACHE", path)
    with pytest.raises(LabError, match="make needs a path without"):
        cache.cache_root()


def test_default_place_follows_xdg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("IMUD_LAB_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_root() == tmp_path / "imud-lab"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert cache.cache_root() == Path("/home/somebody/.cache/imud-lab")
