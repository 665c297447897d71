"""Errors when a node cannot be opened, with the processes of a simulated /proc."""

import asyncio
import errno
import grp
import os
import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from imud.host.files import user_name
from imud.links import LINKS
from imud.links import device_node as inotify
from imud.links.device_node import SERIAL_GROUP, DeviceNode, directories_of, holders_of, open_problem, wait_until
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import in_loop
from tests.support.leaks import open_descriptors
from tests.support.surroundings import DAEMON_UID, needs_root


def process(proc: Path, pid: int, name: str, *targets: str) -> None:
    (proc / str(pid) / "fd").mkdir(parents=True)
    (proc / str(pid) / "comm").write_text(f"{name}\n")
    for number, target in enumerate(targets):
        (proc / str(pid) / "fd" / str(number)).symlink_to(target)


def test_every_holder_is_named_by_program_and_pid(tmp_path: Path) -> None:
    port, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    port.touch()
    link.symlink_to(port)
    proc = tmp_path / "proc"
    process(proc, 10, "minicom", "/dev/null", str(port))
    process(proc, 11, "bash", "/dev/null")
    process(proc, 12, "screen", str(port))
    (proc / "13").mkdir()  # a process that has ended, or of another user
    (proc / "self").mkdir()
    assert holders_of(str(link), proc) == "minicom (pid 10), screen (pid 12)"
    assert holders_of("/dev/ttyUSB9", proc) == ""
    (proc / "10" / "comm").unlink()
    (proc / "12" / "comm").unlink()
    assert holders_of(str(port), proc) == "a process (pid 10), a process (pid 12)"


@pytest.mark.parametrize(
    "command", [["/opt/imud/bin/imud", "probe", "--active"], ["/usr/bin/python3", "-I", "-m", "imud", "probe"]]
)
def test_another_imud_is_named_by_what_it_does(tmp_path: Path, command: list[str]) -> None:
    process(tmp_path, 10, "python3", "/dev/ttyUSB0")
    (tmp_path / "10" / "cmdline").write_text("\0".join(command) + "\0")
    process(tmp_path, os.getpid(), "imud", "/dev/ttyUSB0")
    named = holders_of("/dev/ttyUSB0", tmp_path)
    assert sorted(named.split(", ")) == ["imud probe (pid 10)", f"this imud (pid {os.getpid()})"]


@in_loop
async def test_access_is_waited_for_quietly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """udev sets the group of a node shortly after the kernel has created it. imud waits before it reports an error."""
    path, granted = tmp_path / "tty", False

    def access(_path: object, _mode: int, **_more: bool) -> bool:
        return granted

    monkeypatch.setattr("imud.links.device_node.os.access", access)
    monkeypatch.setattr("imud.links.device_node.ACCESS_WAIT_S", LIMIT_S)
    node = DeviceNode(str(path), "is it plugged in?")
    assert node.absence() == f"{path} does not exist: is it plugged in?"
    waiting = asyncio.create_task(node.wait_present())
    await asyncio.sleep(0)
    path.touch()
    for _ in range(50):
        await asyncio.sleep(0)
    assert not waiting.done()
    assert node.absence() == ""
    granted = True
    path.chmod(0o660)
    await asyncio.wait_for(waiting, LIMIT_S)


@pytest.mark.parametrize(
    ("link", "settings"),
    [
        ("uart", {"port": "/dev/none"}), ("rs485", {"line": "/dev/none"}), ("i2c", {"bus": 255}),
        ("spi", {"port": "/dev/spidev99.0"}), ("replay", {"path": "/none/drive.cap"}),
        ("replay of frames", {"path": "/none/drive.log"}),
    ],
)  # fmt: skip
def test_every_link_says_that_its_port_is_not_there_and_what_to_look_at(link: str, settings: dict[str, object]) -> None:
    row = LINKS[link.partition(" ")[0]]
    make = row.make_can if "frames" in link else row.make_polled if row.polled else row.make
    absence = make(msgspec.convert(settings, row.settings)).absence()
    assert re.fullmatch(r"/\S+ does not exist: (is .*\?|expected a capture file)", absence)


def test_access_that_is_not_granted_is_waited_for_no_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.links.device_node.os.access", lambda *_arguments, **_more: False)
    limits_s, timeout = list[float](), asyncio.timeout
    monkeypatch.setattr(asyncio, "timeout", lambda limit_s: limits_s.append(limit_s) or timeout(0))  # type: ignore[func-returns-value]
    asyncio.run(DeviceNode(str(tmp_path), "").wait_present())
    assert limits_s == [1]


