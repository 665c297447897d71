"""Who may connect, and how often; how many descriptors clients may use: no user locks out another or the devices.

| limit                        | for                                   | why                                         |
|------------------------------|---------------------------------------|---------------------------------------------|
| clients in all               | all                                   | memory is bounded                           |
| but RESERVED_CLIENTS         | all but root, own user, control group | those who can set things right get in       |
| clients and wakers of a user | all but root, own user                | one user cannot use up what is for all      |
| selections of fields         | all                                   | each is encoded apart                       |
| connections per second       | all but root                          | a connection costs 0.1 ms of CPU time       |
| numbers of descriptors       | all                                   | the highest RESERVED_FDS are for devices |
"""

import resource
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from imud.formats.jsonrpc import Code, RpcError
from imud.publishers.socket.rights import Peer, Rights
from imud.publishers.socket.serving import TokenBucket
from imud.units import NS_PER_S

RESERVED_CLIENTS: Final = 16
"""At most a quarter of all."""
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


@dataclass(frozen=True, slots=True)
class Shares:
    """How many clients there may be."""

    clients: int
    """In all."""
    clients_per_user: int

    @property
    def open_clients(self) -> int:
        """Those that are not reserved."""
        return self.clients - min(RESERVED_CLIENTS, self.clients // 4)


class Quota:
    """Decides on new connections and descriptors. Synchronization: the event loop's thread."""

    def __init__(self, shares: Shares, own_uid: int, fd_limit: int, now_ns: Callable[[], int]) -> None:
        self._shares = shares
        self._own_uid = own_uid
        self._fd_end = fd_limit - min(RESERVED_FDS, fd_limit // 4)
        self._now_ns = now_ns
        self._connects: dict[int, TokenBucket] = {}
        self._forms: dict[int, Counter[object]] = {}
        """How many clients of each user watch samples in each form."""

    def refuse_client(self, peer: Peer, rights: Rights, fd: int, clients: Collection[Connected]) -> RpcError | None:
        """Why a client that has just connected with the right to read cannot stay; None if it can."""
        if peer.uid and not self._count_connect(peer.uid):
            return _too_many(f"uid {peer.uid} connects more than {CONNECTS_PER_S} times a second")
        count, most = len(clients), self._shares.clients
        if count >= most:
            return _too_many(f"there are {most} clients already, as many as socket.clients_max allows")
        if peer.uid in (0, self._own_uid):
            return self._refuse_fd(fd)
        if count >= self._shares.open_clients and Rights.CONTROL not in rights:
            return _too_many(
                f"there are {count} clients already; the others that socket.clients_max allows are reserved"
            )
        if sum(client.peer.uid == peer.uid for client in clients) >= self._shares.clients_per_user:
            return _too_many(f"uid {peer.uid} has as many clients already as socket.clients_per_user allows")
        return self._refuse_fd(fd)

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

    def _refuse_fd(self, fd: int) -> RpcError | None:
        """The kernel gives the lowest number that is free: one this high means that all below are in use."""
        return _too_many("the daemon has no descriptor to spare for clients") if fd >= self._fd_end else None


class Seldom:
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
