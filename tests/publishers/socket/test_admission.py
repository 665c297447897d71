"""Admission: no user locks out another, root and the control group always connect, devices keep their descriptors.
Rights of clients by the credentials of the kernel."""

import asyncio
import errno
import os
import resource
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud.formats.jsonrpc import Code, RpcError
from imud.publishers.socket import admission as quota
from imud.publishers.socket.scheduler import TokenBucket
from tests.support.socket_rig import alone, serving
from tests.support.surroundings import needs_root

READ, ALL = quota.Rights.READ, quota.Rights.READ | quota.Rights.CONTROL
OWN_UID = 500
MS = 1_000_000


class House:
    def __init__(self, clients: int = 64, per_user: int = 20, fd_limit: int = 1024) -> None:
        self.now_ns = 0
        self.quota = quota.Quota(clients, per_user, OWN_UID, fd_limit, lambda: self.now_ns)
        self.clients: list[quota.Place] = []

    def connect(self, uid: int, rights: quota.Rights = READ, fd: int = 50) -> str:
        peer = quota.Peer(1, uid, frozenset())
        try:
            self.clients.append(self.quota.admit(peer, rights, fd, self.clients))
        except RpcError as refusal:
            return str(refusal) if refusal.code == Code.TOO_MANY_CLIENTS else pytest.fail(str(refusal))
        return ""

    def fill(self, uids: tuple[int, ...], rights: quota.Rights = READ) -> int:
        """Connect clients of these users in turns until all are refused. Return the number of new clients."""
        before = len(self.clients)
        while [uid for uid in uids if not self.connect(uid, rights)]:
            pass
        return len(self.clients) - before

    def leave(self, uid: int, count: int) -> None:
        for client in [client for client in self.clients if client.uid == uid][:count]:
            self.clients.remove(client)


def test_a_user_gets_its_share_and_users_leave_places_for_root() -> None:
    house = House()
    refusals = [house.connect(1000) for _ in range(25)]
    assert refusals[:20] == [""] * 20
    assert all("socket.clients_per_user" in words for words in refusals[20:])
    assert house.connect(1001) == ""
    house = House()
    outcomes = [house.connect(1000 + number) for number in range(70)]
    assert outcomes.count("") == 48  # 64 minus 16 reserved places
    assert all("reserved" in words for words in outcomes[48:])
    assert (house.connect(0, ALL), house.connect(OWN_UID)) == ("", "")
    assert [house.connect(2000, ALL) for _ in range(14)].count("") == 3
    assert [house.connect(2001, ALL) for _ in range(14)].count("") == 3


def test_root_and_members_connect_when_others_take_all_places() -> None:
    house = House(clients=256, per_user=128)
    house.fill(tuple(range(1000, 1010)))
    house.fill((OWN_UID, *range(2000, 2010)), ALL)
    assert len(house.clients) == 252
    assert "for root" in house.connect(2011, ALL)
    assert [house.connect(0, ALL) for _ in range(5)].count("") == 4
    assert len(house.clients) == 256  # the limit of all clients
    assert "socket.clients_max" in house.connect(0, ALL)
    house = House(clients=256, per_user=128)
    assert (house.fill((OWN_UID,)), house.connect(2000, ALL), house.connect(0, ALL)) == (243, "", "")
    # without reserved places, 128 + 112 clients of two readers and 16 of one member would be all 256
    house = House(clients=256, per_user=128)
    assert (house.fill((1000, 1001)), house.fill((2000,), ALL)) == (240, 3)
    assert "uid 2000 has 3 of the reserved places" in house.connect(2000, ALL)
    assert (house.connect(2001, ALL), [house.connect(0, ALL) for _ in range(4)]) == ("", [""] * 4)