@needs_root
@pytest.mark.parametrize(("gid", "mode"), [(0, 0o600), (0, 0o660), (DAEMON_UID, 0o600), (DAEMON_UID, 0o640)])
def test_a_node_that_no_group_may_open_needs_a_udev_rule(gid: int, mode: int, tmp_path: Path) -> None:
    """I2C and SPI nodes of plain Debian belong to root: joining a group does not give access."""
    path = tmp_path / "i2c-1"
    path.touch()
    os.chown(path, 0, gid)
    path.chmod(mode)
    message = str(open_problem(PermissionError(errno.EACCES, ""), str(path), ""))
    assert f"no group may open it (mode {mode:04o}, group " in message
    assert message.endswith("`imud doctor` prints a udev rule")


@needs_root
def test_a_node_of_a_group_names_it(tmp_path: Path) -> None:
    path = tmp_path / "ttyUSB0"
    path.touch()
    os.chown(path, 0, DAEMON_UID)
    path.chmod(0o660)
    group = grp.getgrgid(DAEMON_UID).gr_name
    assert f"it belongs to group {group}; run `sudo usermod -aG {group} " in str(
        open_problem(PermissionError(errno.EACCES, ""), str(path), "")
    )
    denied = open_problem(PermissionError(errno.EACCES, ""), str(tmp_path / "missing"), "")
    assert isinstance(denied, LinkDenied)
    assert f"belongs to group {SERIAL_GROUP};" in str(denied)


def test_absent_held_and_refused_nodes(tmp_path: Path) -> None:
    process(tmp_path, 10, "minicom", "/dev/i2c-1")
    absent = open_problem(OSError(errno.ENODEV, ""), "/dev/i2c-1", "is I2C on?")
    held = open_problem(OSError(errno.EBUSY, ""), "/dev/i2c-1", "", tmp_path)
    by_driver = open_problem(OSError(errno.EBUSY, ""), "/dev/i2c-2", "", tmp_path)
    assert (type(absent), str(absent)) == (LinkMissing, "/dev/i2c-1 does not exist: is I2C on?")
    assert (type(held), type(by_driver)) == (LinkBusy, LinkBusy)
    assert "in use by minicom (pid 10); stop" in str(held)
    assert "in use by another program or a driver of the kernel; stop" in str(by_driver)
    assert open_problem(OSError(errno.EMFILE, ""), "/dev/i2c-1", "") is None
    by_group = str(open_problem(OSError(errno.EACCES, "x"), "/dev/ttyS9", "?"))
    by_control_group = str(open_problem(OSError(errno.EPERM, "x"), "/dev/ttyS9", "?"))
    assert "usermod" in by_group
    assert "DeviceAllow" not in by_group
    assert "`DeviceAllow=/dev/ttyS9 rw`" in by_control_group
    assert "usermod" not in by_control_group


@pytest.mark.parametrize(("uid", "name"), [(0, "root"), (4_242_424, "4242424")])
def test_the_user_has_a_name_or_a_number(monkeypatch: pytest.MonkeyPatch, uid: int, name: str) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    assert user_name() == name


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
async def test_a_missing_directory_is_waited_for_level_by_level_and_other_changes_do_not_end_it(tmp_path: Path) -> None:
    path = tmp_path / "serial" / "by-id" / "usb-imu"
    waiting = asyncio.create_task(wait_until(path, path.exists))
    for directory in (path.parent.parent, path.parent):
        await turns()
        directory.mkdir()
    for number in range(5):
        await turns()
        (path.parent / f"other{number}").touch()
    await turns()
    assert not waiting.done()
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
async def test_a_wait_does_not_poll_and_leaves_no_descriptor_when_it_is_cancelled(tmp_path: Path) -> None:
    asked = 0

    def ready() -> bool:
        nonlocal asked
        asked += 1
        return False

    before, waiting = len(open_descriptors()), asyncio.create_task(wait_until(tmp_path / "tty", ready))
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
    monkeypatch.setattr(os, "O_CLOEXEC", 1 << 30)
    with pytest.raises(LinkError, match=r"Invalid argument; raise fs\.inotify\.max_user_instances"):
        inotify.DirectoryWatch()


def test_directories_of_a_link(tmp_path: Path) -> None:
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "a").symlink_to("../missing/tty")
    found = [directory.resolve() for directory in directories_of(tmp_path / "by-id" / "a")]
    assert found == [tmp_path / "by-id", tmp_path]
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert directories_of(tmp_path / "a") == [tmp_path], "a circular link ends"
    for number in range(42):
        (tmp_path / f"{number}").mkdir()
        (tmp_path / f"{number}" / "tty").symlink_to(f"../{number + 1}/tty")
    assert len(directories_of(tmp_path / "0" / "tty")) == 40, "path_resolution(7)"
