"""Admission of clients: their rights, and limits for clients, connections and descriptors.

No user can lock out another user or take the descriptors of the devices.

| limit                        | applies to                            | reason                                      |
|------------------------------|---------------------------------------|---------------------------------------------|
| clients in total             | all                                   | bounded memory                              |
| open places                  | all                                   | the other RESERVED_CLIENTS are for users    |
|                              |                                       | who can repair the daemon                   |
| reserved places              | own user, control group               | one user cannot take all of them            |
| places of root               | root                                  | root can always connect                     |
| clients and wakers of a user | all but root, own user                | one user cannot take all of them            |
| selections of fields         | all                                   | imud encodes each selection separately      |
| connections per second       | all but root                          | a connection costs 0.1 ms of CPU time       |
| descriptor numbers           | all                                   | the highest RESERVED_FDS are for devices,   |
|                              |                                       | except one for each reserved place          |

A client keeps the place that it got when it connected: an open place if there is one, otherwise one of the reserved
places for its user. Clients of root take the places of root first, then open places.
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
from typing import Final, NamedTuple

from imud.formats.jsonrpc import Code, RpcError
from imud.model.units import NS_PER_S
from imud.publishers.socket.scheduler import TokenBucket

SO_PEERGROUPS: Final = 59
"""Socket option (asm-generic/socket.h, Linux ≥ 4.13). Python's socket module does not define it."""
_UCRED: Final = struct.Struct("iII")
_GETSOCKOPT_MAX_BYTES: Final = 1024
"""Maximum buffer of Python's getsockopt: 256 groups."""
_GROUPS_MAX: Final = 65536
"""NGROUPS_MAX of Linux (limits.h)."""
_libc: Final = ctypes.CDLL(None, use_errno=True)

RESERVED_CLIENTS: Final = 16
"""Number of reserved places, with the places of root; at most a quarter of all places."""
ROOT_SHARE: Final = 4
"""A quarter of the reserved places is for root. One user may have a quarter of the others. Both are at least one."""
RESERVED_FDS: Final = 256
"""Number of reserved descriptors, at most a quarter of the process limit. A new device needs up to five, a scrape of
the metrics one."""
FDS_MAX: Final = 16384
"""Maximum process limit that imud sets: more than 4096 clients with a waker for each of three devices."""
CONNECTS_PER_S: Final = 64
CONNECTS_BURST: Final = 256
WAKERS_PER_CLIENT: Final = 4
"""Maximum number of wakers of a user, per client that the user may have."""
FORMS_PER_USER: Final = 16
"""Maximum number of selections of fields that all clients of a user watch."""
LOG_PERIOD_NS: Final = 60 * NS_PER_S


class Rights(Flag):
    """Permissions of a client."""

    NONE = 0
    READ = auto()
    CONTROL = auto()


@dataclass(frozen=True, slots=True)
class Peer:
    """Credentials of the client process at the time of connect(2)."""

    pid: int
    uid: int
    groups: frozenset[int]  # effective and supplementary group numbers


class Place(NamedTuple):
    """The place of a client in the limits."""

    uid: int
    is_reserved: bool


@dataclass(frozen=True, slots=True)
class Guard:
    """Rights of users and groups. A group that does not exist is None.

    | right   | users                                                      |
    |---------|------------------------------------------------------------|
    | read    | root, the user of the daemon, members of the read group    |
    | control | root, members of the control group                         |
    """

    own_uid: int
    read_gid: int | None
    control_gid: int | None

    def rights_of(self, peer: Peer) -> Rights:
        rights = Rights.NONE
        if peer.uid in (0, self.own_uid) or self.read_gid in peer.groups:
            rights |= Rights.READ
        if peer.uid == 0 or self.control_gid in peer.groups:
            rights |= Rights.READ | Rights.CONTROL
        return rights