def test_free_places_do_not_give_a_member_more_reserved_places() -> None:
    house = House(clients=256, per_user=128)
    house.fill((1000, 1001))
    house.fill((2000,), ALL)
    for _ in range(10):  # the member takes places of readers, and the readers connect again
        house.leave(1000, 30)
        house.fill((2000,), ALL)
        house.fill((1000, 1001))
        assert house.connect(2001, ALL) == ""
        house.leave(2001, 1)
        house.leave(2000, 20)
        house.fill((1000, 1001))
        house.fill((2000,), ALL)
        assert house.connect(2001, ALL) == ""
        house.leave(2001, 1)
        assert house.connect(0, ALL) == ""
        house.leave(0, 1)


def test_reserved_places_with_many_clients_and_in_a_small_house() -> None:
    house = House(clients=256, per_user=128)
    assert [house.connect(2000, ALL) for _ in range(20)] == [""] * 20
    house.fill((1000, 1001))
    assert house.connect(2000, ALL) == ""
    house = House(clients=256, per_user=128)
    assert ([house.connect(0, ALL) for _ in range(4)], house.fill((1000, 1001))) == ([""] * 4, 240)
    house = House(clients=256, per_user=128)
    assert [house.connect(0, ALL) for _ in range(20)] == [""] * 20
    assert house.fill((1000, 1001)) == 224  # the other 16 clients of root have open places
    assert [house.connect(uid, ALL) for uid in (2000, 2001, 2002, 2003)] == [""] * 4
    house = House(clients=3)
    assert [house.connect(1000) for _ in range(4)].count("") == 3
    house = House(clients=4)
    assert ([house.connect(1000) for _ in range(4)].count(""), house.connect(0, ALL)) == (3, "")
    house = House(clients=8)
    assert [house.connect(1000) for _ in range(8)].count("") == 6
    assert [house.connect(2000, ALL), house.connect(0, ALL)] == ["", ""]


def test_connecting_again_and_again_is_limited_by_user() -> None:
    house = House()
    outcomes = []
    for seconds, count in ((0, 256), (1, 64), (3, 192), (60, 256)):
        house.now_ns += seconds * 1000 * MS
        for _ in range(count + 2):
            outcomes.append(house.connect(1000))
            house.clients.clear()
        assert outcomes.count("") == count
        assert "uid 1000 connects more than 64 times per second" in outcomes[-1]
        outcomes.clear()
    assert house.connect(1001) == ""
    house.quota.tick()  # uid 1000 has no allowance yet, so `tick` keeps it
    assert house.connect(1000) != ""
    for _ in range(1000):
        assert house.connect(0) == ""
        house.clients.clear()


def test_a_user_that_has_not_connected_lately_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[TokenBucket] = []

    def make(*args: int) -> TokenBucket:
        made.append(TokenBucket(*args))
        return made[-1]

    monkeypatch.setattr(quota, "TokenBucket", make)
    house = House()
    for milliseconds, buckets in ((0, 1), (15, 1), (17, 2)):  # one connection per 15.6 ms
        house.now_ns += milliseconds * MS
        house.quota.tick()
        house.connect(1000)
        assert len(made) == buckets


def test_descriptors_and_wakers_are_limited() -> None:
    for limit, end in ((1000, 750), (4096, 3840)):
        house = House(fd_limit=limit)
        assert house.connect(1000, fd=end - 1) == ""
        assert "descriptor" in house.connect(1000, fd=end)
        assert "descriptor" in house.connect(OWN_UID, fd=end + 16)
        assert [house.connect(uid, ALL, fd=end + 15) for uid in (0, 2000)] == ["", ""], "for a reserved place"
        assert "descriptor" in house.connect(0, ALL, fd=end + 16)
        house.quota.check_fds((5, end - 1))
        with pytest.raises(RpcError, match="file descriptors for clients are in use"):
            house.quota.check_fds((5, end))
    house = House(per_user=2)
    with pytest.raises(RpcError, match="uid 1000 has 8 descriptors, the maximum"):
        house.quota.check_waker(1000, 8)
    house.quota.check_waker(1000, 7)
    for uid in (0, OWN_UID):
        house.quota.check_waker(uid, 8)


