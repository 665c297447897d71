"""Rights of clients by the credentials of the kernel."""

import asyncio
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from imud.publishers.socket.admission import Guard, Peer, Rights, gid_of, peer_of
from tests.support.socket_rig import run, serving
from tests.support.surroundings import needs_root

NONE, READ, ALL = Rights.NONE, Rights.READ, Rights.READ | Rights.CONTROL


@pytest.mark.parametrize(
    ("uid", "groups", "expected"),
    [
        (0, (), ALL),
        (500, (), READ),  # the user of the daemon
        (1000, (), NONE), (1000, (7, 80), READ), (1000, (7, 90), ALL), (500, (90,), ALL),
    ],
)  # fmt: skip
def test_rules(uid: int, groups: tuple[int, ...], expected: Rights) -> None:
    assert Guard(500, 80, 90).rights_of(Peer(1, uid, frozenset(groups))) == expected


def test_a_group_that_does_not_exist_gives_nothing() -> None:
    assert gid_of("no-such-group-here") is None
    assert Guard(500, None, None).rights_of(Peer(1, 1000, frozenset((7, 80)))) == NONE


def test_the_peer_of_a_socket_is_this_process() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        peer = peer_of(ours)
    assert (peer.pid, peer.uid) == (os.getpid(), os.geteuid())
    assert peer.groups == {os.getegid(), *os.getgroups()}


CLIENT = """
import os, socket, sys
os.setgroups([int(word) for word in sys.argv[2:]])
os.setgid(65534)
os.setuid(65534)
sock = socket.socket(socket.AF_UNIX)
try:
    sock.connect(sys.argv[1])
    print(sock.makefile().readline())
except PermissionError:
    print("PermissionError")
"""


@pytest.fixture
def open_directory() -> Iterator[Path]:
    path = Path(tempfile.mkdtemp(prefix="imud-"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


MANY_GROUPS = [*map(str, range(70_000, 70_300)), "daemon", "bin"]
"""More than 256 groups, the maximum of Python's getsockopt."""


@needs_root
@pytest.mark.parametrize(
    ("groups", "mode", "expected"),
    [
        ([], 0o660, "PermissionError"), ([], 0o666, '"code":-32001'), (["daemon"], 0o660, '"rights":["read"]'),
        (["bin"], 0o666, '"rights":["read","control"]'), (MANY_GROUPS, None, '"rights":["read","control"]'),
    ],
)  # fmt: skip
def test_other_users(open_directory: Path, groups: list[str], mode: int | None, expected: str) -> None:
    async def body() -> str:
        async with serving(open_directory, group="daemon", control_group="bin") as server:
            if mode is not None:
                os.chmod(server.hub.path, mode)
            numbers = [int(name) if name.isdigit() else gid_of(name) for name in groups]
            return await asyncio.to_thread(ask, server.hub.path, numbers)

    assert expected in run(body)


def ask(path: str, groups: Sequence[int | None]) -> str:
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", CLIENT, path, *map(str, groups)], capture_output=True, text=True,
        timeout=60, check=True,
    )  # fmt: skip
    return done.stdout
