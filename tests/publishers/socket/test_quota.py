"""Who gets in: no user locks out another, root and the control group always get in, devices keep their descriptors."""

import resource
from dataclasses import dataclass, field

import pytest

from imud.formats.jsonrpc import Code, RpcError
from imud.publishers.socket import quota
from imud.publishers.socket.quota import Quota, Seldom, Shares, raise_fd_limit
from imud.publishers.socket.rights import Peer, Rights

READ, ALL = Rights.READ, Rights.READ | Rights.CONTROL
OWN_UID = 500
MS = 1_000_000


@dataclass
class Client:
    """What is counted of one."""

    peer: Peer
    wakers: list[str] = field(default_factory=list)


class House:
    """Clients that were let in."""

    def __init__(self, clients: int = 64, per_user: int = 20, fd_limit: int = 1024) -> None:
        self.now_ns = 0
        self.quota = Quota(Shares(clients, per_user), OWN_UID, fd_limit, lambda: self.now_ns)
        self.clients: list[Client] = []

    def connect(self, uid: int, rights: Rights = READ, fd: int = 50) -> str:
        """Let one in; why not, if not."""
        peer = Peer(1, uid, frozenset())
        refusal = self.quota.refuse_client(peer, rights, fd, self.clients)
        if refusal is None:
            self.clients.append(Client(peer))
            return ""
        assert refusal.code == Code.TOO_MANY_CLIENTS
        return str(refusal)


def test_one_user_gets_its_share_and_others_get_in() -> None:
    house = House()
    refusals = [house.connect(1000) for _ in range(25)]
    assert refusals[:20] == [""] * 20
    assert all("socket.clients_per_user" in words for words in refusals[20:])
    assert house.connect(1001) == ""


def test_many_users_leave_places_for_root_and_control() -> None:
    house = House()
    outcomes = [house.connect(1000 + number) for number in range(70)]
    assert outcomes.count("") == 48  # 64 less the 16 reserved
    assert all("reserved" in words for words in outcomes[48:])
    assert house.connect(0, ALL) == ""
    assert house.connect(OWN_UID) == ""
    assert [house.connect(2000, ALL) for _ in range(14)] == [""] * 14
    assert "socket.clients_max" in house.connect(0, ALL)


def test_a_member_of_the_control_group_cannot_lock_out_root() -> None:
    house = House()
    assert [house.connect(1000, ALL) for _ in range(30)].count("") == 20
    assert house.connect(0, ALL) == ""


def test_a_small_house_has_no_reserved_places() -> None:
    house = House(clients=2)
    assert [house.connect(1000), house.connect(1000)] == ["", ""]


def test_connecting_again_and_again_is_limited_by_user() -> None:
    house = House()
    outcomes = []
    for _ in range(quota.CONNECTS_BURST + 10):
        outcomes.append(house.connect(1000))
        house.clients.clear()
    assert outcomes.count("") == quota.CONNECTS_BURST
    assert "times a second" in outcomes[-1]
    assert house.connect(1001) == ""
    house.now_ns += 1000 * MS
    assert house.connect(1000) == ""
    for _ in range(1000):
        assert house.connect(0) == ""
        house.clients.clear()


def test_high_descriptors_are_kept_for_devices() -> None:
    house = House(fd_limit=1024)
    assert house.connect(1000, fd=767) == ""
    assert "descriptor" in house.connect(1000, fd=768)
    assert "descriptor" in house.connect(0, fd=768)
    house.quota.check_fds((5, 767))
    with pytest.raises(RpcError, match="no descriptor to spare"):
        house.quota.check_fds((5, 768))


def test_wakers_of_all_clients_of_a_user_count() -> None:
    house = House(per_user=2)
    house.connect(1000)
    house.connect(1000)
    for client in house.clients:
        client.wakers = ["imu0", "imu1", "imu2", "imu3"]
    with pytest.raises(RpcError, match="uid 1000 has 8 descriptors already"):
        house.quota.check_waker(house.clients[0].peer, house.clients)
    house.clients[0].wakers.pop()
    house.quota.check_waker(house.clients[0].peer, house.clients)
    for uid in (0, OWN_UID, 1001):
        house.quota.check_waker(Peer(1, uid, frozenset()), house.clients)


def test_selections_of_fields_are_limited() -> None:
    house = House()
    for form in range(1, 1 + quota.FORMS_PER_USER):
        house.quota.exchange_form(1000, None, form)
    house.quota.exchange_form(1000, None, 3)
    for _ in range(2):  # a refusal counts nothing
        with pytest.raises(RpcError, match="16 selections"):
            house.quota.exchange_form(1000, None, 99)
    with pytest.raises(RpcError, match="16 selections"):
        house.quota.exchange_form(1000, 3, 99)  # another client has that form, too
    house.quota.exchange_form(1001, None, 99)
    house.quota.exchange_form(1000, 4, 99)  # its own form goes
    house.quota.exchange_form(1000, 99, None)
    house.quota.exchange_form(1000, None, 100)
    with pytest.raises(RpcError, match="16 selections"):
        house.quota.exchange_form(1000, None, 101)


def test_a_frequent_message_is_logged_once_a_minute_with_its_count() -> None:
    now_ns = 0
    seldom = Seldom(lambda: now_ns)
    assert [seldom.count() for _ in range(5)] == [1, 0, 0, 0, 0]
    now_ns = 60_000 * MS
    assert [seldom.count() for _ in range(2)] == [5, 0]


def test_the_limit_of_descriptors_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = [(1024, 524_288)]
    monkeypatch.setattr(resource, "getrlimit", lambda _which: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda _which, pair: limits.append(pair))
    assert raise_fd_limit() == quota.FDS_MAX
    assert limits[-1] == (quota.FDS_MAX, 524_288)
    assert raise_fd_limit() == quota.FDS_MAX
    limits[:] = [(1024, 4096)]
    assert raise_fd_limit() == 4096
