"""Who may connect, and how often; how many descriptors clients may use: no user locks out another or the devices.

| limit                        | for                                   | why                                         |
|------------------------------|---------------------------------------|---------------------------------------------|
| clients in all               | all                                   | memory is bounded                           |
| open places                  | all                                   | the other RESERVED_CLIENTS are for those    |
|                              |                                       | who can set things right                    |
| reserved places              | own user, control group               | those of one user lock out no other         |
| places of root               | root                                  | root gets in whatever all others do         |
| clients and wakers of a user | all but root, own user                | one user cannot use up what is for all      |
| selections of fields         | all                                   | each is encoded apart                       |
| connections per second       | all but root                          | a connection costs 0.1 ms of CPU time       |
| numbers of descriptors       | all                                   | the highest RESERVED_FDS are for devices,   |
|                              |                                       | but one for each reserved place             |

A client has the place that it got when it connected until it leaves: an open one while there are any, else one of those
reserved for it. Clients of root have root's places first, then open ones.
"""

import ctypes
import errno
import grp
import os
import pwd
import resource
import socket
import struct
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import Flag, auto
from typing import Final, Protocol

from imud.formats.jsonrpc import Code, RpcError
from imud.model.units import NS_PER_S
from imud.publishers.socket.scheduler import TokenBucket

SO_PEERGROUPS: Final = 59
"""asm-generic/socket.h, Linux ≥ 4.13; Python's socket module has no name for it."""
_UCRED: Final = struct.Struct("iII")
_GID: Final = struct.Struct("I")
_GETSOCKOPT_MAX_BYTES: Final = 1024
"""Python's limit for getsockopt: room for 256 groups."""
_GROUPS_MAX: Final = 65536
"""NGROUPS_MAX of Linux (limits.h)."""
_libc: Final = ctypes.CDLL(None, use_errno=True)


class Rights(Flag):
    """What a peer may do."""

    NONE = 0
    READ = auto()
    CONTROL = auto()


@dataclass(frozen=True, slots=True)
class Peer:
    """The process that connected, as it was when it did."""

    pid: int
    uid: int
    groups: frozenset[int]
    """Numbers of its effective and supplementary groups."""


@dataclass(frozen=True, slots=True)
class Guard:
    """The rules above with the numbers filled in; None for a group that does not exist."""

    own_uid: int
    read_gid: int | None
    control_gid: int | None

    def rights_of(self, peer: Peer) -> Rights:
        """What `peer` may do."""
        rights = Rights.NONE
        if peer.uid in (0, self.own_uid) or self.read_gid in peer.groups:
            rights |= Rights.READ
        if peer.uid == 0 or self.control_gid in peer.groups:
            rights |= Rights.READ | Rights.CONTROL
        return rights


def peer_of(sock: socket.socket) -> Peer:
    """The peer of a connected UNIX socket. Raises OSError."""
    pid, uid, gid = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return Peer(pid, uid, frozenset((gid, *_supplementary(sock, uid, gid))))


def gid_of(group: str) -> int | None:
    """Number of a group, None when there is no such group."""
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        return None


def _supplementary(sock: socket.socket, uid: int, gid: int) -> list[int]:
    """The kernel's list; where the kernel has none (before Linux 4.13), the list of the user database."""
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, _GETSOCKOPT_MAX_BYTES)
    except OSError as error:
        if error.errno == errno.ERANGE:
            return _long_list(sock)
        try:
            return os.getgrouplist(pwd.getpwuid(uid).pw_name, gid)
        except KeyError:
            return []
    return [number for (number,) in _GID.iter_unpack(raw)]