def peer_of(sock: socket.socket) -> Peer:
    """Return the credentials of the peer of a connected UNIX socket. Raises OSError.

    The supplementary groups are from the kernel; before Linux 4.13 they are from the user database.
    """
    pid, uid, gid = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, _GETSOCKOPT_MAX_BYTES)
        groups = memoryview(raw).cast("I").tolist()
    except OSError as error:
        try:
            is_long = error.errno == errno.ERANGE  # more than 256 groups
            groups = _long_list(sock) if is_long else os.getgrouplist(pwd.getpwuid(uid).pw_name, gid)
        except KeyError:
            groups = []
    return Peer(pid, uid, frozenset((gid, *groups)))


def gid_of(group: str) -> int | None:
    """Return the number of a group, None if it does not exist."""
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        return None


def _long_list(sock: socket.socket) -> list[int]:
    groups = (ctypes.c_uint32 * _GROUPS_MAX)()
    size_bytes = ctypes.c_uint32(ctypes.sizeof(groups))
    if _libc.getsockopt(sock.fileno(), socket.SOL_SOCKET, SO_PEERGROUPS, groups, ctypes.byref(size_bytes)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return list(groups[: size_bytes.value // ctypes.sizeof(ctypes.c_uint32)])


class Quota:
    """Decides on new connections and descriptors. Synchronization: the event loop's thread."""

    def __init__(
        self, clients_max: int, clients_per_user: int, own_uid: int, fd_limit: int, now_ns: Callable[[], int]
    ) -> None:
        self._clients_max = clients_max
        self._clients_per_user = clients_per_user
        self._reserved = min(RESERVED_CLIENTS, clients_max // 4)
        self._of_root = _share_of(self._reserved)
        self._reserved_per_user = _share_of(self._reserved - self._of_root)
        self._own_uid = own_uid
        self._fd_end = fd_limit - min(RESERVED_FDS, fd_limit // 4)  # first descriptor that is not for clients
        self._reserved_fd_end = self._fd_end + self._reserved
        self._now_ns = now_ns
        self._connects: dict[int, TokenBucket] = {}
        self._forms: dict[int, Counter[object]] = {}  # number of clients in each form, for each user

    def admit(self, peer: Peer, rights: Rights, fd: int, places: Collection[Place]) -> Place:
        """Return the place of a new client that may at least read. `places` are the places of all other clients.

        Raises RpcError if there is no place for the client.
        """
        uid = peer.uid
        if uid and not self._count_connect(uid):
            raise _too_many(f"uid {uid} connects more than {CONNECTS_PER_S} times per second; try again later")
        if len(places) >= self._clients_max:
            raise _too_many(f"{self._clients_max} clients are connected, the limit of socket.clients_max")
        if not uid:
            _check_fd(fd, self._reserved_fd_end)
            return Place(uid, False)
        own = sum(place.uid == uid for place in places)
        if uid != self._own_uid and own >= self._clients_per_user:
            raise _too_many(f"uid {uid} has {own} clients, the limit of socket.clients_per_user")
        if fd < self._fd_end and self._has_open_place(places):
            return Place(uid, False)
        if uid != self._own_uid and Rights.CONTROL not in rights:
            _check_fd(fd, self._fd_end)
            raise _too_many(f"{len(places)} clients are connected; the other places of socket.clients_max are reserved")
        self._check_reserved(uid, places)
        _check_fd(fd, self._reserved_fd_end)
        return Place(uid, True)

    def _has_open_place(self, places: Collection[Place]) -> bool:
        reserved = sum(place.is_reserved for place in places)
        of_root = sum(not place.uid for place in places)
        taken = len(places) - reserved - min(of_root, self._of_root)
        return taken < self._clients_max - self._reserved

    def _check_reserved(self, uid: int, places: Collection[Place]) -> None:
        """Raise RpcError if no reserved place is left for a user other than root."""
        users = [place.uid for place in places if place.is_reserved]
        if users.count(uid) >= self._reserved_per_user:
            raise _too_many(f"uid {uid} has {users.count(uid)} of the reserved places, the maximum for one user")
        if len(users) >= self._reserved - self._of_root:
            raise _too_many("all reserved places are taken; the remaining places are for root")

    def check_waker(self, uid: int, wakers: int) -> None:
        """Raise RpcError if a user, whose clients have `wakers` wakers, has reached the limit."""
        most = self._clients_per_user * WAKERS_PER_CLIENT
        if uid not in (0, self._own_uid) and wakers >= most:
            raise RpcError(Code.UNAVAILABLE, f"notify: uid {uid} has {most} descriptors, the maximum for one user")

    def exchange_form(self, uid: int, old: object, new: object) -> None:
        """Count that a client of the user changes from form `old` to form `new`; None for no samples.

        Raises RpcError, and counts nothing, if `new` would be one more than FORMS_PER_USER.
        """
        if old == new:
            return
        forms = self._forms.setdefault(uid, Counter())
        others = len(forms) - (forms[old] == 1)
        if new is not None and new not in forms and others >= FORMS_PER_USER:
            message = f"watch: the clients of uid {uid} watch {FORMS_PER_USER} selections of fields, the maximum"
            raise RpcError(Code.UNAVAILABLE, f"{message}; leave `fields` out")
        if new is not None:
            forms[new] += 1
        if old is not None:
            forms[old] -= 1
            if not forms[old]:
                del forms[old]
        if not forms:
            del self._forms[uid]

    def check_fds(self, fds: Sequence[int]) -> None:
        """Raise RpcError if new descriptors are reserved. The caller then closes them."""
        if max(fds) >= self._fd_end:
            raise RpcError(Code.UNAVAILABLE, NO_FD_LEFT)

    def tick(self) -> None:
        """Forget the users with a full allowance of connections."""
        if not self._connects:
            return
        now_ns = self._now_ns()
        for uid, bucket in list(self._connects.items()):
            bucket.fill(now_ns)
            if bucket.level >= CONNECTS_BURST:
                del self._connects[uid]

    def _count_connect(self, uid: int) -> bool:
        """Count a connection. Return False if the user has no allowance for it."""
        now_ns = self._now_ns()
        bucket = self._connects.get(uid)
        if bucket is None:
            bucket = self._connects[uid] = TokenBucket(CONNECTS_PER_S, CONNECTS_BURST, now_ns, CONNECTS_BURST)
        bucket.fill(now_ns)
        if bucket.level < 1:
            return False
        bucket.use(1)
        return True


class RateLimitedLog:
    """Limits a frequent log message to one per minute, with a count."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._logged_ns: int | None = None
        self._count = 0

    def count(self) -> int:
        """Count a message. Return the number of messages to log now; 0 if the last log entry is less than 60 s old."""
        now_ns = self._now_ns()
        self._count += 1
        if self._logged_ns is not None and now_ns - self._logged_ns < LOG_PERIOD_NS:
            return 0
        self._logged_ns = now_ns
        count, self._count = self._count, 0
        return count


def raise_fd_limit() -> int:
    """Raise the soft limit of descriptors to FDS_MAX, at most to the hard limit. Return the new limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FDS_MAX if hard == resource.RLIM_INFINITY else min(hard, FDS_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return FDS_MAX if soft == resource.RLIM_INFINITY else soft


NO_FD_LEFT: Final = "all file descriptors for clients are in use; close other clients, or raise LimitNOFILE of the unit"


def _check_fd(fd: int, end: int) -> None:
    # the kernel gives the lowest free number: all numbers below `fd` are in use
    if fd >= end:
        raise _too_many(NO_FD_LEFT)


def _too_many(message: str) -> RpcError:
    return RpcError(Code.TOO_MANY_CLIENTS, message)


def _share_of(places: int) -> int:
    """Return a part of ROOT_SHARE, at least one place if there is any."""
    return max(min(places, 1), places // ROOT_SHARE)
