"""Who is at the other end of a UNIX socket, and what it may do: SO_PEERCRED and SO_PEERGROUPS, as the kernel has them.

| right   | who has it                                             |
|---------|--------------------------------------------------------|
| read    | root, the daemon's own user, members of the read group |
| control | root, members of the control group                     |
"""

import ctypes
import errno
import grp
import os
import pwd
import socket
import struct
from dataclasses import dataclass
from enum import Flag, auto
from typing import Final

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