def test_selections_of_fields_are_limited() -> None:
    house = House()
    for form in range(1, 17):
        house.quota.exchange_form(1000, None, form)
    house.quota.exchange_form(1000, None, 3)
    for _ in range(2):  # a refusal counts nothing
        with pytest.raises(RpcError, match="16 selections"):
            house.quota.exchange_form(1000, None, 99)
    with pytest.raises(RpcError, match="16 selections"):
        house.quota.exchange_form(1000, 3, 99)  # another client has form 3 too
    house.quota.exchange_form(1001, None, 99)
    house.quota.exchange_form(1000, 4, 99)  # no other client has form 4
    house.quota.exchange_form(1000, 99, None)
    house.quota.exchange_form(1000, None, 100)
    with pytest.raises(RpcError, match="16 selections"):
        house.quota.exchange_form(1000, None, 101)


def test_a_frequent_message_is_logged_once_a_minute_with_its_count() -> None:
    now_ns = 0
    limited = quota.RateLimitedLog(lambda: now_ns)
    assert [limited.count() for _ in range(5)] == [1, 0, 0, 0, 0]
    now_ns = 60_000 * MS - 1
    assert limited.count() == 0
    now_ns += 1
    assert [limited.count() for _ in range(2)] == [6, 0]


def test_the_limit_of_descriptors_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _which: limits[0])
    monkeypatch.setattr(resource, "setrlimit", lambda _which, pair: limits.append(pair))
    most = resource.RLIM_INFINITY
    for soft, hard, limit in ((1024, 524_288, 16_384), (1024, 4096, 4096), (1024, most, 16_384)):
        limits[:] = [(soft, hard)]
        assert (quota.raise_fd_limit(), limits[1:]) == (limit, [(limit, hard)])
    for soft, hard, limit in ((16_384, most, 16_384), (65_536, 65_536, 65_536), (most, most, 16_384)):
        limits[:] = [(soft, hard)]
        assert (quota.raise_fd_limit(), limits[1:]) == (limit, []), "imud does not lower a limit"


def test_rights_of_users_and_groups() -> None:
    for uid, groups, expected in (
        (0, (), ALL), (500, (), READ),  # root, and the user of the daemon
        (1000, (), quota.Rights.NONE), (1000, (7, 80), READ), (1000, (7, 90), ALL), (500, (90,), ALL),
    ):  # fmt: skip
        assert quota.Guard(500, 80, 90).rights_of(quota.Peer(1, uid, frozenset(groups))) == expected, (uid, groups)
    assert quota.gid_of("no-such-group-here") is None
    assert quota.Guard(500, None, None).rights_of(quota.Peer(1, 1000, frozenset((7, 80)))) == quota.Rights.NONE


def test_the_peer_of_a_socket_is_this_process() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        peer = quota.peer_of(ours)
    assert (peer.pid, peer.uid) == (os.getpid(), os.geteuid())
    assert peer.groups == {os.getegid(), *os.getgroups()}
    for uid, groups in ((0, os.getgrouplist("root", 77)), (4_000_000_000, [77])):
        replies = quota._UCRED.pack(1, uid, 77), OSError(errno.ENOPROTOOPT, "")
        old = Mock(getsockopt=Mock(side_effect=replies), fileno=lambda: -1)
        assert quota.peer_of(old).groups == {*groups}
    with pytest.raises(OSError, match="Bad file descriptor"):
        quota._long_list(old)


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
@alone()
async def test_other_users(groups: list[str], mode: int | None, expected: str) -> None:
    with tempfile.TemporaryDirectory(prefix="imud-") as name:
        os.chmod(name, 0o755)
        async with serving(Path(name), group="daemon", control_group="bin") as server:
            if mode is not None:
                os.chmod(server.hub.path, mode)
            numbers = [int(name) if name.isdigit() else quota.gid_of(name) for name in groups]
            assert expected in await asyncio.to_thread(ask, server.hub.path, numbers)


def ask(path: str, groups: Sequence[int | None]) -> str:
    command = [sys.executable, "-I", "-S", "-c", CLIENT, path, *map(str, groups)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
