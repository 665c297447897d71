"""Waits for files with inotify."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from imud.links import device_node as inotify
from imud.links.device_node import directories_of, wait_until
from imud.model.errors import LinkError
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import in_loop
from tests.support.leaks import open_descriptors


async def turns(count: int = 20) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def run(path: Path, ready: Callable[[], bool], act: Callable[[], object]) -> None:
    """Check that a wait ends after `act` and not before."""

    async def scene() -> None:
        waiting = asyncio.create_task(wait_until(path, ready))
        await turns()
        assert not waiting.done()
        act()
        await asyncio.wait_for(waiting, LIMIT_S)

    asyncio.run(scene())


def test_a_file_that_is_there_needs_no_watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inotify, "DirectoryWatch", None)
    asyncio.run(wait_until(tmp_path, tmp_path.exists))


def test_a_new_a_renamed_and_a_changed_file_and_the_target_of_a_link_are_noticed(tmp_path: Path) -> None:
    new, renamed, other, changed = (tmp_path / name for name in ("new", "renamed", "other", "changed"))
    run(new, new.exists, new.touch)
    other.touch()
    run(renamed, renamed.exists, lambda: other.rename(renamed))
    changed.touch(0o600)
    run(changed, lambda: bool(changed.stat().st_mode & 0o060), lambda: changed.chmod(0o660))
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id/usb-imu"
    link.symlink_to("../ttyUSB0")
    run(link, link.exists, (tmp_path / "ttyUSB0").touch)


@in_loop
async def test_a_missing_directory_is_waited_for_level_by_level(tmp_path: Path) -> None:
    path = tmp_path / "serial" / "by-id" / "usb-imu"
    waiting = asyncio.create_task(wait_until(path, path.exists))
    for directory in (path.parent.parent, path.parent):
        await turns()
        directory.mkdir()
    path.touch()
    await asyncio.wait_for(waiting, LIMIT_S)


def test_a_directory_that_is_made_before_its_watch_is_set_is_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, add = tmp_path / "by-id" / "tty", inotify.DirectoryWatch.add

    def make_and_add(watch: inotify.DirectoryWatch, directory: Path) -> bool:
        path.parent.mkdir(exist_ok=True)
        return add(watch, directory)

    monkeypatch.setattr(inotify.DirectoryWatch, "add", make_and_add)
    run(path, path.exists, path.touch)


@in_loop
async def test_other_changes_do_not_end_the_wait(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    waiting = asyncio.create_task(wait_until(path, path.exists))
    for number in range(5):
        await turns(10)
        (tmp_path / f"other{number}").touch()
    await turns()
    assert not waiting.done()
    path.touch()
    await asyncio.wait_for(waiting, LIMIT_S)


@in_loop
async def test_a_wait_does_not_poll_and_leaves_no_descriptor_when_it_is_cancelled(tmp_path: Path) -> None:
    asked = 0

    def ready() -> bool:
        nonlocal asked
        asked += 1
        return False

    before = len(open_descriptors())
    waiting = asyncio.create_task(wait_until(tmp_path / "tty", ready))
    await turns(1000)
    assert len(open_descriptors()) == before + 1
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    await asyncio.get_running_loop().shutdown_default_executor()
    assert len(open_descriptors()) == before
    assert asked == 2  # before and after the watch


def test_a_failed_watch_is_an_error_and_leaves_no_descriptor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, closed = tmp_path / "tty", list[bool]()
    close = inotify.DirectoryWatch.close

    def noted_close(watch: inotify.DirectoryWatch) -> None:
        closed.append(True)
        close(watch)

    monkeypatch.setattr(inotify.DirectoryWatch, "close", noted_close)
    with monkeypatch.context() as patch:
        patch.setattr(inotify.DirectoryWatch, "add", lambda self, directory: False)
        with pytest.raises(LinkError, match="may not read"):
            asyncio.run(wait_until(path, path.exists))
    assert closed == [True]

    class Exhausted:
        def inotify_init1(self, flags: int) -> int:
            return -1

    monkeypatch.setattr(inotify, "libc", Exhausted())
    with pytest.raises(LinkError, match="max_user_instances"):
        asyncio.run(wait_until(path, path.exists))


def test_directories_of_a_link(tmp_path: Path) -> None:
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "a").symlink_to("../missing/tty")
    found = [directory.resolve() for directory in directories_of(tmp_path / "by-id" / "a")]
    assert found == [tmp_path / "by-id", tmp_path]
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert directories_of(tmp_path / "a") == [tmp_path], "a circular link ends"
