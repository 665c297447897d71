"""Waiting for files through inotify."""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from imud.errors import LinkError
from imud.links import inotify
from imud.links.inotify import directories_of, wait_until

LIMIT_S = 5.0
SOON_S = 0.5
"""Far more than inotify takes (under 1 ms), far less than any poll would be worth."""


async def noticed_after(path: Path, ready: Callable[[], bool], act: Callable[[], object]) -> float:
    """Seconds from `act` to the end of the wait, which must not end before."""
    waiting = asyncio.create_task(wait_until(path, ready))
    loop = asyncio.get_running_loop()
    for _ in range(20):  # let it set its watch
        await asyncio.sleep(0)
    assert not waiting.done()
    started_s = loop.time()
    act()
    await asyncio.wait_for(waiting, LIMIT_S)
    return loop.time() - started_s


def run(path: Path, ready: Callable[[], bool], act: Callable[[], object]) -> None:
    assert asyncio.run(noticed_after(path, ready, act)) < SOON_S


def test_a_file_that_is_there_needs_no_watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inotify, "DirectoryWatch", None)
    asyncio.run(wait_until(tmp_path, tmp_path.exists))


def test_a_new_file_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    run(path, path.exists, path.touch)


def test_a_renamed_file_is_noticed(tmp_path: Path) -> None:
    path, other = tmp_path / "tty", tmp_path / "other"
    other.touch()
    run(path, path.exists, lambda: other.rename(path))


def test_a_missing_directory_is_waited_for_level_by_level(tmp_path: Path) -> None:
    path = tmp_path / "serial" / "by-id" / "usb-imu"

    async def scene() -> None:
        waiting = asyncio.create_task(wait_until(path, path.exists))
        for directory in (path.parent.parent, path.parent):
            for _ in range(20):
                await asyncio.sleep(0)
            directory.mkdir()
        path.touch()
        await asyncio.wait_for(waiting, LIMIT_S)

    asyncio.run(scene())


def test_the_target_of_a_dangling_link_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "by-id").mkdir()
    target = tmp_path / "ttyUSB0"
    path = tmp_path / "by-id" / "usb-imu"
    path.symlink_to("../ttyUSB0")
    run(path, path.exists, target.touch)


def test_a_change_of_mode_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    path.touch(0o600)
    run(path, lambda: bool(path.stat().st_mode & 0o060), lambda: path.chmod(0o660))


def test_other_changes_do_not_end_the_wait(tmp_path: Path) -> None:
    path = tmp_path / "tty"

    async def scene() -> None:
        waiting = asyncio.create_task(wait_until(path, path.exists))
        for number in range(5):
            for _ in range(10):
                await asyncio.sleep(0)
            (tmp_path / f"other{number}").touch()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.shield(waiting), 0.02)
        path.touch()
        await asyncio.wait_for(waiting, LIMIT_S)

    asyncio.run(scene())


def test_waiting_does_not_poll(tmp_path: Path) -> None:
    path, asked = tmp_path / "tty", 0

    def ready() -> bool:
        nonlocal asked
        asked += 1
        return path.exists()

    async def scene() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(wait_until(path, ready), 0.05)

    asyncio.run(scene())
    assert asked == 2  # before and after the watch was set


def test_a_cancelled_wait_leaves_no_descriptor(tmp_path: Path) -> None:
    def descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))

    async def scene() -> None:
        before = descriptors()
        waiting = asyncio.create_task(wait_until(tmp_path / "tty", (tmp_path / "tty").exists))
        for _ in range(20):
            await asyncio.sleep(0)
        assert descriptors() == before + 1
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        await asyncio.get_running_loop().shutdown_default_executor()
        assert descriptors() == before

    asyncio.run(scene())


def test_no_instance_left_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Exhausted:
        def inotify_init1(self, flags: int) -> int:
            return -1

    monkeypatch.setattr(inotify, "libc", Exhausted())
    with pytest.raises(LinkError, match="max_user_instances"):
        asyncio.run(wait_until(tmp_path / "tty", (tmp_path / "tty").exists))


def test_a_directory_that_may_not_be_read_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inotify.DirectoryWatch, "add", lambda self, directory: False)
    with pytest.raises(LinkError, match="may this user read"):
        asyncio.run(wait_until(tmp_path / "tty", (tmp_path / "tty").exists))


def test_directories_of_a_link(tmp_path: Path) -> None:
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "a").symlink_to("../missing/tty")
    found = [directory.resolve() for directory in directories_of(tmp_path / "by-id" / "a")]
    assert found == [tmp_path / "by-id", tmp_path]


def test_directories_of_a_circular_link_end(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert directories_of(tmp_path / "a") == [tmp_path]
