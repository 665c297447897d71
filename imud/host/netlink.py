"""Network interfaces by rtnetlink(7): waiting for changes, bit rate and state of a CAN interface."""

import asyncio
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from imud.model.errors import LinkError

RTMGRP_LINK: Final = 1  # multicast group for changes of interfaces (RTNLGRP_LINK as a bit)
RTM_NEWLINK: Final = 16
RTM_GETLINK: Final = 18
NLM_F_REQUEST: Final = 1
IFLA_LINKINFO: Final = 18
IFLA_INFO_DATA: Final = 2
IFLA_CAN_BITTIMING: Final = 1
IFLA_CAN_STATE: Final = 4
IFF_UP: Final = 1
ARPHRD_CAN: Final = 280
NEWS_BYTES: Final = 65536
ANSWER_S: Final = 1.0  # Maximum time to wait for a reply, s. The kernel replies within the system call.
SYS: Final = Path("/sys")

_HEADER: Final = struct.Struct("=IHHII")
_LINK: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")


class CanDetails(NamedTuple):
    """Bit rate and state of a CAN interface; None if the driver does not report the value (virtual interfaces)."""

    bitrate: int | None  # bit rate of the bus, bit/s
    state: int | None  # `enum can_state`: 0 error-active, 1 warning, 2 error-passive, 3 bus-off


def absence(name: str, sys: Path = SYS) -> str:
    """Return why a CAN interface cannot be used now; empty if it can. Raises LinkError for other interfaces."""
    folder = sys / "class/net" / name
    try:
        kind = int((folder / "type").read_text())
        flags = int((folder / "flags").read_text(), 16)
    except OSError:
        return f"{name} does not exist: expected a CAN interface (`ip link` lists them)"
    if kind != ARPHRD_CAN:
        raise LinkError(f"{name} is not a CAN interface (`ip -details link show type can` lists them)")
    return "" if flags & IFF_UP else f"{name} is down: set its bit rate and bring it up (`ip link set {name} up`)"


def misfit(name: str, sys: Path = SYS) -> tuple[str, bool] | None:
    """Return the reason why this host has no such CAN interface, and whether another kind of interface has this name;
    None if the interface exists."""
    try:
        is_absent = not (sys / "class/net" / name).exists()
        reason = absence(name, sys)
    except LinkError as error:
        return f"expected a CAN interface, got {name}: {error}", True
    return (reason, False) if is_absent else None


def can_interfaces(sys: Path = SYS, *, down: bool = False) -> list[str]:
    """Return the names of the CAN interfaces that are up, sorted. With `down`, include the interfaces that are down."""
    found = []
    for folder in sorted((sys / "class/net").glob("*")):
        with suppress(LinkError):
            if not absence(folder.name, sys) or down:
                found.append(folder.name)
    return found


async def wait_until(holds: Callable[[], bool]) -> None:
    """Return when `holds()` is true. imud calls `holds` again after each change of an interface."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.NETLINK_ROUTE) as news:
        news.bind((0, RTMGRP_LINK))
        changed = asyncio.Event()
        loop = asyncio.get_running_loop()
        loop.add_reader(news.fileno(), changed.set)
        try:
            while not holds():
                await changed.wait()
                changed.clear()
                _drain(news)
        finally:
            loop.remove_reader(news.fileno())


def _drain(news: socket.socket) -> None:
    """Discard the messages. Only their arrival matters, also if they overran the buffer (ENOBUFS)."""
    while True:
        try:
            news.recv(NEWS_BYTES)
        except BlockingIOError:
            return
        except OSError:
            continue


def can_details(name: str) -> CanDetails:
    """Return bit rate and state of a CAN interface. Raises LinkError if the interface does not exist."""
    try:
        index = socket.if_nametoindex(name)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asking:
            asking.settimeout(ANSWER_S)
            size = _HEADER.size + _LINK.size
            asking.send(_HEADER.pack(size, RTM_GETLINK, NLM_F_REQUEST, 1, 0) + _LINK.pack(0, 0, index, 0, 0))
            answer = asking.recv(NEWS_BYTES)
    except OSError as error:
        raise LinkError(f"cannot read the settings of {name}: {error.strerror}") from error
    return parse_details(answer)


def parse_details(answer: bytes) -> CanDetails:
    """Return the details in a reply to RTM_GETLINK."""
    size, kind, *_ = _HEADER.unpack_from(answer)
    if kind != RTM_NEWLINK:
        return CanDetails(None, None)
    info = dict(_attributes(answer[_HEADER.size + _LINK.size : size])).get(IFLA_LINKINFO, b"")
    data = dict(_attributes(dict(_attributes(info)).get(IFLA_INFO_DATA, b"")))
    return CanDetails(_first_u32(data.get(IFLA_CAN_BITTIMING)), _first_u32(data.get(IFLA_CAN_STATE)))


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each complete attribute."""
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        size, kind = _ATTRIBUTE.unpack_from(data, at)
        if size < _ATTRIBUTE.size:
            return
        yield kind & 0x3FFF, data[at + _ATTRIBUTE.size : at + size]
        at += (size + 3) & ~3


def _first_u32(data: bytes | None) -> int | None:
    return int.from_bytes(data[:4], "little" if struct.pack("=H", 1)[0] else "big") if data else None