def _long_list(sock: socket.socket) -> list[int]:
    """A list of more than 256 groups, for which Python's getsockopt has no room. Raises OSError."""
    groups = (ctypes.c_uint32 * _GROUPS_MAX)()
    size_bytes = ctypes.c_uint32(ctypes.sizeof(groups))
    if _libc.getsockopt(sock.fileno(), socket.SOL_SOCKET, SO_PEERGROUPS, groups, ctypes.byref(size_bytes)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return list(groups[: size_bytes.value // _GID.size])


RESERVED_CLIENTS: Final = 16
"""At most a quarter of all; places of root are among them."""
ROOT_SHARE: Final = 4
"""One of so many reserved places is root's alone, and a user may have one of so many of the others; at least one."""
RESERVED_FDS: Final = 256
"""At most a quarter of the process limit. A device that is plugged in needs up to five, a scrape one."""
FDS_MAX: Final = 16384
"""More than 4096 clients with a waker for each of three devices; the limit is not raised beyond."""
CONNECTS_PER_S: Final = 64
CONNECTS_BURST: Final = 256
WAKERS_PER_CLIENT: Final = 4
"""A user may have so many wakers for each client that it may have, on whichever of them."""
FORMS_PER_USER: Final = 16
"""Different selections of fields, each of which is encoded apart, that all clients of a user together may watch."""
LOG_PERIOD_NS: Final = 60 * NS_PER_S


class Connected(Protocol):
    """What is counted of a client."""

    @property
    def peer(self) -> Peer: ...
    @property
    def wakers(self) -> Collection[str]: ...
    @property
    def reserved(self) -> bool:
        """Whether it has a reserved place, as `Quota.admit` said."""
        ...


@dataclass(frozen=True, slots=True)
class Shares:
    """How many clients there may be."""

    clients: int
    """In all."""
    clients_per_user: int

    @property
    def reserved(self) -> int:
        """Places that are not open to all."""
        return min(RESERVED_CLIENTS, self.clients // 4)

    @property
    def root(self) -> int:
        """Those of the reserved places that only root can have."""
        return _share_of(self.reserved)

    @property
    def reserved_per_user(self) -> int:
        """Of the other reserved places, those that one user may have."""
        return _share_of(self.reserved - self.root)


class Quota:
    """Decides on new connections and descriptors. Synchronization: the event loop's thread."""

    def __init__(self, shares: Shares, own_uid: int, fd_limit: int, now_ns: Callable[[], int]) -> None:
        self._shares = shares
        self._own_uid = own_uid
        self._fd_end = fd_limit - min(RESERVED_FDS, fd_limit // 4)
        self._reserved_fd_end = self._fd_end + shares.reserved
        self._now_ns = now_ns
        self._connects: dict[int, TokenBucket] = {}
        self._forms: dict[int, Counter[object]] = {}
        """How many clients of each user watch samples in each form."""

    def admit(self, peer: Peer, rights: Rights, fd: int, clients: Collection[Connected]) -> bool:
        """Let a client in that has just connected with the right to read; return whether its place is a reserved one.

        Raises RpcError when it cannot stay. `clients` are those that have been let in before.
        """
        uid = peer.uid
        if uid and not self._count_connect(uid):
            raise _too_many(f"uid {uid} connects more than {CONNECTS_PER_S} times a second")
        if len(clients) >= self._shares.clients:
            most = self._shares.clients
            raise _too_many(f"there are {most} clients already, as many as socket.clients_max allows")
        if not uid:
            self._check_fd(fd, self._reserved_fd_end)
            return False
        own = sum(client.peer.uid == uid for client in clients)
        if uid != self._own_uid and own >= self._shares.clients_per_user:
            raise _too_many(f"uid {uid} has as many clients already as socket.clients_per_user allows")
        if fd < self._fd_end and self._has_open_place(clients):
            return False
        if uid != self._own_uid and Rights.CONTROL not in rights:
            self._check_fd(fd, self._fd_end)
            raise _too_many(
                f"there are {len(clients)} clients already; the others that socket.clients_max allows are reserved"
            )
        self._check_reserved(uid, clients)
        self._check_fd(fd, self._reserved_fd_end)
        return True

    def _has_open_place(self, clients: Collection[Connected]) -> bool:
        shares = self._shares
        reserved = sum(client.reserved for client in clients)
        of_root = sum(not client.peer.uid for client in clients)
        taken = len(clients) - reserved - min(of_root, shares.root)
        return taken < shares.clients - shares.reserved

    def _check_reserved(self, uid: int, clients: Collection[Connected]) -> None:
        """Raise RpcError when there is no reserved place for a user other than root."""
        users = [client.peer.uid for client in clients if client.reserved]
        if users.count(uid) >= self._shares.reserved_per_user:
            raise _too_many(f"uid {uid} has {users.count(uid)} of the reserved places already, as many as a user may")
        if len(users) >= self._shares.reserved - self._shares.root:
            raise _too_many("all reserved places are taken; those that are left are for root")

    def check_waker(self, peer: Peer, clients: Collection[Connected]) -> None:
        """Raises RpcError when a user has as many wakers as it may."""
        if peer.uid in (0, self._own_uid):
            return
        most = self._shares.clients_per_user * WAKERS_PER_CLIENT
        if sum(len(client.wakers) for client in clients if client.peer.uid == peer.uid) >= most:
            raise RpcError(
                Code.UNAVAILABLE, f"notify: uid {peer.uid} has {most} descriptors already, as many as it may"
            )

    def exchange_form(self, uid: int, old: object, new: object) -> None:
        """Count that a client of the user watches samples in form `new` instead of `old`; None for nothing.

        Raises RpcError, and counts nothing, when the user's clients have FORMS_PER_USER other forms, and not this one.
        """
        if old == new:
            return
        forms = self._forms.setdefault(uid, Counter())
        others = len(forms) - (forms[old] == 1)
        if new is not None and new not in forms and others >= FORMS_PER_USER:
            message = f"watch: uid {uid} has {FORMS_PER_USER} selections of fields already; leave `fields` out"
            raise RpcError(Code.UNAVAILABLE, message)
        if new is not None:
            forms[new] += 1
        if old is not None:
            forms[old] -= 1
            if not forms[old]:
                del forms[old]
        if not forms:
            del self._forms[uid]

    def check_fds(self, fds: Sequence[int]) -> None:
        """Raises RpcError when new descriptors are among those reserved; the caller closes them then."""
        if max(fds) >= self._fd_end:
            raise RpcError(Code.UNAVAILABLE, "the daemon has no descriptor to spare for clients")

    def tick(self) -> None:
        """Forget users that have not connected lately."""
        now_ns = self._now_ns()
        for uid, bucket in list(self._connects.items()):
            bucket.fill(now_ns)
            if bucket.level >= CONNECTS_BURST:
                del self._connects[uid]

    def _count_connect(self, uid: int) -> bool:
        """Whether the user may connect now."""
        now_ns = self._now_ns()
        bucket = self._connects.get(uid)
        if bucket is None:
            bucket = self._connects[uid] = TokenBucket(CONNECTS_PER_S, CONNECTS_BURST, now_ns)
        bucket.fill(now_ns)
        if bucket.level < 1:
            return False
        bucket.use(1)
        return True

    @staticmethod
    def _check_fd(fd: int, end: int) -> None:
        """The kernel gives the lowest number that is free: one this high means that all below are in use."""
        if fd >= end:
            raise _too_many("the daemon has no descriptor to spare for clients")


class RateLimitedLog:
    """Says when a message that may come very often is to be logged: once a minute, with the count."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._logged_ns: int | None = None
        self._count = 0

    def count(self) -> int:
        """Count one; return how many came since the last that was to be logged, 0 when this is not."""
        now_ns = self._now_ns()
        self._count += 1
        if self._logged_ns is not None and now_ns - self._logged_ns < LOG_PERIOD_NS:
            return 0
        self._logged_ns = now_ns
        count, self._count = self._count, 0
        return count


def raise_fd_limit() -> int:
    """Raise the soft limit of descriptors to FDS_MAX or the hard limit; return what it is then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FDS_MAX if hard == resource.RLIM_INFINITY else min(hard, FDS_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return FDS_MAX if soft == resource.RLIM_INFINITY else soft


def _too_many(message: str) -> RpcError:
    return RpcError(Code.TOO_MANY_CLIENTS, message)


def _share_of(places: int) -> int:
    """One of ROOT_SHARE; at least one where there is any."""
    return max(min(places, 1), places // ROOT_SHARE)
